"""The figures of one axis: each process with its interval and its status."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from imu_calibration.allan.forms import GAUSS_MARKOV, choose_form, fit_names, without_finest
from imu_calibration.allan.moment_fit import MomentFit, Moments
from imu_calibration.allan.processes import FLICKER, QUANTISATION, RANDOM_WALK, WHITE
from imu_calibration.allan.score_intervals import coefficient_interval, time_interval

DETERMINED, WEAK, HELD = 'determined', 'weak', 'held'
DETERMINED_RATIO = 1.6
"""Upper over lower end of the 95 % interval up to which a figure counts as determined: a quarter to either side."""
MISFIT = 1e-3
"""Probability of a misfit below which the shortest averaging times are left out."""
LEAST_SCALES = 8
"""Least number of averaging times in the fit."""
LONGEST_LEFT_OUT = 2.0
"""s; a model that fails beyond is wrong for another reason than a filter in the sensor."""
WHITE_SHARE = 0.5
"""Least share of white noise in the shortest variance for which shorter averaging times of an unexplained curve are excluded."""
MARGIN = 8.0
"""Where a filter shows, averaging times up to so many of the longest that shows it are left out."""
TIME = 'correlation_time'
PEAK, PEAK_HEIGHT = 0.371, 0.525
"""Where the Allan variance of a sine peaks, in periods, and how high, in squared amplitudes."""
RICHEST = tuple((QUANTISATION.name, WHITE.name, *form) for form in ((FLICKER.name, RANDOM_WALK.name), (RANDOM_WALK.name, GAUSS_MARKOV)))
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

    form: tuple[str, ...]
    """Names of the processes that make the slow part; empty: none shows."""
    terms: dict[str, Term]
    """Name of the process -> its figure; 'correlation_time' in addition to 'gauss_markov'."""
    others: tuple[tuple[str, ...], ...]
    """Other forms that explain the curve as well."""
    alternatives: dict[str, Term]
    """Figures of processes that occur only in these forms."""
    fit: MomentFit
    """The fitted model."""
    shortest: float
    """Shortest averaging time that was fitted, s."""
    excess: float
    """Factor on all covariances because the misfit exceeds the sampling error, at least 1."""
    oscillation: tuple[float, float] | None = None
    """Frequency (Hz) and amplitude: of the sine with the largest hump that no model explains; from a recording, of its line."""
    scatter: float = 0.0
    """Standard deviation of the level of the variances from rest to rest, over the level."""


def identify_axis(moments: Moments) -> AxisNoise:
    """Return the noise of one axis from its Allan variances."""
    moments, excess = fit_range(moments)
    moments = replace(moments, scatter=scatter_of(moments))
    choice = choose_form(moments, excess)
    best, rivals = choice.best, choice.rivals
    fast = tuple(name for name in (QUANTISATION.name,) if name in best.fit.names)
    terms: dict[str, Term] = {}
    for name in (*fast, WHITE.name, *best.form):
        terms |= _figures(choice, name, excess)
    for name in {FLICKER.name, RANDOM_WALK.name} - set(best.form):
        terms |= {name: _held(_figures(choice.widened(name), name, excess)[name])}
    alternatives: dict[str, Term] = {}
    for other in (*rivals, *filter(None, [choice.close(GAUSS_MARKOV)])):
        for name in set(other.form) - set(best.form) - set(alternatives):
            alternatives |= _figures(choice, name, excess)
    return AxisNoise(best.form, _doubted(terms, best, rivals), tuple(rival.form for rival in rivals), alternatives, best.fit,
                     float(moments.scales.tau[moments.used][0]), excess, _hump(moments, best.fit) if excess > 1 else None, moments.scatter)


def scatter_of(moments: Moments) -> float:
    """Return the excess variation of the level of the variances between parts; the sampling error is that of a model with every slope."""
    fit = fit_names(moments, RICHEST[0])
    expected = moments.design(fit.processes) @ fit.coefficients
    return moments.parts.scatter(moments.used, np.diag(fit.covariance) / expected**2)


def _hump(moments, fit):
    """Return frequency and amplitude of the sine that makes the largest excess; its Allan variance is a^2 sin^4(x) / x^2, x = pi f tau."""
    beyond = moments.target - moments.design(fit.processes) @ fit.coefficients
    highest = int(np.argmax(beyond / np.sqrt(np.diag(fit.covariance))))
    if beyond[highest] <= 0:
        return None
    return float(PEAK / moments.scales.tau[moments.used][highest]), float(np.sqrt(beyond[highest] / PEAK_HEIGHT))


def predicted(moments: Moments, axis: AxisNoise) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the prediction for every averaging time of a recording: the variance, and the degrees of freedom of a measured one.

    The level of the noise differs there from part to part as it did where it was identified.
    """
    every = replace(moments, used=np.ones_like(moments.used))
    fit = axis.fit
    expected = every.design(fit.processes) @ fit.coefficients
    spread = np.einsum('p,q,pqii->i', fit.coefficients, fit.coefficients, every.tensor(fit.processes))
    level = axis.scatter**2 * moments.parts.share() if axis.scatter else 0.0
    return expected, 2.0 / (spread * axis.excess / expected**2 + level)


