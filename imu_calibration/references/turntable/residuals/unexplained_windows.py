"""The residual of windows on a table after the test of every effect."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from imu_calibration.effects.base import AXES
from imu_calibration.estimation.rows import weights_of
from imu_calibration.references.turntable.selection.linearised_problem import LinearisedProblem
from imu_calibration.references.turntable.selection.reduced_recording import ReducedRecording
from imu_calibration.selection.questions import Question
from imu_calibration.selection.unexplained import (
    IN_MOTION,
    MIN_EXPLAINED_WINDOWS,
    SIGNIFICANT_SDS,
    Unexplained,
    correlate,
    largest_axes,
    slow_explanations,
)

WITHIN_SHARE = 0.02
"""Least excess of the squares within windows, as a share of their number, that counts."""
MUCH_SCATTER = 10.0
"""
Least excess variance in motion, over the noise at rest and over the excess of the middle axis, of
an axis with a separate cause.
"""
LOUD = 0.5
"""
Least mean square of a tone over the variance of the noise at rest, from which it is an unexplained
residual.
"""


def unexplained(problem: LinearisedProblem, chosen: Sequence[Question]) -> dict[str, Unexplained]:
    """Return sensor -> Unexplained with the effects `chosen` in the model."""
    used = problem.search.indices(chosen)
    values = weights_of(used, problem.evidence.fit(used)[0], problem.space.size)
    excess_of = problem.explained.excess(chosen)
    return {
        sensor: _unexplained(problem, sensor, excess, values)
        for sensor, excess in excess_of.items()
    }


def beyond_noise(problem: LinearisedProblem, sensor: str, rest: Unexplained) -> Unexplained:
    """
    Return the residual of a sensor as significant if an axis has loud tones or scatter in motion.

    Loud tones have a mean square above `LOUD` times the variance of the noise at rest. Without both
    the residual `rest` is returned unchanged.
    """
    scatter = _scatter_of_one_axis(problem, sensor)
    noise = problem.noise[sensor].white_variance
    squares = np.array(scatter)
    for tone in rest.tones:
        axis = AXES.index(tone.axis)
        mean_square = 0.5 * tone.amplitude**2
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
    Return the `scatter_in_motion` of an axis that exceeds the other axes, else 0, shape (3,).

    Errors of the reference (encoder steps, jitter of the stamps) scatter all axes in motion, a
    cause in the sensor its own axis.
    """
    excess = scatter_in_motion(problem, sensor)
    least = np.maximum(np.median(excess), problem.noise[sensor].without_misfit().low_variance)
    return np.where(excess > MUCH_SCATTER * least, excess, 0.0)


def scatter_in_motion(problem: LinearisedProblem, sensor: str) -> np.ndarray:
    """Return the excess variance of moving samples over the noise at rest, shape (3,)."""
    noise = problem.noise[sensor].without_misfit()
    recording = problem.recording
    kinds = recording.kind[recording.moving]
    counts = recording.count[recording.moving]
    if not len(kinds):
        return np.zeros(3)
    in_motion = np.average([noise.row_variance(kind) for kind in kinds], axis=0, weights=counts)
    return np.maximum(in_motion - noise.low_variance, 0.0)


def _unexplained(
    problem: LinearisedProblem, sensor: str, excess: np.ndarray, values: np.ndarray
) -> Unexplained:
    """
    Return the residual of a sensor that the model does not explain, and its likely cause.

    Parameters
    ----------
    problem : LinearisedProblem
    sensor : str
    excess : ndarray, shape (2, 3)
        Excess squares over noise of the means and within windows, of each axis.
    values : ndarray, shape (n + 1,)
        Weights of columns and residual (`weights_of`).

    """
    # Residual of the means of the windows, and its sd by noise alone.
    space = problem.space
    recording = problem.recording
    explained = problem.explained
    residual_of_axes = [
        space.mean[sensor][axis] @ values[space.places(sensor, axis)] for axis in range(3)
    ]
    residual = np.stack(residual_of_axes, axis=1)
    floor = explained.floor.noise[sensor]
    white = recording.mean_variance(floor)
    noise_sd = np.sqrt(white + floor.bias_variance)

    # Is the excess of the means, or of the samples within windows, significant?
    n_means, n_within = explained.numbers[sensor]
    sigma_means, sigma_within = explained.sigma(sensor, excess)
    # At least the excess of one axis, which negative values of other axes would lower.
    excess_of_means, excess_within = np.maximum(excess.sum(axis=1), excess.max(axis=1))
    sigma = sigma_means
    if excess_within > WITHIN_SHARE * n_within:
        sigma = max(sigma_means, sigma_within)
    rms = float(np.sqrt(max(np.mean(residual**2 - noise_sd**2), 0.0)))
    significant = bool(sigma > SIGNIFICANT_SDS and n_means >= 3 * MIN_EXPLAINED_WINDOWS)
    unexplained = Unexplained(
        significant=significant,
        rms=rms,
        sigma=float(sigma),
        correlates_with=None,
        share=0.0,
        residual=residual,
        noise_sd=noise_sd,
    )
    if not significant:
        return unexplained

    # An excess within windows only: its rms in units of the variance of their samples.
    if sigma_means <= SIGNIFICANT_SDS:
        moving_kinds = np.unique(recording.kind[recording.moving])
        variance = np.mean([floor.row_variance(kind) for kind in moving_kinds])
        rms_within = np.sqrt(variance * excess_within / n_within)
        return replace(unexplained, rms=float(rms_within))

    # The means differ by less than the wander of the bias, but neighbours by more than white noise.
    if rms == 0:
        rms = float(np.sqrt(np.mean(white) * excess_of_means / n_means))

    # Its correlation with time, temperature and motion. The fit has absorbed the part of the cause
    # that the columns of the model resemble.
    fitted = []
    for axis in range(3):
        used = np.flatnonzero(values[space.places(sensor, axis)[:-1]])
        fitted.append(space.mean[sensor][axis][:, used])
    name, share = correlate(_explanations(recording), residual, noise_sd, fitted=fitted)
    return replace(unexplained, rms=rms, correlates_with=name, share=share)


def _explanations(recording: ReducedRecording) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """
    Yield (name, columns, mask of the windows where they are known) of each explanation.

    Columns have shape (k, m), one row for each window.
    """
    describe = recording.describe
    all_windows = np.ones(len(recording.kind), bool)
    yield from slow_explanations(describe['time'], describe['temperature'])
    yield 'rate', np.stack([describe['rate'], describe['rate'] ** 2], axis=1), all_windows
    yield 'specific force', (describe['specific force'] - 9.8)[:, None], all_windows
    for name in describe:
        if name.startswith('angle'):
            number = name[len('angle') :]
            angle = describe[name]
            # In a window of a larger span, rad, the mean angle has no meaning.
            known = describe['span' + number] < 0.7
            waves = []
            for multiple in (1, 2, 3):
                waves += [np.cos(multiple * angle), np.sin(multiple * angle)]
            joint = recording.model.joint_names[int(number)]
            yield f'angle of {joint}', np.stack(waves, axis=1), known
    yield IN_MOTION, recording.moving[:, None].astype(float), all_windows
