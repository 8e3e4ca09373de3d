"""Points of a joint trajectory, by name and by time from its start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from imu_calibration.core.errors import InputError


@dataclass(frozen=True, eq=False)
class TrajectoryPoints:
    """
    Content of a JointTrajectory. Without points it commands the joints to stop.

    Raises
    ------
    InputError
        When no controller would follow it: shapes or times that do not fit, numbers that are not finite, a last point with a velocity.

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
                raise InputError(f'each point of a trajectory must have {shape[1]} {_WORDS[name]}, one for each joint, got shape '
                                 f'{values.shape}; give all or none', code='position_count')
            if not np.all(np.isfinite(values)):
                raise InputError(f'every number of a trajectory must be finite, some {_WORDS[name]} are not; correct the points',
                                 code='not_finite')
        if not np.all(np.diff(self.time, prepend=0.0) > 0):
            raise InputError('the times of a trajectory must rise from above zero, they do not; correct time_from_start',
                             code='times_not_rising')
        if self.acceleration is not None and self.rate is None:
            raise InputError('a trajectory with accelerations must have velocities, it has none; give both', code='velocities_missing')
        if self.rate is not None and len(self) and np.any(self.rate[-1]):
            raise InputError('a trajectory must end at rest, its last point has a velocity; let it be zero', code='not_at_rest')

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
        """Return the quantities of the points, by name."""
        given = {'position': self.position, 'rate': self.rate, 'acceleration': self.acceleration}
        return {name: values for name, values in given.items() if values is not None}

    def ordered(self, joint_names: Sequence[str]) -> TrajectoryPoints:
        """
        Return the same with the joints in another order.

        Raises
        ------
        InputError
            When the trajectory names other joints than these, or not all of them.

        """
        own, wanted = list(self.joint_names), list(joint_names)
        if sorted(own) != sorted(wanted):
            raise InputError(f'a trajectory must name exactly the joints {", ".join(wanted)}, got {", ".join(own) or "none"}; '
                             'name every joint once', code='joint_names')
        order = [own.index(name) for name in wanted]
        columns: dict[str, Any] = {name: values[:, order] for name, values in self.columns().items()}
        return replace(self, joint_names=tuple(wanted), **columns)

    def slowed(self, factor: float) -> TrajectoryPoints:
        """Return the same path at `factor` of its speed, 0 < factor <= 1."""
        slower: dict[str, Any] = {name: values * factor**order for order, (name, values) in enumerate(self.columns().items())}
        return replace(self, time=self.time / factor, **slower)


_WORDS = {'position': 'positions', 'rate': 'velocities', 'acceleration': 'accelerations'}