def fit_range(moments: Moments) -> tuple[Moments, float]:
    """
    Return the moments without the averaging times at which the sensor filters its noise, and the remaining misfit.

    The shortest ones are excluded until one of the richest models explains the others. Where none does (vibration), those are kept that
    are explained best, as long as their shortest still shows white noise, else all.

    Returns
    -------
    Moments
        With `used` reduced.
    float
        Excess of the squares over their expectation, at least 1.

    """
    most = min(int(np.sum(moments.scales.tau <= LONGEST_LEFT_OUT)), int(moments.used.sum()) - LEAST_SCALES)
    least, kept = np.inf, moments
    for count in range(max(most, 0) + 1):
        trial = without_finest(moments, count)
        freedom = int(trial.used.sum()) - len(RICHEST[0])
        fit = min((fit_names(trial, names) for names in RICHEST), key=lambda found: found.misfit)
        if chdtrc(freedom, fit.misfit) > MISFIT:
            return _with_margin(trial, count, most), 1.0
        seen = fit.coefficient(WHITE.name) * trial.design((WHITE,))[0, 0] > WHITE_SHARE * trial.target[0]
        if not count or (seen and fit.misfit / freedom < least):
            least, kept = fit.misfit / freedom, trial
    return kept, max(float(least), 1.0)


def _with_margin(moments, count, most):
    """Return the moments without the scales at which a detected filter still bends the curve, by 1 - 3/2 (its time) / tau."""
    tau = moments.scales.tau
    return without_finest(moments, min(int(np.sum(tau < MARGIN * tau[count])), most)) if count else moments


def _figures(choice, name, excess):
    """Return the terms of one process: its figure, and the correlation time of a Gauss-Markov process."""
    fits, weights = choice.having(name)
    index = fits[0].names.index(name)
    interval = coefficient_interval(choice.moments, fits, weights, name=name, excess=excess)
    found = {name: _term(name, np.sqrt(fits[0].coefficients[index]), np.sqrt(interval))}
    if name == GAUSS_MARKOV:
        found[TIME] = _term(TIME, fits[0].processes[index].time, time_interval(choice.moments, fits, weights, excess=excess))
    return found


def _term(name, value, interval):
    lower, upper = (float(end) for end in interval)
    if not value > 0:
        return Term(name, None, (0.0, upper), HELD, 'not seen')
    if lower > 0 and upper / lower <= DETERMINED_RATIO:
        return Term(name, float(value), (lower, upper), DETERMINED)
    return Term(name, float(value), (lower, upper), WEAK, 'too short' if lower > 0 else 'may be none')


def _held(term):
    return replace(term, value=None, status=HELD, interval=(0.0, term.interval[1]),
                   reason='not seen')


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
