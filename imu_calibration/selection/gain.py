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
        before, after = (
            float(np.sqrt(max(rms**2 - self.noise_rms**2, 0.0)))
            for rms in (self.heldout_rms_before, self.heldout_rms_after)
        )
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
        return (
            1.0 - self.heldout_rms_after / self.heldout_rms_before
            if self.heldout_rms_before > 0
            else 0.0
        )


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
    gain = gain_in_turn(problem, before, after, sensors=sensors)
    used = map(problem.search.indices, (before, after))
    values = [problem.space.reduced(some, problem.evidence.fit(some)[0])[None] for some in used]
    return gain_of(
        gain.sensor,
        gain.measure,
        [_squares(problem.locked_samples, each, gain.sensor)[gain.measure] for each in values],
    )


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
    found, fold = [], problem.evidence.fold
    for sensor in sensors:
        pair = []
        for used in map(problem.search.indices, (before, after)):
            values = np.array(
                [
                    problem.space.reduced(used, problem.evidence.fit(used, number)[0])
                    for number in range(fold.max() + 1)
                ]
            )
            pair.append(_squares(problem.all_samples, values[fold], sensor))
        for measure in MEASURES:
            each = [squares[measure] for squares in pair]
            found.append((gain_of(sensor, measure, each), _certainty(each)))
    most = max(
        (gain for gain, _ in found if gain.measure != REST_MEASURE), key=lambda gain: gain.least
    )
    if most.least > 0:
        return most
    return max(found, key=lambda entry: (not np.isinf(entry[0].least), entry[1]))[0]


def gain_of(
    sensor: str, measure: str, pair: Sequence[tuple[np.ndarray, np.ndarray]], *, of: str = OF_MODEL
) -> Gain:
    """Return the Gain from (sums of squares, numbers) of each group of rows, before and after."""
    before, after = (
        float(np.sqrt(squares.sum() / max(number.sum(), 1))) for squares, number in pair
    )
    return Gain(sensor, measure, before, after, reduction_interval(pair), len(pair[0][0]), of)


def _squares(
    space: ParameterSpace, values: np.ndarray, sensor: str
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """
    Return measure -> (sums of squares, their numbers) per window, each (k,).

    They are taken at vectors of `ParameterSpace.reduced`, one or many.
    """
    recording = space.recording
    means, within = np.zeros(len(recording.windows)), np.zeros(len(recording.windows))
    for axis in range(3):
        weights = np.broadcast_to(
            values[:, space.places(sensor, axis)], (len(means), len(space.places(sensor, axis)))
        )
        means += np.einsum('kq,kq->k', space.mean[sensor][axis], weights) ** 2
        within += space.squares_within(sensor, axis, weights)
    rest = ~recording.moving
    at_rest = np.array(
        [window.sensors[sensor].noise_variance.sum() for window in recording.windows]
    )
    within[rest] = at_rest[rest] * (recording.count[rest] - 1)
    three = np.full(len(means), 3.0)
    every = (within + recording.count * means, 3 * recording.count)
    return dict(
        zip(
            MEASURES,
            (
                every,
                (means, three),
                (within, 3 * (recording.count - 1)),
                (means[rest], three[rest]),
            ),
        )
    )


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
