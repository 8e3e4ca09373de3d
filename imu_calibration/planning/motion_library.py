"""Motions of a table or an arm, and the repertoire of candidates."""

from __future__ import annotations

from collections.abc import Sequence
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
    """Limits that it keeps, with which the way to it is timed."""

    @property
    def seconds(self) -> float:
        """Length without the way to its place, s."""
        return float(sum(segment.duration for segment in self.segments))

    def travel(self, position: np.ndarray) -> tuple[Segment, ...]:
        """
        Return the way from where the joints are to the place of the motion: one move, or none.
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
        way = self.travel(position)
        shift = (way[-1].end if way else np.asarray(position, float)) - self.place
        return way + tuple(
            replace(segment, start=segment.start + shift) for segment in self.segments
        )

    def seconds_from(self, position: np.ndarray) -> float:
        """Return the length with the way to its place, s."""
        return self.seconds + sum(segment.duration for segment in self.travel(position))

    def points(self, position: np.ndarray) -> TrajectoryPoints:
        """
        Return the trajectory from where the joints rest.

        Positions, velocities and accelerations, at rest at the end.
        """
        return trajectory(self.joint_names, self.from_position(position))

    @property
    def details(self) -> dict[str, Any]:
        """Numbers of the motion for plan.yaml; angles of joints in degrees, named so."""
        units = np.where(self.limits.turns, 180.0 / np.pi, 1.0)
        rates = [segment.rate_to for segment in self.segments if segment.kind == 'spin']
        found = {'place_deg_or_m': np.round(self.place * units, 4).tolist()}
        return found | (
            {'rates_deg_s_or_m_s': np.round(np.array(rates) * units, 4).tolist()} if rates else {}
        )

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
    edges = np.concatenate([[0.0], np.cumsum([segment.duration for segment in segments])])
    times = np.concatenate(
        [
            np.linspace(a, b, max(int(np.ceil((b - a) / TRAJECTORY_STEP_SECONDS)), 1) + 1)[1:]
            for a, b in zip(edges, edges[1:], strict=False)
        ]
    )
    motion = motion_at(segments, times)
    rate = motion.rate.copy()
    acceleration = motion.acceleration.copy()
    rate[-1], acceleration[-1] = 0.0, 0.0
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
    Return the ends within which places are chosen.

    Of joints that turn, at most one turn about the middle of the range.
    """
    wide = limits.turns & (limits.upper - limits.lower > 2 * np.pi)
    # 0 without ends.
    middle = 0.5 * (np.maximum(limits.lower, -ENDLESS_END) + np.minimum(limits.upper, ENDLESS_END))
    return np.where(wide, middle - np.pi, limits.lower), np.where(
        wide, middle + np.pi, limits.upper
    )


def up_at(table: Table, position: np.ndarray) -> np.ndarray:
    """
    Return which direction of the sensor frame points up at a position.

    The joints rest at the position. The direction is a unit vector, shape (3,).
    """
    return reference_motion(table, rest_at(np.asarray(position, float)[None])).mat_sn[0] @ np.array(
        [0.0, 0.0, 1.0]
    )


def candidates(limits: MotionLimits) -> np.ndarray:
    """Return positions to choose from, the first that nearest to zero, shape (n, n_joints)."""
    from scipy.stats import qmc  # here, because its import is slow

    lower, upper = reachable(limits)
    home = np.clip(np.zeros(len(limits)), lower, upper)
    spread = lower + (upper - lower) * qmc.Sobol(len(limits), seed=5).random(N_TRIED)
    parts = [home[None], spread]
    if len(limits) <= 3:
        steps = []
        for a, b, turning in zip(lower, upper, limits.turns, strict=True):
            if not turning:
                steps.append(np.linspace(a, b, 3))
                continue
            # Multiples of the grid within the limits, those of rounding errors included.
            first = np.ceil(a / POSITION_GRID - 1e-9)
            last = np.floor(b / POSITION_GRID + 1e-9)
            steps.append(np.arange(first, last + 1) * POSITION_GRID)
        grid = np.stack(np.meshgrid(*steps, indexing='ij'), axis=-1).reshape(-1, len(limits))
        parts.insert(1, grid[np.lexsort(np.abs(grid).T)])
    return np.concatenate(parts)


