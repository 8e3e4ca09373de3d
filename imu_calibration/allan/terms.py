"""
Noise figures of one axis.

A form is the set of slow processes in a model, in addition to white noise and perhaps quantisation.
"""

from collections.abc import Sequence
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
"""Forms that are tried, with a Gauss-Markov process last."""
PROCESSES = {process.name: process for process in (QUANTISATION, WHITE, FLICKER, RANDOM_WALK)}
MAX_COST_EXCESS = 6.0
"""Largest cost above the least one of a form that is possible as well."""
PRICE = 2.0
"""Cost of a coefficient."""
PRICE_OF_TIME = 7.0
"""Cost of a correlation time, because many are tried."""
TIME_STEP = 8
"""
Stride over the correlation times; each is tested for a clearly higher likelihood than the time of
best fit.
"""
MIN_FORM_WEIGHT = 0.05
"""Least likelihood of a form in an interval, over that of the best form."""
MIN_COMPARED_MEANS = 6.0
"""
Least number of means in the longest part at the averaging times at which forms are compared: with
fewer, the logarithms of variances are not Gaussian.
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
        Other forms that explain the curve nearly as well, without generalisations of better ones.
        """
        rivals: list[MomentFit] = []
        for fit in self.fits:
            if fit.cost - self.best.cost > MAX_COST_EXCESS:
                continue
            better = (self.best, *rivals)
            if not any(_is_special_case(known.form, fit.form) for known in better):
                rivals.append(fit)
        return tuple(rivals)

    def having(self, name: str) -> tuple[list[MomentFit], list[float]]:
        """
        Return (fits with a process, the best first; likelihood of each over that of the best).

        Fits of a likelihood up to `MIN_FORM_WEIGHT` are omitted.
        """
        with_process = [fit for fit in self.fits if name in fit.names]
        best = with_process[0]
        fits = [best]
        weights = [1.0]
        for fit in with_process[1:]:
            weight = float(np.exp(-0.5 * (fit.cost - best.cost)))
            if weight > MIN_FORM_WEIGHT:
                fits.append(fit)
                weights.append(weight)
        return fits, weights

    def widened(self, name: str) -> 'Choice':
        """Return a Choice with one fit: the best form with a further process, `name`."""
        fast = tuple(known for known in self.best.names if known == QUANTISATION.name)
        fit = fit_names(self.moments, (*fast, WHITE.name, name, *self.best.form))
        return Choice((replace(fit, cost=self.best.cost),), self.moments)

    def close(self, name: str) -> MomentFit | None:
        """
        Return the best fit with a process that explains the curve nearly as well as the best form.

        None if there is none. Its cost may exceed that of `rivals` by the price of a correlation
        time.
        """
        for fit in self.fits:
            if name in fit.form and fit.cost - self.best.cost <= MAX_COST_EXCESS + PRICE_OF_TIME:
                return fit
        return None


def _is_special_case(form: tuple[str, ...], wider: tuple[str, ...]) -> bool:
    """
    Return whether a form is a special case of a wider one.

    A random walk is a Gauss-Markov process with an infinite correlation time.
    """
    for name in form:
        if name not in wider and not (name == RANDOM_WALK.name and GAUSS_MARKOV in wider):
            return False
    return True


def choose_form(moments: Moments, excess: float = 1.0) -> Choice:
    """
    Return the fits of all forms, with quantisation noise if it is significant with the best form.

    `excess` is a factor on all covariances, for a curve that no form explains.
    """
    fits = _all_forms(moments, (), excess)
    wider = fit_form(moments, fits[0].form, (QUANTISATION.name,))
    if score_at_zero(moments, wider) < QUANTISATION_P_VALUE:
        fits = _all_forms(moments, (QUANTISATION.name,), excess)
    return Choice(fits, moments)


def _all_forms(moments: Moments, fast: tuple[str, ...], excess: float) -> tuple[MomentFit, ...]:
    """
    Return the fits of all forms that the averaging times can determine, the least cost first.

    `fast` are the names of processes that each of them has in addition to white noise.
    """
    n_scales = int(moments.used.sum())
    fits = []
    for form in FORMS:
        # Two averaging times for each slow process, and some for white noise and the misfit.
        if len(fast) + 2 * len(form) + 3 <= n_scales:
            fits.append(fit_form(moments, form, fast, excess=excess))
    return tuple(sorted(fits, key=lambda fit: fit.cost))


