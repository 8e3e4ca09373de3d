"""Noise terms of one axis, and the forms of models that are compared."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.special import chdtrc, digamma, polygamma

from imu_calibration.allan.moment_fit import (
    MomentFit,
    Moments,
    Whitener,
    coefficient_interval,
    fit_processes,
    fit_with_time,
    score_at_zero,
    time_interval,
)
from imu_calibration.allan.processes import FLICKER, QUANTISATION, RANDOM_WALK, WHITE, gauss_markov
from imu_calibration.estimation.solution import DETERMINED, HELD, WEAK

GAUSS_MARKOV = 'gauss_markov'
FORMS = (
    (),
    (RANDOM_WALK.name,),
    (FLICKER.name,),
    (GAUSS_MARKOV,),
    (FLICKER.name, RANDOM_WALK.name),
    (RANDOM_WALK.name, GAUSS_MARKOV),
)
"""Slow parts that are tried, a Gauss-Markov process last."""
PROCESSES = {process.name: process for process in (QUANTISATION, WHITE, FLICKER, RANDOM_WALK)}
MAX_COST_EXCESS = 6.0
"""Forms whose cost is within this of the least are possible as well."""
PRICE, PRICE_OF_TIME = 2.0, 7.0
"""Cost of a coefficient, and of a correlation time, for which many are tried."""
TIME_STEP = 8
"""
Stride over the correlation times; each is tested for a clearly higher likelihood than the time of
best fit.
"""
MIN_FORM_WEIGHT = 0.05
"""Forms less likely than this, against the best, are excluded from intervals."""
MIN_COMPARED_MEANS = 6.0
"""
Forms are compared at averaging times of which the longest part holds so many: with fewer,
logarithms are far from Gaussian.
"""
QUANTISATION_P_VALUE = 1e-3
"""Probability below which quantisation is included."""


@dataclass(frozen=True, eq=False)
class Choice:
    """The forms of one axis, the best first."""

    fits: tuple[MomentFit, ...]
    """All forms in order of their cost."""
    moments: Moments
    """Data of the fit."""

    @property
    def best(self) -> MomentFit:
        """The selected form."""
        return self.fits[0]

    @property
    def rivals(self) -> tuple[MomentFit, ...]:
        """
        Other forms that explain the curve nearly as well, except supersets of a form named before.
        """
        found: list[MomentFit] = []
        for fit in self.fits:
            if fit.cost - self.best.cost <= MAX_COST_EXCESS and not any(
                _is_part(known.form, fit.form) for known in (self.best, *found)
            ):
                found.append(fit)
        return tuple(found)

    def having(self, name: str) -> tuple[list[MomentFit], list[float]]:
        """
        Return the fits with a process, the best first, and the likelihood of each relative to it.

        Negligible ones are omitted.
        """
        found = [fit for fit in self.fits if name in fit.names]
        weights = [1.0, *(float(np.exp(-0.5 * (fit.cost - found[0].cost))) for fit in found[1:])]
        return [fit for fit, weight in zip(found, weights) if weight > MIN_FORM_WEIGHT], [
            w for w in weights if w > MIN_FORM_WEIGHT
        ]

    def widened(self, name: str) -> 'Choice':
        """Return a choice of one: the best form with a further process."""
        fast = tuple(known for known in self.best.names if known == QUANTISATION.name)
        fit = fit_names(self.moments, (*fast, WHITE.name, name, *self.best.form))
        return Choice((replace(fit, cost=self.best.cost),), self.moments)

    def close(self, name: str) -> MomentFit | None:
        """
        Return the best form with a process among those that explain the curve nearly as well.

        Or None.
        """
        near = []
        for fit in self.fits:
            if name in fit.form and fit.cost - self.best.cost <= MAX_COST_EXCESS + PRICE_OF_TIME:
                near.append(fit)
        return near[0] if near else None


def _is_part(form, wider):
    """
    Return whether a form is a special case of another one.

    A random walk is a Gauss-Markov process that never forgets.
    """
    return all(
        name in wider or (name == RANDOM_WALK.name and GAUSS_MARKOV in wider) for name in form
    )


def choose_form(moments: Moments, excess: float = 1.0) -> Choice:
    """
    Fit every form, with quantisation where the curve shows it.

    `excess`: factor on all covariances of an unexplained curve.
    """
    fits = _all_forms(moments, (), excess)
    wider = fit_form(moments, fits[0].form, (QUANTISATION.name,))
    if score_at_zero(moments, wider) < QUANTISATION_P_VALUE:
        fits = _all_forms(moments, (QUANTISATION.name,), excess)
    return Choice(fits, moments)


def _all_forms(moments, fast, excess):
    n_scales = int(moments.used.sum())
    fits = []
    for form in FORMS:
        if len(fast) + 2 * len(form) + 3 <= n_scales:
            fits.append(fit_form(moments, form, fast, excess=excess))
    return tuple(sorted(fits, key=lambda found: found.cost))


def fit_form(
    moments: Moments, form: tuple[str, ...], fast: tuple[str, ...] = (), *, excess: float = 1.0
) -> MomentFit:
    """
    Fit white noise, `fast` processes and the slow ones of a form; squares are divided by `excess`.
    """
    names = (*fast, WHITE.name, *form)
    fit = fit_names(moments, names)
    fit = _likeliest(moments, fit) if GAUSS_MARKOV in form else fit
    return replace(
        fit,
        cost=log_cost(moments, fit, excess)
        + PRICE * len(names)
        + PRICE_OF_TIME * (GAUSS_MARKOV in form),
    )


def _likeliest(moments, fit):
    """
    Return the fit with another correlation time where one is plainly likelier.

    The weights of a long time can keep it long.
    """

    def at(time):
        found = fit_processes(moments, (*fit.processes[:-1], gauss_markov(time)))
        return log_cost(moments, found), found

    costs = [at(time)[0] for time in moments.times[::TIME_STEP]]
    best = int(np.argmin(costs))
    if costs[best] > log_cost(moments, fit) - MAX_COST_EXCESS:
        return fit
    near = slice(max((best - 1) * TIME_STEP, 0), (best + 1) * TIME_STEP)
    return min((at(time) for time in moments.times[near]), key=lambda found: found[0])[1]


def fit_names(moments: Moments, names: tuple[str, ...]) -> MomentFit:
    """Fit the processes of these names; a Gauss-Markov process is the last."""
    processes = tuple(PROCESSES[name] for name in names if name != GAUSS_MARKOV)
    return (
        fit_with_time(moments, processes)
        if GAUSS_MARKOV in names
        else fit_processes(moments, processes)
    )


def log_cost(moments: Moments, fit: MomentFit, excess: float = 1.0) -> float:
    """
    Return minus twice the log likelihood of the logarithms of the variances except for a constant.

    With `excess` times their covariance.

    Infinite for a fit that expects no variance at some averaging time.
    """
    some = moments.scales.tau[moments.used] * MIN_COMPARED_MEANS <= moments.scales.longest
    expected = (moments.design(fit.processes) @ fit.coefficients)[some]
    covariance = fit.covariance[np.ix_(some, some)]
    if not (np.all(expected > 0) and np.all(np.isfinite(covariance))):
        return np.inf
    freedom = 2 * expected**2 / np.diag(covariance)
    spread = np.sqrt(polygamma(1, freedom / 2) * freedom / 2)
    whiten = Whitener(covariance / np.outer(expected, expected) * np.outer(spread, spread))
    rest = whiten(
        np.log(moments.target[some] / expected) - digamma(freedom / 2) + np.log(freedom / 2)
    )
    cost = float(rest @ rest) / excess + whiten.log_determinant
    return cost if np.isfinite(cost) else np.inf


def without_finest(moments: Moments, count: int) -> Moments:
    """Return the moments without the `count` shortest averaging times."""
    used = moments.used.copy()
    used[:count] = False
    return replace(moments, used=used)


DETERMINED_RATIO = 1.6
"""
Upper over lower end of the 95 % interval up to which a figure counts as determined: a quarter to
either side.
"""
MISFIT_P_VALUE = 1e-3
"""Probability of a misfit below which the shortest averaging times are left out."""
LEAST_SCALES = 8
"""Least number of averaging times in the fit."""
LONGEST_LEFT_OUT = 2.0
"""s; a model that fails beyond is wrong for another reason than a filter in the sensor."""
WHITE_SHARE = 0.5
"""
Least share of white noise in the shortest variance for which shorter averaging times of an
unexplained curve are excluded.
"""
FILTER_TIME_RATIO = 8.0
"""Where a filter shows, averaging times up to so many of the longest that shows it are left out."""
TIME_KEY = 'correlation_time'
PEAK, PEAK_HEIGHT = 0.371, 0.525
"""Where the Allan variance of a sine peaks, in periods, and how high, in squared amplitudes."""
RICHEST = tuple((QUANTISATION.name, WHITE.name, *form) for form in FORMS[-2:])
"""Models that explain a curve if any does."""


@dataclass(frozen=True)
class Term:
    """One figure of one axis."""

    name: str
    """Name of the process, or 'correlation_time'."""
    value: float | None
    """The figure; None when it is held."""
    interval: tuple[float, float]
    """95 %; begins at 0 when the curve does without the process."""
    status: str
    """'determined', 'weak' or 'held'."""
    reason: str = ''
    """Why it is not determined."""


@dataclass(frozen=True, eq=False)
class AxisNoise:
    """The noise of one axis."""

    terms: dict[str, Term]
    """Name of the process -> its figure; 'correlation_time' in addition to 'gauss_markov'."""
    form: tuple[str, ...] = ()
    """Names of the processes that make the slow part; empty: none shows."""
    others: tuple[tuple[str, ...], ...] = ()
    """Other forms that explain the curve as well."""
    alternatives: dict[str, Term] = field(default_factory=dict)
    """Figures of processes that occur only in these forms."""
    shortest: float = 0.0
    """
    Shortest averaging time that was fitted, s; longer than the period where the sensor filters its
    noise.
    """
    excess: float = 1.0
    """Factor on all covariances because the misfit exceeds the sampling error, at least 1."""
    oscillation: tuple[float, float] | None = None
    """
    Frequency (Hz) and amplitude: of the sine with the largest hump that no model explains; from a
    recording, of its line.
    """
    scatter: float = 0.0
    """Standard deviation of the level of the variances from rest to rest, over the level."""
    fit: Any = None
    """The fitted model (MomentFit); None: from a document."""


def identify_axis(moments: Moments) -> AxisNoise:
    """Return the noise of one axis from its Allan variances."""
    moments, excess = _fit_range(moments)
    moments = replace(moments, scatter=scatter_of(moments))
    choice = choose_form(moments, excess)
    best, rivals = choice.best, choice.rivals
    fast = tuple(name for name in (QUANTISATION.name,) if name in best.names)
    terms: dict[str, Term] = {}
    for name in (*fast, WHITE.name, *best.form):
        terms |= _figures(choice, name, excess)
    for name in {FLICKER.name, RANDOM_WALK.name} - set(best.form):
        terms |= {name: _held(_figures(choice.widened(name), name, excess)[name])}
    alternatives: dict[str, Term] = {}
    for other in (*rivals, *filter(None, [choice.close(GAUSS_MARKOV)])):
        for name in set(other.form) - set(best.form) - set(alternatives):
            alternatives |= _figures(choice, name, excess)
    return AxisNoise(
        _doubted(terms, best, rivals),
        best.form,
        tuple(rival.form for rival in rivals),
        alternatives,
        float(moments.scales.tau[moments.used][0]),
        excess,
        _hump(moments, best) if excess > 1 else None,
        moments.scatter,
        best,
    )


def with_wider_white_noise(axis: AxisNoise, factor: float) -> AxisNoise:
    """
    Return the noise of an axis whose white noise may be too high by a factor, at least 1.

    The lower end of its interval is divided by the factor, because outliers or repeated readings
    raise the variances at every averaging time alike.
    """
    white = axis.terms[WHITE.name]
    if factor <= 1.0 or white.value is None:
        return axis
    wider = replace(white, interval=(white.interval[0] / factor, white.interval[1]))
    if wider.status == DETERMINED and wider.interval[1] > DETERMINED_RATIO * wider.interval[0]:
        wider = replace(wider, status=WEAK, reason='readings at fault')
    return replace(axis, terms=axis.terms | {WHITE.name: wider})


def scatter_of(moments: Moments) -> float:
    """
    Return the excess variation of the level of the variances between parts.

    The sampling error is that of a model with every slope.
    """
    fit = fit_names(moments, RICHEST[0])
    expected = moments.design(fit.processes) @ fit.coefficients
    return moments.parts.scatter(moments.used, np.diag(fit.covariance) / expected**2)


def _hump(moments, fit):
    """
    Return frequency and amplitude of the sine that makes the largest excess.

    Its Allan variance is a^2 sin^4(x) / x^2, x = pi f tau.
    """
    beyond = moments.target - moments.design(fit.processes) @ fit.coefficients
    highest = int(np.argmax(beyond / np.sqrt(np.diag(fit.covariance))))
    if beyond[highest] <= 0:
        return None
    return float(PEAK / moments.scales.tau[moments.used][highest]), float(
        np.sqrt(beyond[highest] / PEAK_HEIGHT)
    )


def predicted(moments: Moments, axis: AxisNoise) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the prediction for every averaging time of a recording.

    The variance, and the degrees of freedom of a measured one.

    The level of the noise differs there from part to part as it did where it was identified.
    """
    every = replace(moments, used=np.ones_like(moments.used))
    fit = axis.fit
    expected = every.design(fit.processes) @ fit.coefficients
    spread = np.einsum(
        'p,q,pqii->i', fit.coefficients, fit.coefficients, every.tensor(fit.processes)
    )
    level = axis.scatter**2 * moments.parts.share() if axis.scatter else 0.0
    return expected, 2.0 / (spread * axis.excess / expected**2 + level)


