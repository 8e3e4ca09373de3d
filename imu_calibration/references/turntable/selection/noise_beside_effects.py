"""
Noise estimated in addition to candidate effects, and the band of frequencies in which it holds.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.effects.base import AXES
from imu_calibration.estimation.noise_likelihood import NoiseLikelihood
from imu_calibration.estimation.rows import Rows
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
    Return the space with only the slow part of the centred rows on some axes.

    These are the axes with a fast part that no effect explains.

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
            misfit = band_misfit(
                np.full(3, squares),
                n_rows - rank,
                np.full(3, slow_squares),
                dof_slow=n_slow_rows - slow_rank,
            )
            if misfit.apart[0] and misfit.fast[0] >= 2.0 * variance_at_rest[axis]:
                slow_only[sensor][axis] = True
                slow_variance[sensor][axis] = misfit.slow[axis]
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
So does one of up to this many times that of the middle axis, and of this many times the plausible
one at most: the axes of a sensor are of one make and their biases wander alike, while a cable pulls
along one. Not of the quietest: a bias that steps may rest on one axis.
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
    noise = noise_before_fit(space)
    every = np.arange(space.size)
    noise = {
        sensor: replace(own, known=(known or {}).get(sensor, ())) for sensor, own in noise.items()
    }
    for look_along in (False, True):
        values = solve_normal(
            normal_matrix(space, noise), every, space.prior_sd, prior_mean=space.prior_mean
        )[0]
        noise = {
            sensor: _with_moving_factors(space, sensor, noise[sensor], values, look_along)
            for sensor in space.sensors
        }
    return {
        sensor: _with_bias_process(space, sensor, noise, smooth[sensor]) for sensor in space.sensors
    }


def natural_processes(noise: NoiseModel, period: float) -> tuple[BiasProcess, ...]:
    """
    Return the least bias processes.

    The known ones, else from the white noise of the sensor and the time between samples, s.
    """
    return noise.known or (
        BiasProcess(
            NATURAL * float(np.sqrt(np.median(noise.white_variance) * period)), CORRELATION_TIMES[0]
        ),
    )


def plausible_processes(
    noise: NoiseModel, period: float, *, sensor: str, duration: float
) -> tuple[BiasProcess, ...]:
    """
    Return the bias processes up to a size that is plausible as noise.

    As found in the recording, naturally at least, at most as such biases do within its duration, s:
    further where all axes do so.
    """
    natural = natural_processes(noise, period)
    if noise.known or not noise.bias_processes:
        return natural
    seen = float(np.sqrt(sum(process.within(duration) ** 2 for process in noise.bias_processes)))
    most = PLAUSIBLE * max(natural[0].sd, STABLE[sensor])
    alike = MAX_MIDDLE_RATIO * noise.middle_wander * seen / float(np.sqrt(noise.bias_variance))
    share = min(1.0, float(np.clip(alike, most, MAX_WANDER_RATIO * most)) / seen)
    return tuple(replace(process, sd=share * process.sd) for process in noise.bias_processes)


def noise_before_fit(space: ParameterSpace) -> dict[str, NoiseModel]:
    """Return sensor -> NoiseModel before anything is fitted: the noise at rest."""
    found = {}
    for sensor in space.sensors:
        white, inflation = white_noise(space.recording.windows, sensor) or (
            _white_without_rest(space, sensor),
            np.ones(3),
        )
        found[sensor] = NoiseModel(
            white,
            inflation,
            reference=ReferenceNoise.of_steps(space.recording.encoder_step, sensor),
            shaken=shaken_means(space.recording.windows, sensor),
        )
    return found


def _white_without_rest(space: ParameterSpace, sensor: str) -> np.ndarray:
    moving = space.recording.moving
    dof = max((space.recording.count[moving] - 1).sum(), 1)
    return np.array(
        [
            max(least_misfit(space.within_sum(sensor, axis, moving))[0] / dof, 1e-30)
            for axis in range(3)
        ]
    )


def _with_moving_factors(
    space: ParameterSpace, sensor: str, noise: NoiseModel, values: np.ndarray, look_along: bool
) -> NoiseModel:
    """
    Return the noise with the scatter of moving windows.

    The residual's variance, and a factor for directions along the columns.
    """
    found = {}
    for kind in np.unique(space.recording.kind[space.recording.moving]):
        rows = space.recording.kind == kind
        dof = (space.recording.count[rows] - 1).sum()
        variances = np.zeros(3)
        along = np.zeros(3)
        for axis in range(3):
            reduced = np.append(-values[space.index[sensor][axis]], 1.0)
            if look_along:
                squares, rank = 0.0, 0
                for products in space.within_each(sensor, axis, rows):
                    products[:, :, -1] = products @ reduced
                    variances[axis] += (reduced @ products[:, :, -1].T).sum() / dof
                    misfit, dimensions = misfit_along(products)
                    squares = squares + misfit
                    rank = rank + dimensions
                along[axis] = squares / max(rank, 1)
            else:
                variances[axis] = reduced @ space.within_sum(sensor, axis, rows) @ reduced / dof
        share = float(np.clip(np.mean(along / variances), 1.0, None)) if look_along else 1.0
        factor = np.maximum(variances / noise.white_variance, LEAST_NOISE_SHARE)
        factor = factor * share / noise.inflation
        found[str(kind)] = MovingFactors(factor, factor, np.maximum(factor, 1.0), share)
    return replace(noise, moving=found)


def _with_bias_process(
    space: ParameterSpace,
    sensor: str,
    noise: dict[str, NoiseModel],
    smooth: Sequence[Sequence[int]],
) -> NoiseModel:
    """
    Return the noise of a sensor with window offsets and bias process.

    It is estimated with all effects but the superfluous smooth ones. A wander would follow a step
    of the biases, or a temperature that acts late: one of these that beats the process is a part
    of the model too.
    """
    recording = space.recording
    superfluous = sorted(set().union(*smooth))
    structural = np.setdiff1d(np.concatenate(space.index[sensor]), superfluous)
    own = np.append(structural, superfluous).astype(int)
    place = {parameter: k for k, parameter in enumerate(own)}
    equations = np.zeros((len(recording.windows), 3, len(own) + 1))
    for axis in range(3):
        columns = [*(place[parameter] for parameter in space.index[sensor][axis]), -1]
        equations[:, axis, columns] = space.mean[sensor][axis]
    products = _known_otherwise(space, sensor, noise, own)
    rows = recording.mean_rows(equations, noise[sensor], products)
    rows = recording.without_offsets(rows, noise[sensor])
    natural = float(
        np.sqrt(
            sum(process.sd**2 for process in natural_processes(noise[sensor], recording.period))
        )
    )
    smooth_columns = equations[:, :, len(structural) : -1]
    options = []  # columns of each smooth effect
    for parameters in smooth:
        options.append([place[k] - len(structural) for k in parameters])
    wander = _WanderProblem(
        recording=recording,
        rows=rows,
        n_structural=len(structural),
        options=options,
        prior_sd=drift_prior(
            smooth_columns, space.prior_sd[superfluous], max(natural, STABLE[sensor])
        ),
        natural=natural,
        stable=STABLE[sensor],
    )
    found = _best_course(wander)
    shape = found.search.best(found.used)[0]
    middle = 0.0
    if shape[1] > PLAUSIBLE * found.search.usual:
        middle = found.search.of_middle_axis(shape, found.used)
    return replace(noise[sensor], middle_wander=middle, **found.search.polished(shape, found.used))


@dataclass(frozen=True, eq=False)
class _Choice:
    """The model beside which a bias process is estimated."""

    search: BiasProcessSearch
    """Noise with these columns."""
    used: Sequence[int]
    """Parameters of the smooth effect or course of the biases that is needed."""
    moment: int
    """Number of the step among the steps; negative: it is none."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _WanderProblem:
    """Rows of one sensor, of which a bias process or a course in time explains the wander."""

    recording: ReducedRecording
    rows: Rows
    """
    Means ``[structural | smooth | residual]`` without a bias process but the known ones, with the
    products of what is known of the parameters otherwise.
    """
    n_structural: int
    """Columns that every model has."""
    options: Sequence[Sequence[int]]
    """Numbers of the parameters of each smooth effect."""
    prior_sd: np.ndarray
    """Prior sd of these parameters."""
    natural: float
    """Standard deviation of the bias processes that are known, SI."""
    stable: float
    """Bias variation of a stable sensor, SI."""

    def choice(self, courses: Sequence[np.ndarray], steps: Sequence[np.ndarray] = ()) -> _Choice:
        """Return the best of the smooth effects, of courses in time and of steps, or none."""
        # Columns of the courses and steps on each axis, and their priors.
        added = _columns_of_biases([*courses, *steps], len(self.rows))
        usual = max(self.natural, self.stable)
        sd = drift_prior(added, np.full(added.shape[2], np.inf), usual)
        # A course has one parameter on each axis.
        options = [list(option) for option in self.options]
        n_smooth = len(self.prior_sd)
        for first in range(n_smooth, n_smooth + len(sd), len(AXES)):
            options.append([first, first + 1, first + 2])

        equations = self.rows.equations
        rows = replace(
            self.rows,
            equations=np.concatenate([equations[:, :, :-1], added, equations[:, :, -1:]], axis=2),
            products=_with_priors(self.rows.products, sd),
        )
        likelihood = NoiseLikelihood(rows, common=self.n_structural, choices=options)
        least = 0.0 if rows.processes else self.natural
        search = BiasProcessSearch(likelihood, least, self.stable)
        first_step = len(options) - len(steps)
        # Each of the moments is as likely as the other ones.
        prices = np.zeros(len(options))
        prices[first_step:] = 2 * np.log(max(len(steps), 1))
        used = _needed_smooth(search, options, prior_sd=np.append(self.prior_sd, sd), prices=prices)
        moment = options.index(list(used)) - first_step if used else -1
        return _Choice(search, used, moment)


