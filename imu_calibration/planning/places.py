"""Positions of the joints: attitudes spread over the reach of the chain within its limits."""

import numpy as np

from imu_calibration.reference.joint_motion import JointMotion
from imu_calibration.reference.kinematics import reference_motion
from imu_calibration.reference.motion_limits import MotionLimits
from imu_calibration.reference.table import Table

N_TRIED = 512
"""Positions that places are chosen from: a power of two, as the sequence wants it."""
GRID = np.pi / 4
"""On a table with few joints the positions are multiples of this, so that they include faces, edges and corners."""
UNBOUNDED = 1e9
"""Finite stand-in for the ends of endless joints, rad."""
HEADING = 0.4
"""Weight of the horizontal axes relative to the vertical in comparisons of attitudes: headings show the tilt only."""


def reachable(limits: MotionLimits) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends within which places are chosen: of joints that turn, at most one turn about the middle of the range."""
    wide = limits.turns & (limits.upper - limits.lower > 2 * np.pi)
    middle = 0.5 * (np.maximum(limits.lower, -UNBOUNDED) + np.minimum(limits.upper, UNBOUNDED))   # 0 without ends
    return np.where(wide, middle - np.pi, limits.lower), np.where(wide, middle + np.pi, limits.upper)


def rest_at(position: np.ndarray) -> JointMotion:
    """Return rest at each of the positions, shape (n, n_joints)."""
    zero = np.zeros_like(position)
    return JointMotion(np.zeros(len(position)), position, zero, zero, zero)


def up_at(table: Table, position: np.ndarray) -> np.ndarray:
    """Return which direction of the sensor frame points up where the joints rest at a position, unit vector, shape (3,)."""
    return reference_motion(table, rest_at(np.asarray(position, float)[None])).mat_sn[0] @ np.array([0.0, 0.0, 1.0])


def candidates(limits: MotionLimits) -> np.ndarray:
    """Return positions to choose from, the first that nearest to zero, shape (n, n_joints)."""
    from scipy.stats import qmc  # here, because it takes long to import

    lower, upper = reachable(limits)
    home = np.clip(np.zeros(len(limits)), lower, upper)
    spread = lower + (upper - lower) * qmc.Sobol(len(limits), seed=5).random(N_TRIED)
    parts = [home[None], spread]
    if len(limits) <= 3:
        steps = [np.arange(np.ceil(a / GRID - 1e-9), np.floor(b / GRID + 1e-9) + 1) * GRID if turning else np.linspace(a, b, 3)
                 for a, b, turning in zip(lower, upper, limits.turns, strict=True)]
        grid = np.stack(np.meshgrid(*steps, indexing='ij'), axis=-1).reshape(-1, len(limits))
        parts.insert(1, grid[np.lexsort(np.abs(grid).T)])
    return np.concatenate(parts)


def choose_places(table: Table, limits: MotionLimits, count: int) -> np.ndarray:
    """
    Return positions whose attitudes have the largest distances, the first at home, shape (n, n_joints).

    Each next position has the attitude furthest from the chosen ones; of equals the one nearest to zero, which the order of
    `candidates` sees to. Where all attitudes that are left are as good as there already, fewer are returned.
    """
    tried = candidates(limits)
    mats = reference_motion(table, rest_at(tried)).mat_sn
    features = np.concatenate([mats[:, :, 2], HEADING * mats[:, :, 0], HEADING * mats[:, :, 1]], axis=1)
    chosen, distance = [0], np.linalg.norm(features - features[0], axis=1)
    while len(chosen) < count and distance.max() > 0.05:
        nearly = distance > distance.max() - 1e-6
        chosen.append(int(np.argmax(nearly)))
        distance = np.minimum(distance, np.linalg.norm(features - features[chosen[-1]], axis=1))
    return tried[chosen]
