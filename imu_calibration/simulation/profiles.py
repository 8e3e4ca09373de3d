"""Named motions of a turntable, for the verb simulate and the simulator node."""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from imu_calibration.core.errors import InputError, did_you_mean
from imu_calibration.kinematics.motion_limits import MotionLimits, free_limits, limits_of
from imu_calibration.kinematics.table import Table
from imu_calibration.simulation.motion_builder import MotionBuilder, Profile, Segment, stretch
from imu_calibration.simulation.motion_primitives import (
    FACES,
    GIMBALS,
    PAPER_PROFILES,
    ProfileEntry,
    Task,
    poses,
    run,
    simultaneous,
    spin_joint,
    spin_vertical,
    swing,
    swing_at,
    swings,
    two_axes,
)

_SIGNS = list(product((1, -1), repeat=2))
EDGES = np.array(
    [[a, b, 0] for a, b in _SIGNS] + [[a, 0, b] for a, b in _SIGNS] + [[0, a, b] for a, b in _SIGNS]
) / np.sqrt(2)
"""Directions to the middles of the edges of a cube, shape (12, 3)."""
CORNERS = np.array(list(product((1, -1), repeat=3))) / np.sqrt(3)
"""Directions to the corners of a cube, shape (8, 3)."""

MAX_PROFILE_SWING = 0.5
"""Amplitude of a swing at most, rad or m."""


def within_limits(
    builder: MotionBuilder,
    rng: np.random.Generator,
    n_poses: int = 24,
    *,
    frequencies: Sequence[float] = (0.25, 0.5, 1.0),
    swing_time: float = 5.0,
    n_other: int = 20,
) -> None:
    """
    Append poses, swings of one joint and of two at once, and spins of joints without an end.

    Each joint swings together with at most `n_other` joints before it, for `swing_time` s.
    """
    limits = builder.limits
    count = builder.n_joints
    lower, upper = _turn_or_range(limits)
    moving = np.flatnonzero(upper > lower)

    def spread_positions(n: int) -> np.ndarray:
        """Return n positions, each joint evenly over its range (Latin hypercube), (n, n_joints)."""
        number = rng.permuted(np.tile(np.arange(n), (count, 1)), axis=1).T
        return lower + (upper - lower) * (number + 0.5) / n

    tasks = [_rest_at(position) for position in spread_positions(n_poses)]
    unit = np.eye(count)  # row: 1 for one joint
    for joint in moving.tolist():
        # One joint swings.
        for at, frequency in zip(spread_positions(len(frequencies)), frequencies, strict=True):
            tasks.append(_swing_within(limits, at, frequency * unit[joint], swing_time))

        # Two joints swing, at different frequencies (Hz). For the first joint, which has no earlier
        # one, a position is drawn and not used.
        earlier_joints = moving[moving < joint][-n_other:]
        positions = spread_positions(max(len(earlier_joints), 1))
        for other, at in zip(earlier_joints, positions, strict=False):
            of_both = 0.3 * unit[joint] + 0.45 * unit[other]
            tasks.append(_swing_within(limits, at, of_both, swing_time))

        # A joint without an end spins, at 27 to 90 % of its speed.
        if limits.endless[joint]:
            shares = 0.9 * np.linspace(0.3, 1.0, len(frequencies))
            speeds = shares * np.degrees(limits.speed[joint])
            for at, speed in zip(spread_positions(len(shares)), speeds, strict=True):
                at_deg = np.where(limits.turns, np.degrees(at), np.nan)
                tasks.append(spin_joint(joint, at_deg, speed, dwell=4.0))
    run(builder, rng, tasks)


within_limits_short = partial(
    within_limits, n_poses=10, frequencies=(0.5,), swing_time=4.0, n_other=1
)


def _turn_or_range(limits: MotionLimits) -> tuple[np.ndarray, np.ndarray]:
    """Return the (lower, upper) ends of each joint, of an endless one half a turn to each side."""
    lower = np.where(limits.endless, -np.pi, limits.lower)
    return lower, np.where(limits.endless, np.pi, limits.upper)


