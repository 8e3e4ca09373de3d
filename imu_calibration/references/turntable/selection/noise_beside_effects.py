"""
Noise estimated in addition to candidate effects, and the band of frequencies in which it holds.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.effects.base import AXES
from imu_calibration.estimation.noise_likelihood import NoiseLikelihood
from imu_calibration.estimation.rows import Rows, weights_of
from imu_calibration.estimation.scaled_solve import solve_normal
from imu_calibration.estimation.sensor_noise import NATURAL, BiasProcess
from imu_calibration.references.turntable.estimation.noise_search import (
    CORRELATION_TIMES,
    BiasProcessSearch,
)
from imu_calibration.references.turntable.estimation.session_noise import (
    band_misfit,
    least_misfit,
    misfit_along,
    shaken_means,
    white_noise,
)
from imu_calibration.references.turntable.noise_model import (
    MovingFactors,
    NoiseModel,
    ReferenceNoise,
)
from imu_calibration.references.turntable.selection.parameter_space import (
    ParameterSpace,
    normal_matrix,
    within_matrix,
)
from imu_calibration.references.turntable.selection.reduced_recording import ReducedRecording
from imu_calibration.selection.bias_courses import step_places, temperature_courses


def in_trusted_band(space: ParameterSpace) -> ParameterSpace:
    """
    Return the space with only the slow part compared on axes with an unexplained fast part.

    The rows are the samples about the mean of their window; the slow part are the means of short
    pieces of a window.

    Joint states at 100 Hz do not show a motor's ripple at 47 Hz, and no effect of the catalogue
    makes up for it; judged sample by sample, such a recording is evidence for any effect that
    reduces the ripple. The fast part is replaced by white noise of the slow part's variance, so
    that all counts of samples hold.
    """
    recording = space.recording
    moving = recording.moving
    n_rows = (recording.count[moving] - 1).sum()
    n_slow_rows = np.maximum(recording.slow_rows - 1.0, 0.0)[moving].sum()
    slow_only = {}
    slow_variance = {}
    for sensor in space.sensors:
        noise = white_noise(recording.windows, sensor)
        variance_at_rest = np.zeros(3)
        if noise is not None:
            variance, inflation = noise
            variance_at_rest = variance * np.maximum(inflation, 1.0)
        slow_only[sensor] = np.zeros(3, bool)
        slow_variance[sensor] = np.zeros(3)
        for axis in range(3):
            # The best fit of all candidate effects together: no effect explains the remainder.
            squares, rank = least_misfit(space.within_sum(sensor, axis, moving, part='within'))
            slow_squares, slow_rank = least_misfit(
                space.within_sum(sensor, axis, moving, part='slow')
            )
            # The misfit of one axis, three times, because the function takes three axes.
            misfit = band_misfit(
                np.full(3, squares),
                n_rows - rank,
                np.full(3, slow_squares),
                dof_slow=n_slow_rows - slow_rank,
            )
            # The fast part is unexplained: above the slow part, and clearly above noise at rest.
            if misfit.apart[0] and misfit.fast[0] >= 2.0 * variance_at_rest[axis]:
                slow_only[sensor][axis] = True
                slow_variance[sensor][axis] = misfit.slow[0]
    return replace(space, slow_only=slow_only, slow_variance=slow_variance)


STRONG = 10.0
"""
Twice the logarithm of the Bayes factor required for an effect smooth in time against a bias process
only: very strong (Kass, Raftery 1995), since some fifteen of them are tested.
"""
PLAUSIBLE = 3.0
"""
A wander of up to this many times the natural one passes for noise; with eight a cable that pulls in
an arc, half a milligravity, was one.
"""
MAX_MIDDLE_RATIO, MAX_WANDER_RATIO = 3.0, 4.0
"""
A wander of up to the first times that of the middle axis passes for noise too, but of at most the
second times the plausible one: the axes of a sensor are of one make and their biases wander alike,
while a cable pulls along one. Not of the quietest: a bias that steps may rest on one axis.
"""
STABLE = {'accelerometer': 1e-4, 'gyroscope': 0.0}
"""
Bias variation that is normal for any white noise, m/s^2 and rad/s: the best accelerometers keep
their bias to 10 ug.
"""
MAX_DRIFT_RATIO = 100.0
"""
Largest drift over the usual bias variation: the ratio by which the effects' priors, for consumer
instruments, exceed their bias variation.
"""
MOST_MOMENTS = 40
"""Moments at which a step of the biases is compared with a bias process at a time."""
LEAST_NOISE_SHARE = 0.9
"""Moving windows scatter no less than this share of the noise at rest."""


def noise_beside_effects(
    space: ParameterSpace,
    smooth: dict[str, list[tuple[int, ...]]],
    known: dict[str, tuple[BiasProcess, ...]] | None = None,
) -> dict[str, NoiseModel]:
    """
    Return sensor -> NoiseModel, estimated together with a model of all candidate effects.

    Windows' offsets and the bias process are estimated by restricted maximum likelihood on the
    means of the windows; the variance within moving windows from the residual, and its serial
    correlation from the misfit of each window along its columns.

    Parameters
    ----------
    space : ParameterSpace
    smooth : dict
        Sensor -> list of tuples of parameters: effects that are smooth in time. Only the best
        choice among them, if any is needed, remains in the model with which the bias process is
        estimated.
    known : dict, optional
        Sensor -> its bias processes, where measured separately.

    """
    noise = {}
    for sensor, at_rest in noise_before_fit(space).items():
        noise[sensor] = replace(at_rest, known=(known or {}).get(sensor, ()))

    # Variance within moving windows: from a fit with the noise at rest, then, with its serial
    # correlation, from a fit with the first variance.
    all_parameters = np.arange(space.size)
    for is_correlated in (False, True):
        values, _ = solve_normal(
            normal_matrix(space, noise),
            all_parameters,
            space.prior_sd,
            prior_mean=space.prior_mean,
        )
        for sensor in space.sensors:
            noise[sensor] = _with_moving_factors(
                space, sensor, noise[sensor], values, is_correlated
            )

    with_processes = {}
    for sensor in space.sensors:
        with_processes[sensor] = _with_bias_process(space, sensor, noise, smooth[sensor])
    return with_processes


def natural_processes(noise: NoiseModel, period: float) -> tuple[BiasProcess, ...]:
    """
    Return the least bias processes of a sensor.

    They are the known ones, else one with `NATURAL` times the white noise of one second; `period`:
    time between samples, s.
    """
    if noise.known:
        return noise.known
    noise_of_one_second = float(np.sqrt(np.median(noise.white_variance) * period))
    return (BiasProcess(NATURAL * noise_of_one_second, CORRELATION_TIMES[0]),)


def plausible_processes(
    noise: NoiseModel, period: float, *, sensor: str, duration: float
) -> tuple[BiasProcess, ...]:
    """
    Return the bias processes of a recording, reduced to a size that is plausible as noise.

    With the sd s of the estimated processes within the duration, the sd w of the bias of the middle
    axis there, and p = PLAUSIBLE times the usual sd of a bias, s is at most::

        clip(MAX_MIDDLE_RATIO w, p, MAX_WANDER_RATIO p)

    The middle axis is the one with the second largest wander.

    Parameters
    ----------
    noise : NoiseModel
    period, duration : float
        Time between samples, and of the recording, s.
    sensor : str

    """
    least_processes = natural_processes(noise, period)
    if noise.known or not noise.bias_processes:
        return least_processes
    wander = float(np.sqrt(sum(process.within(duration) ** 2 for process in noise.bias_processes)))
    plausible = PLAUSIBLE * max(least_processes[0].sd, STABLE[sensor])
    # `middle_wander` and the root of `bias_variance` are sds over a long duration: their ratio, the
    # share of the middle axis, applies to the sd within the duration of the recording too.
    limit_by_middle_axis = (
        MAX_MIDDLE_RATIO * noise.middle_wander * wander / float(np.sqrt(noise.bias_variance))
    )
    limit = float(np.clip(limit_by_middle_axis, plausible, MAX_WANDER_RATIO * plausible))
    share = min(1.0, limit / wander)
    return tuple(replace(process, sd=share * process.sd) for process in noise.bias_processes)


def noise_before_fit(space: ParameterSpace) -> dict[str, NoiseModel]:
    """Return sensor -> NoiseModel before anything is fitted: the noise at rest."""
    recording = space.recording
    models = {}
    for sensor in space.sensors:
        at_rest = white_noise(recording.windows, sensor)
        if at_rest is None:
            at_rest = (_white_without_rest(space, sensor), np.ones(3))
        white, inflation = at_rest
        models[sensor] = NoiseModel(
            white,
            inflation,
            reference=ReferenceNoise.of_steps(recording.encoder_step, sensor),
            shaken=shaken_means(recording.windows, sensor),
        )
    return models


def _white_without_rest(space: ParameterSpace, sensor: str) -> np.ndarray:
    """
    Return the variance of single samples in motion at the best fit of all effects, shape (3,).

    It is the noise of a recording without rests.
    """
    moving = space.recording.moving
    dof = max((space.recording.count[moving] - 1).sum(), 1)
    variances = []
    for axis in range(3):
        squares, _ = least_misfit(space.within_sum(sensor, axis, moving))
        variances.append(max(squares / dof, 1e-30))
    return np.array(variances)


def _with_moving_factors(
    space: ParameterSpace, sensor: str, noise: NoiseModel, values: np.ndarray, is_correlated: bool
) -> NoiseModel:
    """
    Return the noise with the scatter of samples in each kind of moving window.

    The scatter is the variance of the residual at the parameters `values`, shape (q,). With
    `is_correlated` it grows by the ratio of the mean square of the residual along the columns of
    each window to this variance, the mean over the axes, which is 1 for white noise. The factors
    are on ``white_variance * inflation``.
    """
    recording = space.recording
    weights = weights_of(range(space.size), values, space.size)
    moving = {}
    for kind in np.unique(recording.kind[recording.moving]):
        of_kind = recording.kind == kind
        dof = (recording.count[of_kind] - 1).sum()
        variances = np.zeros(3)
        column_variances = np.zeros(3)
        for axis in range(3):
            # The residual is its products with the columns times these weights.
            of_axis = weights[space.places(sensor, axis)]
            if is_correlated:
                scatter = _scatter_in_windows(space, sensor, axis, of_kind, of_axis, dof)
                variances[axis], column_variances[axis] = scatter
            else:
                variances[axis] = of_axis @ space.within_sum(sensor, axis, of_kind) @ of_axis / dof
        # The same factor for rows, slow parts and means, of which the means have at least the noise
        # at rest.
        correlation = 1.0
        if is_correlated:
            correlation = float(np.clip(np.mean(column_variances / variances), 1.0, None))
        factor = np.maximum(variances / noise.white_variance, LEAST_NOISE_SHARE)
        factor = factor * correlation / noise.inflation
        moving[str(kind)] = MovingFactors(
            factor, slow=factor, means=np.maximum(factor, 1.0), correlation=correlation
        )
    return replace(noise, moving=moving)


def _scatter_in_windows(
    space: ParameterSpace,
    sensor: str,
    axis: int,
    rows: np.ndarray,
    weights: np.ndarray,
    dof: float,
) -> tuple[float, float]:
    """
    Return (variance of the residual of an axis, its mean square along the columns of each window).

    `rows`: mask of the windows, with `dof` degrees of freedom; `weights`, shape (q_a + 1,): a row
    ``[design | residual]`` of the axis times these is the residual of the fit.
    """
    variance = 0.0
    squares = 0.0
    rank = 0
    for products in space.within_each(sensor, axis, rows):
        # With the rows B of a window, B'B w in the last column of B'B: products of all columns with
        # the residual B w of the fit, in place of that of the linearisation.
        products[:, :, -1] = products @ weights
        variance += (weights @ products[:, :, -1].T).sum() / dof  # w'B'B w
        squares_of_windows, rank_of_windows = misfit_along(products)
        squares += squares_of_windows
        rank += rank_of_windows
    return variance, squares / max(rank, 1)


def _with_bias_process(
    space: ParameterSpace,
    sensor: str,
    noise: dict[str, NoiseModel],
    smooth: Sequence[Sequence[int]],
) -> NoiseModel:
    """
    Return the noise of a sensor with window offsets and bias process.

    It is estimated with all effects of the sensor; of the smooth ones only the one that explains
    the means better than a bias process remains. A wander would follow a step of the biases, or a
    temperature that acts late: one of these that beats the process is a part of the model too.

    Parameters
    ----------
    space : ParameterSpace
    sensor : str
    noise : dict
        Sensor -> NoiseModel.
    smooth : sequence of sequences of int
        Parameters of each effect of the sensor that is smooth in time.

    """
    # Means of the windows ``[structural | smooth | residual]`` with the parameters of the sensor,
    # from the rows of each axis, which have only the parameters that act on it.
    recording = space.recording
    of_smooth = sorted(set().union(*smooth))
    structural = np.setdiff1d(np.concatenate(space.index[sensor]), of_smooth)
    parameters = np.append(structural, of_smooth).astype(int)
    place = {parameter: k for k, parameter in enumerate(parameters)}
    equations = np.zeros((len(recording.windows), 3, len(parameters) + 1))
    for axis in range(3):
        columns = [*(place[parameter] for parameter in space.index[sensor][axis]), -1]
        equations[:, axis, columns] = space.mean[sensor][axis]
    products = _information_without_means(space, sensor, noise, parameters)
    rows = recording.mean_rows(equations, noise[sensor], products)
    rows = recording.without_offsets(rows, noise[sensor])

    # Which smooth effect, course in time or step explains them better than a bias process?
    processes = natural_processes(noise[sensor], recording.period)
    natural_wander = float(np.sqrt(sum(process.sd**2 for process in processes)))
    smooth_columns = equations[:, :, len(structural) : -1]
    # Columns of each smooth effect among `smooth_columns`.
    options = []
    for parameters_of_effect in smooth:
        options.append([place[k] - len(structural) for k in parameters_of_effect])
    wander = _WanderProblem(
        recording=recording,
        rows=rows,
        n_structural=len(structural),
        options=options,
        prior_sd=drift_prior(
            smooth_columns, space.prior_sd[of_smooth], max(natural_wander, STABLE[sensor])
        ),
        natural_wander=natural_wander,
        normal_wander=STABLE[sensor],
    )
    choice = _best_course(wander)

    # Offsets and bias process with that model, of a grid of sizes, then refined. The wander of the
    # middle axis is a limit (`plausible_processes`), needed only above a plausible process.
    search = choice.search
    shape, _ = search.best(choice.used)
    middle_wander = 0.0
    if shape.bias > PLAUSIBLE * search.usual:
        middle_wander = search.of_middle_axis(shape, choice.used)
    polished = search.polished(shape, choice.used)
    return replace(noise[sensor], middle_wander=middle_wander, **polished)


@dataclass(frozen=True, eq=False)
class _Choice:
    """The model with which a bias process is estimated."""

    search: BiasProcessSearch
    """Search for the noise of rows with the columns under test."""
    used: Sequence[int]
    """Parameters of the smooth effect, course or step that is in the model; empty without one."""
    step: int
    """Index of the step in the model among the steps under test; negative if it has none."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _WanderProblem:
    """Rows of one sensor, of which a bias process or a course in time explains the wander."""

    recording: ReducedRecording
    """Times and temperatures of the windows."""
    rows: Rows
    """
    Means of the windows ``[structural | smooth | residual]``, with the known bias processes only.

    Their products are the information on the parameters that is not from means.
    """
    n_structural: int
    """Number of the first parameters, not smooth in time, which every model under test has."""
    options: Sequence[Sequence[int]]
    """Parameters of each smooth effect, counted after the structural ones."""
    prior_sd: np.ndarray
    """Prior sd of the parameters of all smooth effects, shape (n_smooth,)."""
    natural_wander: float
    """Sd of the bias that the sensor has at least (`natural_processes`), SI."""
    normal_wander: float
    """Sd of the bias that is normal for any sensor of this type (`STABLE`), SI."""

    def best_model(
        self, courses: Sequence[np.ndarray], steps: Sequence[np.ndarray] = ()
    ) -> _Choice:
        """
        Return the likeliest model of the wander: a bias process and at most one cause in time.

        A cause is a smooth effect, a course in time or a step. The courses and steps, each shape
        (n_windows,), are multiplied by one bias per axis.
        """
        # Columns of the courses and steps, three biases each, and their priors.
        bias_columns = _columns_of_biases([*courses, *steps], len(self.rows))
        usual_wander = max(self.natural_wander, self.normal_wander)
        bias_sd = drift_prior(bias_columns, np.full(bias_columns.shape[2], np.inf), usual_wander)
        equations = self.rows.equations
        rows = replace(
            self.rows,
            equations=np.concatenate(
                [equations[:, :, :-1], bias_columns, equations[:, :, -1:]], axis=2
            ),
            products=_with_priors(self.rows.products, bias_sd),
        )

        # Parameters of each cause, counted after the structural ones: effects, courses, steps.
        options = [list(option) for option in self.options]
        n_smooth = len(self.prior_sd)
        for first in range(n_smooth, n_smooth + len(bias_sd), len(AXES)):
            options.append([first, first + 1, first + 2])
        first_step = len(options) - len(steps)
        # A step is at any of the moments with equal probability: minus twice its logarithm.
        prices = np.zeros(len(options))
        prices[first_step:] = 2 * np.log(max(len(steps), 1))

        likelihood = NoiseLikelihood(rows, common=self.n_structural, choices=options)
        # Known bias processes are in the rows already, so that a further one may be zero.
        least_wander = 0.0 if rows.processes else self.natural_wander
        search = BiasProcessSearch(likelihood, least=least_wander, usual=self.normal_wander)
        prior_sd = np.append(self.prior_sd, bias_sd)
        used = _needed_smooth(search, options, prior_sd=prior_sd, prices=prices)
        step = options.index(list(used)) - first_step if used else -1
        return _Choice(search, used, step)


