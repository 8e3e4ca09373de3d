"""Solution of an estimation, and the status of its parameters."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from typing import ClassVar, TypeVar

import numpy as np

from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.covariance_terms import Terms, of_fit, replace_weak, total
from imu_calibration.estimation.noise_model import NoiseModel
from imu_calibration.estimation.weighted_system import make_prior


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
"""Factor on all accelerometer readings by hand from an uncertain gravity; the sds of the other parameters are judged without it."""
WEAK_DATA, LIKELIHOOD_RATIO, REPLACEMENT = 'weak data', 'likelihood ratio', 'replacement'
"""
Reasons for which a parameter is held: its sd would exceed half the prior's; its prior is not significantly worse; the prior has the smaller
expected error.
"""


def statuses(sd: Iterable[float], held: Iterable[bool], tolerances: Iterable[float]) -> tuple[Status, ...]:
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
    return tuple(HELD if h else FIXED if s == 0 else DETERMINED if s <= t else WEAK for h, s, t in zip(held, sd, tolerances, strict=True))


def reasons_held(held: Iterable[bool], names: Iterable[str], replaced: Collection[str], *,
                 tested: Collection[str] = ()) -> dict[str, str]:
    """Return held parameter -> the reason: `replaced` by its prior, for those `tested` by likelihood ratio, or too weak data."""
    return {name: WEAK_DATA if name not in replaced else LIKELIHOOD_RATIO if name in tested else REPLACEMENT
            for name, flag in zip(names, held, strict=True) if flag}


def tolerances_of(model: SensorModel, overrides: dict | None = None) -> np.ndarray:
    """
    Return the tolerance of each parameter of a model, shape (n_params,).

    Parameters
    ----------
    overrides : dict, optional
        {section: {effect: tolerance}} in SI, as in config/tolerances.yaml.

    """
    overrides = overrides or {}
    return np.concatenate([np.full(e.size, float(overrides.get(e.sensor, {}).get(e.name, e.tolerance))) for e in model.effects])


@dataclass(frozen=True, eq=False)
class Solution:
    """Estimated parameters with covariance, noise and quality of the fit."""

    judged_without: ClassVar[tuple[str, ...]] = ()
    """Terms of the covariance that have a status together, and do not count for that of each parameter."""

    model: SensorModel
    """The effects, linearised at the values of the columns."""
    values: np.ndarray
    """Parameters in ``model.param_names`` order, SI, shape (n_params,)."""
    terms: Terms
    """Their covariance as named terms (`covariance_terms`), each of shape (n_params, n_params)."""
    held: np.ndarray
    """True where a parameter is fixed at its prior, shape (n_params,)."""
    noise: dict[str, NoiseModel]
    """Sensor -> its noise."""
    chi2_per_dof: dict
    """Sensor -> {'mean', 'spin', 'dynamic'} -> weighted residual sum of squares per degree of freedom."""
    information: np.ndarray
    """Information matrix of the data without the prior, shape (n_params, n_params)."""
    residual_rms: dict
    """Sensor -> rms residual of single samples in moving windows and of window means, shape (2,)."""
    session_biases: dict = field(default_factory=dict)
    """
    Sensor -> bias of each recording, shape (n_sessions, 3), for sensors whose bias differs between recordings; `values` has their mean.
    """

    not_believed: dict[str, float] = field(default_factory=dict)
    """Fixed parameter -> its estimate, which exceeds the range of known sensors and is no larger than misfit can cause."""

    replaced: tuple[str, ...] = ()
    """Held parameters that the recording determines weakly, replaced by their prior (`covariance_terms.replace_weak`)."""

    def at(self, values: np.ndarray) -> 'Solution':
        """Return the same with other values, shape (n_params,)."""
        return replace(self, values=values)

    @property
    def param_names(self) -> list[str]:
        """Names in the order of `values`."""
        return self.model.param_names

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
        return np.sqrt(np.diag(total({name: term for name, term in self.terms.items() if name not in self.judged_without})))

    @property
    def prior_mean(self) -> np.ndarray:
        """Values before any data, shape (n_params,)."""
        return make_prior(self.model).mean

    @property
    def replacement_limit(self) -> np.ndarray | float:
        """Largest ``(value - prior)^2 / variance`` of a weak parameter that is replaced by its prior (`replace_weak`)."""
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
    Return the solution with weak values that compensation applies replaced by their prior where that lowers the expected error.

    See `replace_weak`. A replaced parameter is held.
    """
    effects = solution.model.effects
    applied = np.repeat([e.compensation == 'exact' for e in effects], [e.size for e in effects])
    weak = np.flatnonzero(applied & ~solution.held & (solution.judged_sd > tolerances))
    values, terms, replaced = replace_weak(solution.values, solution.terms, solution.prior_mean, weak=weak.tolist(),
                                           limit=solution.replacement_limit)
    return replace(solution, values=values, terms=terms, held=solution.held | replaced,
                   replaced=tuple(np.array(solution.param_names)[replaced].tolist()))


CONVENTION_SHARE = 1e-9
"""Directions of a covariance, scaled to a unit diagonal, below this share of the largest are conventions."""


def shrunk(solution: Solution, parts: list[slice]) -> Solution:
    """
    Return a Solution in which the values of some effects are shrunk towards their prior.

    The factor is ``1 - k / chi2``, at least 0 (James and Stein), chi2 the squared distance from the prior in standard deviations, k its
    number of directions. The other parameters are updated as if the effect were known at the shrunk value. An absent effect then hardly
    raises the error of the other parameters, a significant effect is kept, and the standard deviations hold in both cases.

    Parameters
    ----------
    solution : Solution
    parts : list of slice
        Parameters of each effect.

    """
    values, prior = solution.values.copy(), make_prior(solution.model).mean
    covariance = of_fit(solution.terms)
    for part in parts:
        at = np.arange(part.start, part.stop)[~solution.held[part]]
        if not len(at):
            continue
        sd = np.sqrt(np.diag(covariance)[at])
        sizes, directions = np.linalg.eigh(covariance[np.ix_(at, at)] / np.outer(sd, sd))
        known = sizes > CONVENTION_SHARE * sizes[-1]
        far = directions[:, known].T @ ((values[at] - prior[at]) / sd)
        chi2 = float((far**2 / sizes[known]).sum())
        step = directions[:, known] @ (far / sizes[known]) / sd   # inverse covariance times the distance
        values -= min(1.0, known.sum() / max(chi2, 1e-300)) * np.where(solution.held, 0.0, covariance[:, at] @ step)
    return solution.at(values)
