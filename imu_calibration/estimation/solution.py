"""
Solution of an estimation.

Its covariance as named terms whose sum is the total, and the status of its parameters.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, TypeVar

import numpy as np

from imu_calibration.core.text_enum import StrEnum
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.prior import make_prior
from imu_calibration.estimation.sensor_noise import SensorNoise

Terms = Mapping[str, np.ndarray]
"""Term -> covariance matrix, shape (n_params, n_params)."""
SAMPLE_NOISE = 'noise'
"""White noise of the samples and of the reference."""
BIAS_PROCESS = 'bias_process'
"""Bias processes, offsets of windows or poses, and the bias of each recording."""
HELD_PRIORS = 'held_parameters'
"""
The uncertainty of priors at which parameters are fixed, and the squared shift of replaced
parameters.
"""
PLACEMENTS = 'placements'
"""Errors that the rests of a placement by hand have in common."""
MODEL_ERROR = 'model_error'
"""Scatter between parts of the recording beyond noise."""
DRIFT = 'drift'
"""Parameters that change during the recording."""
REJECTED = 'rejected_effects'
"""Effects that were rejected, or are collinear with other effects in the recording."""
GRAVITY = 'gravity'
"""The uncertainty of the local gravity."""
UNMODELLED_EARTH_RATE = 'earth_rate'
"""The Earth's rate, where it is not modelled."""

REMEDIES = {
    (GRAVITY,): 'give the local gravity, or the latitude from which it follows',
    (MODEL_ERROR, DRIFT, REJECTED): 'find the cause of the residual: more motions do not help',
}
"""Terms that more data do not reduce -> what does."""
EXCESS_REMEDY = 'find the cause of the residual, which exceeds the noise at rest'
"""Remedy where the data would suffice if the residual were as small as the noise."""
WANDER_REMEDY = 'find the cause of the change of the bias: more motions do not help'
"""Remedy where the data would suffice if the bias were constant during the recording."""
TURNS_REMEDY = (
    'check that both sensors have the same axes, and that the recording contains each complete turn'
)
"""Remedy where the rates of most turns by hand contradict gravity before and after them."""
MOVED_REMEDY = 'put the IMU down in each attitude, with engines and fans off, and record again'
"""Remedy where a sensor moved although it was held still."""
PLACE_REMEDY = 'give latitude and azimuth_deg in the description of the table'
"""Remedy for the Earth's rate, which motions determine worse than the place gives it."""
AZIMUTH_REMEDY = 'give azimuth_deg in the description of the table'
"""The same where the latitude is given."""
REMEDY_KEYS = {
    PLACE_REMEDY: 'table',
    AZIMUTH_REMEDY: 'table',
    REMEDIES[GRAVITY,]: 'gravity',
    REMEDIES[MODEL_ERROR, DRIFT, REJECTED]: 'diagnose',
    EXCESS_REMEDY: 'diagnose',
    WANDER_REMEDY: 'diagnose',
}
"""Remedy that is no motion -> the key of its input or program (`errors.ERROR_KEYS`)."""
NO_STEP = (*REMEDY_KEYS, TURNS_REMEDY, MOVED_REMEDY)
"""Remedies in place of a next step by hand: no further attitude repairs the recording."""


def remedy(
    terms: 'Terms',
    index: int,
    tolerance: float,
    *,
    excess: float = 1.0,
    of_misfit: Collection[str] = (),
) -> str:
    """
    Return the remedy with which a parameter gets within its tolerance; '' if more data suffice.

    More data reduce noise, bias processes and the uncertainty of held parameters. Where these are
    within the tolerance, ``sum of their variances <= (excess tolerance)^2``, the largest of the
    other terms decides.

    Parameters
    ----------
    terms : mapping
        Covariance of the parameters.
    index : int
        Of the parameter.
    tolerance : float
    excess : float
        Standard deviation of the residual over that of the noise, where the terms follow from the
        residual.
    of_misfit : names
        Terms that describe an error of the model here, so that more data do not reduce them.

    """
    variances = {name: float(term[index, index]) for name, term in terms.items()}
    irreducible = {}  # variance of the terms of each remedy
    for names in REMEDIES:
        irreducible[names] = sum(variances.get(name, 0.0) for name in names)
    irreducible[MODEL_ERROR, DRIFT, REJECTED] += sum(variances.get(name, 0.0) for name in of_misfit)
    reducible = sum(variances.values()) - sum(irreducible.values())
    if reducible > (excess * tolerance) ** 2:
        return ''
    if reducible > tolerance**2:
        return EXCESS_REMEDY
    largest = max(irreducible, key=lambda names: irreducible[names])
    return REMEDIES[largest] if irreducible[largest] > 0 else ''


