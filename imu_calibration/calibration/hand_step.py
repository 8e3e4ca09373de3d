"""Steps by hand: a turn to one of 26 attitudes and a rest there; duration, description, and rows of the turn."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from imu_calibration.calibration.coverage import DIRECTIONS
from imu_calibration.core.units import DEG
from imu_calibration.effects.base import AXES
from imu_calibration.kinematics.rotations import skew
from imu_calibration.references.gravity.equations import tangent

HOLD_TIME = 3.0
"""s; hold time after which a pose certainly counts."""
TURN_BEGINS, TURN_RATE = 0.5, 60.0 * DEG
"""s, rad/s; time to begin and to end a turn, and its rate."""
TURNED = 0.35
"""rad, 20 degrees: smaller turns between two poses carry little information about the gyroscope and are easily made wrong."""
ROUNDED = 15
"""deg, rounding of a turn in instructions."""


@dataclass(frozen=True, eq=False)
class HandStep:
    """A turn to an attitude, and a rest there."""

    up: np.ndarray
    """Direction of the sensor that points up then, unit vector, shape (3,)."""
    axis: np.ndarray | None = None
    """Axis of the sensor to turn about, counter-clockwise seen from its tip; None: from anywhere."""
    angle: float = 0.0
    """Angle of the turn, rad."""

    @property
    def seconds(self) -> float:
        """Duration, s."""
        return HOLD_TIME + TURN_BEGINS + (0.5 * np.pi if self.axis is None else self.angle) / TURN_RATE

    @property
    def is_turn(self) -> bool:
        """Whether the turn is large enough to count."""
        return self.axis is not None and self.angle > TURNED

    @property
    def kind(self) -> str:
        """'turn' or 'pose'."""
        return 'turn' if self.is_turn else 'pose'

    @property
    def details(self) -> dict[str, Any]:
        """Numbers of the step for plan.yaml."""
        found: dict[str, Any] = {'up': [float(f'{c:.6g}') for c in self.up]}
        if self.axis is not None and self.is_turn:
            found |= {'turn_axis': [float(f'{c:.6g}') for c in self.axis], 'turn_deg': round(float(np.degrees(self.angle)), 1)}
        return found

    @property
    def words(self) -> str:
        """Instruction."""
        hold = f'hold it still with {direction_words(self.up)} up'
        if not self.is_turn:
            return hold
        about = DIRECTIONS[int(np.argmax(DIRECTIONS @ self.axis))]
        return f'turn it by {round(self.angle / DEG / ROUNDED) * ROUNDED} deg about its {direction_words(about)} axis and {hold}'


def direction_words(up: np.ndarray) -> str:
    """Return the name of a standard direction: '+x -z'."""
    return ' '.join(f'{"+" if c > 0 else "-"}{a}' for c, a in zip(up, AXES) if abs(c) > 1e-9)


def shortest_turn(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, float]:
    """Return (axis in the sensor frame, angle) of the shortest turn of the sensor that brings `end` up where `start` was."""
    about = np.cross(end, start)
    size = np.linalg.norm(about)
    angle = float(np.arctan2(size, start @ end))
    return (about / size if size > 1e-6 else tangent(start[None])[0, :, 0]), angle


def turn_rows(start: np.ndarray | None, end: np.ndarray) -> np.ndarray:
    """Return the design of the shortest turn from one direction up to another for the gyroscope's matrix, shape (2, 9)."""
    if start is None:
        return np.zeros((2, 9))
    about, angle = shortest_turn(start, end)
    if angle < TURNED:
        return np.zeros((2, 9))
    across = tangent(end[None])[0].T
    return (across @ skew(end) @ _rotation_slopes(about, angle)).reshape(2, 9)


def steps_from(up: np.ndarray | None) -> tuple[tuple[HandStep, ...], np.ndarray]:
    """Return the step to each of `DIRECTIONS`, by the shortest turn from the current one, and the `turn_rows` of each, shape (26, 2, 9)."""
    return _steps_from(None if up is None else tuple(up.tolist()))


@lru_cache(maxsize=256)   # plans revisit the same directions
def _steps_from(up):
    start = None if up is None else np.array(up)
    steps = tuple(HandStep(to) if start is None else HandStep(to, *shortest_turn(start, to)) for to in DIRECTIONS)
    rows = np.array([turn_rows(start, to) for to in DIRECTIONS])
    rows.flags.writeable = False
    return steps, rows


def _rotation_slopes(about, angle=np.pi):
    """Return the derivative of the rotation error in the turned frame by the gyroscope's matrix, near the identity, shape (3, 9)."""
    cross = skew(about)
    # integral over the turn of the remaining rotation, C(angle - t)
    to_come = angle * np.outer(about, about) + np.sin(angle) * (np.eye(3) - np.outer(about, about)) - (1 - np.cos(angle)) * cross
    return -np.einsum('ip,q->ipq', to_come, about).reshape(3, 9)