def _fit_range(moments):
    """
    Return the moments without filtered averaging times, and the remaining misfit.

    The averaging times at which the sensor filters its noise are removed.

    The shortest ones are excluded until one of the richest models explains the others. Where none
    does (vibration), those are kept that are explained best, as long as their shortest still shows
    white noise, else all.

    Returns
    -------
    Moments
        With `used` reduced.
    float
        Excess of the squares over their expectation, at least 1.

    """
    most = min(
        int(np.sum(moments.scales.tau <= LONGEST_LEFT_OUT)), int(moments.used.sum()) - LEAST_SCALES
    )
    least, kept = np.inf, moments
    for count in range(max(most, 0) + 1):
        trial = without_finest(moments, count)
        freedom = int(trial.used.sum()) - len(RICHEST[0])
        fit = min((fit_names(trial, names) for names in RICHEST), key=lambda found: found.misfit)
        if chdtrc(freedom, fit.misfit) > MISFIT_P_VALUE:
            return _with_margin(trial, count, most), 1.0
        seen = (
            fit.coefficient(WHITE.name) * trial.design((WHITE,))[0, 0]
            > WHITE_SHARE * trial.target[0]
        )
        if not count or (seen and fit.misfit / freedom < least):
            least = fit.misfit / freedom
            kept = trial
    return kept, max(float(least), 1.0)