def _best_course(wander: _WanderProblem) -> _Choice:
    """Return the best model beside a bias process: a step is sought coarsely, then closely."""
    recording = wander.recording
    if np.ptp(recording.session) > 0:  # between two recordings each bias may change
        return wander.choice([])
    count = len(wander.rows)
    temperature = recording.describe['temperature']
    courses = [course.values for course in temperature_courses(recording.time, temperature)]
    places = step_places(np.arange(count), MOST_MOMENTS)
    found = wander.choice(courses, _steps(places, count))
    if found.moment >= 0 and len(places) == MOST_MOMENTS:
        # the windows between the neighbours of the best moment
        first = places[max(found.moment - 1, 0)]
        last = places[min(found.moment + 1, len(places) - 1)]
        places = step_places(np.arange(first, last + 1), MOST_MOMENTS, least=0)
        found = wander.choice(courses, _steps(places, count))
    return found


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
    """Return the information with further parameters before the column of the residual."""
    count = len(information) - 1 + len(sd)
    extended = np.zeros((count + 1, count + 1))
    kept = np.append(np.arange(len(information) - 1), count)
    extended[np.ix_(kept, kept)] = information
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
    Return the parameters of the smooth effect that beats the bias process.

    Each one is judged with the noise estimated jointly, and has a further price.

    By restricted likelihood, all parameters integrated out under their priors: at its maximum over
    as many as there are windows the wander is underestimated, and noise of 15 s resembles a drift.
    """
    losses = [search.best([])[1]]
    for option, price in zip(options, np.broadcast_to(prices, len(options)), strict=True):
        occam = 2 * np.log(prior_sd[option]).sum()
        losses.append(search.best(option)[1] + occam + STRONG + price)
    return [[], *options][int(np.argmin(losses))]


def _known_otherwise(
    space: ParameterSpace, sensor: str, noise: dict[str, NoiseModel], own: np.ndarray
) -> np.ndarray:
    """
    Return the information on the parameters `own` (normal matrix).

    It includes the information from priors and from within windows.
    """
    at = np.append(own, space.size)
    information = within_matrix(space, noise, sensors=(sensor,))[np.ix_(at, at)]
    prior = 1 / space.prior_sd[own] ** 2
    information[:-1, :-1] += np.diag(prior)
    information[:-1, -1] += space.prior_mean[own] * prior
    information[-1, :-1] = information[:-1, -1]
    return information