def fit_form(
    moments: Moments, form: tuple[str, ...], fast: tuple[str, ...] = (), *, excess: float = 1.0
) -> MomentFit:
    """
    Return the fit of a noise model to the Allan variances of an axis, with the cost of the model.

    The cost is minus twice the log likelihood (`log_cost`) plus a price for each parameter.

    Parameters
    ----------
    moments : Moments
        Allan variances with their covariance.
    form : tuple of str
        Names of the slow processes of the model. White noise is always part of it.
    fast : tuple of str
        Names of further processes of short averaging times, such as quantisation.
    excess : float
        Factor on all covariances, for a curve that no model explains.

    """
    names = (*fast, WHITE.name, *form)
    fit = fit_names(moments, names)
    # The correlation time of a Gauss-Markov process is a parameter with a price of its own.
    if GAUSS_MARKOV in form:
        fit = _at_likelier_time(moments, fit)
    cost = log_cost(moments, fit, excess)
    price_of_time = PRICE_OF_TIME * (GAUSS_MARKOV in form)
    return replace(fit, cost=cost + PRICE * len(names) + price_of_time)


def _at_likelier_time(moments: Moments, fit: MomentFit) -> MomentFit:
    """
    Return the fit with another correlation time if one is clearly likelier, else the fit itself.

    The fit minimises weighted squares, and with the weights of a long time a long time fits best.
    """
    # Every `TIME_STEP`-th time, then all times about the best of these.
    costs = []
    for time in moments.times[::TIME_STEP]:
        costs.append(log_cost(moments, _with_time(moments, fit, time)))
    best = int(np.argmin(costs))
    if costs[best] > log_cost(moments, fit) - MAX_COST_EXCESS:
        return fit
    near = slice(max((best - 1) * TIME_STEP, 0), (best + 1) * TIME_STEP)
    fits = [_with_time(moments, fit, time) for time in moments.times[near]]
    return min(fits, key=lambda trial: log_cost(moments, trial))


def _with_time(moments: Moments, fit: MomentFit, time: float) -> MomentFit:
    """Return a fit of the processes of another one, with the correlation time of the last fixed."""
    return fit_processes(moments, (*fit.processes[:-1], gauss_markov(time)))


def fit_names(moments: Moments, names: tuple[str, ...]) -> MomentFit:
    """Fit the processes of these names; a Gauss-Markov process is the last."""
    processes = tuple(PROCESSES[name] for name in names if name != GAUSS_MARKOV)
    if GAUSS_MARKOV in names:
        return fit_with_time(moments, processes)
    return fit_processes(moments, processes)


def log_cost(moments: Moments, fit: MomentFit, excess: float = 1.0) -> float:
    """
    Return minus twice the log likelihood of the logarithms of the variances except for a constant.

    A variance with the expectation f and n degrees of freedom is ``f chi^2_n / n``, of which the
    logarithm has the mean ``ln f + digamma(n / 2) - ln(n / 2)`` and the variance ``trigamma(n /
    2)``. Its correlations are those of the variances; squares are divided by `excess`. The cost is
    infinite for a fit that expects no variance at some averaging time.
    """
    # Only averaging times with enough means for nearly Gaussian logarithms.
    compared = moments.scales.tau[moments.used] * MIN_COMPARED_MEANS <= moments.scales.longest
    expected = (moments.design(fit.processes) @ fit.coefficients)[compared]
    covariance = fit.covariance[np.ix_(compared, compared)]
    if not (np.all(expected > 0) and np.all(np.isfinite(covariance))):
        return np.inf
    freedom = 2 * expected**2 / np.diag(covariance)  # n, from the variance 2 f^2 / n
    # Standard deviation of a logarithm over the relative one of its variance.
    log_factor = np.sqrt(polygamma(1, freedom / 2) * freedom / 2)
    whiten = Whitener(covariance / np.outer(expected, expected) * np.outer(log_factor, log_factor))
    log_ratio = np.log(moments.target[compared] / expected)
    residual = whiten(log_ratio - digamma(freedom / 2) + np.log(freedom / 2))
    cost = float(residual @ residual) / excess + whiten.log_determinant
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
"""Probability of a misfit below which the shortest averaging times are excluded."""
LEAST_SCALES = 8
"""Least number of averaging times in the fit."""
LONGEST_EXCLUDED = 2.0
"""
Longest averaging time that may be excluded, s: a misfit beyond is not that of a filter in the
sensor.
"""
WHITE_SHARE = 0.5
"""
Least share of white noise in the shortest variance for which shorter averaging times of an
unexplained curve are excluded.
"""
FILTER_TIME_RATIO = 8.0
"""
Averaging times up to this many times the shortest one without a misfit by a filter are excluded.
"""
TIME_KEY = 'correlation_time'
"""Key of the correlation time among the terms."""
PEAK_PERIODS = 0.371
"""Averaging time at which the Allan variance of a sine has its maximum, in periods."""
PEAK_HEIGHT = 0.525
"""This maximum, in squared amplitudes."""
RICHEST = tuple((QUANTISATION.name, WHITE.name, *form) for form in FORMS[-2:])
"""Processes of the models that contain all others."""


