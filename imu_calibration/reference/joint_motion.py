"""The joints' motion at given instants: angles and three derivatives."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np


@dataclass(frozen=True, eq=False)
class JointMotion:
    """Angles of the joints and their first three derivatives; columns in the order of the table's joints."""

    time: np.ndarray
    """Seconds, shape (n,)."""
    position: np.ndarray
    """Joint angles, rad, shape (n, n_joints)."""
    rate: np.ndarray
    """First derivative, rad/s, shape (n, n_joints)."""
    acceleration: np.ndarray
    """Second derivative, rad/s^2, shape (n, n_joints)."""
    jerk: np.ndarray
    """Third derivative, rad/s^3, shape (n, n_joints)."""
    thermal_branch: np.ndarray | None = None
    """Thermal branch at these instants (`reference.thermal_branch`), shape (n,); None: unknown."""
    vibration: np.ndarray | None = None
    """Variance of vibration (`reference.vibration`), (m/s^2)^2, shape (n, 3); None: unknown."""

    def __len__(self) -> int:
        return len(self.time)

    def select(self, index: np.ndarray | slice) -> 'JointMotion':
        """Return the motion at `index` (slice, mask or integer array)."""
        known = {f.name: getattr(self, f.name) for f in fields(self)}
        selected: dict[str, Any] = {name: None if values is None else values[index] for name, values in known.items()}
        return JointMotion(**selected)

    @classmethod
    def joined(cls, parts: Sequence['JointMotion']) -> 'JointMotion':
        """Return consecutive motions; a quantity that one of them lacks is unknown."""
        columns = {f.name: [getattr(part, f.name) for part in parts] for f in fields(cls)}
        joined: dict[str, Any] = {name: None if any(each is None for each in some) else np.concatenate(some)
                                  for name, some in columns.items()}
        return cls(**joined)
