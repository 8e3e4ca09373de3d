"""
Gain of the extended model in predicting held-out windows.

The locked ones were also excluded from its selection.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imu_calibration.selection.linearised_problem import LinearisedProblem
from imu_calibration.selection.parameter_space import ParameterSpace
from imu_calibration.selection.questions import Question

WINDOW_RESAMPLES = 1000
"""Number of resamples of windows for an interval."""
SAMPLES, REST_MEASURE = 'samples', 'means of windows at rest'
MEASURES = (SAMPLES, 'window means', 'samples about the mean of their window', REST_MEASURE)
"""Residuals of which a gain is reported."""
APPLIED, OF_MODEL = 'error of corrected readings', 'residual of the model'
"""
Kinds of residuals: of readings as compensation corrects them, relative to the reference, or of raw
readings, relative to the model.
"""
LEAST_REDUCTION = 0.01
"""
With an unexplained excess, or without rests, a finding reduces the cross-validated residual by more
than this share, with 97.5 % confidence.
"""


@dataclass(frozen=True, eq=False)
class Gain:
    """Residual on windows that were held out, before and after."""

    sensor: str
    """Sensor; the residuals have its unit."""
    measure: str
    """One of `MEASURES`, whichever shows the effect better in the windows that it was chosen on."""
    heldout_rms_before: float
    """Rms residual of the model without the finding, m/s^2 or rad/s."""
    heldout_rms_after: float
    """The same with it."""
    ci95: tuple[float, float]
    """95 % interval of the reduction, by resampling windows."""
    windows: int
    """Windows that were held out."""
    of: str = OF_MODEL
    """`APPLIED` or `OF_MODEL`."""
    noise_rms: float = float('nan')
    """Rms noise at rest that both contain, m/s^2 or rad/s; nan where it is not known."""

    @property
    def beyond_noise(self) -> tuple[float, float]:
        """Rms before and after without the noise at rest, ``sqrt(max(rms^2 - noise^2, 0))``."""
        noise_square = self.noise_rms**2
        before = float(np.sqrt(max(self.heldout_rms_before**2 - noise_square, 0.0)))
        after = float(np.sqrt(max(self.heldout_rms_after**2 - noise_square, 0.0)))
        return before, after

    @property
    def least(self) -> float:
        """
        Lower end of the interval, minus infinity with too few windows.

        Too few windows occur, for example, for rests in a recording without any.
        """
        return -np.inf if np.isnan(self.ci95[0]) else self.ci95[0]

    @property
    def reduction(self) -> float:
        """1 - after / before."""
        if not self.heldout_rms_before > 0:
            return 0.0
        return 1.0 - self.heldout_rms_after / self.heldout_rms_before


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
        weights = problem.space.reduced(used, values)[None]
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
    Return the same Gain on the selection windows by cross-validation.

    Returned is the measure with the largest reduction; if that is uncertain, the one with the
    surest: a small lag may reduce window means by a tenth through noise, and samples by a certain
    half percent. For a quiet sensor moving windows show the encoder, rests the sensor.
    """
    fold = problem.evidence.fold
    gains = []
    certainties = []
    for sensor in sensors:
        # Each window is predicted by a fit to the other folds.
        squares_of_choices = []
        for choice in (before, after):
            used = problem.search.indices(choice)
            weights_of_folds = []
            for number in range(fold.max() + 1):
                values, _ = problem.evidence.fit(used, number)
                weights_of_folds.append(problem.space.reduced(used, values))
            weights = np.array(weights_of_folds)[fold]
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


def gain_of(
    sensor: str, measure: str, pair: Sequence[tuple[np.ndarray, np.ndarray]], *, of: str = OF_MODEL
) -> Gain:
    """Return the Gain from (sums of squares, numbers) of each group of rows, before and after."""
    rms = []
    for squares, number in pair:
        rms.append(float(np.sqrt(squares.sum() / max(number.sum(), 1))))
    before, after = rms
    n_groups = len(pair[0][0])
    return Gain(sensor, measure, before, after, reduction_interval(pair), n_groups, of)


def _squares(
    space: ParameterSpace, values: np.ndarray, sensor: str
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """
    Return measure -> (sums of squares, their numbers) per window, each (k,).

    They are taken at vectors of `ParameterSpace.reduced`, one or many.
    """
    # Squares of the mean residual and of the residual about it, sums over the axes.
    recording = space.recording
    n_windows = len(recording.windows)
    of_mean = np.zeros(n_windows)
    about_mean = np.zeros(n_windows)
    for axis in range(3):
        places = space.places(sensor, axis)
        weights = np.broadcast_to(values[:, places], (n_windows, len(places)))
        of_mean += np.einsum('kq,kq->k', space.mean[sensor][axis], weights) ** 2
        about_mean += space.squares_within(sensor, axis, weights)

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
    """Return by how many standard deviations sums of squares fall from window to window."""
    fall = pair[0][0] - pair[1][0]
    return float(fall.sum() / max(np.sqrt(fall @ fall), 1e-300))


def reduction_interval(pair: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[float, float]:
    """
    Return the 95 % interval of the reduction over resampled windows.

    From (sums of squares, numbers) per window before and after.
    """
    n_windows = len(pair[0][0])
    if n_windows < 3:
        return (float('nan'), float('nan'))
    draw = np.random.default_rng(1).integers(0, n_windows, (WINDOW_RESAMPLES, n_windows))
    rms = [
        np.sqrt(squares[draw].sum(axis=1) / number[draw].sum(axis=1)) for squares, number in pair
    ]
    low, high = np.quantile(1 - rms[1] / rms[0], (0.025, 0.975))
    return (float(low), float(high))
