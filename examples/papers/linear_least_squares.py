"""
Accurate linear least squares: orthogonal factors of scaled columns instead of normal equations.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from imu_calibration.core.errors import InputError, NotObservableError

RANK_TOLERANCE = 1e-10
"""
A singular value of the unit-column design below this times the largest counts as zero; rounding
errors are about 1e-15.
"""
COLUMN_TOLERANCE = 1e-14
"""
A column shorter than this times the longest is rounding of zero (the sine of pi), not a column to
be scaled up.
"""


@dataclass(frozen=True, eq=False)
class LinearSolution:
    """
    Least-squares solution of ``outputs = design @ values`` for one or several columns of outputs.
    """

    values: np.ndarray
    """Parameters in `param_names` order, shape (n_params,) or (n_params, n_outputs)."""
    param_names: tuple
    """Names of the parameters."""
    unit_covariance: np.ndarray
    """
    Covariance for output noise of sd 1 (of sd 1/sqrt(weight) with weights), shape (n_params,
    n_params).
    """
    residuals: np.ndarray
    """Outputs minus prediction, not weighted, shape of the outputs."""
    cond: float
    """Condition number of the (weighted) design in the units it came in."""
    eqcond: float
    """Condition number after every column is scaled to unit norm; independent of units."""

    @property
    def unit_sd(self) -> np.ndarray:
        """Sd of each parameter for output noise of sd 1, shape (n_params,)."""
        return np.sqrt(np.diag(self.unit_covariance))


def solve_linear(
    design: np.ndarray,
    outputs: np.ndarray,
    param_names: tuple[str, ...],
    *,
    weights: np.ndarray | None = None,
) -> LinearSolution:
    """
    Solve ``outputs = design @ values`` by least squares through the SVD of the unit-column design.

    Parameters
    ----------
    design : array, shape (n, n_params)
        One row per observation.
    outputs : array, shape (n,) or (n, n_outputs)
        Observations; several columns share the design.
    param_names : sequence of str
        One name per column of the design.
    weights : array, shape (n,), optional
        Inverse variances of the observations.

    Returns
    -------
    LinearSolution

    Raises
    ------
    InputError
        When shapes disagree or a value is not finite.
    NotObservableError
        When the design is singular; the message names the directions that it does not determine.

    """
    design, outputs, names, root = _checked(design, outputs, param_names, weights)
    norms, left, singular, right = _scaled_svd(design * root[:, None])
    _require_full_rank(design, norms, singular, right, names)

    def fit(target):
        weighted = (target.T * root).T
        return ((right.T / singular) @ (left.T @ weighted)).T / norms

    values = fit(outputs).T
    # One refinement step: the residual is formed at full precision.
    values = values + fit(outputs - design @ values).T
    inverse = right.T / singular / norms[:, None]
    raw = np.linalg.svd(design * root[:, None], compute_uv=False)
    return LinearSolution(
        values, names, inverse @ inverse.T, outputs - design @ values, _ratio(raw), _ratio(singular)
    )


def numerical_rank(design: np.ndarray) -> int:
    """
    Return the rank of `design` after its columns are scaled to unit norm.

    Zero columns count as zero.
    """
    singular = _scaled_svd(np.asarray(design, float))[2]
    return int(np.sum(~_negligible(singular)))


def condition_numbers(design: np.ndarray) -> tuple[float, float]:
    """
    Return (condition number as it is, condition number with unit-norm columns).

    Infinite when a column is zero.
    """
    design = np.asarray(design, float)
    return _ratio(np.linalg.svd(design, compute_uv=False)), _ratio(_scaled_svd(design)[2])


def null_directions(design: np.ndarray, param_names: tuple[str, ...]) -> list[dict[str, float]]:
    """
    Return the combinations of parameters that change no output, as a list of {name: weight}.

    Weights are changes of the parameters in their own units, the leading one being 1; combinations
    are made as short as an echelon form can. A column of zeros gives a direction of its own.

    """
    norms, _, singular, right = _scaled_svd(np.asarray(design, float))
    weak = right[_negligible(singular)]
    return [] if len(weak) == 0 else _echelon(weak, norms, tuple(param_names))


def predicted_sd(
    design: np.ndarray, weights: np.ndarray | None = None, sigma: float = 1.0
) -> np.ndarray:
    """
    Return the sd that each parameter will have, before any data exist.

    Infinite where the design does not reach it.

    Parameters
    ----------
    design : array, shape (n, n_params)
    weights : array, shape (n,), optional
        Inverse variances of the observations; with them `sigma` stays 1.
    sigma : float
        Output noise sd.

    """
    design = np.asarray(design, float)
    if weights is not None:
        design = design * np.sqrt(np.asarray(weights, float))[:, None]
    norms, _, singular, right = _scaled_svd(design)
    weak = _negligible(singular)
    reach = np.sqrt(np.sum((right[~weak].T / singular[~weak]) ** 2, axis=1)) / norms
    touched = np.any(np.abs(right[weak]) > 1e-7, axis=0)
    return np.where(touched, np.inf, sigma * reach)


@dataclass(frozen=True, eq=False)
class ToleranceScaled:
    """
    Standard deviations along directions of the parameter space.

    Each parameter is in units of its tolerance.
    """

    singular_values: np.ndarray
    """
    One over the sd of each direction in tolerances, descending, shape (n_params,); below 1 the
    direction is too weak.
    """
    directions: np.ndarray
    """Unit vectors in tolerance units, one per row, shape (n_params, n_params)."""
    sd_over_tolerance: np.ndarray
    """
    Predicted sd over tolerance of each parameter, shape (n_params,); infinite when not reached.
    """

    @property
    def cond(self) -> float:
        """Largest over smallest singular value."""
        return _ratio(self.singular_values)

    def weak_directions(
        self, param_names: tuple[str, ...], share: float = 0.1
    ) -> list[dict[str, float]]:
        """
        Return [{name: weight}] for directions whose sd exceeds the tolerance, the weakest first.
        """
        rows = self.directions[self.singular_values < 1.0][::-1]
        return [
            {
                name: float(w)
                for name, w in zip(param_names, row)
                if abs(w) >= share * np.max(np.abs(row))
            }
            for row in rows
        ]


def tolerance_scaled(
    design: np.ndarray, tolerances: np.ndarray, sigma: float = 1.0
) -> ToleranceScaled:
    """
    Scale a design to parameters in units of their tolerances and outputs in units of their noise.

    Parameters
    ----------
    design : array, shape (n, n_params)
    tolerances : array, shape (n_params,)
        The sd that would be good enough, in the unit of each parameter.
    sigma : float or array, shape (n,)
        Output noise sd.

    """
    design = (
        np.asarray(design, float) / np.broadcast_to(np.asarray(sigma, float), len(design))[:, None]
    )
    tolerances = np.asarray(tolerances, float)
    singular, right = np.linalg.svd(np.linalg.qr(_padded(design * tolerances), mode='r'))[1:]
    return ToleranceScaled(singular, right, predicted_sd(design) / tolerances)


def _checked(design, outputs, param_names, weights):
    design, outputs, names = (
        np.asarray(design, float),
        np.asarray(outputs, float),
        tuple(param_names),
    )
    if design.ndim != 2 or design.shape[1] != len(names):
        raise InputError(
            f'the design must have one column per parameter ({len(names)}), got shape'
            f' {design.shape}; correct one of them'
        )
    if outputs.shape[:1] != design.shape[:1] or outputs.ndim > 2:
        raise InputError(
            f'outputs must have {len(design)} rows like the design, got shape {outputs.shape};'
            ' correct one of them'
        )
    weights = np.ones(len(design)) if weights is None else np.asarray(weights, float)
    if weights.shape != (len(design),) or not np.all(weights >= 0):
        raise InputError(
            f'weights must be {len(design)} numbers >= 0, got shape {weights.shape}; give inverse'
            ' variances'
        )
    if not (
        np.all(np.isfinite(design))
        and np.all(np.isfinite(outputs))
        and np.all(np.isfinite(weights))
    ):
        raise InputError(
            'design, outputs and weights must be finite, got NaN or infinity; remove those rows'
        )
    return design, outputs, names, np.sqrt(weights)


def _scaled_svd(design):
    """
    Return (column norms, U, singular values, V') of the unit-column design.

    The norms are 1 for empty columns. There are n_params singular values, that is, all of them.
    """
    norms = np.linalg.norm(design, axis=0)
    empty = norms <= COLUMN_TOLERANCE * np.max(norms)
    norms = np.where(empty, 1.0, norms)
    orthogonal, factor = np.linalg.qr(_padded(np.where(empty, 0.0, design / norms)))
    left, singular, right = np.linalg.svd(factor)
    return norms, (orthogonal @ left)[: len(design)], singular, right


def _negligible(singular):
    """Return a mask of the descending singular values that count as zero."""
    return singular <= RANK_TOLERANCE * max(singular[0], np.finfo(float).tiny)


def _padded(design):
    missing = design.shape[1] - design.shape[0]
    return np.vstack([design, np.zeros((missing, design.shape[1]))]) if missing > 0 else design


def _ratio(singular):
    return float(singular[0] / singular[-1]) if singular[-1] > 0 else np.inf


def _require_full_rank(design, norms, singular, right, names):
    weak = _negligible(singular)
    if np.any(weak):
        directions = _echelon(right[weak], norms, names)
        raise NotObservableError(
            f'the design must determine {len(names)} parameters, got rank {int(np.sum(~weak))} from'
            f' {len(design)} rows; not determined: {"; ".join(map(_as_text, directions))}. Record'
            ' motion that changes these columns independently, or hold a parameter.',
            code='rank',
        )


def _echelon(weak, norms, names):
    pivots = np.sort(scipy.linalg.qr(weak, pivoting=True, mode='r')[1][: len(weak)])
    rows = np.linalg.solve(weak[:, pivots], weak)
    shown = np.abs(rows) > 1e-6
    changes = rows / norms * norms[pivots, None]
    return [
        {names[k]: float(change[k]) for k in np.flatnonzero(keep)}
        for change, keep in zip(changes, shown)
    ]


def _as_text(direction):
    if len(direction) == 1:
        return next(iter(direction))
    return ' '.join(f'{weight:+.3g} {name}' for name, weight in direction.items())
