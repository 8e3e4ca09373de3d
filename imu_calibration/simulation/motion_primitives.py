"""
Parts of a turntable session with axes z, y, x from the base outwards.

The module also holds the motions of the two source papers.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from imu_calibration.kinematics.rotations import rotation, rpy_from_rotation
from imu_calibration.simulation.motion_builder import MotionBuilder

GOLDEN_ANGLE_DEG = 137.50776
FACES = np.concatenate([np.eye(3), -np.eye(3)])
"""Directions to the faces of a cube, shape (6, 3)."""
Task = Callable[[MotionBuilder], object]
"""Part of a session: appends segments to a builder."""


@dataclass(frozen=True)
class ProfileEntry:
    """A profile in the registry."""

    description: str
    """One line for the help."""
    build: Callable
    """``build(builder, rng)`` appends the segments; `rng` is seeded."""
    table: dict | None = None
    """Description of the table that the profile brings; None: it moves the given table."""
    n_joints: int | None = None
    """Number of joints for which `build` is made; None: any number, or that of `table`."""
    adapts: bool = False
    """
    Whether a table with another number of joints gets `any_table` instead, and one with joint
    limits `within_limits`.
    """


def pose_deg(up_b: np.ndarray, heading_deg: float = 0.0) -> np.ndarray:
    """
    Return the joint angles of a z-y-x table that bring the vertical along `up_b`, deg.

    They are in the order outer, middle m, inner i, from
    ``up_b = (-sin m, sin i cos m, cos i cos m)``; the outer joint only sets the heading.
    """
    x, y, z = np.asarray(up_b, float) / np.linalg.norm(up_b)
    middle = -np.arcsin(np.clip(x, -1, 1))
    inner = np.arctan2(y, z) if np.hypot(y, z) > 1e-9 else 0.0  # any angle with x vertical
    return np.array([heading_deg, *np.degrees([middle, inner])])


def pose(up_b: np.ndarray, heading_deg: float, dwell: float) -> Task:
    """Rest with `up_b` vertical."""
    return lambda builder: builder.move(pose_deg(up_b, heading_deg)).rest(dwell)


def spin_vertical(up_b: np.ndarray, speeds_deg: ArrayLike, dwell: float) -> Task:
    """
    Turn the outer joint both ways with `up_b` vertical.

    The body turns about `up_b` and gravity is constant in it.
    """
    return spin_joint(0, pose_deg(up_b, np.nan), speeds_deg, dwell=dwell)


def spin_joint(joint: int, at_deg: ArrayLike, speeds_deg: ArrayLike, *, dwell: float) -> Task:
    """Turn one joint both ways at each speed (deg/s), from the joint angles `at_deg`."""
    rates_deg = np.multiply.outer(speeds_deg, (1, -1)).reshape(-1, 1)

    def task(builder: MotionBuilder) -> None:
        is_turned = np.arange(builder.n_joints) == joint
        builder.move(at_deg).spin(np.where(is_turned, rates_deg, 0.0), dwell)

    return task


def swing(axis: int, amplitude_deg: float, frequency: float, *, duration: float) -> Task:
    """
    Swing about sensor axis 0, 1 or 2 (x, y, z) of a z-y-x table.

    The joint is the inner one, the middle one, or the middle one with the inner at 90 deg.
    """
    joint = (2, 1, 1)[axis]
    at_deg = ([0, 0, 0], [0, 0, 0], [0, 0, 90])[axis]
    amplitude = np.radians(amplitude_deg * np.eye(3)[joint])
    return swing_at(np.radians(at_deg), amplitude, frequency, duration=duration)


def swing_at(
    position: np.ndarray,
    amplitude: np.ndarray,
    frequency: ArrayLike,
    *,
    duration: float,
    settle: bool = True,
) -> Task:
    """Swing about joint positions (rad, m), with a rest before and, to `settle`, after it."""

    def task(builder: MotionBuilder) -> None:
        builder.move_to(position).rest(1.0).swing(amplitude, frequency, duration)
        if settle:
            builder.rest(1.0)

    return task


def two_axes(at_deg: Sequence[float] | np.ndarray, rates_deg: ArrayLike, dwell: float) -> Task:
    """Turn two joints at once, then both the other way, so that a delay cannot pass for an arm."""
    return lambda builder: builder.move(at_deg).spin(np.multiply.outer((1, -1), rates_deg), dwell)


def run(
    builder: MotionBuilder,
    rng: np.random.Generator,
    tasks: Sequence[Task],
    *,
    reference_every: int = 12,
) -> None:
    """
    Run tasks in a random order, so that drift is separable from other effects.

    After every `reference_every` tasks the joints rest at the reference pose.
    """
    builder.rest_at_home(8.0)
    for count, index in enumerate(rng.permutation(len(tasks)), start=1):
        tasks[index](builder)
        if count % reference_every == 0:
            builder.rest_at_home(5.0)
    builder.rest_at_home(6.0)


def poses(directions: Sequence[np.ndarray] | np.ndarray, dwell: float) -> list[Task]:
    """
    Return the tasks of resting with each direction vertical.

    The headings are spread by the golden angle.
    """
    return [pose(up_b, GOLDEN_ANGLE_DEG * k, dwell) for k, up_b in enumerate(directions)]


def swings(
    amplitudes_and_frequencies: tuple[tuple[float, float], ...], duration: float
) -> list[Task]:
    """
    Return the tasks of swinging about each sensor axis at each amplitude (deg) and frequency (Hz).
    """
    tasks = []
    for axis in range(3):
        for amplitude, frequency in amplitudes_and_frequencies:
            tasks.append(swing(axis, amplitude, frequency, duration=duration))
    return tasks


def simultaneous(speeds_deg: tuple[float, float] | np.ndarray, dwell: float) -> list[Task]:
    """
    Return the five tasks of turning two joints at a time, at the two speeds.

    Outer and inner joint, outer and middle (about y, about z), outer and inner, middle and inner.
    """
    a, b = speeds_deg
    return [
        two_axes([0, 0, 0], [a, 0, b], dwell),
        two_axes([0, 0, 0], [a, b, 0], dwell),
        two_axes([0, 0, 90], [a, -b, 0], dwell),
        two_axes([0, 45, 0], [a, 0, -b], dwell),
        two_axes([0, 0, 30], [0, b, a], dwell),
    ]


AXIS_ORDERS = ('XYX', 'XYZ', 'XZX', 'XZY', 'YXY', 'YXZ', 'YZX', 'YZY', 'ZXY', 'ZXZ', 'ZYX', 'ZYZ')
"""The twelve orders of three gimbals, from the base outwards."""
AXIS_VECTORS = {'X': [1.0, 0.0, 0.0], 'Y': [0.0, 1.0, 0.0], 'Z': [0.0, 0.0, 1.0]}
EQUAL_ANGLES_DEG = np.arange(0.0, 401.0, 10.0)
"""Avrutov 2017, samples 1 and 2: the 41 equal angles (40 according to the paper)."""


def _table(
    axes: Sequence[Sequence[float]],
    up: Sequence[float] = (0.0, 0.0, 1.0),
    latitude: float = 50.45,
    rpy_deg: Sequence[float] = (0.0, 0.0, 0.0),
) -> dict[str, Any]:
    """Return the description of a table with the axes of its joints from the base outwards."""
    names = ('outer', 'middle', 'inner') if len(axes) == 3 else ('turn',)
    joints = [{'name': name, 'axis': list(axis)} for name, axis in zip(names, axes, strict=True)]
    mount = {'rpy_deg': list(rpy_deg), 'xyz': None}
    return {
        'joints': joints,
        'up': list(up),
        'latitude': latitude,
        'height': 170.0,
        'azimuth_deg': 0.0,
        'mount': mount,
    }


def _gimbals(order: str, up_axis: str) -> dict[str, Any]:
    """Return a table with axes in an order from the base, e.g. 'ZYX', and its vertical."""
    return _table([AXIS_VECTORS[axis] for axis in order], AXIS_VECTORS[up_axis])


GIMBALS = _gimbals('ZYX', 'Z')


def avrutov_rates_deg(sample: int) -> np.ndarray:
    """
    Return the rates about x, y, z of Avrutov's gyroscope series (sample 3 or 4), deg/s.

    Shape (11, 3).
    """
    if sample == 3:
        rate = np.arange(0.0, 101.0, 10.0)
        return np.stack([rate, rate ** (1 / 2), rate ** (1 / 3)], axis=1)
    rate = np.arange(0.0, 11.0)
    return np.stack([rate, np.exp(-rate), rate**2], axis=1)


def _equal_angles(builder: MotionBuilder, _rng: np.random.Generator) -> None:
    """
    Rest with all gimbals at the same angle, in 41 positions.

    The rests of 30...60 s in the paper are shortened; `duration` of `make_profile` stretches them.
    """
    builder.rest(5.0)
    for angle in EQUAL_ANGLES_DEG:
        builder.move(np.full(builder.n_joints, angle), shortest=False).rest(5.0)


def _body_rates(builder: MotionBuilder, _rng: np.random.Generator, sample: int) -> None:
    """
    Turn with each row of `avrutov_rates_deg` as the rate of the body.

    The outer joint turns about the vertical; the other two bring the rate's direction upright.
    """
    for rates in avrutov_rates_deg(sample):
        speed = float(np.linalg.norm(rates))
        upright = rates if speed else np.array([0.0, 0.0, 1.0])
        builder.move(pose_deg(upright, np.nan)).rest(2.0).spin([[speed, 0.0, 0.0]], 10.0)


def _gimbal_rates(builder: MotionBuilder, _rng: np.random.Generator, sample: int) -> None:
    """
    Turn with each row of `avrutov_rates_deg` as the rates of the gimbals (x inner, z outer).

    The rates of the body differ from them.
    """
    for x, y, z in avrutov_rates_deg(sample):
        builder.move([0.0, 0.0, 0.0]).rest(2.0).spin([[z, y, x]], 30.0)


def _six_faces(builder: MotionBuilder) -> None:
    """Rest with each axis up and down."""
    for face in FACES:
        pose(face, 0.0, 10.0)(builder)


def _zhang_spins(builder: MotionBuilder, _rng: np.random.Generator) -> None:
    """Six faces, and spins about each axis at three speeds (Zhang)."""
    _six_faces(builder)
    for axis in np.eye(3):
        builder.move(pose_deg(axis, np.nan))
        for speed in (100.0, 150.0, 200.0):
            builder.spin([[speed, 0.0, 0.0]], 10.0)


def _zhang_oscillations(builder: MotionBuilder, _rng: np.random.Generator) -> None:
    """Six faces, and swings about each axis (Zhang)."""
    _six_faces(builder)
    for axis in range(3):
        for amplitude, frequency in ((10.0, 1.0), (5.0, 2.0), (90.0, 0.5)):
            swing(axis, amplitude, frequency, duration=12.0)(builder)


def _zhang_mixed(builder: MotionBuilder, _rng: np.random.Generator) -> None:
    """Six faces, spins, swings and turns about two axes at once (Zhang)."""
    _six_faces(builder)
    tasks = [
        *(spin_vertical(axis, 200.0, 6.0) for axis in np.eye(3)),
        *swings(((10.0, 1.0),), 12.0),
        two_axes([0, 0, 0], [200, 0, 200], 6.0),
        two_axes([0, 0, 0], [200, 200, 0], 6.0),
        two_axes([0, 0, 90], [200, 200, 0], 6.0),
    ]
    for task in tasks:
        task(builder)


SKEW_60_RPY_DEG = np.degrees(
    rpy_from_rotation(rotation(np.pi / 3 * np.ones(3) / np.sqrt(3)))
).tolist()
"""
A fixture that turns the sensor by 60 deg about (1, 1, 1): every spin axis then meets all three
sensor axes.
"""


PAPER_PROFILES: dict[str, ProfileEntry] = {
    **{
        f'avrutov_{order}{suffix}': ProfileEntry(
            (
                f'41 positions of equal angles 0..400 deg, gimbals {order} from the base; add _up_x'
                ' or _up_y to turn gravity'
            ),
            _equal_angles,
            _gimbals(order, up_axis),
        )
        for order, (suffix, up_axis) in product(
            AXIS_ORDERS, (('', 'Z'), ('_up_x', 'X'), ('_up_y', 'Y'))
        )
    },
    'avrutov_111': ProfileEntry(
        "the literal reading of 'around three axes simultaneously': one turn about (1, 1, 1)",
        _equal_angles,
        _table([[1.0, 1.0, 1.0]]),
    ),
    **{
        f'avrutov_rates_{sample}': ProfileEntry(
            (
                f'gyroscope series of sample {sample} as body rates: one turn about a fixed axis'
                ' for each row'
            ),
            partial(_body_rates, sample=sample),
            GIMBALS,
        )
        for sample in (3, 4)
    },
    **{
        f'avrutov_gimbals_{sample}': ProfileEntry(
            (
                f'gyroscope series of sample {sample} commanded to the gimbals, which are not body'
                ' rates'
            ),
            partial(_gimbal_rates, sample=sample),
            GIMBALS,
        )
        for sample in (3, 4)
    },
    'zhang_z0': ProfileEntry(
        'six faces, spins about the sensor axes at 100, 150, 200 deg/s',
        _zhang_spins,
        GIMBALS,
    ),
    'zhang_z60': ProfileEntry(
        'the same with a fixture skewed by 60 deg about (1, 1, 1)',
        _zhang_spins,
        _table([AXIS_VECTORS[axis] for axis in 'ZYX'], rpy_deg=SKEW_60_RPY_DEG),
    ),
    'zhang_o': ProfileEntry(
        'six faces, swings about the sensor axes: 10 deg 1 Hz, 5 deg 2 Hz, 90 deg 0.5 Hz',
        _zhang_oscillations,
        GIMBALS,
    ),
    'zhang_m': ProfileEntry(
        'six faces, three spins, three swings, three simultaneous turns',
        _zhang_mixed,
        GIMBALS,
    ),
}
