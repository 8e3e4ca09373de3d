"""The joints' motion at given instants: angles and three derivatives."""

from dataclasses import dataclass, fields

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

    def __len__(self) -> int:
        return len(self.time)

    def select(self, index: np.ndarray | slice) -> 'JointMotion':
        """Return the motion at `index` (slice, mask or integer array)."""
        return JointMotion(**{f.name: getattr(self, f.name)[index] for f in fields(self)})