def total(terms: Terms) -> np.ndarray:
    """Return the covariance, the sum of its terms."""
    return np.sum(list(terms.values()), axis=0)


def with_term(terms: Terms, name: str, covariance: np.ndarray) -> dict[str, np.ndarray]:
    """Return the terms with a covariance added to one of them."""
    return {**terms, name: terms.get(name, 0.0) + covariance}


def common_scale(model: SensorModel, values: np.ndarray) -> np.ndarray:
    """
    Return the change of the parameters with a common scale of the accelerometer, shape (n_params,).

    A wrong gravity has this effect: rests determine only the matrix over gravity.
    """
    change = np.zeros(len(values))
    part = model.part('accelerometer', Role.LINEAR)
    change[part] = values[part]
    return change


def bounded_by_prior(terms: Terms, held: np.ndarray, prior_sd: np.ndarray) -> dict[str, np.ndarray]:
    """
    Return the terms with no more than the variance of the prior for held parameters.

    The value of a held parameter is that of its prior, so that errors of the data, such as a bias
    that moves, do not add to its variance. With s the standard deviation of the sum of the terms
    and p that of the prior, rows and columns are multiplied by ``min(1, p / s)``.

    Parameters
    ----------
    terms : mapping
        Name -> covariance, shape (n_params, n_params).
    held : ndarray of bool, shape (n_params,)
    prior_sd : ndarray, shape (n_params,)

    """
    sd = np.sqrt(np.diag(total(terms)))
    factor = np.ones(len(sd))
    wide = held & (sd > prior_sd)
    factor[wide] = prior_sd[wide] / sd[wide]
    return {name: term * np.outer(factor, factor) for name, term in terms.items()}


def of_fit(terms: Terms) -> np.ndarray:
    """Return the posterior covariance of the fit, without allowances: noise and bias processes."""
    return total({name: terms[name] for name in (SAMPLE_NOISE, BIAS_PROCESS) if name in terms})


def replace_weak(
    values: np.ndarray,
    terms: Terms,
    prior: np.ndarray,
    *,
    weak: Sequence[int],
    limit: np.ndarray | float = 1.0,
) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
    """
    Return (values, terms, mask of the replaced parameters), weak values replaced by their prior.

    Values are replaced where that lowers the expected error.

    A value v with prior p and standard deviation s of the fit is replaced where ``(v - p)^2 <
    s^2``. The parameter with the smallest ratio is replaced first; all parameters correlated with
    it are updated with it fixed, ``x += C[:, k] / C[k, k] (p - v)``, C being the posterior
    covariance of the fit, before the next test. The error of the result is that of the estimate and
    the shift d, so that its covariance is the former one plus ``d d'``: at most ``1 + limit`` times
    the former variance. The variance of the prior itself would ignore the recording, which bounds
    the parameter much more closely.

    Parameters
    ----------
    values : ndarray, shape (n_params,)
    terms : mapping
        Covariance of the values.
    prior : ndarray, shape (n_params,)
        Prior values; a parameter whose prior is not finite is not replaced.
    weak : sequence of int
        Parameters under test.
    limit : array of shape (n_params,) or float
        Largest ``(v - p)^2 / s^2`` of a replaced parameter: 1 for the smallest expected error
        without knowledge of the truth; the quantile of chi-square for a likelihood-ratio test of
        the prior value.

    """
    moved = values.copy()
    posterior = of_fit(terms)
    limits = np.broadcast_to(limit, values.shape)
    replaced = np.zeros(len(values), bool)
    smallest = 1e-12 * np.diag(posterior)
    candidates = [k for k in weak if np.isfinite(prior[k])]
    while True:
        # Without parameters that the ones fixed before determine.
        candidates = [k for k in candidates if posterior[k, k] > smallest[k]]
        if not candidates:
            break
        # The least significant difference from its prior.
        ratio = [(moved[k] - prior[k]) ** 2 / posterior[k, k] / limits[k] for k in candidates]
        least = int(np.argmin(ratio))
        if ratio[least] >= 1.0:
            break
        # All parameters, and the posterior, given that one at its prior.
        k = candidates.pop(least)
        slope = posterior[:, k] / posterior[k, k]
        moved = moved + slope * (prior[k] - moved[k])
        posterior = posterior - np.outer(slope, posterior[k])
        replaced[k] = True
    moved[replaced] = prior[replaced]
    if not replaced.any():
        return values, dict(terms), replaced
    terms = with_term(terms, HELD_PRIORS, np.outer(moved - values, moved - values))
    return moved, terms, replaced


