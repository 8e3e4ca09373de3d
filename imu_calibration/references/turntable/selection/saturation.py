"""Saturation: a limit that outputs pile up at, and the samples that it spoils."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from imu_calibration.core.distributions import norm_sf
from imu_calibration.core.samples import rounding_variance
from imu_calibration.effects.forward_equations import coefficient_jacobian, coefficients, columns
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.scaled_solve import solve_normal
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.full_scale import MIN_CLIPPED_SAMPLES
from imu_calibration.preprocessing.window import Window, sensors_of
from imu_calibration.references.turntable.selection.window_evidence import (
    MIN_FOLD_WINDOWS,
    locked_windows,
)
from imu_calibration.references.turntable.window_statistics import measured, references_of

CLIP_MARGIN_SDS = 4.0
"""
Samples predicted within this many standard deviations of the limit are left out: noise decides
whether they are clipped.
"""
AGREEMENT = 0.25
"""
Least sum of the probabilities of exceeding the limit over clipped samples, as a share of its
expectation for clipping by noise.

Near one g at rest only the tails of the noise are cut: a correct limit then has a probability of a
tenth for each sample.
"""
MIN_LEFT_SAMPLES = 20
"""A window with fewer samples left is dropped."""
THINNED_SAMPLES = 50
"""Samples of a moving window that a simple fit uses, at least: a few parameters need no more."""
SAME_LEVEL = 1 - 1e-12
"""Share of the largest output from which an output equals it but for rounding."""


@dataclass(frozen=True)
class Saturation:
    """A limit that the outputs of one sensor pile up at."""

    sensor: str
    """'accelerometer' or 'gyroscope'."""
    level: float
    """Largest output, m/s^2 or rad/s."""
    level_sd: float
    """Standard deviation of the level: the resolution with which outputs approach it."""
    n_clipped: int
    """Samples at the limit."""
    n_expected: float
    """Samples that the model expects beyond it, where there are none."""
    rms_before: float
    """
    Rms of measured minus predicted where the model expects outputs beyond the limit, without the
    limit in the model.
    """
    rms_after: float
    """The same with it."""

    @property
    def p_value(self) -> float:
        """Probability that no sample exceeds a level, from the expected number (Poisson)."""
        return float(np.exp(-self.n_expected))


def predictions(
    windows: Sequence[Window], table: Table, model: SensorModel, *, values: np.ndarray
) -> list[dict[str, np.ndarray]]:
    """
    Return the outputs that the model predicts in each window, as sensor -> array of shape (n, 3).

    Of a window with one sample of motion (at rest) the shape is (1, 3).
    """
    if not windows:
        return []
    references = references_of(windows, model, table)
    first_samples = np.cumsum([len(window.motion) for window in windows])[:-1]
    predicted: list[dict[str, np.ndarray]] = [{} for _ in windows]
    for sensor in sensors_of(windows):
        output = columns(references, sensor) @ coefficients(model, sensor, values)
        for of_window, part in zip(predicted, np.split(output, first_samples)):
            of_window[sensor] = part
    return predicted


def sample_sd_at_rest(windows: Sequence[Window], sensor: str) -> np.ndarray:
    """
    Return the median over static windows of the sd of their samples, shape (3,).

    It is at least that of rounding. Without static windows it is the sd of second differences,
    ``x_k - 2 x_(k+1) + x_(k+2)``, over sqrt(6).
    """
    # Few samples have no reliable sd.
    long_enough = [window for window in windows if len(window.time) > 8]
    at_rest = [window for window in long_enough if window.kind == 'static']
    if at_rest:
        readings = np.concatenate([measured(window, sensor) for window in windows])
        rounding = np.sqrt(rounding_variance(readings))
        sds = [measured(window, sensor).std(axis=0) for window in at_rest]
        return np.maximum(np.median(sds, axis=0), rounding)
    sds = []
    for window in long_enough:
        differences = np.diff(measured(window, sensor), 2, axis=0)
        sds.append(differences.std(axis=0) / np.sqrt(6))
    return np.median(sds, axis=0)


def simple_fit(windows: Sequence[Window], table: Table, model: SensorModel) -> np.ndarray:
    """
    Return the parameters of a model by one least-squares step from its start, shape (n_params,).

    The rows are a part of the samples of moving windows and the means of static ones, all with the
    weight of one sample at rest.
    """
    start = np.where(np.isfinite(model.start()), model.start(), 0.0)
    prior, sd = model.prior()
    # About `THINNED_SAMPLES` of a moving window: one of `stride` samples.
    thinned = []
    for window in windows:
        stride = len(window.time) // THINNED_SAMPLES
        if window.kind != 'static' and stride > 1:
            window = window.select(slice(None, None, stride))
        thinned.append(window)
    # Normal matrix of the rows [derivatives by the parameters | residual at the start].
    normal = np.zeros((len(start) + 1,) * 2)
    references = references_of(thinned, model, table)
    for sensor in sensors_of(windows):
        design = columns(references, sensor)
        outputs = []
        for window in thinned:
            output_of_window = measured(window, sensor)
            if window.kind == 'static':
                output_of_window = output_of_window.mean(axis=0, keepdims=True)
            outputs.append(output_of_window)
        output = np.concatenate(outputs)

        # output = design @ coefficients(parameters), linearised at the start.
        base = coefficients(model, sensor, start)
        slope = coefficient_jacobian(model, sensor, start)
        weight = 1 / sample_sd_at_rest(windows, sensor) ** 2
        for axis in range(3):
            residual = output[:, axis] - design @ base[:, axis]
            rows = np.column_stack([design @ slope[:, axis], residual])
            normal += weight[axis] * rows.T @ rows
    step, _ = solve_normal(normal, np.arange(len(start)), sd, prior_mean=prior - start)
    return start + step


def may_be_clipped(windows: Sequence[Window], sensor: str) -> bool:
    """
    Return whether clearly more samples have the largest output than any of the next smaller values.

    That is more than three times as many as of the five values below it.
    """
    size = np.concatenate([np.abs(measured(w, sensor)).ravel() for w in windows])
    level = size.max(initial=0.0)
    is_largest = size >= level * SAME_LEVEL
    n_largest = int(is_largest.sum())
    if n_largest < MIN_CLIPPED_SAMPLES or level == 0:
        return False
    # A coarse output repeats all its values, most of all the step at gravity; the values just below
    # the largest, within a tenth, show how often.
    below = size[(size < level * SAME_LEVEL) & (size > 0.9 * level)]
    _, repeats = np.unique(below, return_counts=True)
    return bool(n_largest > 3 * repeats[-5:].max(initial=1))


def find_saturation(
    windows: Sequence[Window],
    predicted: Sequence[Mapping[str, np.ndarray]],
    noise_sd: np.ndarray,
    *,
    sensor: str,
) -> Saturation | None:
    """
    Return the `Saturation` of a sensor, or None.

    Parameters
    ----------
    windows : sequence of Window
    predicted : sequence of dict
        Sensor -> prediction of a model without limit, of each window (`predictions`).
    noise_sd : array, shape (3,)
        Standard deviation of single samples.
    sensor : str

    """
    if not may_be_clipped(windows, sensor):
        return None
    # Of every sample; a window with one sample of motion has one prediction.
    outputs = [measured(window, sensor) for window in windows]
    output = np.concatenate(outputs)
    expected_of_windows = [
        np.broadcast_to(prediction[sensor], readings.shape)
        for prediction, readings in zip(predicted, outputs)
    ]
    expected = np.concatenate(expected_of_windows)
    level = np.abs(output).max()
    clipped = np.abs(output) >= level * SAME_LEVEL

    # Probability p of each sample to exceed the level by the model and its noise. If noise decides
    # which samples are clipped, each with the probability p, the mean of p over clipped samples is
    # sum p^2 / sum p.
    p_beyond = norm_sf((level - np.abs(expected)) / noise_sd)
    n_expected = float(p_beyond.sum())
    if n_expected < MIN_CLIPPED_SAMPLES:
        return None
    needed = AGREEMENT * clipped.sum() * (p_beyond**2).sum() / n_expected
    if p_beyond[clipped].sum() < needed:
        return None

    # Residual with and without the limit in the model, where the model exceeds the limit.
    exceeds = np.abs(expected) > level
    rms_before = 0.0
    rms_after = 0.0
    if exceeds.any():
        before = output - expected
        after = output - np.clip(expected, -level, level)
        rms_before = float(np.sqrt(np.mean(before[exceeds] ** 2)))
        rms_after = float(np.sqrt(np.mean(after[exceeds] ** 2)))
    return Saturation(
        sensor=sensor,
        level=float(level),
        level_sd=float(1e-4 * level),
        n_clipped=int(clipped.any(axis=1).sum()),
        n_expected=n_expected,
        rms_before=rms_before,
        rms_after=rms_after,
    )


def without_clipped(
    windows: Sequence[Window],
    predicted: Sequence[Mapping[str, np.ndarray]],
    levels: dict[str, float],
    *,
    noise_sd: dict[str, np.ndarray],
) -> list[Window]:
    """
    Return the windows without clipped samples.

    Also excluded are samples that are predicted within a few standard deviations of the limit.

    Parameters
    ----------
    windows : sequence of Window
    predicted : sequence of dict
        Sensor -> prediction of a model without limit, of each window (`predictions`).
    levels : dict
        Sensor -> largest output.
    noise_sd : dict
        Sensor -> standard deviation of single samples, shape (3,).

    """
    kept = []
    for window, of_sensors in zip(windows, predicted):
        usable = np.ones(len(window.time), bool)
        for sensor, level in levels.items():
            near = np.abs(of_sensors[sensor]) > level - CLIP_MARGIN_SDS * noise_sd[sensor]
            clipped = np.abs(measured(window, sensor)) >= level * SAME_LEVEL
            usable &= ~(near | clipped).any(axis=1)
        # Of a window at rest the mean counts, which clipping of some samples biases.
        if usable.all():
            kept.append(window)
        elif window.kind != 'static' and usable.sum() >= MIN_LEFT_SAMPLES:
            kept.append(window.select(usable))
    return kept


def windows_at(windows: Sequence[Window], rows: np.ndarray) -> list[Window]:
    """Return the windows of the rows that are true."""
    return [window for window, taken in zip(windows, rows) if taken]


def without_clipping(
    windows: list[Window], table: Table, model: SensorModel
) -> tuple[list[Window], np.ndarray, list[Saturation]]:
    """
    Return (windows without samples that a limit spoils, mask of the locked ones, limits).

    The limits are estimated from the windows that are not locked. One fast swing may be all that
    reaches a limit: a window with the largest output of a sensor is therefore not locked, if that
    output is a limit.
    """
    locked = locked_windows(np.array([window.kind for window in windows]))
    at_limit = _windows_at_limit(windows)
    fit = _limits(windows_at(windows, at_limit | ~locked), table, model)
    if fit is None or not fit.limits:
        return windows, locked, []
    locked &= ~at_limit

    # Windows are cut at their clipped samples: locked and other ones separately, then in the order
    # of time again.
    levels = {limit.sensor: limit.level for limit in fit.limits}
    entries = []
    for is_locked in (False, True):
        part = windows_at(windows, locked == is_locked)
        predicted = predictions(part, table, model, values=fit.values)
        for window in without_clipped(part, predicted, levels, noise_sd=fit.noise_sd):
            entries.append((window.time[0], is_locked, window))
    entries.sort(key=lambda entry: entry[:2])
    kept = [window for _, _, window in entries]
    return kept, np.array([is_locked for _, is_locked, _ in entries]), fit.limits


def _windows_at_limit(windows: Sequence[Window]) -> np.ndarray:
    """Return a mask of the windows with the largest output of a sensor that may be clipped."""
    at_limit = np.zeros(len(windows), bool)
    for sensor in sensors_of(windows):
        if may_be_clipped(windows, sensor):
            largest = np.array([np.abs(measured(window, sensor)).max() for window in windows])
            at_limit |= largest >= largest.max() * SAME_LEVEL
    return at_limit


@dataclass(frozen=True, eq=False)
class _Limits:
    """Limits of the sensors, and a model of the samples that they do not spoil."""

    limits: list[Saturation]
    """Limits that outputs pile up at; none where no limit agrees with the motion."""
    noise_sd: dict[str, np.ndarray]
    """Sensor -> standard deviation of single samples, shape (3,)."""
    values: np.ndarray
    """Parameters by `simple_fit`, shape (n_params,)."""


def _limits(windows: Sequence[Window], table: Table, model: SensorModel) -> _Limits | None:
    """
    Return the limits of the sensors with a simple fit of the other samples.

    None where no output may be clipped, or too few windows remain for the fit.
    """
    suspects = [sensor for sensor in sensors_of(windows) if may_be_clipped(windows, sensor)]
    if not suspects:
        return None

    # Two fits without the samples near the largest reading: the first one still has clipped ones.
    largest_readings = {}
    for sensor in suspects:
        largest = max(np.abs(measured(window, sensor)).max() for window in windows)
        largest_readings[sensor] = float(largest)
    noise_sd = {sensor: sample_sd_at_rest(windows, sensor) for sensor in sensors_of(windows)}
    kept = windows
    for _ in range(2):
        predicted = predictions(windows, table, model, values=simple_fit(kept, table, model))
        kept = without_clipped(windows, predicted, largest_readings, noise_sd=noise_sd)
        # Too few windows are below the limit: an output always near it does not determine it.
        if len(kept) < MIN_FOLD_WINDOWS:
            return None

    values = simple_fit(kept, table, model)
    predicted = predictions(windows, table, model, values=values)
    limits = []
    for sensor in suspects:
        limit = find_saturation(windows, predicted, noise_sd[sensor], sensor=sensor)
        if limit:
            limits.append(limit)
    return _Limits(limits, noise_sd, values)
