"""
The residual after the test of every effect.

Its size, its correlation, and its regimes in the session.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from imu_calibration.core.distributions import f_sf
from imu_calibration.effects.base import AXES, Role
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.selection.bias_courses import LEAST_WARMING, temperature_courses
from imu_calibration.selection.explained_share import ExplainedWindows
from imu_calibration.selection.linearised_problem import LinearisedProblem
from imu_calibration.selection.questions import Question
from imu_calibration.selection.reduced_recording import ReducedRecording
from imu_calibration.selection.residual_blocks import largest_axes

SIGNIFICANT_SDS = 5.0
"""Standard deviations above noise from which a rest is significant."""
MIN_EXPLAINED_WINDOWS = 12
"""Least number of windows; with fewer the model hardly predicts held-out windows."""
WITHIN_SHARE = 0.02
"""Least excess of the variance within windows that counts."""
ALPHA = 1e-4
"""Significance that a correlation must have."""
IN_MOTION = 'motion (moving windows against windows at rest)'
"""Name of the variable that separates moving windows from windows at rest."""
CURVES_IN_TIME = 'time'
"""Name of the variable for a polynomial of the time and for steps."""
MUCH_SCATTER = 10.0
"""
Least excess variance in motion, over the noise at rest and over the excess of the middle axis, of
an axis with a cause of its own.
"""

LOUD = 0.5
"""
Least mean square of a tone over the variance of the noise at rest, from which it is an unexplained
residual.
"""


@dataclass(frozen=True, eq=False)
class Unexplained:
    """Structure of one sensor's residual that no effect explains."""

    significant: bool
    """Whether it is significant against noise and plausible bias processes."""
    rms: float
    """
    Rms beyond noise, m/s^2 or rad/s (but see `unit`): of the windows' means, or within windows
    where only that is significant.
    """
    sigma: float
    """Standard deviations by which it exceeds noise."""
    correlates_with: str | None
    """Variable of the largest correlation, or None."""
    share: float
    """Share of the windows' variance explained by it."""
    residual: np.ndarray
    """Residual of the windows' means, shape (k, 3)."""
    noise_sd: np.ndarray
    """Expected sd from noise, shape (k, 3)."""
    unit: str | None = None
    """
    Unit of `rms` where it is not the sensor's: 'rad/turn' where turns by hand have the largest
    residual.
    """
    axes: tuple = ()
    """Axes of the sensor that carry it, the strongest first."""
    regimes: tuple = ()
    """Conditions under which it appears (`RestRegime`), at most one for each axis."""
    proposal: Any = None
    """Formula that it follows (`Proposal`), or None."""
    tones: tuple = ()
    """Fixed frequencies and fixed multiples of a joint's speed in it (`Tone`), the surest first."""

    @property
    def by_structure(self) -> bool:
        """Whether it is significant by a formula, a place, a tone or scatter, not by its size."""
        return self.significant and self.sigma < SIGNIFICANT_SDS

    @property
    def entry(self) -> dict[str, Any]:
        """Entry of a calibration document."""
        return {'rms': self.rms, 'axes': list(self.axes)} | (
            {'unit': self.unit} if self.unit else {}
        )


def unexplained(
    problem: LinearisedProblem, explained: ExplainedWindows, chosen: Sequence[Question]
) -> dict[str, Unexplained]:
    """Return sensor -> Unexplained for a choice of effects."""
    excess, used = explained.excess(chosen), problem.search.indices(chosen)
    values = problem.space.reduced(used, problem.evidence.fit(used)[0])
    return {sensor: _rest(problem, explained, sensor, excess[sensor], values) for sensor in excess}


def beyond_noise(problem: LinearisedProblem, sensor: str, rest: Unexplained) -> Unexplained:
    """
    Return the residual of a sensor.

    As significant if loud tones or the scatter in motion of one axis exceed the noise at rest.
    """
    scatter, noise = _scatter_of_one_axis(problem, sensor), problem.noise[sensor].white_variance
    squares = np.array(scatter)
    for tone in rest.tones:
        axis, mean_square = AXES.index(tone.axis), 0.5 * tone.amplitude**2
        if mean_square > LOUD * noise[axis]:
            squares[axis] += mean_square
    if not squares.any():
        return rest
    return replace(
        rest,
        significant=True,
        rms=float(np.sqrt(squares.mean())),
        axes=largest_axes(squares, 0.0),
        correlates_with=IN_MOTION if scatter.any() else None,
    )