@dataclass(frozen=True)
class Term:
    """One figure of one axis."""

    name: str
    """Name of the process, or 'correlation_time'."""
    value: float | None
    """The figure; None when it is held."""
    interval: tuple[float, float]
    """95 % interval; it begins at 0 if the curve does not require the process."""
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
    """Names of the slow processes; empty without a slow part in the curve."""
    others: tuple[tuple[str, ...], ...] = ()
    """Other forms that explain the curve as well."""
    alternatives: dict[str, Term] = field(default_factory=dict)
    """Figures of processes that occur in the other forms only."""
    shortest: float = 0.0
    """
    Shortest averaging time that was fitted, s; longer than the period where the sensor filters its
    noise.
    """
    excess: float = 1.0
    """Factor on all covariances because the misfit exceeds the sampling error, at least 1."""
    oscillation: tuple[float, float] | None = None
    """
    Frequency (Hz) and amplitude of the sine with the largest unexplained hump; of a recording,
    those of the line near this frequency.
    """
    scatter: float = 0.0
    """Standard deviation of the level of the variances from rest to rest, over the level."""
    fit: Any = None
    """The fitted model (MomentFit); None: from a document."""


def identify_axis(moments: Moments) -> AxisNoise:
    """
    Return the noise of one axis from its Allan variances.

    The likeliest form of the model gives the figures, with intervals that include other likely
    forms; processes that occur only in these are alternatives.
    """
    # Averaging times of the fit, the scatter between rests, and the form.
    moments, excess = _fit_range(moments)
    moments = replace(moments, scatter=scatter_of(moments))
    choice = choose_form(moments, excess)
    best = choice.best
    rivals = choice.rivals

    # Figures of the best model; upper limits of flicker and random walk without them.
    terms: dict[str, Term] = {}
    for name in best.names:
        terms |= _figures(choice, name, excess)
    for name in {FLICKER.name, RANDOM_WALK.name} - set(best.form):
        terms[name] = _held(_figures(choice.widened(name), name, excess)[name])

    # Figures of the processes in other forms. A Gauss-Markov process that fits nearly as well is
    # included: its price may exclude it from the rivals.
    alternatives: dict[str, Term] = {}
    with_gauss_markov = choice.close(GAUSS_MARKOV)
    for other in rivals if with_gauss_markov is None else (*rivals, with_gauss_markov):
        for name in set(other.form) - set(best.form) - set(alternatives):
            alternatives |= _figures(choice, name, excess)
    return AxisNoise(
        _doubted(terms, best, rivals),
        best.form,
        others=tuple(rival.form for rival in rivals),
        alternatives=alternatives,
        shortest=float(moments.scales.tau[moments.used][0]),
        excess=excess,
        oscillation=_hump(moments, best) if excess > 1 else None,
        scatter=moments.scatter,
        fit=best,
    )


def with_wider_white_noise(axis: AxisNoise, factor: float) -> AxisNoise:
    """
    Return the noise of an axis whose white noise may be too high by a factor, at least 1.

    The lower end of its interval is divided by the factor, because outliers or repeated readings
    raise the variances at every averaging time by the same factor.
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
    Return the relative standard deviation of the level of the variances between parts.

    It is in excess of the sampling error by a model with every slope (`Parts.scatter`).
    """
    fit = fit_names(moments, RICHEST[0])
    expected = moments.design(fit.processes) @ fit.coefficients
    return moments.parts.scatter(moments.used, np.diag(fit.covariance) / expected**2)


def _hump(moments: Moments, fit: MomentFit) -> tuple[float, float] | None:
    """
    Return (frequency in Hz, amplitude) of the sine with the most significant excess over a fit.

    A sine of amplitude a and frequency f has the Allan variance ``a^2 sin^4(x) / x^2``, ``x = pi f
    tau``, which is largest at ``f tau = PEAK_PERIODS``. None without a positive excess.
    """
    excess = moments.target - moments.design(fit.processes) @ fit.coefficients
    highest = int(np.argmax(excess / np.sqrt(np.diag(fit.covariance))))
    if excess[highest] <= 0:
        return None
    frequency = PEAK_PERIODS / moments.scales.tau[moments.used][highest]
    return float(frequency), float(np.sqrt(excess[highest] / PEAK_HEIGHT))


