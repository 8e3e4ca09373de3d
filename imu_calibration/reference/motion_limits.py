"""How far and how fast the joints that are driven may go, as arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imu_calibration.constants import DEG
from imu_calibration.reference.table import Table

USUAL = {True: (150.0 * DEG, 300.0 * DEG), False: (0.25, 0.5)}
"""Speed and acceleration of joints that turn, and of those that slide, whose description says nothing: rad/s, rad/s^2; m/s, m/s^2."""


@dataclass(frozen=True, eq=False)
class MotionLimits:
    """Limits of the joints that are driven, in the order of ``table.joint_names``: rad and m, each shape (n_joints,)."""

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

    def __len__(self) -> int:
        return len(self.lower)

    @property
    def endless(self) -> np.ndarray:
        """True for joints that may turn on and on."""
        return self.turns & ~np.isfinite(self.lower)

    def hold(self, position: np.ndarray, margin: float = 1e-9) -> bool:
        """Whether every position, shape (..., n_joints), lies within the range."""
        return bool(np.all(position >= self.lower - margin) and np.all(position <= self.upper + margin))


def free_limits(n_joints: int) -> MotionLimits:
    """Return the limits of joints that turn without end at the usual speed."""
    whole, (speed, acceleration) = np.full(n_joints, np.inf), USUAL[True]
    return MotionLimits(-whole, whole, np.full(n_joints, speed), np.full(n_joints, acceleration), np.ones(n_joints, bool))


def limits_of(table: Table) -> MotionLimits:
    """
    Return the limits of a table's joints.

    A joint that others follow keeps the limits of these as well. What the description leaves open is the usual speed, no end for joints
    that turn, and no motion for joints that slide.
    """
    names = table.joint_names
    turns = np.ones(len(names), bool)
    lower, upper, fastest = np.full(len(names), -np.inf), np.full(len(names), np.inf), np.full((2, len(names)), np.inf)
    # A joint's own entry comes last, so that a follower does not say how it moves.
    for joint in sorted(table.joints, key=lambda joint: joint.mimic is None):
        column, limits = names.index(joint.source), joint.limits
        turns[column] = joint.turns
        factor, offset = (1.0, 0.0) if joint.mimic is None else (joint.mimic.multiplier, joint.mimic.offset)
        if factor and limits.lower is not None and limits.upper is not None:
            ends = sorted(((limits.lower - offset) / factor, (limits.upper - offset) / factor))
            lower[column], upper[column] = max(lower[column], ends[0]), min(upper[column], ends[1])
        given = [np.inf if value is None or not factor else value / abs(factor) for value in (limits.speed, limits.acceleration)]
        fastest[:, column] = np.minimum(fastest[:, column], given)
    usual = np.array([USUAL[bool(turning)] for turning in turns]).T
    stuck = ~turns & ~np.isfinite(lower)
    lower[stuck] = upper[stuck] = 0.0
    speed, acceleration = np.where(np.isfinite(fastest), fastest, usual)
    return MotionLimits(lower, upper, speed, acceleration, turns)