def _swing_within(
    limits: MotionLimits, at: np.ndarray, frequency: np.ndarray, duration: float
) -> Task:
    """
    Return the task of swinging about a position, the joints with a frequency above zero (Hz).

    The amplitude is 70 % of the smallest limit by range, speed and acceleration. Near an end of the
    range the middle is moved, so that a tenth of the amplitude remains free.
    """
    lower, upper = _turn_or_range(limits)
    omega = 2 * np.pi * np.maximum(frequency, 1e-9)
    largest = [
        0.3 * (upper - lower),
        limits.speed / omega,
        limits.acceleration / omega**2,
        np.full(len(at), MAX_PROFILE_SWING),
    ]
    amplitude = np.where(frequency > 0, 0.7 * np.minimum.reduce(largest), 0.0)
    within_range = np.clip(at, lower + 1.1 * amplitude, upper - 1.1 * amplitude)
    middle = np.where(limits.endless, at, within_range)
    return swing_at(middle, amplitude, np.maximum(frequency, 0.1), duration=duration)


def _rest_at(position: np.ndarray) -> Task:
    """Return the task of resting at joint positions, rad and m."""
    return lambda builder: builder.move_to(position).rest(4.0)


THREE_AXIS = ('outer', 'middle', 'inner')
SPEEDS_DEG = (60.0, 120.0, 200.0)
"""Three speeds: with one or two, a delay is a mounting angle and a square is an asymmetry."""


def profile_names() -> dict[str, str]:
    """
    Return name -> one line of description of each profile.

    Of the profiles that differ in the direction of gravity only one is listed.
    """
    return {name: entry.description for name, entry in _REGISTRY.items() if '_up_' not in name}


def make_profile(
    name: str,
    seed: int = 0,
    table: dict[str, Any] | Table | None = None,
    *,
    duration: float | None = None,
) -> Profile:
    """
    Return the motion called `name`.

    Parameters
    ----------
    name : str
        One of `profile_names`.
    seed : int
        Seed of the order of the session, and in 'random' of the motions themselves.
    table : Table, optional
        The table to be moved; default three axes. Sessions for three axes become poses, spins and
        swings of every joint on a table with another number of joints, and are within the limits of
        joints that have them. Profiles with their own table (`Profile.table`) ignore it.
    duration : float, optional
        Wanted length, s; rests and spins are stretched to reach it.

    Raises
    ------
    InputError
        When the name is unknown, the table does not suit the profile, a joint would exceed its
        limits, or the duration is too short.

    """
    if name not in _REGISTRY:
        raise InputError(
            f"profile '{name}' is unknown{did_you_mean(name, profile_names())}; "
            f'the profiles are {", ".join(profile_names())}',
            code='profile_unknown',
        )
    entry = _REGISTRY[name]
    table = entry.table or table
    joint_names = _joint_names(entry, table)
    fits = entry.n_joints in (None, len(joint_names))
    if not (fits or entry.adapts):
        raise InputError(
            f"profile '{name}' must have a table with {entry.n_joints} joints, got"
            f" {len(joint_names)}; choose 'any_table'",
            code='joint_count',
        )
    # A description in a mapping states no limits.
    limits = limits_of(table) if isinstance(table, Table) else free_limits(len(joint_names))
    build = entry.build
    if entry.adapts and not limits.endless.all():
        build = within_limits
    elif not fits:
        build = _any_table

    def build_segments(dwell: float) -> tuple[Segment, ...]:
        builder = MotionBuilder(len(joint_names), dwell, limits)
        build(builder, np.random.default_rng(seed))
        return builder.segments

    segments = build_segments(1.0) if duration is None else stretch(build_segments, duration)
    profile = Profile(name, segments, joint_names, entry.table)
    _require_within(profile, limits)
    return profile


def _require_within(profile: Profile, limits: MotionLimits) -> None:
    """Refuse a motion that exceeds the range of a joint, evaluated at 20 Hz."""
    if limits.endless.all():
        return
    time = np.linspace(0.0, profile.duration, int(20 * profile.duration) + 1)
    position = profile.at(time).position
    for column, name in enumerate(profile.joint_names or ()):
        lower = limits.lower[column]
        upper = limits.upper[column]
        least = position[:, column].min()
        most = position[:, column].max()
        if least < lower - 1e-6 or most > upper + 1e-6:
            unit, factor = ('deg', np.degrees(1.0)) if limits.turns[column] else ('m', 1.0)
            raise InputError(
                f"profile '{profile.name}' must keep joint '{name}' within"
                f' [{factor * lower:.4g}, {factor * upper:.4g}] {unit}, it would move from'
                f' {factor * least:.4g} to {factor * most:.4g};'
                " choose 'within_limits'",
                code='joint_range',
            )


