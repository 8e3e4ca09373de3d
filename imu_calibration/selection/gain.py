"""
Gain of the extended model in predicting held-out windows.

The locked ones were also excluded from its selection.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

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


def gain_of(
    sensor: str, measure: str, pair: Sequence[tuple[np.ndarray, np.ndarray]], *, of: str = OF_MODEL
) -> Gain:
    """
    Return the Gain of a sensor by a measure.

    `pair`: (sums of squares, numbers of squares) before and after, each of shape (n_groups,).
    """
    before, after = [
        float(np.sqrt(squares.sum() / max(number.sum(), 1))) for squares, number in pair
    ]
    n_groups = len(pair[0][0])
    return Gain(
        sensor=sensor,
        measure=measure,
        heldout_rms_before=before,
        heldout_rms_after=after,
        ci95=reduction_interval(pair),
        windows=n_groups,
        of=of,
    )


def reduction_interval(pair: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[float, float]:
    """
    Return the 95 % interval of ``1 - rms after / rms before`` over resampled windows.

    `pair`: (sums of squares, numbers of squares) before and after, each of shape (n_windows,).
    """
    n_windows = len(pair[0][0])
    if n_windows < 3:
        return (float('nan'), float('nan'))
    draw = np.random.default_rng(1).integers(0, n_windows, (WINDOW_RESAMPLES, n_windows))
    rms = []  # of each resample, before and after
    for squares, number in pair:
        rms.append(np.sqrt(squares[draw].sum(axis=1) / number[draw].sum(axis=1)))
    low, high = np.quantile(1 - rms[1] / rms[0], (0.025, 0.975))
    return (float(low), float(high))
