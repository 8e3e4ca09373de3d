"""Evidence from a recording without a table: few poses, so that variances are estimated along and every pose is held out in turn."""

from functools import cached_property

import numpy as np
import scipy.linalg
from scipy.stats import f as f_distribution

FOLDS = 12
"""Parts that poses are dealt into; with up to `ONE_BY_ONE` poses each is a part of its own."""
ONE_BY_ONE = 24
OFFSETS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
"""Scatter of poses or turns beyond the noise of their samples that is tried, in units of that noise."""
WANDERS = (0.0, 0.5, 1.0, 2.0, 4.0)
"""Wander of the bias that is tried, in units of offset and noise together."""
TIMES = (100.0, 300.0)
"""Its correlation times, s."""
ALIKE = 0.1
"""Columns that differ by less than this count as one."""
UNIQUE = 0.2
"""Least sine of the angle between a column and what the baseline explains for the column to count."""


class HandEvidence:
    """
    Losses of choices of parameters on all poses and on those held out; what `Search` asks for.

    Losses are ``n log(mean square)`` per block: the variance is not known but estimated from the same few rows.
    """

    def __init__(self, blocks, space, smooth, baseline):
        self.blocks, self.space, self.baseline = blocks, space, tuple(baseline)
        self.covariances = [_covariance(block, np.r_[list(baseline), _alive(block, smooth)].astype(int)) for block in blocks]
        poses = np.unique(np.concatenate([block.pose for block in blocks]))
        self.n_folds = len(poses) if len(poses) <= ONE_BY_ONE else FOLDS
        place = {pose: k % self.n_folds for k, pose in enumerate(poses)}
        self.folds = [np.array([place[pose] for pose in block.pose]) for block in blocks]
        self._fits = {}

    @cached_property
    def _white(self):
        return [scipy.linalg.solve_triangular(np.linalg.cholesky(v), b.rows, lower=True) for v, b in zip(self.covariances, self.blocks)]

    @cached_property
    def total(self):
        """Normal matrix of all rows, shape (q + 1, q + 1)."""
        return sum(white.T @ white for white in self._white)

    @cached_property
    def _without(self):
        """Normal matrices without each fold."""
        found = []
        for number in range(self.n_folds):
            normal = np.zeros((self.space.size + 1,) * 2)
            for block, covariance, fold in zip(self.blocks, self.covariances, self.folds):
                kept = np.flatnonzero(fold != number)
                if len(kept):
                    rows = scipy.linalg.solve_triangular(np.linalg.cholesky(covariance[np.ix_(kept, kept)]), block.rows[kept], lower=True)
                    normal += rows.T @ rows
            found.append(normal)
        return found

    def fit(self, used, number=None):
        """Return (values, inverse information) of the parameters `used` on all poses, or on all but fold `number`."""
        key = (tuple(used), number)
        if key not in self._fits:
            normal, index = (self.total if number is None else self._without[number]), np.asarray(used)
            information = normal[np.ix_(index, index)] + np.diag(1 / self.space.prior_sd[index]**2)
            scale = 1 / np.sqrt(np.diag(information))
            scaled = information * np.outer(scale, scale)
            scaled.flat[::len(index) + 1] += 1e-12
            inverse = np.linalg.inv(scaled) * np.outer(scale, scale)
            self._fits[key] = inverse @ normal[index, -1], inverse
        return self._fits[key]

    def residuals(self, used):
        """Return the residual rows of each block under the fit to all poses."""
        values = self.fit(used)[0]
        return [block.rows[:, -1] - block.rows[:, list(used)] @ values for block in self.blocks]

    def heldout_residuals(self, used):
        """Return the residual of every row under the fit that did not see its pose, a list per block."""
        values = np.array([self.fit(used, number)[0] for number in range(self.n_folds)])
        index = list(used)
        return [b.rows[:, -1] - np.einsum('mp,mp->m', b.rows[:, index], values[fold]) for b, fold in zip(self.blocks, self.folds)]

    def heldout(self, used):
        """Return the loss of all poses when each is held out in turn."""
        squares = [r**2 / np.diag(v) for r, v in zip(self.heldout_residuals(used), self.covariances)]
        return float(sum(len(s) * np.log(s.mean()) for s in squares))

    def loss(self, used):
        """Return the loss of the best fit to all poses."""
        values = np.append(-self.fit(used)[0], 1.0)
        index = np.append(np.asarray(used), self.space.size)
        return float(sum(len(w) * np.log(np.mean((w[:, index] @ values)**2)) for w in self._white))

    def p_value(self, smaller, larger):
        """Return the p-value of `larger` against `smaller`: F test on the blocks in which the new columns stand."""
        added = [k for k in larger if k not in set(smaller)]
        squares, count = np.zeros(2), 0
        for white, block in zip(self._white, self.blocks):
            if not np.any(block.rows[:, added]):
                continue
            squares += [np.sum((white[:, np.append(u, self.space.size)] @ np.append(-self.fit(u)[0], 1.0))**2) for u in map(list, (smaller, larger))]
            count += len(white)
        rank = max(self.rank(added, smaller), 1)
        spare = count - self._columns_in_use(larger, added)
        if spare < 3 or squares[1] <= 0:
            return 1.0
        return float(f_distribution.sf(max(squares[0] - squares[1], 0.0) / rank / (squares[1] / spare), rank, spare))

    def _columns_in_use(self, used, added):
        """Return the number of parameters that act on the blocks of the added columns."""
        rows = np.concatenate([b.rows[:, list(used)] for b in self.blocks if np.any(b.rows[:, added])])
        return int(np.sum(np.any(rows != 0, axis=0)))

    def rank(self, added, smaller):
        """Return how many combinations of the added columns the smaller choice cannot imitate."""
        white = np.concatenate(self._white)
        known, new = _basis(white[:, list(smaller)]), _basis(white[:, list(added)], ALIKE)
        if not new.shape[1]:
            return 0
        sines = np.linalg.svd(new - known @ (known.T @ new), compute_uv=False)
        return int(np.sum(sines > UNIQUE))


