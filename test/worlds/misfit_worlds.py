"""
Pairs of sessions of one IMU in worlds where something goes on that no catalogue of effects holds.

`make_pair` returns a first session to calibrate on and a second one to compensate: the same unit,
table and cause, another motion and other noise. Each cause is made by its physics at the place
where it acts: the motor moves the table, the encoder is read, the fixture gives way, the filter
runs, the driver stamps.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.signal import cont2discrete, lfilter

from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.simulation.motion_builder import MotionBuilder, Profile

from worlds.physics import Session, make_session
from worlds.physics_cause import Cause
from worlds.physics_draw import ARCMIN, DEG, generator

SHAFT = {
    'joints': [{'name': 'shaft', 'axis': [1, 0, 0]}],
    'up': [0, 1, 0],
    'gravity': 9.80665,
    'latitude': None,
    'mount': {'rpy_deg': [0, 0, 0], 'xyz': None},
}
"""A horizontal motor shaft, as in recordings of hardware."""
FINE_RATE = 1000.0
"""Rate of the grid on which what a motor does is differentiated, Hz."""


@dataclass(frozen=True, eq=False)
class Disturbed:
    """A motion with a displacement of every joint on top, differentiated on a fine grid."""

    moves: Profile
    """What the joints were told to do."""
    displacement: object
    """Function of (time, JointMotion) -> displacement, rad, shape (n, n_joints)."""

    def __post_init__(self):
        time = np.arange(-0.1, self.moves.duration + 0.1, 1.0 / FINE_RATE)
        object.__setattr__(
            self,
            '_curve',
            make_interp_spline(time, self.displacement(time, self.moves.at(time)), k=5),
        )

    @property
    def duration(self):
        """Length, s."""
        return self.moves.duration

    def find(self, kind):
        """Return (start, end) of every segment of a kind of what was told."""
        return self.moves.find(kind)

    def at(self, time):
        """Return the true JointMotion."""
        told, time = self.moves.at(time), np.atleast_1d(time)
        parts = [
            getattr(told, name) + self._curve(time, order)
            for order, name in enumerate(('position', 'rate', 'acceleration', 'jerk'))
        ]
        return JointMotion(told.time, *parts)


class MotorRipple(Cause):
    """
    The torque of a motor varies with its angle at several orders, poles and steps.

    The joint runs ahead and behind.
    """

    ORDERS, AMPLITUDES = (6, 24, 50), (2e-3, 4e-4, 1.5e-4)

    def __init__(self, size=1.0, rng=None):
        super().__init__(size, rng)
        self.phase = rng.uniform(0.0, 2.0 * np.pi, (len(self.ORDERS), 8))

    def moved(self, moves):
        """Add the ripple of every order."""

        def ripple(time, motion):
            waves = [
                amplitude * np.sin(order * motion.position + phase[: motion.position.shape[1]])
                for order, amplitude, phase in zip(self.ORDERS, self.AMPLITUDES, self.phase)
            ]
            return self.size * np.sum(waves, axis=0)

        return Disturbed(moves, ripple)


class Cogging(Cause):
    """
    Magnets pull the joint into detents.

    At low speed it sticks and jumps, at high speed inertia carries it over.
    """

    DETENTS, DEPTH, SMOOTH_FROM = 48, 5e-3, 30.0 * DEG

    def moved(self, moves):
        """Pull the joint towards the nearest detent, the less the faster it turns."""

        def pull(time, motion):
            depth = self.size * self.DEPTH / (1.0 + (motion.rate / self.SMOOTH_FROM) ** 2)
            return -depth * np.sin(self.DETENTS * motion.position)

        return Disturbed(moves, pull)


class Backlash(Cause):
    """
    The encoder sits on the motor's side of a gear with play.

    After each reversal the motor crosses the play while friction holds the load.
    """

    PLAY, CROSSING = 0.25 * DEG, 0.04

    def encoder_error(self, time, motion):
        """Return half the play in the direction of the last motion; crossing it takes a moment."""
        fine = np.arange(time[0], time[-1] + 1.0 / FINE_RATE, 1.0 / FINE_RATE)
        side = _last_sign(np.stack([np.interp(fine, time, rate) for rate in motion.rate.T], axis=1))
        decay = np.exp(-1.0 / FINE_RATE / self.CROSSING)
        for _ in range(2):
            side = lfilter([1.0 - decay], [1.0, -decay], side, axis=0, zi=side[:1] * decay)[0]
        error = 0.5 * self.size * self.PLAY * side
        slope = np.gradient(error, 1.0 / FINE_RATE, axis=0)
        return tuple(
            np.stack([np.interp(time, fine, column) for column in part.T], axis=1)
            for part in (error, slope)
        )


def _last_sign(rate):
    """Return the sign of the last motion, 1 before the first, shape (n, n_joints)."""
    moving = np.abs(rate) > 0.05 * DEG
    last = np.maximum.accumulate(np.where(moving, np.arange(len(rate))[:, None], 0), axis=0)
    return np.where(
        np.take_along_axis(moving, last, axis=0),
        np.sign(np.take_along_axis(rate, last, axis=0)),
        1.0,
    )


class EncoderEccentricity(Cause):
    """
    The encoder's disc runs out of true and is not round.

    Its reading errs with the first and the second harmonic of the angle.
    """

    ORDERS, AMPLITUDES = (1, 2), (8.0 * ARCMIN, 4.0 * ARCMIN)

    def __init__(self, size=1.0, rng=None):
        super().__init__(size, rng)
        self.phase = rng.uniform(0.0, 2.0 * np.pi, (len(self.ORDERS), 8))

    def encoder_error(self, time, motion):
        """Return the error of the reading at the true angle."""
        n_joints, error, slope = motion.position.shape[1], 0.0, 0.0
        for order, amplitude, phase in zip(self.ORDERS, self.AMPLITUDES, self.phase):
            angle = order * motion.position + phase[:n_joints]
            error = error + self.size * amplitude * np.sin(angle)
            slope = slope + self.size * amplitude * order * np.cos(angle) * motion.rate
        return error, slope


class GearEccentricity(EncoderEccentricity):
    """The same before a gear of 5 to 1: harmonics five and ten of the table's angle."""

    ORDERS, AMPLITUDES = (5, 10), (4.0 * ARCMIN, 1.5 * ARCMIN)


