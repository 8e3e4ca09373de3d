"""Evidence from a recording without a table: few poses, so that variances are estimated too and every pose is held out in turn."""

from collections.abc import Sequence

import numpy as np

from imu_calibration.core.distributions import f_sf
from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.noise_model import BiasProcess
from imu_calibration.estimation.noise_search import NoiseLikelihood
from imu_calibration.estimation.whitening import Whitening
from imu_calibration.references.gravity.bias_movement import orthonormal_basis
from imu_calibration.references.gravity.effect_rows import Block, HandSpace
from imu_calibration.selection.evidence import Evidence

POSE_FOLDS = 12
"""Number of folds of the poses; with up to `ONE_BY_ONE` poses each pose is a fold."""
ONE_BY_ONE = 24
SCATTER_RATIOS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
"""Candidate scatter of poses or turns beyond the noise of their samples, in units of that noise."""
BIASES = (0.0, 0.5, 1.0, 2.0, 4.0)
"""Candidate bias processes, in units of offset and noise together."""
BIAS_TIMES = (100.0, 300.0)
"""Its correlation times, s."""
DEPENDENT = 1e-9
"""Singular value of scaled columns, over the largest, up to which one of them depends on the others."""
MIN_COLUMN_DIFFERENCE = 0.1
"""Columns that differ by less than this count as collinear."""
MIN_COLUMN_SINE = 0.2
"""Least sine of the angle between a column and the baseline's columns for the column to count."""


class HandEvidence(Evidence):
    """
    Losses of choices of parameters on all poses and on held-out poses.

    Losses are ``n log(mean square)`` per block: the variance is not known but estimated from the same few rows.

    Parameters
    ----------
    blocks : sequence of Block
    space : HandSpace
    smooth : sequence of int
        Parameters of effects that are smooth in time, included when the noise is estimated.
    baseline : sequence of int
        Parameters of the model under diagnosis.

    """

    def __init__(self, blocks: Sequence[Block], space: HandSpace, smooth: Sequence[int], *, baseline: Sequence[int]):
        self.blocks, self.space = blocks, space
        self._noise = [_noise(block, [*baseline, *(k for k in smooth if np.any(block.rows[:, :, k]))]) for block in blocks]
        poses = np.unique(np.concatenate([block.pose for block in blocks]))
        n_folds = len(poses) if len(poses) <= ONE_BY_ONE else POSE_FOLDS
        self.folds = [np.searchsorted(poses, block.pose) % n_folds for block in blocks]
        self._white = self._whitened()
        total, *without = (sum(rows.T @ rows for rows in white) for white in (self._white, *map(self._whitened, range(n_folds))))
        super().__init__(total, np.array(without), prior_sd=space.prior_sd, prior_mean=np.zeros(space.size))

    def _whitened(self, number=None):
        """Return the rows of each block, without fold `number`, as independent rows of unit variance, a list of (m, q + 1)."""
        white = []
        for block, (variance, processes), fold in zip(self.blocks, self._noise, self.folds):
            kept = fold != number
            whitening = Whitening(variance[kept], block.time[kept], [np.arange(kept.sum())], processes=processes)
            white.append(whitening(block.rows[kept]).reshape(-1, self.space.size + 1))
        return white

    def residuals(self, used: Sequence[int]) -> list[np.ndarray]:
        """Return the residual rows of each block under the fit to all poses, shape (m, n_axes)."""
        values = self.fit(used)[0]
        return [block.rows[:, :, -1] - block.rows[:, :, list(used)] @ values for block in self.blocks]

    def heldout_residuals(self, used: Sequence[int]) -> list[np.ndarray]:
        """Return the residual of every row under the fit without its pose, shape (m, n_axes) per block."""
        left = self.left_by_others(used)
        return [np.einsum('mac,mc->ma', block.rows, left[fold]) for block, fold in zip(self.blocks, self.folds)]

    def against_noise(self, used: Sequence[int]) -> dict[str, np.ndarray]:
        """Return sensor -> squares of the same in units of noise and usual bias drift, of each block, shape (n_blocks, 1)."""
        left = self.heldout_residuals(used)
        return {sensor: np.array([[np.sum(r**2 / block.floor)] for block, r in zip(self.blocks, left) if block.sensor == sensor])
                for sensor in SENSORS}

    @property
    def numbers(self) -> dict[str, np.ndarray]:
        """Sensor -> number of the squares of each block."""
        return {sensor: np.array([block.known.size for block in self.blocks if block.sensor == sensor]) for sensor in SENSORS}

    def _heldout(self, used):
        squares = [r**2 / (variance + sum(process.sd**2 for process in processes))
                   for r, (variance, processes) in zip(self.heldout_residuals(used), self._noise)]
        return float(sum(s.size * np.log(s.mean()) for s in squares))

    def _loss(self, used):
        return float(sum(len(white) * np.log(np.mean(self._left(white, used)**2)) for white in self._white))

    def _left(self, white, used):
        return white[:, -1] - white[:, list(used)] @ self.fit(used)[0]

    def p_value(self, smaller: Sequence[int], larger: Sequence[int]) -> float:
        """Return the p-value of `larger` against `smaller`: F test on the blocks that contain the new columns."""
        added = [k for k in larger if k not in set(smaller)]
        concerned = [white for white in self._white if np.any(white[:, added])]
        squares = [sum(np.sum(self._left(white, used)**2) for white in concerned) for used in (smaller, larger)]
        rank = max(self.rank(added, smaller), 1)
        in_use = np.any([np.any(white[:, list(larger)] != 0, axis=0) for white in concerned], axis=0).sum()
        spare = sum(map(len, concerned)) - int(in_use)
        if spare < 3 or squares[1] <= 0:
            return 1.0
        return float(f_sf(max(squares[0] - squares[1], 0.0) / rank / (squares[1] / spare), rank, spare))

    def rank(self, added: Sequence[int], smaller: Sequence[int]) -> int:
        """Return how many combinations of the added columns are not collinear with the smaller choice."""
        white = np.concatenate(self._white)
        known, new = orthonormal_basis(white[:, list(smaller)], DEPENDENT), orthonormal_basis(white[:, list(added)], MIN_COLUMN_DIFFERENCE)
        if not new.shape[1]:
            return 0
        sines = np.linalg.svd(new - known @ (known.T @ new), compute_uv=False)
        return int(np.sum(sines > MIN_COLUMN_SINE))


def _noise(block, used):
    """Return (independent variance of each row (m, n_axes), bias processes): scatter between rows, for poses a bias process too."""
    count, axes, width = block.rows.shape
    basis = orthonormal_basis(block.rows.reshape(-1, width)[:, used], DEPENDENT)
    rows = np.concatenate([basis.reshape(count, axes, -1), block.rows[:, :, -1:]], axis=2)
    likelihood = NoiseLikelihood(rows, block.known, block.time, sessions=[np.arange(count)])
    biases = [(share, time) for share in BIASES[1:] for time in BIAS_TIMES] if block.name == 'poses' else []
    shapes = [(offset, share * max(offset, 1.0), time) for offset in SCATTER_RATIOS for share, time in [(0.0, BIAS_TIMES[0]), *biases]]
    offset, bias, time = min(shapes, key=likelihood.loss)
    unit = likelihood.typical
    return block.known + (offset * unit)**2, (BiasProcess(bias * unit, time),) if bias else ()