def _alive(block, columns):
    return [k for k in columns if np.any(block.rows[:, k])]


def _basis(columns, least=1e-9):
    """Return an orthonormal basis of the span of columns, which may be empty or dependent: singular values above `least` of the largest count."""
    size = np.linalg.norm(columns, axis=0)
    columns = columns[:, size > 0] / size[size > 0]
    if not columns.shape[1]:
        return columns
    left, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, singular > least * singular[0]]


def _covariance(block, used):
    """Return the covariance of the rows: noise, scatter from row to row, and for poses a wandering bias; restricted likelihood."""
    typical = float(np.sqrt(np.median(block.known)))
    columns = _basis(block.rows[:, used])
    residual = block.rows[:, -1]
    steps = np.abs(block.time[:, None] - block.time[None, :])
    same = block.axis[:, None] == block.axis[None, :]
    kernels = [same * np.exp(-steps / time) for time in TIMES] if block.name == 'poses' else []
    best = None
    for offset in OFFSETS:
        for share, kernel in [(0.0, None)] + [(w, k) for w in WANDERS[1:] for k in kernels]:
            covariance = np.diag(block.known + (offset * typical)**2)
            if kernel is not None:
                covariance += (share * typical)**2 * max(offset, 1.0)**2 * kernel
            cost = _restricted_cost(covariance, columns, residual)
            if best is None or cost < best[0] - 1e-9:
                best = (cost, covariance)
    return best[1]


def _restricted_cost(covariance, columns, residual):
    factor = np.linalg.cholesky(covariance)
    white = scipy.linalg.solve_triangular(factor, np.column_stack([columns, residual]), lower=True)
    inner = white[:, :-1].T @ white[:, :-1]
    root = np.linalg.cholesky(inner + 1e-12 * np.trace(inner) / max(len(inner), 1) * np.eye(len(inner)))
    solved = scipy.linalg.solve_triangular(root, white[:, :-1].T @ white[:, -1], lower=True)
    return 2 * np.log(np.diag(factor)).sum() + 2 * np.log(np.diag(root)).sum() + white[:, -1] @ white[:, -1] - solved @ solved
