"""Motions of a table or an arm, and the repertoire of candidates."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any

import numpy as np

from imu_calibration.core.text_enum import StrEnum
from imu_calibration.core.units import DEG, STANDARD_GRAVITY
from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.kinematics.joint import Joint, JointLimits
from imu_calibration.kinematics.joint_motion import JointMotion, rest_at
from imu_calibration.kinematics.motion_limits import MotionLimits, TrajectoryPoints, limits_of
from imu_calibration.kinematics.table import Table
from imu_calibration.simulation.motion_builder import MotionBuilder, Profile, Segment

TRAJECTORY_STEP_SECONDS = 0.05
"""
Time between the points of a trajectory, s: quintics between them follow the motion to a micrometre.
"""


class MotionKind(StrEnum):
    """Motion of the IMU."""

    MOVE = 'move'
    """A move from one position to another, with as much information as a swing."""
    POSE = 'pose'
    """It rests."""
    SPIN = 'spin'
    """One joint turns at a constant rate."""
    SWING = 'swing'
    """One joint swings."""
    TOGETHER = 'two axes'
    """Several joints move at once."""
    RETURN = 'return'
    """A rest at an earlier position, which shows the change of the biases."""


@dataclass(frozen=True, eq=False)
class PlannedMotion:
    """A motion from rest to rest at one position, with its description."""

    kind: MotionKind
    """Kind of motion."""
    joint_names: tuple[str, ...]
    """Joints in the order of the columns."""
    place: np.ndarray
    """
    Start and end, rad or m, shape (n_joints,); after whole turns an endless joint counts as
    returned.
    """
    segments: tuple[Segment, ...]
    """Segments of the motion."""
    text: str
    """Description of the segments."""
    limits: MotionLimits
    """Limits that it keeps, also in the move to its place."""

    @property
    def seconds(self) -> float:
        """Length without the move to its place, s."""
        return float(sum(segment.duration for segment in self.segments))

    def travel(self, position: np.ndarray) -> tuple[Segment, ...]:
        """
        Return the segments of the move from a position to the place of the motion, () for none.
        """
        return (
            MotionBuilder(len(self.place), limits=self.limits, start=position)
            .move_to(self.place)
            .segments
        )

    def from_position(self, position: np.ndarray) -> tuple[Segment, ...]:
        """
        Return all segments from the present position, with whole turns of endless joints unchanged.
        """
        move = self.travel(position)
        # An endless joint moves the shortest way: the move may end at the place plus full turns.
        shift = (move[-1].end if move else np.asarray(position, float)) - self.place
        shifted = tuple(replace(segment, start=segment.start + shift) for segment in self.segments)
        return move + shifted

    def seconds_from(self, position: np.ndarray) -> float:
        """Return the length with the move to its place, s."""
        return self.seconds + sum(segment.duration for segment in self.travel(position))

    def points(self, position: np.ndarray) -> TrajectoryPoints:
        """
        Return the trajectory from the position where the joints rest to the end of the motion.
        """
        return trajectory(self.joint_names, self.from_position(position))

    @property
    def details(self) -> dict[str, Any]:
        """Numbers of the motion for plan.yaml; angles of joints in degrees, named so."""
        units = np.where(self.limits.turns, 180.0 / np.pi, 1.0)
        rates = [segment.rate_to for segment in self.segments if segment.kind == 'spin']
        details = {'place_deg_or_m': np.round(self.place * units, 4).tolist()}
        if rates:
            details['rates_deg_s_or_m_s'] = np.round(np.array(rates) * units, 4).tolist()
        return details

    @property
    def words(self) -> str:
        """One line of instruction."""
        there = f'go to {place_words(self.joint_names, self.place, self.limits)}'
        return f'{there}, {self.text}' if self.text else there


def trajectory(joint_names: tuple[str, ...], segments: tuple[Segment, ...]) -> TrajectoryPoints:
    """
    Return the points of consecutive segments, one at each transition; no points without motion.
    """
    if not segments:
        return TrajectoryPoints.stop(joint_names)
    transitions = np.concatenate([[0.0], np.cumsum([segment.duration for segment in segments])])
    times_of_segments = []
    for begin, end in zip(transitions[:-1], transitions[1:], strict=True):
        n_steps = max(int(np.ceil((end - begin) / TRAJECTORY_STEP_SECONDS)), 1)
        times_of_segments.append(np.linspace(begin, end, n_steps + 1)[1:])
    times = np.concatenate(times_of_segments)
    motion = motion_at(segments, times)
    rate = motion.rate.copy()
    acceleration = motion.acceleration.copy()
    # At rest at the end, without rounding.
    rate[-1] = 0.0
    acceleration[-1] = 0.0
    return TrajectoryPoints(joint_names, times, motion.position, rate, acceleration)


def motion_at(segments: tuple[Segment, ...], time: np.ndarray) -> JointMotion:
    """Return the joints' motion at times since the start of the first segment."""
    return Profile('plan', tuple(segments)).at(time)