def choose_places(table: Table, limits: MotionLimits) -> np.ndarray:
    """
    Return positions whose attitudes have the largest distances, the first at home.

    Shape (n, n_joints).

    Each next position has the attitude furthest from those of the chosen positions; of equally
    distant attitudes the position nearest to zero is chosen, by the order of `candidates`. Fewer
    positions are returned where the remaining attitudes are close to chosen ones.
    """
    tried = candidates(limits)
    mats = reference_motion(table, rest_at(tried)).mat_sn
    features = np.concatenate(
        [mats[:, :, 2], HEADING * mats[:, :, 0], HEADING * mats[:, :, 1]], axis=1
    )
    chosen = [0]
    distance = np.linalg.norm(features - features[0], axis=1)
    while len(chosen) < REST_PLACES and distance.max() > 0.05:
        nearly = distance > distance.max() - 1e-6
        chosen.append(int(np.argmax(nearly)))
        distance = np.minimum(distance, np.linalg.norm(features - features[chosen[-1]], axis=1))
    return tried[chosen]


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
REST_PLACES, SPIN_PLACES, SWING_PLACES, TOGETHER_PLACES = 20, 4, 3, 2
"""
Places for rests; for spins and for swings of each joint, and for each set of joints, of a chain
with at most three joints.
"""


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
        self.limits = MotionLimits(
            limits.lower,
            limits.upper,
            LIMIT_SHARE * limits.speed,
            LIMIT_SHARE * limits.acceleration,
            limits.turns,
        )
        self.names = tuple(table.joint_names)
        self.spread = choose_places(table, self.limits)
        self.motions = [
            PlannedMotion(kind, self.names, place, segments, text, self.limits)
            for kind, place, segments, text in (
                *self._rests(),
                *self._spins(),
                *self._swings(),
                *self._together(),
            )
        ]
        self.places = np.unique(np.round([motion.place for motion in self.motions], 9), axis=0)
        nearest = []
        for motion in self.motions:
            nearest.append(int(np.argmin(np.abs(self.places - motion.place).sum(axis=1))))
        self.place_of = np.array(nearest)

    def _rests(self):
        for place in self.spread:
            yield MotionKind.MOVE, place, (), ''
            for dwell in DWELLS:
                yield (
                    MotionKind.POSE,
                    place,
                    self._builder(place).rest(dwell).segments,
                    f'rest for {dwell:g} s',
                )

    def _spins(self):
        moving = np.flatnonzero(self.limits.turns & (self.limits.upper > self.limits.lower))
        for joint in moving:
            for place in self._subset(SPIN_PLACES, int(joint)):
                for share in SPEEDS:
                    rates = np.zeros(len(self.names))
                    rates[joint] = share * self.limits.speed[joint]
                    if self.limits.endless[joint]:
                        for sense, seconds in product((1.0, -1.0), SPIN_TIME):
                            turns = self._whole_turns(place, sense * rates, seconds)
                            yield MotionKind.SPIN, *turns
                    elif made := self._sweep(place, rates):
                        yield MotionKind.SPIN, *made

    def _swings(self):
        for joint in np.flatnonzero(self.limits.upper > self.limits.lower):
            for place in self._subset(SWING_PLACES, int(joint) + 1):
                for frequency in SWING_FREQUENCIES:
                    shares = np.zeros(len(self.names))
                    shares[joint] = 1.0
                    for seconds in SWING_TIME:
                        yield MotionKind.SWING, *self._swing(place, shares, frequency, seconds)

    def _together(self):
        moving = np.flatnonzero(self.limits.upper > self.limits.lower)
        pairs = [pair for pair in combinations(moving, 2)][-6:]
        sets = [*pairs, *([tuple(moving)] if len(moving) > 2 else [])]
        for number, joints in enumerate(sets):
            for place in self._subset(TOGETHER_PLACES, number + 2):
                frequency = np.full(len(self.names), 0.5)
                frequency[list(joints)] = (
                    0.5 * np.array([1.0, 1.4, 0.7, 1.7, 0.6, 1.2, 0.85, 1.55] * 2)[: len(joints)]
                )
                for seconds in SWING_TIME:
                    yield (
                        MotionKind.TOGETHER,
                        *self._swing(
                            place, np.isin(np.arange(len(self.names)), joints), frequency, seconds
                        ),
                    )
        for pair in pairs:
            if self.limits.endless[list(pair)].all():
                for place in self._subset(TOGETHER_PLACES, int(pair[0] + pair[1])):
                    for sense in (1.0, -1.0):
                        rates = np.zeros(len(self.names))
                        rates[list(pair)] = self.limits.speed[list(pair)].min() * np.array(
                            [1.0, sense]
                        )
                        yield MotionKind.TOGETHER, *self._whole_turns(place, rates, 4.0)

    def _subset(self, count: int, first: int) -> np.ndarray:
        """
        Return a subset of the positions, different for each motion.

        Fewer for a long chain, because moves grow with their square.
        """
        count = max(1, min(count, 3 * count // len(self.names)))
        some = (np.arange(count) * max(len(self.spread) // count, 1) + first) % len(self.spread)
        return self.spread[np.unique(some)]

    def _builder(self, place):
        return MotionBuilder(len(self.names), limits=self.limits, start=place)

    def _whole_turns(self, place, rates, seconds):
        """Turn at constant rates for at least `seconds`, until endless joints have returned."""
        speed = np.abs(rates).max()
        ramp = self._spun(place, rates, 1.0)
        extra = np.abs(sum(segment.end - segment.start for segment in ramp)).max() - speed
        turns = np.ceil((seconds * speed + extra) / (2 * np.pi))
        held = (2 * np.pi * turns - extra) / speed
        ending = 'turn' if turns == 1 else 'turns'
        return (
            place,
            self._spun(place, rates, held),
            f'spin {self._rate_words(rates)} for {turns:.0f} whole {ending}',
        )

    def _sweep(self, place, rates):
        """
        Turn a limited joint at a constant rate through its range and back.

        None if that is too short for a window.
        """
        joint = int(np.argmax(np.abs(rates)))
        lower = self.limits.lower[joint]
        upper = self.limits.upper[joint]
        start = place.copy()
        start[joint] = lower + 0.02 * (upper - lower)
        there = np.stack([rates, -rates])
        for share in (1.0, 0.6, 0.35, 0.2, 0.1):
            held = self._longest(start, share * there, joint)
            if held >= SPIN_TIME[0]:
                segments = self._spun(start, share * there, min(held, SPIN_TIME[1]))
                return (
                    start,
                    segments,
                    (
                        f'sweep {self._rate_words(share * rates)} for {min(held, SPIN_TIME[1]):.1f}'
                        ' s and back'
                    ),
                )
        return None

    def _longest(self, start, rates, joint):
        """Return the time at a rate until the end of the range, s."""
        trial = self._spun(start, rates, 1.0)
        time = np.linspace(0.0, sum(segment.duration for segment in trial), 400)
        reached = np.abs(motion_at(trial, time).position[:, joint] - start[joint]).max()
        return 1.0 + (
            0.96 * (self.limits.upper[joint] - self.limits.lower[joint]) - reached
        ) / np.abs(rates[0, joint])

    def _spun(self, place, rates, seconds) -> tuple[Segment, ...]:
        return self._builder(place).spin(np.degrees(rates), seconds).segments

    def _swing(self, place, shares, frequency, seconds):
        """Swing with the largest amplitude within range, speed and acceleration."""
        # Largest position, rate and acceleration of a swing of unit amplitude.
        frequency = np.broadcast_to(frequency, place.shape).astype(float)
        unit = np.where(shares, 1.0, 0.0)
        unit_swing = self._builder(np.zeros(len(place))).swing(unit, frequency, seconds).segments
        motion = motion_at(unit_swing, np.linspace(0.0, seconds, int(60 * seconds)))
        largest_position = np.maximum(np.abs(motion.position).max(axis=0), 1e-9)
        largest_rate = np.maximum(np.abs(motion.rate).max(axis=0), 1e-9)
        largest_acceleration = np.maximum(np.abs(motion.acceleration).max(axis=0), 1e-9)

        # The largest amplitude within all limits, less 1 %: the largest values are between the
        # instants of `motion`.
        lower, upper = reachable(self.limits)
        room = np.where(self.limits.endless, np.inf, 0.48 * (upper - lower))
        reach = [
            room / largest_position,
            self.limits.speed / largest_rate,
            self.limits.acceleration / largest_acceleration,
            np.array([MAX_SWING[bool(turning)] for turning in self.limits.turns]),
        ]
        amplitude = 0.99 * unit * np.minimum.reduce(reach)
        middle = np.where(self.limits.endless | (unit == 0), place, 0.5 * (lower + upper))
        swing = self._builder(middle).swing(amplitude, frequency, seconds).segments

        sizes = []
        for k in np.flatnonzero(unit):
            size = f'{1000 * amplitude[k]:.0f} mm'
            if self.limits.turns[k]:
                size = f'{np.degrees(amplitude[k]):.0f}°'
            sizes.append(f'{self.names[k]} by {size} at {frequency[k]:.2g} Hz')
        return middle, swing, f'swing {", ".join(sizes)} for {seconds:g} s'

    def _rate_words(self, rates: Sequence[float]) -> str:
        return ' and '.join(
            f'{name} at {np.degrees(rate):+.0f} deg/s'
            for name, rate in zip(self.names, rates, strict=True)
            if rate
        )


SPEED, ACCELERATION = 60.0 * DEG, 90.0 * DEG
"""Rotation of a mobile base on the spot, rad/s and rad/s^2."""


def yaw_table(gravity: float | None = None) -> Table:
    """
    Return the table.

    One vertical joint without end, whose angle is known from odometry or marks on the floor.
    """
    joint = Joint(
        'yaw', (0.0, 0.0, 1.0), limits=JointLimits(None, None, SPEED, ACCELERATION, endless=True)
    )
    return Table(
        (joint,),
        gravity=STANDARD_GRAVITY if gravity is None else gravity,
        mount_xyz=(0.0, 0.0, 0.0),
    )
