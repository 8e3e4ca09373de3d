"""Errors of angle encoders: the steps that show in readings, and harmonics of the turn."""

from dataclasses import replace

import numpy as np

from imu_calibration.reference.joint_motion import JointMotion


def with_encoder_harmonics(motion: JointMotion, order: int, cos_amplitude: np.ndarray, *, sin_amplitude: np.ndarray) -> JointMotion:
    """
    Return the true motion behind encoders with a harmonic error, ``q_true = q + c cos(k q) + s sin(k q)``.

    Rates, accelerations and jerks are the exact derivatives.

    Parameters
    ----------
    motion : JointMotion
        Motion measured by the encoders.
    order : int
        Periods per turn, k.
    cos_amplitude, sin_amplitude : array, shape (n_joints,)
        Amplitudes c and s, rad.

    """
    cos_amplitude, sin_amplitude = (np.broadcast_to(np.asarray(a, float), motion.position.shape[1:]) for a in (cos_amplitude,
                                                                                                               sin_amplitude))
    wrong = np.flatnonzero((cos_amplitude != 0) | (sin_amplitude != 0))
    if not len(wrong):
        return motion
    phase, rate, acceleration = order * motion.position[:, wrong], motion.rate[:, wrong], motion.acceleration[:, wrong]
    cos, sin = np.cos(phase), np.sin(phase)
    error = cos_amplitude[wrong] * cos + sin_amplitude[wrong] * sin
    slope = order * (sin_amplitude[wrong] * cos - cos_amplitude[wrong] * sin)
    curvature, third = -order ** 2 * error, -order ** 2 * slope
    moved = {name: getattr(motion, name).copy() for name in ('position', 'rate', 'acceleration', 'jerk')}
    moved['position'][:, wrong] += error
    moved['rate'][:, wrong] *= 1 + slope
    moved['acceleration'][:, wrong] = acceleration * (1 + slope) + curvature * rate ** 2
    moved['jerk'][:, wrong] = motion.jerk[:, wrong] * (1 + slope) + 3 * curvature * rate * acceleration + third * rate ** 3
    return replace(motion, **moved)


def encoder_step(position: np.ndarray) -> float:
    """
    Return the resolution of an encoder that shows in its readings, or 0.

    Looks at isolated jumps, those between readings that repeat; they are one step high. Readings that move by many steps
    from sample to sample have none; their quantisation is white and needs no notice.
    """
    change = np.diff(position)
    moved = change != 0
    isolated = np.abs(change[1:-1][moved[1:-1] & ~moved[:-2] & ~moved[2:]])
    if not len(isolated):
        return 0.0
    step = np.median(isolated)
    return float(step) if np.mean(np.abs(isolated / step - 1) < 0.15) > 0.8 else 0.0
