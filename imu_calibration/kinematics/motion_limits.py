"""
Limits of the driven joints as arrays, and points of a joint trajectory.

The limits are range, speed and acceleration. The points are given by name and time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.units import DEG

# The help of verbs reads the layout of messages, hence this module; the table imports scipy.
if TYPE_CHECKING:
    from imu_calibration.kinematics.joint import Joint
    from imu_calibration.kinematics.table import Table


@dataclass(frozen=True, eq=False)
class TrajectoryPoints:
    """
    Content of a JointTrajectory message. Without points it commands the joints to stop.

    Raises
    ------
    InputError
        When no controller would follow it: shapes or times that do not fit, numbers that are not
        finite, a last point with a velocity.

    """

    joint_names: tuple[str, ...]
    """Joints, in the order of the columns."""
    time: np.ndarray
    """Seconds from the start, shape (n,)."""
    position: np.ndarray
    """Positions, rad or m, shape (n, n_joints)."""
    rate: np.ndarray | None = None
    """Velocities, shape (n, n_joints); None: not given."""
    acceleration: np.ndarray | None = None
    """Accelerations, shape (n, n_joints); None: not given."""

    def __post_init__(self) -> None:
        shape = (len(self.time), len(self.joint_names))
        for name, values in self.columns().items():
            if values.shape != shape:
                raise InputError(
                    f'each point of a trajectory must have {shape[1]} {_WORDS[name]}, one for each'
                    f' joint, got shape {values.shape}; give all or none',
                    code='position_count',
                )
            if not np.all(np.isfinite(values)):
                raise InputError(
                    f'every number of a trajectory must be finite, some {_WORDS[name]} are not;'
                    ' correct the points',
                    code='not_finite',
                )
        if not np.all(np.diff(self.time, prepend=0.0) > 0):
            raise InputError(
                'the times of a trajectory must rise from above zero, they do not; correct'
                ' time_from_start',
                code='times_not_rising',
            )
        if self.acceleration is not None and self.rate is None:
            raise InputError(
                'a trajectory with accelerations must have velocities, it has none; give both',
                code='velocities_missing',
            )
        if self.rate is not None and len(self) and np.any(self.rate[-1]):
            raise InputError(
                'a trajectory must end at rest, its last point has a velocity; let it be zero',
                code='not_at_rest',
            )

    @classmethod
    def stop(cls, joint_names: Sequence[str]) -> TrajectoryPoints:
        """Return the trajectory without points."""
        return cls(tuple(joint_names), np.zeros(0), np.zeros((0, len(joint_names))))

    def __len__(self) -> int:
        return len(self.time)

    @property
    def duration(self) -> float:
        """Time of the last point, s; 0 without points."""
        return float(self.time[-1]) if len(self.time) else 0.0

    def columns(self) -> dict[str, np.ndarray]:
        """Return the given quantities of the points: name -> values, shape (n, n_joints)."""
        given = {'position': self.position, 'rate': self.rate, 'acceleration': self.acceleration}
        return {name: values for name, values in given.items() if values is not None}

    def ordered(self, joint_names: Sequence[str]) -> TrajectoryPoints:
        """
        Return the trajectory with the joints in another order.

        Raises
        ------
        InputError
            When the trajectory names other joints than these, or not all of them.

        """
        present = list(self.joint_names)
        wanted = list(joint_names)
        if sorted(present) != sorted(wanted):
            raise InputError(
                f'a trajectory must name exactly the joints {", ".join(wanted)}, got'
                f' {", ".join(present) or "none"}; name every joint once',
                code='joint_names',
            )
        order = [present.index(name) for name in wanted]
        columns: dict[str, Any] = {}
        for name, values in self.columns().items():
            columns[name] = values[:, order]
        return replace(self, joint_names=tuple(wanted), **columns)

    def slowed(self, factor: float) -> TrajectoryPoints:
        """
        Return the same path at `factor` of its speed, 0 < factor <= 1.

        Derivatives of order k, position being order 0, are multiplied by ``factor^k``.
        """
        columns: dict[str, Any] = {}
        for order, (name, values) in enumerate(self.columns().items()):
            columns[name] = values * factor**order
        return replace(self, time=self.time / factor, **columns)


_WORDS = {'position': 'positions', 'rate': 'velocities', 'acceleration': 'accelerations'}


USUAL = {True: (150.0 * DEG, 300.0 * DEG), False: (0.25, 0.5)}
"""
Whether a joint turns -> default speed and acceleration: rad/s and rad/s^2, or m/s and m/s^2.
"""
NOT_CHECKED = (
    'only the limits of the joints are checked, not collisions of the robot with itself, its'
    ' surroundings or its cables'
)
"""Stated wherever a plan is printed, saved or driven."""
DEFAULT_ORIGIN = 'default'
"""Origin of a limit that no description gives."""
ROBOT_ORIGIN = 'robot description'
"""Origin of a limit in a URDF."""
TABLE_ORIGIN = 'table file'
"""Origin of a limit in a table file."""
RADIANS = 2 * np.pi
"""Ends of a range in degrees up to this number are probably in radians."""
MAX_RADIAN_RANGE = 20 * np.pi
"""A range above this in a robot description, rad, is probably in degrees."""


@dataclass(frozen=True, eq=False)
class MotionLimits:
    """
    Limits of the joints that are driven, in the order of ``table.joint_names``.

    Rad and m, each shape (n_joints,).
    """

    lower: np.ndarray
    """Smallest positions, minus infinity where there is no end."""
    upper: np.ndarray
    """Largest positions."""
    speed: np.ndarray
    """Largest speeds."""
    acceleration: np.ndarray
    """Largest accelerations."""
    turns: np.ndarray
    """True for joints that turn."""
    origins: tuple[tuple[str, str, str], ...] = ()
    """Per joint: origin of range, speed and acceleration."""

    def __len__(self) -> int:
        return len(self.lower)

    @property
    def endless(self) -> np.ndarray:
        """True for joints that may turn without end, shape (n_joints,)."""
        return self.turns & ~np.isfinite(self.lower)

    def wound(self, position: np.ndarray, turns: float) -> 'MotionLimits':
        """
        Return the limits with endless joints restricted to a number of turns.

        To either side of a position, rad and m, shape (n_joints,); zero turns: unrestricted.
        """
        if not turns:
            return self
        return self.around(position, np.where(self.endless, 2 * np.pi * turns, np.inf))

    def around(self, position: np.ndarray, reach: np.ndarray) -> 'MotionLimits':
        """
        Return the limits restricted to a neighbourhood of a position.

        Parameters
        ----------
        position, reach : ndarray, shape (n_joints,)
            Center and distance to either side, rad or m.

        Raises
        ------
        InputError
            When the position is outside the limits.

        """
        lower = np.maximum(self.lower, position - reach)
        upper = np.minimum(self.upper, position + reach)
        if np.any(lower > upper):
            raise InputError(
                'the pose must lie within the range of every joint, joint number'
                f' {int(np.argmax(lower - upper)) + 1} is outside; choose another pose'
            )
        return replace(self, lower=lower, upper=upper)

    def reached(self, position: np.ndarray, reach_deg: float) -> 'MotionLimits':
        """
        Return the limits with rotating joints restricted to a distance from a position.

        `reach_deg`: the distance to either side. Sliding joints are held at the position.
        """
        return self.around(position, np.where(self.turns, reach_deg * DEG, 0.0))


def free_limits(n_joints: int) -> MotionLimits:
    """Return the limits of joints that turn without end at the usual speed."""
    speed, acceleration = USUAL[True]
    return MotionLimits(
        lower=np.full(n_joints, -np.inf),
        upper=np.full(n_joints, np.inf),
        speed=np.full(n_joints, speed),
        acceleration=np.full(n_joints, acceleration),
        turns=np.ones(n_joints, bool),
    )


def limits_of(table: Table) -> MotionLimits:
    """
    Return the limits of the joints of a table that are read.

    The limits of joints that follow another one restrict that one as well. Defaults: `USUAL` speed
    and acceleration, no end for a joint that turns, no motion for a joint that slides;
    `missing_ranges` lists the joints without a range.
    """
    names = table.joint_names
    turns = np.ones(len(names), bool)
    lower = np.full(len(names), -np.inf)
    upper = np.full(len(names), np.inf)
    fastest = np.full((2, len(names)), np.inf)  # speed, acceleration
    origins = [[DEFAULT_ORIGIN] * 3 for _ in names]  # of range, speed, acceleration
    # A joint that is read comes after its followers, so that none of them determines its type.
    for joint in sorted(table.joints, key=lambda joint: joint.mimic is None):
        column = names.index(joint.source)
        limits = joint.limits
        turns[column] = joint.turns

        # The smallest common range. A follower with the factor 0 does not move.
        factor = joint.multiplier
        if factor and limits.lower is not None and limits.upper is not None:
            # A negative factor exchanges the ends.
            ends = ((end - joint.offset) / factor for end in (limits.lower, limits.upper))
            low, high = sorted(ends)
            if low > lower[column] or high < upper[column]:
                origins[column][0] = _origin(joint, 'lower')
            lower[column] = max(lower[column], low)
            upper[column] = min(upper[column], high)
        elif limits.endless and joint.mimic is None and not np.isfinite(lower[column]):
            origins[column][0] = _origin(joint, 'endless')

        # The lowest speed and acceleration; `origins` has them after the range.
        stated = {'speed': limits.speed, 'acceleration': limits.acceleration}
        for row, (key, value) in enumerate(stated.items()):
            if value is None or not factor:
                continue
            if value / abs(factor) < fastest[row, column]:
                fastest[row, column] = value / abs(factor)
                origins[column][row + 1] = _origin(joint, key)

    # Defaults: columns of `usual` are the joints, rows their speed and acceleration.
    usual = np.array([USUAL[bool(turning)] for turning in turns]).T
    speed, acceleration = np.where(np.isfinite(fastest), fastest, usual)
    without_range = ~turns & ~np.isfinite(lower)
    lower[without_range] = 0.0
    upper[without_range] = 0.0
    return MotionLimits(
        lower, upper, speed, acceleration, turns, tuple((a, b, c) for a, b, c in origins)
    )


def _origin(joint: Joint, name: str) -> str:
    """Return the origin of a limit of a joint (`name`: its field), with the name of a follower."""
    origin = ROBOT_ORIGIN if name in joint.limits.described else TABLE_ORIGIN
    return origin if joint.mimic is None else f'{origin}, joint {joint.name}'


def missing_ranges(table: Table) -> tuple[str, ...]:
    """
    Return the joints without a plausible range that are not declared endless.

    A range is implausible if a robot description gives it and it is wider than ten turns.
    """
    limits = limits_of(table)
    is_wide = limits.upper - limits.lower > MAX_RADIAN_RANGE
    is_wide &= limits.turns & np.isfinite(limits.lower)
    missing = []
    for index, name in enumerate(table.joint_names):
        range_origin, _, _ = limits.origins[index]
        if range_origin == DEFAULT_ORIGIN:
            missing.append(name)
        elif is_wide[index] and range_origin.startswith(ROBOT_ORIGIN):
            missing.append(name)
    return tuple(missing)


def range_warnings(table: Table) -> list[str]:
    """Return one line on joints without a range, and one for each range with a doubtful unit."""
    lines = []
    missing = missing_ranges(table)
    if missing:
        lines.append(
            f'every joint must have a range to be moved, {", ".join(missing)}: none, or over ten'
            ' turns; add range_deg: [a, b] (range_m where it slides) or endless: true to the table'
            ' file'
        )
    for joint in table.joints:
        lower = joint.limits.lower
        upper = joint.limits.upper
        # Only ranges in degrees, which a table file gives for rotating joints.
        if not joint.turns or lower is None or upper is None or 'lower' in joint.limits.described:
            continue
        ends = np.degrees((lower, upper))
        if 0 < np.max(np.abs(ends)) <= RADIANS:
            lines.append(
                f"range_deg of joint '{joint.name}' must be in degrees, [{ends[0]:g},"
                f' {ends[1]:g}] looks like radians; write [{np.degrees(ends[0]):.1f},'
                f' {np.degrees(ends[1]):.1f}] if it is'
            )
    return lines


def limit_words(table: Table, limits: MotionLimits) -> list[str]:
    """
    Return one line for each joint: range, speed and acceleration with their origins.

    `limits` may be narrower than those of the table.
    """
    lines = []
    is_endless = limits_of(table).endless  # as declared
    for k, (name, origins) in enumerate(zip(table.joint_names, limits.origins, strict=True)):
        range_origin, speed_origin, acceleration_origin = origins
        factor, unit = (180 / np.pi, 'deg') if limits.turns[k] else (1.0, 'm')
        # An endless joint has a range where `limits` are narrower: endless, here -90 to 90 deg.
        parts = []
        if is_endless[k]:
            parts.append('endless')
        if np.isfinite(limits.lower[k]):
            parts.append(f'{factor * limits.lower[k]:.4g} to {factor * limits.upper[k]:.4g} {unit}')
        text = f'{", here ".join(parts)} ({range_origin})'
        if range_origin == DEFAULT_ORIGIN:
            text = 'no range'
        lines.append(
            f'{name}: {text}, {factor * limits.speed[k]:.4g} {unit}/s ({speed_origin}), '
            f'{factor * limits.acceleration[k]:.4g} {unit}/s^2 ({acceleration_origin})'
        )
    return lines