def _with_margin(moments, count, most):
    """
    Return the moments without the scales at which a detected filter still bends the curve.

    By 1 - 3/2 (its time) / tau.
    """
    tau = moments.scales.tau
    return (
        without_finest(moments, min(int(np.sum(tau < FILTER_TIME_RATIO * tau[count])), most))
        if count
        else moments
    )


def _figures(choice, name, excess):
    """
    Return the terms of one process: its figure, and the correlation time of a Gauss-Markov process.
    """
    fits, weights = choice.having(name)
    index = fits[0].names.index(name)
    interval = coefficient_interval(choice.moments, fits, weights, name=name, excess=excess)
    found = {name: _term(name, np.sqrt(fits[0].coefficients[index]), np.sqrt(interval))}
    if name == GAUSS_MARKOV:
        found[TIME_KEY] = _term(
            TIME_KEY,
            fits[0].processes[index].time,
            time_interval(choice.moments, fits, weights, excess=excess),
        )
    return found


def _term(name, value, interval):
    lower, upper = (float(end) for end in interval)
    if not value > 0:
        return Term(name, None, (0.0, upper), HELD, 'not seen')
    if lower > 0 and upper / lower <= DETERMINED_RATIO:
        return Term(name, float(value), (lower, upper), DETERMINED)
    return Term(
        name, float(value), (lower, upper), WEAK, 'too short' if lower > 0 else 'may be none'
    )


def _held(term):
    return replace(
        term, value=None, status=HELD, interval=(0.0, term.interval[1]), reason='not seen'
    )


def _doubted(terms, best, rivals):
    """Return the terms; a term is weak when another form without it explains the curve as well."""
    doubted = {}
    for name, term in terms.items():
        without = [rival.form for rival in rivals if name in best.form and name not in rival.form]
        if without and term.status == DETERMINED:
            other = ' and '.join(without[0]).replace('_', ' ')
            term = replace(term, status=WEAK, reason=f'{other} fits too')
        doubted[name] = term
    return doubted