def _scatter_of_one_axis(problem: LinearisedProblem, sensor: str) -> np.ndarray:
    """
    Return the excess variance of moving samples over the noise at rest, shape (3,).

    It is given for an axis that exceeds the remaining axes, otherwise 0.

    Errors of the reference (encoder steps, jitter of the stamps) scatter all axes in motion, a
    cause in the sensor its own axis.
    """
    excess = scatter_in_motion(problem, sensor)
    least = np.maximum(np.median(excess), problem.noise[sensor].at_rest_only().low_variance)
    return np.where(excess > MUCH_SCATTER * least, excess, 0.0)


def scatter_in_motion(problem: LinearisedProblem, sensor: str) -> np.ndarray:
    """Return the excess variance of moving samples over the noise at rest, shape (3,)."""
    noise, recording = problem.noise[sensor].at_rest_only(), problem.recording
    kinds, counts = recording.kind[recording.moving], recording.count[recording.moving]
    if not len(kinds):
        return np.zeros(3)
    in_motion = np.average([noise.row_variance(kind) for kind in kinds], axis=0, weights=counts)
    return np.maximum(in_motion - noise.low_variance, 0.0)


def biases_off(model: SensorModel, rests: Mapping[str, Unexplained]) -> list[dict[str, float]]:
    """
    Return bias -> its possible error, for each axis with a significant residual.

    A different offset in half of the windows scatters their means by as much as it shifts the bias.
    Which half is correct is unknown, for any number of windows.
    """
    found = []
    for sensor, rest in rests.items():
        if rest.significant:
            names = model.param_names[model.part(sensor, Role.OFFSET)]
            scatter = np.sqrt(np.maximum(np.mean(rest.residual**2 - rest.noise_sd**2, axis=0), 0.0))
            found += [{names[k]: float(scatter[k])} for k in map(AXES.index, rest.axes)]
    return found


def _rest(
    problem: LinearisedProblem,
    explained: ExplainedWindows,
    sensor: str,
    excess: np.ndarray,
    values: np.ndarray,
) -> Unexplained:
    space, recording = problem.space, problem.recording
    residual = np.stack(
        [space.mean[sensor][axis] @ values[space.places(sensor, axis)] for axis in range(3)], axis=1
    )
    floor = explained.floor.noise[sensor]
    white = floor.variance_beside_bias(
        recording.kind, recording.count, recording.duration, keys=recording.keys
    )
    noise_sd = np.sqrt(white + floor.bias_variance)
    sigma_means, sigma_within = explained.sigma(sensor, excess)
    # Quiet axes dilute the excess of one.
    means, within = np.maximum(excess.sum(axis=1), excess.max(axis=1))
    sigma = (
        max(sigma_means, sigma_within)
        if within > WITHIN_SHARE * explained.n_within
        else sigma_means
    )
    rms = float(np.sqrt(max(np.mean(residual**2 - noise_sd**2), 0.0)))
    significant = bool(sigma > SIGNIFICANT_SDS and explained.n_means >= 3 * MIN_EXPLAINED_WINDOWS)
    found = Unexplained(significant, rms, float(sigma), None, 0.0, residual, noise_sd)
    if not significant:
        return found
    if sigma_means <= SIGNIFICANT_SDS:
        inside = np.mean(
            [floor.row_variance(kind) for kind in np.unique(recording.kind[recording.moving])]
        )
        return replace(found, rms=float(np.sqrt(inside * within / explained.n_within)))
    if rms == 0:  # less than biases may wander, and more than neighbours may differ
        rms = float(np.sqrt(np.mean(white) * means / explained.n_means))
    # The fit has absorbed a part of the cause, as far as the columns of the model resemble it.
    fitted = []
    for axis in range(3):
        used = np.flatnonzero(values[space.places(sensor, axis)[:-1]])
        fitted.append(space.mean[sensor][axis][:, used])
    name, share = correlate(_explanations(recording), residual, noise_sd, fitted=fitted)
    return replace(found, rms=rms, correlates_with=name, share=share)


