"""How much better the extended model predicts windows that took no part in choosing it."""

from dataclasses import dataclass
from typing import NamedTuple, Sequence

import numpy as np

from imu_calibration.selection.attempt import Attempt
from imu_calibration.selection.questions import Question

RESAMPLES = 1000
"""Of whole windows, for an interval."""


@dataclass(frozen=True, eq=False)
class Gain:
    """Residual on windows that took no part in choosing, before and after."""

    sensor: str
    """Sensor in whose unit the residuals are."""
    measure: str
    """'samples', 'window means' or 'samples about the mean of their window', whichever shows the effect better in the windows that it was chosen on."""
    heldout_rms_before: float
    """Rms residual of the model without the finding, m/s^2 or rad/s."""
    heldout_rms_after: float
    """The same with it."""
    ci95: tuple[float, float]
    """95 % interval of the reduction, by resampling whole windows."""
    windows: int
    """Windows that were held out."""

    @property
    def reduction(self) -> float:
        """1 - after / before."""
        return 1.0 - self.heldout_rms_after / self.heldout_rms_before if self.heldout_rms_before > 0 else 0.0


def heldout_gain(attempt: Attempt, before: Sequence[Question], after: Sequence[Question], *, sensors: Sequence[str]) -> Gain:
    """
    Return the Gain of the choice `after` over the choice `before`.

    Both are fitted to the windows that were chosen from; both are judged on the locked ones, by the measure that falls most, or where that is not sure, by
    the one that falls most surely: a small lag takes a tenth off the few window means by chance, and half a percent off the samples for sure.

    Parameters
    ----------
    attempt : Attempt
    before, after : sequence of Question
    sensors : sequence of str
        Sensors that the difference acts on; the one with the larger reduction is reported.

    """
    found = _judged(attempt, before, after, sensors)
    most = _gain(attempt, max(found, key=lambda entry: entry.most))
    return most if most.ci95[0] > 0 else _gain(attempt, max(found, key=lambda entry: entry.surely))


def _gain(attempt, judged):
    rms = [_rms(*entry) for entry in judged.locked]
    return Gain(judged.sensor, judged.measure, rms[0], rms[1], reduction_interval(judged.locked), int(attempt.locked.sum()))


class _Judged(NamedTuple):
    """One measure of one sensor."""

    sensor: str
    measure: str
    most: float
    surely: float
    locked: list


def _judged(attempt, before, after, sensors):
    """Return a _Judged for each measure of each sensor, judged by the windows that were chosen from."""
    found = []
    for sensor in sensors:
        squares = [_squares(attempt, choice, sensor) for choice in (before, after)]
        for measure, sums in _MEASURES.items():
            chosen, locked = ([[part[rows] for part in sums(*s)] for s in squares] for rows in (~attempt.locked, attempt.locked))
            # What is sure to fall: a large fall of a few window means may be chance.
            reduction = np.nan_to_num(reduction_interval(chosen)[0], nan=-np.inf)
            found.append(_Judged(sensor, measure, reduction, _certainty(chosen), locked))
    return found


_MEASURES = {
    'samples': lambda samples, means, count, three: (samples, count),
    'window means': lambda samples, means, count, three: (means, three),
    'samples about the mean of their window': lambda samples, means, count, three: (samples - count / three * means, count - three),
}
"""What may fall -> (sums of squares, numbers) per window, of those that `_squares` returns."""


def _certainty(pair):
    """Return by how many standard deviations sums of squares fall from window to window."""
    fall = pair[0][0] - pair[1][0]
    return float(fall.sum() / max(np.sqrt(fall @ fall), 1e-300))


def _squares(attempt, choice, sensor):
    """Return sums of squares of samples and of window means, and the numbers of each, per window, four arrays (k,)."""
    space, recording = attempt.all_samples, attempt.recording
    used = attempt.search.used(choice)
    values = space.reduced(used, attempt.evidence.fit(used)[0])
    means, within = np.zeros(len(recording.windows)), np.zeros(len(recording.windows))
    for axis in range(3):
        weights = values[space.places(sensor, axis)]
        means += (space.mean[sensor][axis] @ weights)**2
        within += space.squares_within(sensor, axis, weights)
    rest = ~recording.moving
    at_rest = np.array([window.sensors[sensor].noise_variance.sum() for window in recording.windows])
    within[rest] = at_rest[rest] * (recording.count[rest] - 1)
    return within + recording.count * means, means, 3 * recording.count, np.full(len(means), 3.0)


def _rms(squares, number):
    return float(np.sqrt(squares.sum() / max(number.sum(), 1)))


def reduction_interval(pair: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[float, float]:
    """Return the 95 % interval of the reduction over resamples of whole windows, from (sums of squares, numbers) per window before and after."""
    n_windows = len(pair[0][0])
    if n_windows < 3:
        return (float('nan'), float('nan'))
    draw = np.random.default_rng(1).integers(0, n_windows, (RESAMPLES, n_windows))
    rms = [np.sqrt(squares[draw].sum(axis=1) / number[draw].sum(axis=1)) for squares, number in pair]
    low, high = np.quantile(1 - rms[1] / rms[0], (0.025, 0.975))
    return (float(low), float(high))
