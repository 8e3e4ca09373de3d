"""Rotation of measured gravity against measured rates: unit and axes of one sensor against the other, without a table."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.kinematics.reference_motion import skew
from imu_calibration.preprocessing.chunks import Chunks

LARGEST_TURN = 0.7
"""Turns of gravity from chunk to chunk above it are left out, rad."""
FORCE_BAND = 0.2
"""Chunks in which the specific force differs from the usual length, or scatters, by more than this share are excluded as accelerated."""
LEAST_TURN = 1.0
"""Gravity must turn by this much altogether, rad."""
LEAST_EXPLAINED = 0.5
WIDTH = 4.0
"""Factor on standard deviations for the correlation of errors of neighbouring chunks."""
SURE = 0.15
"""A direction is determined when the standard deviation of its column is below this share of its length."""


@dataclass(frozen=True, eq=False)
class Turning:
    """Relation between measured rates and the rotation of measured gravity."""

    matrix: np.ndarray
    """
    ``true rate = matrix @ measured rate`` in the frame of the accelerometer, zero across the directions that were not seen, shape (3, 3).
    """
    seen: np.ndarray
    """
    Projector on the directions with measured rates, shape (3, 3): turns about only (1, 1, 1) determine one direction and no axis.
    """
    explained: float
    """Share of gravity's turns that it explains."""

    @property
    def axes(self) -> np.ndarray:
        """Which of the gyroscope's axes were mostly seen, shape (3,)."""
        return np.diag(self.seen) > 0.5

    @property
    def everywhere(self) -> bool:
        """Whether the rates covered all directions."""
        return round(np.trace(self.seen)) == 3

    @property
    def factor(self) -> float:
        """True rate over measured rate: 1, or pi / 180 for deg/s."""
        return float(np.median(np.linalg.svd(self.matrix, compute_uv=False)[:round(np.trace(self.seen))]))


def relate_turns(chunks: Chunks) -> Turning | None:
    """
    Return the `Turning` of Chunks, or None when gravity turns too little or is not explained by the rates.

    ``du/dt = u x (matrix @ rate + offset)`` for the direction u of specific force; no assumptions on units, axes or bias.
    """
    pairs = _pairs(chunks)
    if pairs is None:
        return None
    direction, change, turn_time, rate = pairs
    spread, directions = np.linalg.eigh(rate.T @ rate / len(rate))
    spread = np.sqrt(np.maximum(spread, 0.0))
    if np.linalg.norm(change, axis=1).sum() < LEAST_TURN or not spread.max() > 0:
        return None
    kept = spread > 1e-3 * spread.max()
    while kept.any():
        seen, scale = directions[:, kept], spread[kept]
        matrix, sure, explained = _fit(direction, change, turn_time, rate @ seen / scale)
        if explained < LEAST_EXPLAINED:
            return None
        if sure.all():
            return Turning(matrix / scale @ seen.T, seen @ seen.T, explained)
        # The direction with the smallest rates may be leakage of another direction, and then degrades both.
        kept = kept & (spread > spread[kept].min())
    return None


def _fit(direction, change, turn_time, rate):
    """Return (matrix (3, m), which of the m rates are sure, share explained) by least squares."""
    lever = skew(direction) * turn_time[:, None, None]
    inputs = np.column_stack([rate, np.ones(len(rate))])
    width = inputs.shape[1]
    design = (lever[:, :, :, None] * inputs[:, None, None, :]).reshape(-1, 3 * width)
    target = change.ravel()
    normal = design.T @ design
    inverse = np.linalg.pinv(normal + 1e-9 * np.trace(normal) * np.eye(3 * width))
    solution = inverse @ (design.T @ target)
    rest = float(((target - design @ solution)**2).sum())
    sd = WIDTH * np.sqrt(np.diag(inverse) * rest / max(len(target) - 3 * width, 1)).reshape(3, width)[:, :-1]
    matrix = solution.reshape(3, width)[:, :-1]
    return matrix, np.linalg.norm(sd, axis=0) < SURE * np.linalg.norm(matrix, axis=0), 1.0 - rest / float((target**2).sum())


def _pairs(chunks):
    """Return (direction, its change, time between, rate) for neighbouring chunks in which gravity rules the accelerometer, or None."""
    if len(chunks) < 20:
        return None
    length = np.linalg.norm(chunks.mean[:, :3], axis=1)
    usual = np.median(length)
    if not usual > 0:
        return None
    direction = chunks.mean[:, :3] / np.maximum(length, 1e-9 * usual)[:, None]
    step = np.diff(chunks.time)
    change = np.diff(direction, axis=0)
    whole = np.abs(chunks.duration / np.median(chunks.duration) - 1) < 0.5
    whole &= (np.abs(length / usual - 1) < FORCE_BAND) & (np.linalg.norm(chunks.sd[:, :3], axis=1) < FORCE_BAND * usual)
    good = whole[1:] & whole[:-1] & (step > 0) & (step < 1.5 * np.median(step)) & (np.linalg.norm(change, axis=1) < LARGEST_TURN)
    if good.sum() < 20:
        return None
    middle = direction[1:] + direction[:-1]
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-9)
    rate = 0.5 * (chunks.mean[1:, 3:] + chunks.mean[:-1, 3:])[good]
    return middle[good], change[good], step[good], rate - np.median(rate, axis=0)