def correlate(
    explanations: Iterator,
    residual: np.ndarray,
    noise_sd: np.ndarray,
    *,
    fitted: Sequence[np.ndarray] | None = None,
) -> tuple[str | None, float]:
    """
    Return (name, adjusted share of the variance) of the best variable, or (None, 0).

    The best variable is the one with the largest correlation, beside the columns of the fit whose
    residual this is::

        residual_i = bias_i + fitted_i @ a_i + columns @ b_i + noise_i

    Parameters
    ----------
    explanations : iterator
        (name, columns (k, m), mask of the windows where they are known).
    residual : ndarray, shape (k, n)
        Of n axes.
    noise_sd : ndarray, shape (k, n)
        Its expected sd from noise.
    fitted : list of ndarray, shape (k, q_i)
        Columns of the fit of each axis beside its bias; default: none.

    """
    best = (None, 0.0)
    if fitted is None:
        fitted = [np.zeros((len(residual), 0))] * residual.shape[1]
    bias = np.ones((len(residual), 1))
    for name, columns, rows in explanations:
        if rows.sum() < 3 * columns.shape[1] + 6:
            continue
        total, total_dof, rest, rest_dof = 0.0, 0, 0.0, 0
        for axis, own in enumerate(fitted):
            weight = 1 / noise_sd[rows, axis, None]
            design = weight * np.column_stack([bias, own, columns])[rows]
            values = weight[:, 0] * residual[rows, axis]
            misfit, dof = _misfit(design[:, : 1 + own.shape[1]], values)
            total, total_dof = total + misfit, total_dof + dof
            misfit, dof = _misfit(design, values)
            rest, rest_dof = rest + misfit, rest_dof + dof
        gained = total_dof - rest_dof
        if min(gained, rest_dof) <= 0:
            continue
        share = 1 - (rest / rest_dof) / (total / total_dof)
        p_value = f_sf((total - rest) / gained / max(rest / rest_dof, 1e-300), gained, rest_dof)
        if p_value < ALPHA and share > max(best[1], 0.15):
            best = (name, float(share))
    return best


def _misfit(design: np.ndarray, values: np.ndarray) -> tuple[float, int]:
    """Return the sum of squares that a fit leaves, and its degrees of freedom."""
    solution, _, rank, _ = np.linalg.lstsq(design, values, rcond=1e-9)
    return float(((values - design @ solution) ** 2).sum()), len(values) - int(rank)


def _explanations(recording: ReducedRecording) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yield (name, columns (k, m), windows where they are known)."""
    describe, every = recording.describe, np.ones(len(recording.kind), bool)
    yield from slow_explanations(describe['time'], describe['temperature'])
    yield 'rate', np.stack([describe['rate'], describe['rate'] ** 2], axis=1), every
    yield 'specific force', (describe['specific force'] - 9.8)[:, None], every
    for name in describe:
        if name.startswith('angle'):
            number = name[len('angle') :]
            angle, known = describe[name], describe['span' + number] < 0.7
            turns = []
            for multiple in (1, 2, 3):
                turns += [np.cos(multiple * angle), np.sin(multiple * angle)]
            yield (
                f'angle of {recording.model.joint_names[int(number)]}',
                np.stack(turns, axis=1),
                known,
            )
    yield IN_MOTION, recording.moving[:, None].astype(float), every


def curves_in_time(time: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the columns of a polynomial of the time and of steps, each shape (k, m)."""
    share = (time - time.mean()) / max(np.ptp(time), 1e-9)
    yield np.stack([share, share**2, share**3], axis=1)
    levels = np.quantile(share, (0.2, 0.35, 0.5, 0.65, 0.8))
    yield np.stack([share > level for level in levels], axis=1).astype(float)


def slow_explanations(
    time: np.ndarray, temperature: np.ndarray
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """
    Yield (name, columns, mask) of time, steps in time, temperature, its rate and its past.

    Temperature is given where it is known and changes: a sensor is warmer or colder than its
    thermometer as long as heat flows.

    Parameters
    ----------
    time, temperature : array, shape (k,)
        s, in order, and degrees Celsius.

    """
    every = np.ones(len(time), bool)
    for curves in curves_in_time(time):
        yield CURVES_IN_TIME, curves, every
    if not np.all(np.isfinite(temperature)) or np.ptp(temperature) <= LEAST_WARMING:
        return
    warm = (temperature - temperature.mean()) / np.ptp(temperature)
    yield 'temperature', np.stack([warm, warm**2], axis=1), every
    for course in temperature_courses(time, temperature):
        yield course.name, course.values[:, None], course.known