class Status(StrEnum):
    """Status of a parameter; stored as text in a document."""

    DETERMINED = 'determined'
    """Its standard deviation is within the tolerance."""
    WEAK = 'weak'
    """It is not, but value and standard deviation are honest."""
    HELD = 'held'
    """Not determined by the recording: value and sd are those of the prior."""
    FIXED = 'fixed'
    """A convention, for example the axes: exact."""


DETERMINED, WEAK, HELD, FIXED = Status
LACKING = (WEAK, HELD)
"""Statuses of parameters that need more data."""
COMMON_SCALE = 'accelerometer.common_scale'
"""
Factor on all accelerometer readings by hand from an uncertain gravity; the sds of the other
parameters are judged without it.
"""
WEAK_DATA, LIKELIHOOD_RATIO, REPLACEMENT = 'weak data', 'likelihood ratio', 'replacement'
"""
Reasons for which a parameter is held: its sd would exceed half the prior's; its prior is not
significantly worse; the prior has the smaller expected error.
"""


def statuses(
    sd: Iterable[float], held: Iterable[bool], tolerances: Iterable[float]
) -> tuple[Status, ...]:
    """
    Return the status of each parameter.

    Parameters
    ----------
    sd : array_like, shape (n_params,)
        Standard deviations, SI; 0 for a convention.
    held : array_like of bool, shape (n_params,)
        Whether the parameter is fixed at its prior.
    tolerances : array_like, shape (n_params,)
        Largest standard deviation of a determined parameter, SI.

    """
    of_parameters = []
    for is_held, deviation, tolerance in zip(held, sd, tolerances, strict=True):
        status = WEAK
        if is_held:
            status = HELD
        elif deviation == 0:
            status = FIXED
        elif deviation <= tolerance:
            status = DETERMINED
        of_parameters.append(status)
    return tuple(of_parameters)


def reasons_held(
    held: Iterable[bool],
    names: Iterable[str],
    replaced: Collection[str],
    *,
    tested: Collection[str] = (),
) -> dict[str, str]:
    """
    Return held parameter -> the reason (`WEAK_DATA`, `LIKELIHOOD_RATIO` or `REPLACEMENT`).

    Parameters
    ----------
    held : iterable of bool, shape (n_params,)
    names : iterable of str
        Names of all parameters.
    replaced : collection of str
        Held parameters whose estimate was replaced by the prior.
    tested : collection of str
        Parameters that are replaced by a likelihood-ratio test.

    """
    reasons = {}
    for name, is_held in zip(names, held, strict=True):
        if not is_held:
            continue
        if name not in replaced:
            reasons[name] = WEAK_DATA
        else:
            reasons[name] = LIKELIHOOD_RATIO if name in tested else REPLACEMENT
    return reasons


def tolerances_of(model: SensorModel, overrides: dict | None = None) -> np.ndarray:
    """
    Return the tolerance of each parameter of a model, shape (n_params,).

    Parameters
    ----------
    overrides : dict, optional
        {section: {effect: tolerance}} in SI, as in config/tolerances.yaml.

    """
    overrides = overrides or {}
    return np.concatenate(
        [
            e.tolerances(float(overrides.get(e.sensor, {}).get(e.name, e.tolerance)))
            for e in model.effects
        ]
    )