class FlexibleMount(Cause):
    """
    The bracket is a spring that the IMU's inertia winds up and gravity bends.

    It turns against the plate, and rings.
    """

    FREQUENCY, DAMPING, SAG = 9.0, 0.15, 0.3 * DEG
    oversampling = 8

    def carried(self, time, force_s, rate_s, alpha_s):
        """
        Turn force and rate by the bracket's deflection theta, to first order.

        ``theta'' + 2 d w theta' + w^2 theta = size (w^2 sag (e x f) / g - alpha)``, e a lever to
        the centre of mass.
        """
        omega, step = 2.0 * np.pi * self.FREQUENCY, time[1] - time[0]
        drive = self.size * (omega**2 * self.SAG * np.cross(_lever(), force_s) / 9.80665 - alpha_s)
        matrices = (
            np.array([[0.0, 1.0], [-(omega**2), -2.0 * self.DAMPING * omega]]),
            np.array([[0.0], [1.0]]),
            np.eye(2),
            np.zeros((2, 1)),
        )
        a, b = cont2discrete(matrices, step)[:2]
        # both states have the same poles: as filters of the second order that start in balance
        poles, adjugate = np.poly(a), np.array([[-a[1, 1], a[0, 1]], [a[1, 0], -a[0, 0]]]) @ b
        base = drive[:1]
        turn, rate = (
            lfilter([0.0, b[k, 0], adjugate[k, 0]], poles, drive - base, axis=0) for k in range(2)
        )
        turn = turn + base / omega**2
        return force_s - np.cross(turn, force_s), rate_s - np.cross(turn, rate_s) + rate


def _lever():
    return np.array([0.6, -0.5, 0.62])


class RateDependentLag(Cause):
    """
    The device's firmware works longer when it turns faster.

    What it hands on is old, by more at high rates.
    """

    AT_REST, PER_RATE = 4e-3, 4e-3
    oversampling = 4

    def delivered(self, time, outputs, rate_s):
        """Read the outputs at a time that lies back by the lag."""
        lag = self.size * (self.AT_REST + self.PER_RATE * np.linalg.norm(rate_s, axis=1))
        # straight lines between the samples would take 7e-4 off a ripple of 6 Hz
        return [CubicSpline(time, out)(np.maximum(time - lag, time[0])) for out in outputs]


class DriverLag(RateDependentLag):
    """An ordinary driver: every reading is 12 ms old when it is stamped."""

    AT_REST, PER_RATE = 12e-3, 0.0


