"""Readings of two sensors in one stream: successive samples change between two values."""

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples

RUN_SAMPLES = 24
"""Samples that are examined together: short against rests, enough for two clusters."""
LEAST_CLUSTER = 5
"""Samples of the smaller cluster, and changes between the clusters, in a run."""
MIN_SEPARATION = 8.0
"""
Distance of the two clusters in standard deviations within them. Normal noise of `RUN_SAMPLES` that
is cut at its widest gap has 2.9 in the median, 5.0 in one of 1,000 runs, and at most 7.7 in a
million runs (simulated).
"""
MIN_AXES = 2
"""Outputs that must change together: noise of one converter step changes each output apart."""
MIN_AXES_CONSTANT = 3
"""The same where the clusters are constant, without noise to compare with."""
LEAST_RUNS = 8
"""Runs with two clusters from which on the stream is one of two sensors."""
MIN_SHARE = 0.1
"""Their share of all runs; while the sensor moves, motion hides the clusters."""
MIN_EQUAL_STAMPS = 0.3
"""Share of equal stamps from which on they are named as a sign of two sensors."""
CHECK, KEY = 'one_source', 'imu_topic'
"""Code of the refusal, and the input that is missing."""


class TwoSourceSearch:
    """
    Counts the runs of samples in which the outputs change between two values.

    The outputs of one sensor at rest are one cluster with its noise. Readings of two sensors in
    one stream are two clusters, which differ by their biases, and every output of a sample is in
    the cluster of its sensor. The order of the sensors is free (drivers with different rates).

    """

    def __init__(self) -> None:
        self.n_runs = 0
        """Runs of `RUN_SAMPLES` samples."""
        self.n_double = 0
        """Runs with two clusters."""
        self.n_steps = 0
        """Steps between stamps."""
        self.n_equal_stamps = 0
        """Steps of zero."""
        # Samples that do not fill a run yet.
        self._incomplete_run: ImuSamples | None = None
        self._last_stamp: int | None = None

    def push(self, samples: ImuSamples) -> None:
        """Process samples as they were received, with finite readings."""
        self._count_stamps(samples.stamp_ns)
        samples = samples.after(self._incomplete_run)
        n_runs = len(samples) // RUN_SAMPLES
        used = n_runs * RUN_SAMPLES
        self._incomplete_run = samples.select(slice(used, None))
        if n_runs:
            outputs = np.concatenate([samples.force_s[:used], samples.rate_s[:used]], axis=1)
            is_double = two_clusters(outputs.reshape(n_runs, RUN_SAMPLES, 6))
            self.n_runs += n_runs
            self.n_double += int(np.count_nonzero(is_double))

    @property
    def found(self) -> bool:
        """Return whether the stream holds the readings of two sensors."""
        return self.n_double >= max(LEAST_RUNS, MIN_SHARE * self.n_runs)

    @property
    def equal_stamp_share(self) -> float:
        """Share of the samples that repeat the stamp of the one before."""
        return self.n_equal_stamps / max(self.n_steps, 1)

    @property
    def requirement(self) -> str:
        """Requirement, observation and remedy where two sensors are found."""
        observed = 'at rest successive readings change between two values by many times the noise'
        if self.equal_stamp_share > MIN_EQUAL_STAMPS:
            observed += f', and {100 * self.equal_stamp_share:.0f} % of the stamps are double'
        return (
            f'the readings must be those of one IMU, {observed}: two IMUs in one stream; give each'
            ' its own topic, or select the rows of one in a text log'
        )

    def require_one(self, *, key: str = KEY) -> None:
        """
        Raise InputError where the stream holds the readings of two sensors.

        `key`: the input that selects one, a key of `errors.ERROR_KEYS`.
        """
        if self.found:
            raise InputError(self.requirement, code=CHECK, key=key)

    def _count_stamps(self, stamp_ns: np.ndarray) -> None:
        """Count the steps between stamps, and those of zero."""
        if self._last_stamp is not None:
            stamp_ns = np.append(self._last_stamp, stamp_ns)
        self.n_steps += max(len(stamp_ns) - 1, 0)
        self.n_equal_stamps += int(np.count_nonzero(np.diff(stamp_ns) == 0))
        if len(stamp_ns):
            self._last_stamp = int(stamp_ns[-1])


def two_clusters(outputs: np.ndarray) -> np.ndarray:
    """
    Return in which runs several outputs change together between two values, bool, shape (n,).

    Parameters
    ----------
    outputs : array, shape (n, n_samples, 6)
        Force and rate of each sample of each run.

    """
    # The two clusters of an output are separated by its widest gap, outliers at the ends excepted.
    outputs = np.ascontiguousarray(np.swapaxes(outputs, 1, 2))  # shape (n, 6, n_samples)
    ordered = np.sort(outputs, axis=2)
    gaps = np.diff(ordered, axis=2)[..., LEAST_CLUSTER - 1 : -(LEAST_CLUSTER - 1)]
    below = np.argmax(gaps, axis=2)[..., None] + LEAST_CLUSTER - 1
    upper = outputs > np.take_along_axis(ordered, below, axis=2)

    # All outputs of a sample belong to one sensor: they divide the samples of a run alike. Noise
    # divides them apart, so that few runs are examined further.
    examined = np.flatnonzero(_most_alike(upper) >= MIN_AXES)
    is_double = np.zeros(len(outputs), bool)
    is_double[examined] = _change_together(outputs[examined], upper[examined])
    return is_double


def _most_alike(upper: np.ndarray) -> np.ndarray:
    """
    Return how many outputs divide the samples of each run alike, at most, shape (n,).

    `upper`: whether a sample is in the upper cluster, bool, shape (n, 6, n_samples). Equal and
    exchanged clusters are the same division.
    """
    differs_from_first = upper ^ upper[..., :1]
    packed = np.packbits(differs_from_first, axis=2)
    most = np.ones(len(upper), int)
    for output in range(packed.shape[1]):
        is_same = (packed == packed[:, output, None]).all(axis=2)
        most = np.maximum(most, is_same.sum(axis=1))
    return most


def _change_together(outputs: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """
    Return in which runs several outputs change together between two separate clusters, (n,).

    Both arguments have the shape (n, 6, n_samples).
    """
    # Means of the two clusters, and the standard deviation within them.
    n_upper = np.maximum(upper.sum(axis=2), 1)
    n_lower = np.maximum((~upper).sum(axis=2), 1)
    mean_upper = np.where(upper, outputs, 0.0).sum(axis=2) / n_upper
    mean_lower = np.where(upper, 0.0, outputs).sum(axis=2) / n_lower
    within = outputs - np.where(upper, mean_upper[..., None], mean_lower[..., None])
    noise = np.sqrt((within**2).mean(axis=2))
    distance = mean_upper - mean_lower
    rounding = 1e-9 * np.abs(outputs).max(axis=2)
    constant = noise <= rounding
    separate = (distance > rounding) & (distance > MIN_SEPARATION * noise)

    # A motion passes from one value to the other once; two sensors change all the time.
    changes = (upper[..., 1:] != upper[..., :-1]).sum(axis=2)
    separate &= changes >= LEAST_CLUSTER

    # Each output divides the samples as the first separate output does.
    reference = np.argmax(separate, axis=1)[:, None, None]
    label = np.take_along_axis(upper, reference, axis=1)
    same = (upper == label).all(axis=2) | (upper != label).all(axis=2)
    together = separate & same
    noisy = (together & ~constant).sum(axis=1) >= MIN_AXES
    return noisy | (together.sum(axis=1) >= MIN_AXES_CONSTANT)