def _best_course(wander: _WanderProblem) -> _Choice:
    """
    Return the likeliest model of the wander, with a course in time, a step, an effect or none.

    A step is sought among `MOST_MOMENTS` windows, then between the two nearest to the best.
    """
    recording = wander.recording
    if np.ptp(recording.session) > 0:  # between two recordings each bias may change
        return wander.best_model(courses=[])
    count = len(wander.rows)
    temperature = recording.describe['temperature']
    courses = [course.values for course in temperature_courses(recording.time, temperature)]
    places = step_places(np.arange(count), MOST_MOMENTS)
    choice = wander.best_model(courses, _steps(places, count))
    # With fewer places each window between the outermost ones was tried already.
    if choice.step >= 0 and len(places) == MOST_MOMENTS:
        first = places[max(choice.step - 1, 0)]
        last = places[min(choice.step + 1, len(places) - 1)]
        places = step_places(np.arange(first, last + 1), MOST_MOMENTS, least=0)
        choice = wander.best_model(courses, _steps(places, count))
    return choice


def _steps(places: np.ndarray, count: int) -> list[np.ndarray]:
    """Return 1 after each of the windows `places`, 0 up to it, each shape (count,)."""
    return [(np.arange(count) > last).astype(float) for last in places]


def _columns_of_biases(courses: Sequence[np.ndarray], count: int) -> np.ndarray:
    """Return the columns of courses in time on each axis, shape (count, 3, 3 * n_courses)."""
    columns = np.zeros((count, len(AXES), len(AXES) * len(courses)))
    for number, course in enumerate(courses):
        for axis in range(len(AXES)):
            columns[:, axis, len(AXES) * number + axis] = course
    return columns


