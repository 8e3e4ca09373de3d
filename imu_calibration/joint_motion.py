"""Motion of the joints at given instants, and small errors of it (encoder harmonics, delay)."""

from dataclasses import dataclass, fields, replace

import numpy as np


@dataclass(frozen=True, eq=False)
class JointMotion:
    """Angles of the joints and their first three derivatives; columns in the order of the table's joints."""

    time: np.ndarray
    """Seconds, shape (n,)."""
    position: np.ndarray
    """Joint angles, rad, shape (n, n_joints)."""
    rate: np.ndarray
    """First derivative, rad/s, shape (n, n_joints)."""
    acceleration: np.ndarray
    """Second derivative, rad/s^2, shape (n, n_joints)."""
    jerk: np.ndarray
    """Third derivative, rad/s^3, shape (n, n_joints)."""

    def __len__(self):
        return len(self.time)

    def select(self, index):
        """Return the motion at `index` (slice, mask or integer array)."""
        return JointMotion(**{f.name: getattr(self, f.name)[index] for f in fields(self)})


def with_encoder_harmonics(motion, order, cos_amplitude, sin_amplitude):
    """
    Return the true motion behind encoders with a harmonic error, ``q_true = q + c cos(k q) + s sin(k q)``.

    Rates, accelerations and jerks are the exact derivatives.

    Parameters
    ----------
    motion : JointMotion
        Motion as the encoders tell it.
    order : int
        Periods per turn, k.
    cos_amplitude, sin_amplitude : array, shape (n_joints,)
        Amplitudes c and s, rad.

    """
    phase = order * motion.position
    cos, sin = np.cos(phase), np.sin(phase)
    error = np.asarray(cos_amplitude) * cos + np.asarray(sin_amplitude) * sin
    slope = order * (np.asarray(sin_amplitude) * cos - np.asarray(cos_amplitude) * sin)
    curvature, third = -order ** 2 * error, -order ** 2 * slope
    rate, acceleration = motion.rate, motion.acceleration
    return replace(motion, position=motion.position + error, rate=rate * (1 + slope),
                   acceleration=acceleration * (1 + slope) + curvature * rate ** 2,
                   jerk=motion.jerk * (1 + slope) + 3 * curvature * rate * acceleration + third * rate ** 3)


def shifted(motion, delay):
    """
    Return the motion at ``time - delay``, with `time` left as it is: what the IMU felt when its stamps are `delay` late.

    Taylor series with the jerk as the last derivative: the position's error is of fourth order in `delay`.

    Parameters
    ----------
    motion : JointMotion
        Motion at the stamps.
    delay : float
        Seconds; positive when the IMU's stamps are late.

    """
    rate, acceleration, jerk = motion.rate, motion.acceleration, motion.jerk
    return replace(motion, position=motion.position - delay * (rate - delay / 2 * (acceleration - delay / 3 * jerk)),
                   rate=rate - delay * (acceleration - delay / 2 * jerk), acceleration=acceleration - delay * jerk)
