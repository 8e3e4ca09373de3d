"""The formula of the grammar that explains the residual of a sensor, chosen on selection windows and evaluated on locked windows."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import svd

from imu_calibration.core.distributions import chi2_sf
from imu_calibration.effects.expressions import array_function, read
from imu_calibration.kinematics.rotations import Reference
from imu_calibration.selection.grammar import Formula
from imu_calibration.selection.residual_blocks import RestBlocks
from imu_calibration.selection.search import FAMILY_WISE, TIE

NEW = 1e-3
"""Least share of a column's size outside the span of the catalogue for a test of it."""
CHUNK = 128
"""Columns that are worked out at once."""


@dataclass(frozen=True, eq=False)
class FormulaChoice:
    """One formula with its evidence."""

    formula: Formula
    """The candidate."""
    columns: np.ndarray
    """Means over the blocks, shape (b, k, 3): the last index is the axis it acts on."""
    p_value: float
    """Probability of such a reduction of the misfit by noise, times the number of formulas."""
    alike: tuple[Formula, ...]
    """Formulas that are not separable from it, the likeliest first."""


@lru_cache(maxsize=64)
def _function(texts):
    return array_function([read(text) for text in texts])


class FormulaSearch:
    """
    Formulas on one sensor's blocks, with baseline and catalogue projected out up to plausible sizes.

    Parameters
    ----------
    blocks : RestBlocks
    formulas : sequence of Formula
    plausible : array, shape (q, q)
        Factor of the covariance that the parameters of the space may plausibly have.
    reference_temperature : float

    """

    def __init__(self, blocks: RestBlocks, formulas: Sequence[Formula], plausible: np.ndarray, *, reference_temperature: float):
        self.blocks, self.formulas = blocks, formulas
        self._place = {text: k for k, text in enumerate(dict.fromkeys(t for f in formulas for column in f.columns for t in _three(column)))}
        self.means = self._worked_out(tuple(self._place), reference_temperature)
        whiten = blocks.whitener(~blocks.locked)
        every = whiten(np.concatenate([*blocks.design, self.means], axis=1))
        ends = np.cumsum([0, *(part.shape[1] for part in blocks.design)])
        self._rest, self._free, self.known = [], [], []
        for axis in range(3):
            part = every[:, ends[axis]:ends[axis + 1]] / whiten.scale[axis]
            left, sizes = svd(part[:, :-1] @ plausible[blocks.index[axis]], full_matrices=False, lapack_driver='gesdd')[:2]
            # Plausible contributions of the catalogue count as noise: a direction keeps the excess over its plausible size.
            basis, damped = left, (1.0 - 1.0 / np.sqrt(1.0 + sizes**2))[:, None]
            columns = every[:, ends[3]:] / whiten.scale[axis]
            self._rest.append(part[:, -1] - basis @ (damped[:, 0] * (basis.T @ part[:, -1])))
            free = columns - basis @ (damped * (basis.T @ columns))
            size = np.einsum('bt,bt->t', columns, columns)
            new = np.einsum('bt,bt->t', free, free) > NEW**2 * np.maximum(size, 1e-300)
            self._free.append(np.where(new, free, 0.0))
            self.known.append(int((sizes > 1.0).sum()))

    def _worked_out(self, texts, reference_temperature):
        ref, places = self.blocks.ref, _values(self.blocks.ref, reference_temperature)
        means = np.empty((len(self.blocks.time), len(texts)))
        with np.errstate(all='ignore'):
            for first in range(0, len(texts), CHUNK):
                worked = _function(texts[first:first + CHUNK])(places)
                rows = np.stack([np.broadcast_to(np.asarray(column, float), len(ref)) for column in worked], axis=1)
                means[:, first:first + len(worked)] = self.blocks.means(rows)
        return np.nan_to_num(means, nan=0.0, posinf=0.0, neginf=0.0)

    @property
    def misfit(self) -> float:
        """Chi-square per degree of freedom of the part outside the catalogue, at least 1."""
        dof = max(3 * len(self._rest[0]) - sum(self.known), 1)
        return max(sum(float(rest @ rest) for rest in self._rest) / dof, 1.0)

    def best(self) -> FormulaChoice | None:
        """Return the simplest of the likeliest formulas, or None where none is significant."""
        gains, counts = self._gains()
        price = 2.0 * counts
        order = np.argsort(price - gains)
        likeliest = order[0]
        p_value = min(1.0, float(chi2_sf(gains[likeliest], max(counts[likeliest], 1))) * len(self.formulas))
        if p_value > FAMILY_WISE or gains[likeliest] <= price[likeliest]:
            return None
        dof = max(3 * len(self._rest[0]) - sum(self.known), 1)
        left = max((sum(float(rest @ rest) for rest in self._rest) - gains[likeliest]) / dof, 1.0)
        near = [k for k in order[:200] if (gains - price)[likeliest] - (gains - price)[k] < 2 * TIE * left and counts[k]]
        chosen = min(near, key=lambda k: (self.formulas[k].complexity, price[k] - gains[k]))
        return FormulaChoice(self.formulas[chosen], self.columns_of(self.formulas[chosen]), p_value,
                      tuple(self.formulas[k] for k in near if k != chosen))

    def columns_of(self, formula: Formula) -> np.ndarray:
        """Return the means of a formula's columns, shape (b, k, 3)."""
        return np.stack([self.means[:, self._at(column)] for column in formula.columns], axis=1)

    def take(self, choice: FormulaChoice) -> None:
        """Project a choice out, so that the next is tested conditional on it."""
        for axis in range(3):
            columns = self._free[axis][:, [self._at(column)[axis] for column in choice.formula.columns]]
            basis, sizes = svd(columns, full_matrices=False)[:2]
            basis = basis[:, sizes > 1e-9 * max(sizes.max(), 1e-300)]
            self._rest[axis] = self._rest[axis] - basis @ (basis.T @ self._rest[axis])
            self._free[axis] = self._free[axis] - basis @ (basis.T @ self._free[axis])
            self.known[axis] += basis.shape[1]

    def _at(self, column):
        return [self._place[text] for text in _three(column)]

    def _gains(self):
        """Return (fall of chi-square, number of amplitudes) of each formula, shape (n,) both."""
        gains, counts = np.zeros(len(self.formulas)), np.zeros(len(self.formulas))
        for width in {len(formula.columns) for formula in self.formulas}:
            chosen = [k for k, formula in enumerate(self.formulas) if len(formula.columns) == width]
            for axis in range(3):
                at = np.array([[self._at(column)[axis] for column in self.formulas[k].columns] for k in chosen])
                free = self._free[axis]
                size = np.sqrt(np.maximum(np.einsum('bt,bt->t', free, free), 1e-300))
                slopes = (free.T @ self._rest[axis]) / size
                gram = np.eye(width) * np.ones((len(chosen), 1, 1))
                for i in range(width):
                    for j in range(i):
                        inner = np.einsum('bg,bg->g', free[:, at[:, i]], free[:, at[:, j]]) / (size[at[:, i]] * size[at[:, j]])
                        gram[:, i, j] = gram[:, j, i] = np.clip(inner, -1.0, 1.0)
                gram += 1e-6 * np.eye(width)
                right = slopes[at]
                gains[chosen] += np.einsum('gk,gk->g', right, np.linalg.solve(gram, right[..., None])[..., 0])
                counts[chosen] += (size[at] > 1e-100).sum(axis=1)
        return gains, counts


def _three(column):
    return (column,) * 3 if isinstance(column, str) else column


def _values(ref: Reference, reference_temperature: float) -> dict:
    """Return the values of the names in a formula."""
    values = {'time': ref.time, 'temperature_ref_c': np.float64(reference_temperature)}
    if ref.temperature_c is not None:
        values['temperature_c'] = ref.temperature_c
    for k, axis in enumerate('xyz'):
        values |= {f'f_{axis}': ref.force_s[:, k], f'w_{axis}': ref.rate_s[:, k], f'alpha_{axis}': ref.alpha_s[:, k]}
        values |= {f'c_{axis}{level}': ref.mat_sn[:, k, m] for m, level in enumerate('xyz')}
    for k in range(ref.joint_angle.shape[1]):
        values |= {f'angle_{k + 1}': ref.joint_angle[:, k], f'joint_rate_{k + 1}': ref.joint_rate[:, k]}
    return values