def _joint_names(entry: ProfileEntry, table: dict[str, Any] | Table | None) -> tuple[str, ...]:
    """Return the joints of a table; without one those of a table with two or three axes."""
    if table is None:
        return THREE_AXIS if entry.n_joints in (None, 3) else THREE_AXIS[:1] + THREE_AXIS[2:]
    if isinstance(table, dict):
        return tuple(joint['name'] for joint in table['joints'])
    return tuple(table.joint_names)


def _spins(directions: np.ndarray, speeds_deg: ArrayLike, dwell: float) -> list[Task]:
    """Return the tasks of turning about the vertical with each direction upright."""
    return [spin_vertical(up_b, speeds_deg, dwell) for up_b in directions]


def _calibration(builder: MotionBuilder, rng: np.random.Generator) -> None:
    """All poses, three speeds about each axis, single joints, swings and two axes at once."""
    run(
        builder,
        rng,
        [
            *poses(np.concatenate([FACES, EDGES, CORNERS]), 5.0),
            *_spins(np.eye(3), SPEEDS_DEG, 4.0),
            *_spins(CORNERS[:4], SPEEDS_DEG[2], 4.0),
            *(
                spin_joint(2, [90 * k, 0, 0], speed, dwell=5.0)
                for k, speed in enumerate(SPEEDS_DEG)
            ),
            *(spin_joint(1, [30, 0, inner], SPEEDS_DEG[1], dwell=5.0) for inner in (0, 90)),
            *swings(((30.0, 0.5), (10.0, 1.0), (5.0, 2.0)), 6.0),
            *simultaneous((150.0, 100.0), 6.0),
        ],
    )


def _short(builder: MotionBuilder, rng: np.random.Generator) -> None:
    """The motions of `_calibration`, fewer and shorter."""
    run(
        builder,
        rng,
        [
            *poses(np.concatenate([FACES, EDGES]), 4.0),
            *_spins(np.eye(3), SPEEDS_DEG, 2.0),
            *_spins(CORNERS[:2], SPEEDS_DEG[2], 2.0),
            spin_joint(2, [0, 0, 0], SPEEDS_DEG[1], dwell=3.0),
            *swings(((20.0, 0.5), (10.0, 1.0)), 4.0),
            *simultaneous((150.0, 100.0), 2.0)[:4],
        ],
    )


def _quick(builder: MotionBuilder, rng: np.random.Generator) -> None:
    """The fewest motions that determine all parameters."""
    run(
        builder,
        rng,
        [
            *poses(np.concatenate([FACES, EDGES[::2], CORNERS[::2]]), 2.0),
            *(spin_vertical(axis, speed, 2.0) for axis, speed in zip(np.eye(3), SPEEDS_DEG)),
            *swings(((10.0, 1.0),), 3.0),
            *simultaneous((150.0, 100.0), 2.0)[:3],
        ],
        reference_every=100,
    )


def _six_faces(builder: MotionBuilder, _rng: np.random.Generator) -> None:
    """The usual motion: every axis up and down, and turned both ways at one speed."""
    builder.rest(3.0)
    for task in [*poses(FACES, 3.0), *_spins(np.eye(3), SPEEDS_DEG[1], 2.0)]:
        task(builder)
    builder.rest_at_home(3.0)


def _static_only(builder: MotionBuilder, rng: np.random.Generator) -> None:
    """Poses only."""
    run(builder, rng, poses(np.concatenate([FACES, EDGES, CORNERS]), 8.0))


def _separating(
    builder: MotionBuilder,
    rng: np.random.Generator,
    n_angles: int = 16,
    n_oblique: int = 4,
    cycles: tuple[tuple[float, float], ...] = ((40.0, 0.4), (10.0, 1.0), (4.0, 2.0), (2.0, 4.0)),
    swing_time: float = 4.0,
) -> None:
    """
    Many angles, three speeds both ways, swings at several frequencies: separates similar effects.

    `cycles` are the amplitudes (deg) and frequencies (Hz) of the swings.
    """
    # Vertical directions on the three great circles between the axes of the sensor.
    angles = 2 * np.pi * (np.arange(n_angles) + 0.25) / n_angles
    rings = []
    for c, s in zip(np.cos(angles), np.sin(angles)):
        for direction in ([c, s, 0.0], [0.0, c, s], [s, 0.0, c]):
            rings.append(np.array(direction))
    run(
        builder,
        rng,
        [
            *poses(rings, 2.2),
            *_spins(np.eye(3), (60.0, 150.0, 300.0), 2.0),
            *_spins(CORNERS[:n_oblique], (150.0, 300.0), 2.0),
            spin_joint(2, [0, 0, 0], (30.0, 120.0), dwell=4.0),
            *(spin_joint(1, [90, 0, inner], (40.0, 100.0), dwell=4.0) for inner in (0, 90)),
            *swings(cycles, swing_time),
            *simultaneous((250.0, 100.0), 2.5),
        ],
        reference_every=20,
    )


