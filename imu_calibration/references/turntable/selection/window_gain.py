"""Gain of the extended model in predicting held-out windows of a table."""

from collections.abc import Sequence

import numpy as np

from imu_calibration.estimation.rows import weights_of
from imu_calibration.references.turntable.selection.linearised_problem import LinearisedProblem
from imu_calibration.references.turntable.selection.parameter_space import ParameterSpace
from imu_calibration.selection.gain import MEASURES, REST_MEASURE, Gain, gain_of
from imu_calibration.selection.questions import Question


def heldout_gain(
    problem: LinearisedProblem,
    before: Sequence[Question],
    after: Sequence[Question],
    *,
    sensors: Sequence[str],
) -> Gain:
    """
    Return the Gain of the choice `after` over the choice `before` on locked windows.

    The locked windows are used only here.

    Both are fitted to the windows that choose, and these choose sensor and measure too
    (`gain_in_turn`).

    Parameters
    ----------
    problem : LinearisedProblem
    before, after : sequence of Question
    sensors : sequence of str
        Sensors that the difference acts on; the one with the larger reduction is reported.

    """
    chosen = gain_in_turn(problem, before, after, sensors=sensors)
    pair = []
    for choice in (before, after):
        used = problem.search.indices(choice)
        values, _ = problem.evidence.fit(used)
        weights = weights_of(used, values, problem.space.size)[None]
        squares = _squares(problem.locked_samples, weights, chosen.sensor)
        pair.append(squares[chosen.measure])
    return gain_of(chosen.sensor, chosen.measure, pair)


def gain_in_turn(
    problem: LinearisedProblem,
    before: Sequence[Question],
    after: Sequence[Question],
    *,
    sensors: Sequence[str],
) -> Gain:
    """
    Return the Gain of the choice `after` over `before` on the selection windows, cross-validated.

    It is of one of the `sensors` and one of `MEASURES`. First choice: the largest lower end of the
    interval, without the measure of rests, if it is above zero. Otherwise the one whose squares
    fall most surely (`_certainty`), rests included: a small lag may reduce window means by a tenth
    through noise, and samples by a certain half percent. For a quiet sensor moving windows show the
    encoder, rests the sensor.
    """
    fold = problem.evidence.fold
    gains = []
    certainties = []
    for sensor in sensors:
        # Each window is predicted by a fit to the other folds.
        squares_of_choices = []
        for choice in (before, after):
            weights = problem.evidence.heldout_weights(problem.search.indices(choice))[fold]
            squares_of_choices.append(_squares(problem.all_samples, weights, sensor))
        for measure in MEASURES:
            pair = [squares[measure] for squares in squares_of_choices]
            gains.append(gain_of(sensor, measure, pair))
            certainties.append(_certainty(pair))

    largest = max(
        (gain for gain in gains if gain.measure != REST_MEASURE), key=lambda gain: gain.least
    )
    if largest.least > 0:
        return largest
    # Gains with an interval first, then the surest.
    ranks = [(not np.isinf(gain.least), certainty) for gain, certainty in zip(gains, certainties)]
    return gains[ranks.index(max(ranks))]


def _squares(
    space: ParameterSpace, weights: np.ndarray, sensor: str
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """
    Return measure -> (sums of squares of the residual, their numbers) per window, each (k,).

    `weights`: those of the residual (`weights_of`), for all windows (1, q + 1) or each (k, q + 1).
    """
    # Squares of the mean residual and of the residual about it, sums over the axes.
    recording = space.recording
    n_windows = len(recording.windows)
    of_mean = np.zeros(n_windows)
    about_mean = np.zeros(n_windows)
    for axis in range(3):
        places = space.places(sensor, axis)
        of_axis = np.broadcast_to(weights[:, places], (n_windows, len(places)))
        of_mean += np.einsum('kq,kq->k', space.mean[sensor][axis], of_axis) ** 2
        about_mean += space.squares_within(sensor, axis, of_axis)

    # At rest the samples about the mean are noise.
    rest = ~recording.moving
    variances = [window.sensors[sensor].noise_variance.sum() for window in recording.windows]
    about_mean[rest] = np.array(variances)[rest] * (recording.count[rest] - 1)

    of_samples = about_mean + recording.count * of_mean
    three_axes = np.full(n_windows, 3.0)
    squares = (
        (of_samples, 3 * recording.count),
        (of_mean, three_axes),
        (about_mean, 3 * (recording.count - 1)),
        (of_mean[rest], three_axes[rest]),
    )
    return dict(zip(MEASURES, squares, strict=True))


def _certainty(pair: Sequence[tuple[np.ndarray, np.ndarray]]) -> float:
    """
    Return the fall of the sums of squares over its standard deviation, ``sum f / sqrt(sum f^2)``.

    With the fall f of each window, from (sums of squares, numbers) before and after.
    """
    fall = pair[0][0] - pair[1][0]
    return float(fall.sum() / max(np.sqrt(fall @ fall), 1e-300))
