"""Rests of the sensor, independent of its units, and its readings there."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.core.samples import runs_of
from imu_calibration.preprocessing.chunks import Chunks

LEAST_CHUNKS = 4
STILL = 0.02
"""Largest turn of the measured gravity from one chunk to the next, rad."""


LEAST_POSES = 9
LEAST_FACES = 6
FARTHEST = 0.8
"""Bias in units of gravity from which on readings are no sphere but counts with an offset."""
LEAST_SPREAD = 0.05
"""Smallest eigenvalue of the scatter of directions (1/3 when they are even) above which poses separate bias from length."""


@dataclass(frozen=True, eq=False)
class Rest:
    """Readings while steady: at rest, or in a rotation with constant direction of gravity."""

    force: np.ndarray
    """Mean specific force in each steady stretch, shape (n_stretches, 3)."""
    rate: np.ndarray
    """Median of the mean rate, shape (3,)."""
    range: np.ndarray
    """Median over the chunks at rest of largest minus smallest, force then rate, shape (6,); 0 where the noise does not show."""
    ranges: np.ndarray
    """First chunk of each stretch and the one after its last, shape (n_stretches, 2)."""

    @property
    def norm(self) -> np.ndarray:
        """Length of the specific force in each stretch, shape (n_stretches,)."""
        return np.linalg.norm(self.force, axis=1)

    @property
    def sphere(self) -> tuple[np.ndarray, float] | None:
        """Centre (the bias) and radius of the sphere on which the readings of many poses lie, or None."""
        return self._sphere() if len(self.force) >= LEAST_POSES else None

    @property
    def bias(self) -> np.ndarray | None:
        """Bias of the accelerometer, to a tenth of gravity or so, where six faces or more show it, or None."""
        found = self._sphere() if len(self.force) >= LEAST_FACES else None
        return None if found is None else found[0]

    def _sphere(self):
        scaled = self.force / np.median(self.norm)
        design = np.column_stack([2 * scaled, np.ones(len(scaled))])
        *centre, rest = np.linalg.lstsq(design, (scaled**2).sum(axis=1), rcond=None)[0]
        centre = np.array(centre)
        directions = (scaled - centre) / np.maximum(np.linalg.norm(scaled - centre, axis=1, keepdims=True), 1e-9)
        spread = np.linalg.eigvalsh(np.cov(directions.T))[0]
        if spread < LEAST_SPREAD or np.linalg.norm(centre) > FARTHEST:
            return None
        return centre * np.median(self.norm), float(np.sqrt(rest + centre @ centre) * np.median(self.norm))

    @property
    def length(self) -> float:
        """Gravity in the units of the accelerometer: the radius of the sphere, else the median length."""
        return float(np.median(self.norm)) if self.sphere is None else self.sphere[1]


def find_rest(chunks: Chunks) -> Rest | None:
    """Return the `Rest` of Chunks, or None when the sensor never rests (see `still_chunks`)."""
    still = still_chunks(chunks)
    if still.sum() < LEAST_CHUNKS:
        return None
    runs = _stretches(still)
    force = np.array([chunks.mean[a:b, :3].mean(axis=0) for a, b in runs])
    return Rest(force, np.median(chunks.mean[still, 3:], axis=0), np.median(chunks.range[still], axis=0), runs)


def still_chunks(chunks: Chunks) -> np.ndarray:
    """
    Return in which chunks the sensor is at rest, bool, shape (n,).

    At rest both sensors scatter as little as in the quietest tenth, and gravity keeps its direction. Both are relative, so that
    counts and g do as well as m/s^2.
    """
    if len(chunks) < LEAST_CHUNKS:
        return np.zeros(len(chunks), bool)
    quiet = np.ones(len(chunks), bool)
    for part in (slice(0, 3), slice(3, 6)):
        scatter = np.linalg.norm(chunks.sd[:, part], axis=1)
        quiet &= scatter <= 3.0 * np.quantile(scatter, 0.1) + 1e-3 * np.median(scatter)
    direction = chunks.mean[:, :3] / np.maximum(np.linalg.norm(chunks.mean[:, :3], axis=1, keepdims=True), 1e-12)
    turn = np.linalg.norm(np.diff(direction, axis=0), axis=1)
    still = quiet & (np.append(turn, 0.0) < STILL) & (np.append(0.0, turn) < STILL)
    if still.sum() < LEAST_CHUNKS:
        return still
    rate = np.median(chunks.mean[still, 3:], axis=0)
    away = np.linalg.norm(chunks.mean[:, 3:] - rate, axis=1)
    # A spin at constant rate about the vertical is as quiet as rest, but has rates.
    return still & (away <= np.maximum(0.05 * away.max(), 3.0 * np.median(np.linalg.norm(chunks.sd[still, 3:], axis=1))))


def _stretches(still):
    runs = runs_of(still)
    long = runs[np.ptp(runs, axis=1) >= 2]
    return long if len(long) else runs