def place_words(names: tuple[str, ...], place: np.ndarray, limits: MotionLimits) -> str:
    """Return the text of a position: ``outer 45°, slide 120 mm``."""
    units = [(1 / DEG, '°') if turning else (1000.0, ' mm') for turning in limits.turns]
    return ', '.join(
        f'{name} {round(value * factor):d}{unit}'
        for name, value, (factor, unit) in zip(names, place, units, strict=True)
    )


N_TRIED = 512
"""
Number of positions from which places are chosen: a power of two, as the Sobol sequence requires.
"""
POSITION_GRID = np.pi / 4
"""
On a table with few joints the positions are multiples of this, so that they include faces, edges
and corners.
"""
ENDLESS_END = 1e9
"""Finite stand-in for the ends of endless joints, rad."""
HEADING = 0.4
"""
Weight of the horizontal axes relative to the vertical in comparisons of attitudes: headings show
the tilt only.
"""


def reachable(limits: MotionLimits) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the (lower, upper) ends within which places are chosen, each of shape (n_joints,).

    For a joint that turns by more than one turn they are half a turn from the middle of its range.
    """
    is_wide = limits.turns & (limits.upper - limits.lower > 2 * np.pi)
    # 0 without ends.
    middle = 0.5 * (np.maximum(limits.lower, -ENDLESS_END) + np.minimum(limits.upper, ENDLESS_END))
    lower = np.where(is_wide, middle - np.pi, limits.lower)
    upper = np.where(is_wide, middle + np.pi, limits.upper)
    return lower, upper


def up_at(table: Table, position: np.ndarray) -> np.ndarray:
    """Return the vertical unit vector in the sensor frame, joints at rest at a position, (3,)."""
    mat_sn = reference_motion(table, rest_at(np.asarray(position, float)[None])).mat_sn[0]
    return mat_sn @ np.array([0.0, 0.0, 1.0])


def candidates(limits: MotionLimits) -> np.ndarray:
    """
    Return positions to choose from, shape (n, n_joints), first the one nearest to zero.

    With at most three joints a grid follows, first where the last joint is near zero, of these
    first where the one before it is; then a Sobol sequence within the reachable range.
    """
    from scipy.stats import qmc  # here, because its import is slow

    lower, upper = reachable(limits)
    home = np.clip(np.zeros(len(limits)), lower, upper)
    sobol = lower + (upper - lower) * qmc.Sobol(len(limits), seed=5).random(N_TRIED)
    if len(limits) > 3:
        return np.concatenate([home[None], sobol])

    steps = []  # of each joint
    for a, b, turning in zip(lower, upper, limits.turns, strict=True):
        if not turning:
            steps.append(np.linspace(a, b, 3))
            continue
        # Multiples of the grid within the limits, up to rounding errors.
        first = np.ceil(a / POSITION_GRID - 1e-9)
        last = np.floor(b / POSITION_GRID + 1e-9)
        steps.append(np.arange(first, last + 1) * POSITION_GRID)
    grid = np.stack(np.meshgrid(*steps, indexing='ij'), axis=-1).reshape(-1, len(limits))
    return np.concatenate([home[None], grid[np.lexsort(np.abs(grid).T)], sobol])


def choose_places(table: Table, limits: MotionLimits) -> np.ndarray:
    """
    Return positions with widely different attitudes, the first at home, shape (n, n_joints).

    Each next position has the attitude furthest from those of the chosen positions; of equally
    distant attitudes the position nearest to zero is chosen, by the order of `candidates`. Fewer
    positions are returned where the remaining attitudes are close to chosen ones.
    """
    positions = candidates(limits)
    mat_sn = reference_motion(table, rest_at(positions)).mat_sn
    # The axes of the level frame in the sensor frame, first the vertical one.
    features = np.concatenate(
        [mat_sn[:, :, 2], HEADING * mat_sn[:, :, 0], HEADING * mat_sn[:, :, 1]], axis=1
    )
    chosen = [0]
    # Distance of each attitude to the nearest chosen one.
    distance = np.linalg.norm(features - features[0], axis=1)
    while len(chosen) < REST_PLACES and distance.max() > 0.05:
        is_furthest = distance > distance.max() - 1e-6
        chosen.append(int(np.argmax(is_furthest)))
        distance = np.minimum(distance, np.linalg.norm(features - features[chosen[-1]], axis=1))
    return positions[chosen]


LIMIT_SHARE = 0.98
"""
Share of speeds and accelerations that is used, so that splines between the points of a trajectory
keep the limits too.
"""
DWELLS = (1.8, 2.5, 4.0, 6.5, 10.0, 16.0)
"""Durations of a rest, s: half a second to settle, and at least one second of window."""
SPIN_TIME = (2.0, 7.0)
"""Seconds for which a constant rate is held at least."""
SWING_TIME = (4.0, 10.0)
"""Seconds of a swing."""
SWING_FREQUENCIES = (0.35, 1.0)
"""Swings, Hz."""
SPEEDS = (1.0, 0.5)
"""Spins, as shares of the largest speed."""
MAX_SWING = {True: 120.0 * DEG, False: 0.3}
"""Amplitude of a swing of a joint that turns, rad, or slides, m, at most."""
REST_PLACES = 20
"""Places for rests."""
# Of a chain with at most three joints:
SPIN_PLACES = 4
"""Places for spins of each joint."""
SWING_PLACES = 3
"""Places for swings of each joint."""
TOGETHER_PLACES = 2
"""Places for motions of each set of joints."""
JOINT_FREQUENCIES = 0.5 * np.array([1.0, 1.4, 0.7, 1.7, 0.6, 1.2, 0.85, 1.55] * 2)
"""Frequencies of joints that swing together, Hz."""


class MotionLibrary:
    """
    The motions of a chain within its limits, and the places where they start and end.

    Parameters
    ----------
    table : Table
    limits : MotionLimits, optional
        Default: the limits of the table.

    """

    def __init__(self, table: Table, limits: MotionLimits | None = None):
        self.table = table
        limits = limits or limits_of(table)
        self.limits = replace(
            limits,
            speed=LIMIT_SHARE * limits.speed,
            acceleration=LIMIT_SHARE * limits.acceleration,
        )
        self.names = tuple(table.joint_names)
        self._moving = np.flatnonzero(limits.upper > limits.lower)
        """Joints that can move, indices."""
        self.spread = choose_places(table, self.limits)
        """Positions of the rests, with the largest differences in attitude first."""
        self.motions = [
            *self._rests(),
            *self._spins(),
            *self._swings(),
            *self._swings_together(),
            *self._spins_together(),
        ]
        self.places = np.unique(np.round([motion.place for motion in self.motions], 9), axis=0)
        """Positions where motions start and end, shape (n_places, n_joints)."""
        nearest = []
        for motion in self.motions:
            nearest.append(int(np.argmin(np.abs(self.places - motion.place).sum(axis=1))))
        self.place_of = np.array(nearest)
        """Index into `places` for each motion."""

    def motion(
        self, kind: MotionKind, place: np.ndarray, segments: tuple[Segment, ...], *, text: str
    ) -> PlannedMotion:
        """Return a motion of the chain within its limits."""
        return PlannedMotion(kind, self.names, place, segments, text, self.limits)

    def _rests(self) -> Iterator[PlannedMotion]:
        """Yield a mere move to each place, and rests of several lengths there."""
        for place in self.spread:
            yield self.motion(MotionKind.MOVE, place, (), text='')
            for dwell in DWELLS:
                segments = self._builder(place).rest(dwell).segments
                yield self.motion(MotionKind.POSE, place, segments, text=f'rest for {dwell:g} s')

    def _spins(self) -> Iterator[PlannedMotion]:
        """Yield turns of each rotating joint: whole ones if endless, otherwise sweeps."""
        for joint in self._moving[self.limits.turns[self._moving]]:
            for place in self._subset(SPIN_PLACES, int(joint)):
                for share in SPEEDS:
                    rates = np.zeros(len(self.names))
                    rates[joint] = share * self.limits.speed[joint]
                    if self.limits.endless[joint]:
                        for sense, seconds in product((1.0, -1.0), SPIN_TIME):
                            yield self._whole_turns(MotionKind.SPIN, place, sense * rates, seconds)
                        continue
                    sweep = self._sweep(place, rates)
                    if sweep is not None:
                        yield sweep

    def _swings(self) -> Iterator[PlannedMotion]:
        """Yield swings of each joint that can move."""
        for joint in self._moving:
            swings = np.arange(len(self.names)) == joint
            for place in self._subset(SWING_PLACES, int(joint) + 1):
                for frequency, seconds in product(SWING_FREQUENCIES, SWING_TIME):
                    yield self._swing(MotionKind.SWING, place, swings, frequency, seconds)

    def _pairs(self) -> list[tuple[int, ...]]:
        """Return the pairs of joints that move together: the last ones, near the sensor."""
        pairs: list[tuple[int, ...]] = list(combinations(self._moving.tolist(), 2))
        return pairs[-6:]

    def _swings_together(self) -> Iterator[PlannedMotion]:
        """Yield swings of pairs of joints, and of all joints, with different frequencies."""
        sets = self._pairs()
        if len(self._moving) > 2:
            sets.append(tuple(self._moving))
        for number, joints in enumerate(sets):
            swings = np.isin(np.arange(len(self.names)), joints)
            frequency = np.full(len(self.names), 0.5)
            frequency[list(joints)] = JOINT_FREQUENCIES[: len(joints)]
            for place in self._subset(TOGETHER_PLACES, number + 2):
                for seconds in SWING_TIME:
                    yield self._swing(MotionKind.TOGETHER, place, swings, frequency, seconds)

    def _spins_together(self) -> Iterator[PlannedMotion]:
        """Yield turns of two endless joints at equal speed, in equal and in opposite sense."""
        for pair in self._pairs():
            joints = list(pair)
            if not self.limits.endless[joints].all():
                continue
            speed = self.limits.speed[joints].min()
            for place in self._subset(TOGETHER_PLACES, int(sum(pair))):
                for sense in (1.0, -1.0):
                    rates = np.zeros(len(self.names))
                    rates[joints] = speed * np.array([1.0, sense])
                    yield self._whole_turns(MotionKind.TOGETHER, place, rates, 4.0)

    def _subset(self, count: int, first: int) -> np.ndarray:
        """
        Return about `count` of the positions, evenly from number `first` on.

        For n > 3 joints only ``3 count / n``, because the number of moves between places grows with
        the square of their number.
        """
        count = max(1, min(count, 3 * count // len(self.names)))
        stride = max(len(self.spread) // count, 1)
        numbers = (np.arange(count) * stride + first) % len(self.spread)
        return self.spread[np.unique(numbers)]

    def _builder(self, place: np.ndarray) -> MotionBuilder:
        """Return a builder of segments that begin at a position."""
        return MotionBuilder(len(self.names), limits=self.limits, start=place)

    def _whole_turns(
        self, kind: MotionKind, place: np.ndarray, rates: np.ndarray, seconds: float
    ) -> PlannedMotion:
        """
        Return a spin at constant rates that ends after whole turns, where it began.

        `place`: start, rad, shape (n_joints,); `rates`: of the joints that turn, all equally fast,
        rad/s, shape (n_joints,), 0 for the others; `seconds`: least time at these rates.
        """
        speed = np.abs(rates).max()

        # Angle of both ramps: that of a spin with one second at the rate, less that second.
        spin_of_one_second = self._spun(place, rates, 1.0)
        turned = sum(segment.end - segment.start for segment in spin_of_one_second)
        ramp_angle = np.abs(turned).max() - speed

        # Fewest whole turns that contain the ramps and the least time; the rate is held for longer
        # to complete the last one.
        n_turns = np.ceil((seconds * speed + ramp_angle) / (2 * np.pi))
        seconds_at_rate = (2 * np.pi * n_turns - ramp_angle) / speed
        noun = 'turn' if n_turns == 1 else 'turns'
        text = f'spin {self._rate_words(rates)} for {n_turns:.0f} whole {noun}'
        return self.motion(kind, place, self._spun(place, rates, seconds_at_rate), text=text)

    def _sweep(self, place: np.ndarray, rates: np.ndarray) -> PlannedMotion | None:
        """
        Return a turn of a limited joint at a constant rate through its range and back.

        It is slower where the time at the rate is too short for a window; None if it always is.
        """
        joint = int(np.argmax(np.abs(rates)))
        lower = self.limits.lower[joint]
        upper = self.limits.upper[joint]
        start = place.copy()
        # 2 % of the range remain free at each end.
        start[joint] = lower + 0.02 * (upper - lower)
        to_and_fro = np.stack([rates, -rates])
        for share in (1.0, 0.6, 0.35, 0.2, 0.1):
            sweep_rates = share * to_and_fro
            longest = self._longest_at_rate(start, sweep_rates, joint)
            if longest >= SPIN_TIME[0]:
                seconds_at_rate = min(longest, SPIN_TIME[1])
                segments = self._spun(start, sweep_rates, seconds_at_rate)
                words = self._rate_words(sweep_rates[0])
                text = f'sweep {words} for {seconds_at_rate:.1f} s and back'
                return self.motion(MotionKind.SPIN, start, segments, text=text)
        return None

    def _longest_at_rate(self, start: np.ndarray, rates: np.ndarray, joint: int) -> float:
        """
        Return how long a joint can turn at a rate if it moves through 96 % of its range, s.

        The ramps before and after are within these 96 % too.

        `rates`: of all joints on the way out and back, shape (2, n_joints).
        """
        one_second = self._spun(start, rates, 1.0)
        time = np.linspace(0.0, sum(segment.duration for segment in one_second), 400)
        travelled = np.abs(motion_at(one_second, time).position[:, joint] - start[joint]).max()
        remaining = 0.96 * (self.limits.upper[joint] - self.limits.lower[joint]) - travelled
        return 1.0 + remaining / np.abs(rates[0, joint])

    def _spun(self, place: np.ndarray, rates: np.ndarray, seconds: float) -> tuple[Segment, ...]:
        """Return the segments of a spin at constant rates (rad/s) for a time, with its ramps."""
        return self._builder(place).spin(np.degrees(rates), seconds).segments

    def _swing(
        self,
        kind: MotionKind,
        place: np.ndarray,
        swings: np.ndarray,
        frequency: np.ndarray | float,
        seconds: float,
    ) -> PlannedMotion:
        """
        Return a swing with the largest amplitude within range, speed and acceleration.

        `swings`: whether each joint swings, shape (n_joints,); `frequency` in Hz, of each or all.
        """
        frequency = np.broadcast_to(frequency, place.shape).astype(float)
        lower, upper = reachable(self.limits)
        # Joints with ends swing about the middle of their range.
        middle = np.where(self.limits.endless | ~swings, place, 0.5 * (lower + upper))
        amplitude = self._largest_amplitude(swings, frequency, seconds)
        swing = self._builder(middle).swing(amplitude, frequency, seconds).segments
        sizes = []
        for k in np.flatnonzero(swings):
            size = f'{1000 * amplitude[k]:.0f} mm'
            if self.limits.turns[k]:
                size = f'{np.degrees(amplitude[k]):.0f}°'
            sizes.append(f'{self.names[k]} by {size} at {frequency[k]:.2g} Hz')
        return self.motion(kind, middle, swing, text=f'swing {", ".join(sizes)} for {seconds:g} s')

    def _largest_amplitude(
        self, swings: np.ndarray, frequency: np.ndarray, seconds: float
    ) -> np.ndarray:
        """
        Return the amplitude of each joint in a swing, rad or m, shape (n_joints,); 0 without one.

        Position, rate and acceleration are proportional to it. Arguments as for `_swing`.
        """
        # Largest position, rate and acceleration of a swing of unit amplitude.
        unit = np.where(swings, 1.0, 0.0)
        unit_swing = self._builder(np.zeros(len(unit))).swing(unit, frequency, seconds).segments
        motion = motion_at(unit_swing, np.linspace(0.0, seconds, int(60 * seconds)))
        largest_position = np.maximum(np.abs(motion.position).max(axis=0), 1e-9)
        largest_rate = np.maximum(np.abs(motion.rate).max(axis=0), 1e-9)
        largest_acceleration = np.maximum(np.abs(motion.acceleration).max(axis=0), 1e-9)

        # The largest amplitude within all limits, less 1 %: the largest values are between the
        # instants of `motion`. Of the range 2 % remain free at each end.
        lower, upper = reachable(self.limits)
        room = np.where(self.limits.endless, np.inf, 0.48 * (upper - lower))
        reach = [
            room / largest_position,
            self.limits.speed / largest_rate,
            self.limits.acceleration / largest_acceleration,
            np.array([MAX_SWING[bool(turning)] for turning in self.limits.turns]),
        ]
        return 0.99 * unit * np.minimum.reduce(reach)

    def _rate_words(self, rates: np.ndarray) -> str:
        """Return the joints that turn and their rates (rad/s) as text."""
        return ' and '.join(
            f'{name} at {np.degrees(rate):+.0f} deg/s'
            for name, rate in zip(self.names, rates, strict=True)
            if rate
        )


SPEED = 60.0 * DEG
"""Rotation of a mobile base on the spot, rad/s."""
ACCELERATION = 90.0 * DEG
"""The same, rad/s^2."""


def yaw_table(gravity: float | None = None) -> Table:
    """
    Return the table of a mobile base that turns on the spot: one vertical joint without end.

    Its angle is measured by odometry or by marks on the floor.
    """
    joint = Joint(
        'yaw', (0.0, 0.0, 1.0), limits=JointLimits(None, None, SPEED, ACCELERATION, endless=True)
    )
    return Table(
        (joint,),
        gravity=STANDARD_GRAVITY if gravity is None else gravity,
        mount_xyz=(0.0, 0.0, 0.0),
    )
