"""
Selection of the processes in an Allan curve: candidate forms of the slow part of the noise, compared by penalised likelihood.

Every form has white noise. Forms are compared by the likelihood of the logarithms of the variances (nearly Gaussian, with the covariance of
the fitted form) and a price for each parameter; forms close to the best are possible as well, and are reported.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import digamma, polygamma

from imu_calibration.allan.moment_fit import MomentFit, Moments, Whitener, fit_processes, fit_with_time
from imu_calibration.allan.processes import FLICKER, QUANTISATION, RANDOM_WALK, WHITE, gauss_markov
from imu_calibration.allan.score_intervals import score_at_zero

GAUSS_MARKOV = 'gauss_markov'
FORMS = ((), ('random_walk',), ('bias_instability',), ('gauss_markov',), ('bias_instability', 'random_walk'),
         ('random_walk', 'gauss_markov'))
"""Slow parts that are tried, a Gauss-Markov process last."""
PROCESSES = {process.name: process for process in (QUANTISATION, WHITE, FLICKER, RANDOM_WALK)}
CLOSE = 6.0
"""Forms whose cost is within this of the least are possible as well."""
PRICE, PRICE_OF_TIME = 2.0, 7.0
"""Cost of a coefficient, and of a correlation time, for which many are tried."""
TIME_STEP = 8
"""Stride over the correlation times; each is tested for a clearly higher likelihood than the time of best fit."""
LEAST_WEIGHT = 0.05
"""Forms less likely than this, against the best, are excluded from intervals."""
INDEPENDENT = 6.0
"""Forms are compared at averaging times of which the longest part holds so many: with fewer, logarithms are far from Gaussian."""
CLEAR = 1e-3
"""Probability below which quantisation is included."""


@dataclass(frozen=True, eq=False)
class FormFit:
    """One form fitted to one axis."""

    form: tuple[str, ...]
    """Names of the slow processes."""
    fit: MomentFit
    """Coefficients."""
    cost: float
    """Minus twice the log likelihood, and the penalty of the parameters."""


@dataclass(frozen=True, eq=False)
class Choice:
    """The forms of one axis, the best first."""

    fits: tuple[FormFit, ...]
    """All forms in order of their cost."""
    moments: Moments
    """Data of the fit."""

    @property
    def best(self) -> FormFit:
        """The selected form."""
        return self.fits[0]

    @property
    def rivals(self) -> tuple[FormFit, ...]:
        """Other forms that explain the curve nearly as well, except supersets of a form named before."""
        found: list[FormFit] = []
        for fit in self.fits:
            if fit.cost - self.best.cost <= CLOSE and not any(_is_part(known.form, fit.form) for known in (self.best, *found)):
                found.append(fit)
        return tuple(found)

    def having(self, name: str) -> tuple[list[MomentFit], list[float]]:
        """Return the fits with a process, the best first, and the likelihood of each relative to it; negligible ones are omitted."""
        found = [fit for fit in self.fits if name in fit.fit.names]
        weights = [1.0, *(float(np.exp(-0.5 * (fit.cost - found[0].cost))) for fit in found[1:])]
        return [fit.fit for fit, weight in zip(found, weights) if weight > LEAST_WEIGHT], [w for w in weights if w > LEAST_WEIGHT]

    def widened(self, name: str) -> 'Choice':
        """Return a choice of one: the best form with a further process."""
        fast = tuple(known for known in self.best.fit.names if known == QUANTISATION.name)
        form = (name, *self.best.form)
        fit = fit_names(self.moments, (*fast, WHITE.name, *form))
        return Choice((FormFit(form, fit, self.best.cost),), self.moments)

    def close(self, name: str) -> FormFit | None:
        """Return the best form with a process among those that explain the curve nearly as well, or None."""
        near = [fit for fit in self.fits if name in fit.form and fit.cost - self.best.cost <= CLOSE + PRICE_OF_TIME]
        return near[0] if near else None


def _is_part(form, wider):
    """Return whether a form is a special case of another one: a random walk is a Gauss-Markov process that never forgets."""
    return all(name in wider or (name == RANDOM_WALK.name and GAUSS_MARKOV in wider) for name in form)


def choose_form(moments: Moments, excess: float = 1.0) -> Choice:
    """Fit every form, with quantisation where the curve shows it; `excess`: factor on all covariances of an unexplained curve."""
    fits = _all_forms(moments, (), excess)
    wider = fit_form(moments, fits[0].form, (QUANTISATION.name,))
    if score_at_zero(moments, wider.fit, 0) < CLEAR:
        fits = _all_forms(moments, (QUANTISATION.name,), excess)
    return Choice(fits, moments)


def _all_forms(moments, fast, excess):
    n_scales = int(moments.used.sum())
    fits = [fit_form(moments, form, fast, excess=excess) for form in FORMS if len(fast) + 2 * len(form) + 3 <= n_scales]
    return tuple(sorted(fits, key=lambda found: found.cost))


def fit_form(moments: Moments, form: tuple[str, ...], fast: tuple[str, ...] = (), *, excess: float = 1.0) -> FormFit:
    """Fit white noise, `fast` processes and the slow ones of a form; squares are divided by `excess`."""
    names = (*fast, WHITE.name, *form)
    fit = fit_names(moments, names)
    fit = _likeliest(moments, fit) if GAUSS_MARKOV in form else fit
    return FormFit(tuple(form), fit, log_cost(moments, fit, excess) + PRICE * len(names) + PRICE_OF_TIME * (GAUSS_MARKOV in form))


def _likeliest(moments, fit):
    """Return the fit with another correlation time where one is plainly likelier: the weights of a long time can keep it long."""
    def at(time):
        found = fit_processes(moments, (*fit.processes[:-1], gauss_markov(time)))
        return log_cost(moments, found), found

    costs = [at(time)[0] for time in moments.times[::TIME_STEP]]
    best = int(np.argmin(costs))
    if costs[best] > log_cost(moments, fit) - CLOSE:
        return fit
    near = slice(max((best - 1) * TIME_STEP, 0), (best + 1) * TIME_STEP)
    return min((at(time) for time in moments.times[near]), key=lambda found: found[0])[1]


def fit_names(moments: Moments, names: tuple[str, ...]) -> MomentFit:
    """Fit the processes of these names; a Gauss-Markov process is the last."""
    processes = tuple(PROCESSES[name] for name in names if name != GAUSS_MARKOV)
    return fit_with_time(moments, processes) if GAUSS_MARKOV in names else fit_processes(moments, processes)


def log_cost(moments: Moments, fit: MomentFit, excess: float = 1.0) -> float:
    """
    Return minus twice the log likelihood of the logarithms of the variances except for a constant, with `excess` times their covariance.

    Infinite for a fit that expects no variance at some averaging time.
    """
    some = moments.scales.tau[moments.used] * INDEPENDENT <= moments.scales.longest
    expected = (moments.design(fit.processes) @ fit.coefficients)[some]
    covariance = fit.covariance[np.ix_(some, some)]
    if not (np.all(expected > 0) and np.all(np.isfinite(covariance))):
        return np.inf
    freedom = 2 * expected**2 / np.diag(covariance)
    spread = np.sqrt(polygamma(1, freedom / 2) * freedom / 2)
    whiten = Whitener(covariance / np.outer(expected, expected) * np.outer(spread, spread))
    rest = whiten(np.log(moments.target[some] / expected) - digamma(freedom / 2) + np.log(freedom / 2))
    cost = float(rest @ rest) / excess + whiten.log_determinant
    return cost if np.isfinite(cost) else np.inf


def without_finest(moments: Moments, count: int) -> Moments:
    """Return the moments without the `count` shortest averaging times."""
    used = moments.used.copy()
    used[:count] = False
    return replace(moments, used=used)