class LagJitter(Cause):
    """
    The transport takes a time that differs from message to message and wanders, seldom much.

    Stamps of arrival.
    """

    SMALLEST, MEAN, WANDER = 2e-3, 3e-3, 2e-3

    def stamped(self, time, rng):
        """Return a gamma-distributed delay with a slow wander, in the order of arrival."""
        every_ten = np.arange(0.0, time[-1] + 20.0, 10.0)
        slow = np.interp(time, every_ten, rng.uniform(0.0, 1.0, len(every_ten)))
        late = self.size * (
            self.SMALLEST + rng.gamma(2.0, self.MEAN / 2.0, len(time)) + self.WANDER * slow
        )
        return np.maximum.accumulate(time + late) - time


class StampBursts(Cause):
    """
    The driver's thread is held up now and then.

    What queued is delivered at once and stamped on arrival.
    """

    EVERY, HELD_UP = 4.0, 0.08

    def stamped(self, time, rng):
        """Return the time that each message waited."""
        starts = np.cumsum(rng.exponential(self.EVERY, int(3 * time[-1] / self.EVERY) + 10))
        ends = starts + self.size * rng.uniform(0.3, 1.0, len(starts)) * self.HELD_UP
        k = np.searchsorted(starts, time, side='right') - 1
        late = np.where(k >= 0, np.maximum(ends[np.maximum(k, 0)] - time, 0.0), 0.0)
        # Messages follow one another by a tenth of a millisecond at least.
        order = np.arange(len(time)) * 1e-4
        return np.maximum.accumulate(time + late - order) + order - time


CAUSES = {
    'motor_ripple': MotorRipple,
    'cogging': Cogging,
    'backlash': Backlash,
    'encoder_eccentricity': EncoderEccentricity,
    'gear_eccentricity': GearEccentricity,
    'flexible_mount': FlexibleMount,
    'rate_dependent_lag': RateDependentLag,
    'lag_jitter': LagJitter,
    'stamp_bursts': StampBursts,
    'driver_lag': DriverLag,
}
"""Causes by name."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Two sessions of one unit in one world, each made when it is first read."""

    cause: str | None
    """Name in `CAUSES`; None: a clean world."""
    made: Callable[[int], Session]
    """Makes the first session (0) or the second (1)."""

    @cached_property
    def first(self) -> Session:
        """Return the session to calibrate on."""
        return self.made(0)

    @cached_property
    def second(self) -> Session:
        """Return the session to compensate: another motion, other noise, another start."""
        return self.made(1)

    @property
    def table(self):
        """Return the table description, as in the table's YAML."""
        return self.first.table


def make_pair(
    cause,
    seed,
    *,
    size=1.0,
    table='three_axis',
    profile='quick',
    noise='realistic',
    grade='industrial',
    **options,
):
    """
    Return the `Pair` of a world.

    Parameters
    ----------
    cause : str or None
        Name in `CAUSES`; None: nothing beside what the model holds.
    seed : int
        Draws the unit, the motions, the cause's phases and the noise.
    size : float
        Of the cause; 1: clearly visible, 0: none.
    table, profile : str or dict, str
        As for `worlds.physics.make_session`; table 'shaft' with profile 'sweeps': one joint swept
        to and fro, a quarter faster in the second session.
    noise, grade, options
        As for `worlds.physics.make_session`.

    """
    kind = None if cause is None else CAUSES[cause]

    def made(number):
        acting = None if kind is None else kind(size, generator(seed, f'cause {cause}'))
        motion = sweeps(1.0 + 0.25 * number) if profile == 'sweeps' else profile
        return make_session(
            2 * seed + number,
            noise=noise,
            grade=grade,
            table=SHAFT if table == 'shaft' else table,
            profile=motion,
            unit=seed,
            cause=acting,
            **options,
        )

    return Pair(cause, made)


def sweeps(pace=1.0, seconds=100.0):
    """
    Return what a motor that advances in jerks does.

    190 deg/s to and fro at pace 1 with 6 Hz on top, between rests.
    """
    builder = MotionBuilder(1)
    builder.rest(5.0)
    for _ in range(round(seconds / 25.0)):
        builder.oscillate([[60.0], [6.0]], [[0.5 * pace], [6.0]], 20.0, fade=1.0)
        builder.rest(5.0)
    return Profile('sweeps', tuple(builder.segments))