def _with_priors(information: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """
    Return a normal matrix extended by parameters of which only the prior sd is known.

    They are inserted before the residual, which is the last row and column.
    """
    count = len(information) - 1 + len(sd)
    extended = np.zeros((count + 1, count + 1))
    given = np.append(np.arange(len(information) - 1), count)
    extended[np.ix_(given, given)] = information
    added = np.arange(len(information) - 1, count)
    extended[added, added] = 1 / sd**2
    return extended


def drift_prior(columns: np.ndarray, prior_sd: np.ndarray, usual: float) -> np.ndarray:
    """
    Return the prior sd of parameters as drifts of a sensor, shape (q,).

    With the prior of the catalogue, for consumer instruments, a navigation gyroscope would drift by
    15 000 times its bias variation, and its actual drift would be unlikely.

    Parameters
    ----------
    columns : ndarray, shape (n, 3, q)
        Of the means of windows.
    prior_sd : ndarray, shape (q,)
    usual : float
        Standard deviation of the usual wander of the bias.

    """
    spread = np.sqrt(columns.var(axis=0).max(axis=0))
    return np.minimum(prior_sd, MAX_DRIFT_RATIO * usual / np.maximum(spread, 1e-300))


def _needed_smooth(
    search: BiasProcessSearch,
    options: Sequence[Sequence[int]],
    *,
    prior_sd: np.ndarray,
    prices: np.ndarray | float = 0.0,
) -> Sequence[int]:
    """
    Return the parameters of the option with the least loss; none if the bias process alone is best.

    The loss of an option is that of the likeliest noise with its parameters, plus the logarithm of
    its prior, `STRONG` and its price.

    By restricted likelihood, all parameters integrated out under their priors: at its maximum over
    as many as there are windows the wander is underestimated, and noise of 15 s resembles a drift.

    Parameters
    ----------
    search : BiasProcessSearch
    options : sequence of sequences of int
        Parameters of each smooth effect, course or step.
    prior_sd : array
        Of all these parameters.
    prices : array, shape (n_options,) or float
        Twice the negative log prior probability of each option.

    """
    losses = [search.best([])[1]]
    for option, price in zip(options, np.broadcast_to(prices, len(options)), strict=True):
        of_prior = 2 * np.log(prior_sd[option]).sum()
        losses.append(search.best(option)[1] + of_prior + STRONG + price)
    return [[], *options][int(np.argmin(losses))]


def _information_without_means(
    space: ParameterSpace, sensor: str, noise: dict[str, NoiseModel], parameters: np.ndarray
) -> np.ndarray:
    """Return the normal matrix of parameters by their priors and the samples within windows."""
    chosen = np.append(parameters, space.size)  # and the residual, which is last
    normal = within_matrix(space, noise, sensors=(sensor,))[np.ix_(chosen, chosen)]
    prior = 1 / space.prior_sd[parameters] ** 2
    normal[:-1, :-1] += np.diag(prior)
    normal[:-1, -1] += space.prior_mean[parameters] * prior
    normal[-1, :-1] = normal[:-1, -1]
    return normal