@dataclass(frozen=True)
class AttitudeDependence:
    """Scatter of the means at rest with and without a dependence on the attitude."""

    ratio: float
    """Variance of the residuals per degree of freedom, over that of a fit with the attitude."""
    p_value: float
    """Probability of so large a fall by chance."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Estimated parameters with covariance, noise and quality of the fit."""

    judged_without: ClassVar[tuple[str, ...]] = ()
    """
    Terms of the covariance that have a status together, and do not count for that of each
    parameter.
    """

    model: SensorModel
    """The effects, linearised at the values of the columns."""
    values: np.ndarray
    """Parameters in ``model.param_names`` order, SI, shape (n_params,)."""
    terms: Terms
    """Their covariance as named terms, each of shape (n_params, n_params)."""
    held: np.ndarray
    """True where a parameter is fixed at its prior, shape (n_params,)."""
    noise: Mapping[str, SensorNoise]
    """Sensor -> its noise."""
    chi2_per_dof: dict
    """
    Sensor -> {'mean', 'spin', 'dynamic'} -> weighted residual sum of squares per degree of freedom.
    """
    information: np.ndarray
    """Information matrix of the data without the prior, shape (n_params, n_params)."""
    residual_rms: dict
    """
    Sensor -> rms residual of single samples in moving windows and of window means, shape (2,).
    """
    session_biases: dict = field(default_factory=dict)
    """
    Sensor -> bias of each recording, shape (n_sessions, 3), for sensors whose bias differs between
    recordings; `values` has their mean.
    """

    not_believed: dict[str, float] = field(default_factory=dict)
    """
    Fixed parameter -> its estimate, which exceeds the range of known sensors and is no larger than
    misfit can cause.
    """

    slow_over_fast: dict = field(default_factory=dict)
    """
    Sensor -> kind of moving window -> `BandMisfit.slow_over_fast`: above 1 the residual has
    structure in time.
    """

    attitude: dict[str, AttitudeDependence] = field(default_factory=dict)
    """Sensor -> its means at rest with and without a dependence on the attitude."""

    replaced: tuple[str, ...] = ()
    """
    Held parameters that the recording determines weakly, replaced by their prior (`replace_weak`).
    """

    def at(self, values: np.ndarray) -> 'Solution':
        """Return the same with other values, shape (n_params,)."""
        return replace(self, values=values)

    @property
    def param_names(self) -> list[str]:
        """Names in the order of `values`."""
        return self.model.param_names

    @property
    def absent(self) -> tuple[str, ...]:
        """Sensors without readings: their parameters are nominal and held."""
        return tuple(sensor for sensor in SENSORS if sensor not in self.noise)

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance of the values, the sum of its terms, shape (n_params, n_params)."""
        return total(self.terms)

    @property
    def sd(self) -> np.ndarray:
        """Standard deviations, shape (n_params,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def judged_sd(self) -> np.ndarray:
        """Standard deviations that are compared with the tolerances, shape (n_params,)."""
        return self.sd_without(*self.judged_without)

    def sd_without(self, *names: str) -> np.ndarray:
        """Return the standard deviations without some terms of the covariance, (n_params,)."""
        kept = {name: term for name, term in self.terms.items() if name not in names}
        return np.sqrt(np.diag(total(kept)))

    @property
    def prior_mean(self) -> np.ndarray:
        """Values before any data, shape (n_params,)."""
        return make_prior(self.model).mean

    @property
    def replacement_limit(self) -> np.ndarray | float:
        """
        Largest ``(value - prior)^2 / variance`` of a weak parameter to replace.

        Such a parameter is replaced by its prior (`replace_weak`).
        """
        return 1.0

    def value(self, name: str) -> float:
        """Return the parameter called `name`."""
        return float(self.values[self.param_names.index(name)])

    def sd_of(self, name: str) -> float:
        """Return the standard deviation of the parameter called `name`."""
        return float(self.sd[self.param_names.index(name)])


AnySolution = TypeVar('AnySolution', bound=Solution)


def with_weak_replaced(solution: AnySolution, tolerances: np.ndarray) -> AnySolution:
    """
    Return the solution with weak values that compensation applies replaced by their prior.

    They are replaced where that lowers the expected error (`replace_weak`), and are then held.
    """
    applied = solution.model.mask(lambda effect: effect.compensation == 'exact')
    # Errors of placements count for what is printed, but do not draw the estimate to its prior.
    sd = solution.sd_without(PLACEMENTS, *solution.judged_without)
    weak = np.flatnonzero(applied & ~solution.held & (sd > tolerances))
    values, terms, replaced = replace_weak(
        solution.values,
        solution.terms,
        solution.prior_mean,
        weak=weak.tolist(),
        limit=solution.replacement_limit,
    )
    return replace(
        solution,
        values=values,
        terms=terms,
        held=solution.held | replaced,
        replaced=tuple(np.array(solution.param_names)[replaced].tolist()),
    )


CONVENTION_SHARE = 1e-9
"""
Directions of a covariance, scaled to a unit diagonal, below this share of the largest are
conventions.
"""