def predicted(moments: Moments, axis: AxisNoise) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (Allan variance, degrees of freedom of a measured one) for every averaging time.

    `moments` are those of any recording. The level of its noise is assumed to differ from part to
    part as in the recording from which the noise of the axis was identified.
    """
    all_scales = replace(moments, used=np.ones_like(moments.used))
    fit = axis.fit
    expected = all_scales.design(fit.processes) @ fit.coefficients
    sampling = np.einsum(
        'p,q,pqii->i', fit.coefficients, fit.coefficients, all_scales.tensor(fit.processes)
    )
    # Relative variance of the level of the noise from part to part.
    level = axis.scatter**2 * moments.parts.share() if axis.scatter else 0.0
    return expected, 2.0 / (sampling * axis.excess / expected**2 + level)


def _fit_range(moments: Moments) -> tuple[Moments, float]:
    """
    Return the moments without filtered averaging times, and the remaining misfit.

    The shortest averaging times are excluded until one of the richest models explains all longer
    ones. If none does (vibration), the range with the least misfit is kept, among ranges of which
    the shortest averaging time shows white noise; all averaging times if there is no such range.

    Returns
    -------
    Moments
        With `used` reduced.
    float
        Excess of the squares over their expectation, at least 1.

    """
    most = min(
        int(np.sum(moments.scales.tau <= LONGEST_EXCLUDED)), int(moments.used.sum()) - LEAST_SCALES
    )
    least_misfit = np.inf  # per degree of freedom
    best_range = moments
    for n_excluded in range(max(most, 0) + 1):
        trial = without_finest(moments, n_excluded)
        freedom = int(trial.used.sum()) - len(RICHEST[0])
        fit = min((fit_names(trial, names) for names in RICHEST), key=lambda fit: fit.misfit)
        if chdtrc(freedom, fit.misfit) > MISFIT_P_VALUE:
            return _with_margin(trial, n_excluded, most), 1.0
        white_variance = fit.coefficient(WHITE.name) * trial.design((WHITE,))[0, 0]
        shows_white = white_variance > WHITE_SHARE * trial.target[0]
        if not n_excluded or (shows_white and fit.misfit / freedom < least_misfit):
            least_misfit = fit.misfit / freedom
            best_range = trial
    return best_range, max(float(least_misfit), 1.0)


def _with_margin(moments: Moments, n_excluded: int, most: int) -> Moments:
    """
    Return the moments without the scales at which a filter of the sensor still bends the curve.

    `n_excluded` scales show a misfit; at most `most` are excluded. At tau the filter lowers the
    curve by 3/2 (its time) / tau.
    """
    if not n_excluded:
        return moments
    tau = moments.scales.tau
    n_bent = int(np.sum(tau < FILTER_TIME_RATIO * tau[n_excluded]))
    return without_finest(moments, min(n_bent, most))


def _figures(choice: Choice, name: str, excess: float) -> dict[str, Term]:
    """
    Return the terms of one process: its figure, and the correlation time of a Gauss-Markov process.
    """
    fits, weights = choice.having(name)
    best = fits[0]
    index = best.names.index(name)
    interval = coefficient_interval(choice.moments, fits, weights, name=name, excess=excess)
    terms = {name: _term(name, np.sqrt(best.coefficients[index]), np.sqrt(interval))}
    if name == GAUSS_MARKOV:
        interval_of_time = time_interval(choice.moments, fits, weights, excess=excess)
        terms[TIME_KEY] = _term(TIME_KEY, best.processes[index].time, interval_of_time)
    return terms


def _term(name: str, value: float, interval: Sequence[float] | np.ndarray) -> Term:
    """Return the term of a figure, determined if the ratio of the ends of its interval is small."""
    lower, upper = (float(end) for end in interval)
    if not value > 0:
        return Term(name, None, (0.0, upper), HELD, 'not seen')
    if not lower > 0:
        return Term(name, float(value), (lower, upper), WEAK, 'may be none')
    if upper / lower <= DETERMINED_RATIO:
        return Term(name, float(value), (lower, upper), DETERMINED)
    return Term(name, float(value), (lower, upper), WEAK, 'too short')


def _held(term: Term) -> Term:
    """Return the term of a process that is not in the best form: its upper limit only."""
    interval = (0.0, term.interval[1])
    return replace(term, value=None, status=HELD, interval=interval, reason='not seen')


def _doubted(
    terms: dict[str, Term], best: MomentFit, rivals: tuple[MomentFit, ...]
) -> dict[str, Term]:
    """Return the terms; a term is weak when another form without it explains the curve as well."""
    doubted = {}
    for name, term in terms.items():
        without = [rival.form for rival in rivals if name in best.form and name not in rival.form]
        if without and term.status == DETERMINED:
            other = ' and '.join(without[0]).replace('_', ' ')
            term = replace(term, status=WEAK, reason=f'{other} fits too')
        doubted[name] = term
    return doubted
