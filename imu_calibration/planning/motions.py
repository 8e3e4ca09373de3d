"""A motion of a plan: it starts and ends at rest at one position of the joints, within their limits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from imu_calibration.core.constants import DEG
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.motion_limits import MotionLimits
from imu_calibration.kinematics.trajectory_points import TrajectoryPoints
from imu_calibration.simulation.motion_builder import MotionBuilder, Profile, Segment

STEP = 0.05
"""Time between the points of a trajectory, s: quintics between them follow the motion to a micrometre."""


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
    """Start and end, rad or m, shape (n_joints,); after whole turns an endless joint counts as returned."""
    segments: tuple[Segment, ...]
    """Segments of the motion."""
    text: str
    """Description of the segments."""
    limits: MotionLimits
    """Limits that it keeps, with which the way to it is timed."""
    number: int = -1
    """Number in the catalogue."""

    @property
    def seconds(self) -> float:
        """Length without the way to its place, s."""
        return float(sum(segment.duration for segment in self.segments))

    def travel(self, position: np.ndarray) -> tuple[Segment, ...]:
        """Return the way from where the joints are to the place of the motion: one move, or none."""
        builder = MotionBuilder(len(self.place), limits=self.limits, start=position)
        builder.move_to(self.place)
        return tuple(builder.segments)

    def from_position(self, position: np.ndarray) -> tuple[Segment, ...]:
        """Return all segments from the present position, with whole turns of endless joints unchanged."""
        way = self.travel(position)
        shift = (way[-1].end if way else np.asarray(position, float)) - self.place
        return way + tuple(replace(segment, start=segment.start + shift) for segment in self.segments)

    def seconds_from(self, position: np.ndarray) -> float:
        """Return the length with the way to its place, s."""
        return self.seconds + sum(segment.duration for segment in self.travel(position))

    def points(self, position: np.ndarray) -> TrajectoryPoints:
        """Return the trajectory from where the joints rest: positions, velocities and accelerations, at rest at the end."""
        return trajectory(self.joint_names, self.from_position(position))

    @property
    def words(self) -> str:
        """One line of instruction."""
        there = f'go to {place_words(self.joint_names, self.place, self.limits)}'
        return f'{there}, {self.text}' if self.text else there


def trajectory(joint_names: tuple[str, ...], segments: tuple[Segment, ...]) -> TrajectoryPoints:
    """Return the points of consecutive segments, one at each transition; no points without motion."""
    if not segments:
        return TrajectoryPoints.stop(joint_names)
    edges = np.concatenate([[0.0], np.cumsum([segment.duration for segment in segments])])
    times = np.concatenate([np.linspace(a, b, max(int(np.ceil((b - a) / STEP)), 1) + 1)[1:]
                            for a, b in zip(edges, edges[1:], strict=False)])
    motion = motion_at(segments, times)
    rate, acceleration = motion.rate.copy(), motion.acceleration.copy()
    rate[-1], acceleration[-1] = 0.0, 0.0
    return TrajectoryPoints(joint_names, times, motion.position, rate, acceleration)


def motion_at(segments: tuple[Segment, ...], time: np.ndarray) -> JointMotion:
    """Return the joints' motion at times since the start of the first segment."""
    return Profile('plan', tuple(segments)).at(time)


def place_words(names: tuple[str, ...], place: np.ndarray, limits: MotionLimits) -> str:
    """Return the text of a position: ``outer 45°, slide 120 mm``."""
    units = [(1 / DEG, '°') if turning else (1000.0, ' mm') for turning in limits.turns]
    return ', '.join(f'{name} {round(value * factor):d}{unit}' for name, value, (factor, unit) in zip(names, place, units, strict=True))