_separating_short = partial(
    _separating,
    n_angles=8,
    n_oblique=1,
    cycles=((20.0, 0.5), (5.0, 1.5), (2.0, 4.0)),
    swing_time=3.0,
)


def _thermal(builder: MotionBuilder, _rng: np.random.Generator) -> None:
    """
    The same short round again and again, so that only time and temperature differ between rounds.
    """
    builder.rest_at_home(20.0)
    for round_number in range(6):
        for task in [
            *poses(FACES, 5.0),
            *_spins(np.eye(3), SPEEDS_DEG[1], 3.0),
            *swings(((10.0, 1.0),), 3.0),
        ]:
            task(builder)
        builder.move([90.0 * round_number, 0.0, 0.0]).rest(15.0)


def _tumbling(
    builder: MotionBuilder,
    _rng: np.random.Generator,
    rest: float,
    parts: Sequence[tuple[list[float], list[float], float, float]],
) -> None:
    """
    Rest for `rest` s, then swing all joints at once from zero, part after part.

    A part is (amplitude of each joint in deg, frequency of each joint in Hz, duration in s, rest
    after it in s).
    """
    builder.rest(rest)
    for amplitude_deg, frequency, duration, rest_after in parts:
        builder.move([0, 0, 0]).oscillate(
            amplitude_deg, frequency, duration, phase=[0.3, 1.1, 2.0], fade=2.0
        ).rest(rest_after)


def _random(
    builder: MotionBuilder,
    rng: np.random.Generator,
    directions: np.ndarray = np.concatenate([FACES, CORNERS]),
    speed_ranges: tuple[tuple[float, float], ...] = ((40, 80), (100, 150), (170, 220)),
    n_oblique: int = 2,
    n_swings: int = 2,
    n_simultaneous: int = 4,
) -> None:
    """
    Drawn poses, spins both ways at every speed, swings and two-axis turns.

    Poses are near `directions`; `n_oblique` spins are about oblique axes, `n_swings` swings about
    each axis, and `n_simultaneous` turns about two axes at once.
    """
    # The order of the draws is part of the recording of a seed. Angles in deg, speeds in deg/s.
    # Poses.
    tasks = poses([_random_direction_near(rng, up_b, 0.25) for up_b in directions], 2.6)

    # Spins about each axis of the sensor at every speed, about oblique axes, and of one joint.
    speeds = np.array([rng.uniform(*limits, 3) for limits in speed_ranges])  # (n_speeds, 3 axes)
    for k, axis in enumerate(np.eye(3)):
        tasks.append(spin_vertical(_random_direction_near(rng, axis, 0.2), speeds[:, k], 2.0))
    for _ in range(n_oblique):
        axis = _random_direction_near(rng, rng.choice(CORNERS), 0.3)
        tasks.append(spin_vertical(axis, rng.uniform(120, 220), 2.0))
    for joint in (1, 2):
        position = rng.uniform(-180, 180, 3)
        tasks.append(spin_joint(joint, position, rng.uniform(50, 120), dwell=3.0))

    # Swings, fast and slow, whose speed is that of an amplitude of 7 to 14 deg at 1 Hz.
    for axis in range(3):
        frequencies = [rng.uniform(1.5, 3.0), rng.uniform(0.5, 1.0)]
        for frequency in frequencies[:n_swings]:
            amplitude = rng.uniform(7, 14) / frequency
            tasks.append(swing(axis, amplitude, frequency, duration=3.5))

    # Two axes turn at once, in other ones of the five ways each time.
    rates = rng.uniform(80, 180, (n_simultaneous, 2)) * rng.choice([-1, 1], (n_simultaneous, 2))
    for way, rates_of_pair in zip(rng.permutation(5), rates):
        tasks.append(simultaneous(rates_of_pair, 2.0)[way])
    run(builder, rng, tasks, reference_every=15)


_random_short = partial(
    _random,
    directions=np.concatenate([FACES, CORNERS[::2]]),
    speed_ranges=((60, 90), (150, 210)),
    n_oblique=1,
    n_swings=1,
    n_simultaneous=3,
)


