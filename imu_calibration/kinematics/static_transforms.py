"""Where frames of one rigid body are to each other: the tree of static transforms, and poses through it."""

from collections.abc import Iterable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from imu_calibration.core.errors import InputError

NAMED = 6
"""Largest number of frames in one line."""


class StaticTransforms:
    """Transforms from parent to child frames; the newest of each child counts, as in tf2."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, np.ndarray, np.ndarray]] = {}

    def add(self, parent: str, child: str, *, xyz: Sequence[float], quaternion: Sequence[float]) -> bool:
        """
        Add the pose of a child frame in its parent: translation in m, quaternion (x, y, z, w).

        Returns
        -------
        bool
            Whether it was usable: finite, a quaternion that turns, two frames.

        """
        xyz, quaternion = np.array(xyz, float), np.array(quaternion, float)
        if not (np.isfinite(xyz).all() and np.isfinite(quaternion).all() and np.linalg.norm(quaternion) > 0.5) or parent == child:
            return False
        self._parents[child] = (parent, xyz, Rotation.from_quat(quaternion).as_matrix())
        return True

    def pose(self, target: str, source: str) -> tuple[np.ndarray, np.ndarray] | None:
        """
        Return the pose of `source` in `target`, or None if they are not connected.

        Returns
        -------
        xyz_t : ndarray
            Origin of the source in the target frame, m, shape (3,).
        mat_ts : ndarray
            Turns source vectors into target vectors, shape (3, 3).

        """
        ups, downs = self._to_root(source), self._to_root(target)
        if ups[-1][0] != downs[-1][0]:
            return None
        (_, xyz_s, mat_rs), (_, xyz_t, mat_rt) = ups[-1], downs[-1]
        return mat_rt.T @ (xyz_s - xyz_t), mat_rt.T @ mat_rs

    def why_not(self, target: str, source: str) -> str:
        """Return the missing connection of two frames as text."""
        known = {*self._parents, *(parent for parent, _, _ in self._parents.values())}
        if not known:
            return 'no static transform has come'
        absent = [f"'{name}'" for name in (target, source) if name not in known]
        names = ', '.join(sorted(known)[:NAMED]) + (', ...' if len(known) > NAMED else '')
        return f'{" and ".join(absent)} {"is" if len(absent) == 1 else "are"} in none that came (frames: {names})' if absent else \
            f"'{target}' and '{source}' are in trees without a static connection (roots: {self._to_root(target)[-1][0]}, " \
            f'{self._to_root(source)[-1][0]})'

    def _to_root(self, frame):
        """Return (ancestor, origin of `frame` in it, matrix from `frame` to it) from the frame up to its root; a ring ends once closed."""
        steps, seen = [(frame, np.zeros(3), np.eye(3))], {frame}
        while (step := self._parents.get(steps[-1][0])) is not None and step[0] not in seen:
            parent, xyz, mat = step
            _, origin, turned = steps[-1]
            steps.append((parent, xyz + mat @ origin, mat @ turned))
            seen.add(parent)
        return steps


def up_of(root: str, transforms: Iterable[tuple[str, str, np.ndarray]]) -> tuple[float, float, float]:
    """
    Return the z axis of the outermost frame in the frame `root`: up, where that frame is the world or a map.

    Parameters
    ----------
    root : str
        Frame of the robot's root.
    transforms : iterable of (parent, child, quaternion)
        The quaternion x, y, z, w turns vectors of the child into the parent.

    Raises
    ------
    InputError
        When the frames form a circle.

    """
    parents = {child: (parent, quaternion) for parent, child, quaternion in transforms}
    up, frame, passed = np.array([0.0, 0.0, 1.0]), root, []
    mats = []
    while frame in parents:
        passed.append(frame)
        frame, quaternion = parents[frame]
        if frame in passed:
            raise InputError(f"static transforms must form a tree, those around '{frame}' form a circle; correct them, or give `up`",
                             key='up', code='frame_circle')
        mats.append(_matrix(quaternion))
    for matrix in reversed(mats):
        up = matrix.T @ up
    return tuple(up.tolist())


def _matrix(quaternion):
    """Return the rotation matrix of a quaternion x, y, z, w of any length, shape (3, 3)."""
    return Rotation.from_quat(quaternion).as_matrix()