def _random_direction_near(
    rng: np.random.Generator, direction: np.ndarray, spread: float
) -> np.ndarray:
    """Return a direction near another one, with the sd `spread` of each component."""
    vector = direction + rng.normal(0.0, spread, 3)
    return vector / np.linalg.norm(vector)


def _any_table(builder: MotionBuilder, rng: np.random.Generator) -> None:
    """Poses, spins at three speeds, swings and two joints at once for any number of joints."""
    count = builder.n_joints
    # 24 positions, in which each joint has every multiple of 15 deg once, in a random order.
    angles = rng.permuted(np.tile(np.arange(24) * 15.0, (count, 1)), axis=1).T
    tasks = [_rest_at(np.radians(row)) for row in angles]
    unit = np.eye(count)  # row: 1 for one joint
    for joint in range(count):
        for speed in SPEEDS_DEG:
            tasks.append(spin_joint(joint, rng.uniform(-180, 180, count), speed, dwell=4.0))
        for frequency in (0.5, 1.0, 2.0):
            place = np.radians(rng.uniform(-180, 180, count))
            # The same largest rate at each frequency.
            amplitude = np.radians(10.0 / frequency * unit[joint])
            tasks.append(swing_at(place, amplitude, frequency, duration=4.0, settle=False))
        for other in range(joint):
            rates_deg = 120.0 * unit[joint] + 80.0 * unit[other]
            for at_deg in rng.uniform(-180, 180, (3, count)):
                tasks.append(two_axes(at_deg, rates_deg, 5.0))
    run(builder, rng, tasks)


_ON_ARM = {
    **GIMBALS,
    'mount': {'rpy_deg': [0.0, 0.0, 0.0], 'xyz': [0.2, 0.15, 0.1]},
}


def _session(description: str, build: Callable) -> ProfileEntry:
    """Return the entry of a session of a table with three axes, which adapts to other tables."""
    return ProfileEntry(description, build, n_joints=3, adapts=True)


_REGISTRY = {
    'calibration': _session(
        'full session on a three-axis table, about 11 min: poses, spins, swings, two axes at once',
        _calibration,
    ),
    'short': _session('the same in about 5 min', _short),
    'quick': _session('the shortest that determines all parameters, about 2 min', _quick),
    'six_faces': _session(
        'every axis up and down, and turned both ways at one speed, about 1 min: similar effects'
        ' are collinear',
        _six_faces,
    ),
    'static_only': ProfileEntry('26 poses, no deliberate rotation', _static_only, n_joints=3),
    'random': _session(
        'poses, spins, swings and two-axis turns drawn from the seed, about 5 min', _random
    ),
    'random_short': _session('the same in about 3 min, with two speeds', _random_short),
    'separating': _session(
        'many angles, three speeds both ways, four frequencies: separates similar effects',
        _separating,
    ),
    'separating_short': _session('the same with fewer angles, about 6 min', _separating_short),
    'separating_arm': ProfileEntry(
        'separating with the sensor on an arm of 0.27 m, so that spins exceed 1 g',
        _separating,
        _ON_ARM,
    ),
    'thermal': ProfileEntry(
        'the same round six times while the temperature changes', _thermal, n_joints=3
    ),
    'navigation': ProfileEntry(
        'rest, 50 s of slow tumbling, rest, 50 s of livelier tumbling',
        partial(
            _tumbling,
            rest=10.0,
            parts=(
                ([70.0, 50.0, 60.0], [0.11, 0.17, 0.13], 50.0, 10.0),
                ([40.0, 25.0, 20.0], [0.31, 0.53, 0.71], 50.0, 5.0),
            ),
        ),
        n_joints=3,
    ),
    'tumbling': ProfileEntry(
        '60 s of three-axis sinusoids (60, 45, 30 deg at 0.7, 0.9, 1.1 Hz)',
        partial(_tumbling, rest=5.0, parts=(([60.0, 45.0, 30.0], [0.7, 0.9, 1.1], 60.0, 5.0),)),
        n_joints=3,
    ),
    'two_axis': ProfileEntry(
        'poses, spins, swings and simultaneous turns of a two-axis table', _any_table, n_joints=2
    ),
    'within_limits': ProfileEntry(
        'poses, swings and, where a joint has no end, spins, within the limits of every joint',
        within_limits,
    ),
    'within_limits_short': ProfileEntry('the same with fewer of them', within_limits_short),
    'any_table': ProfileEntry(
        'poses, spins, swings and simultaneous turns of all joints of the table', _any_table
    ),
    **PAPER_PROFILES,
}
