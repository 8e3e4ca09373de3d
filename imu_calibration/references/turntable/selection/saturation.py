"""Saturation: a limit that outputs pile up at, and the samples that it spoils."""

from collections.abc import Sequence
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
from imu_calibration.references.turntable.window_statistics import references_of

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
    """Return of each window sensor -> output that the model predicts, shape (n or 1, 3)."""
    references = references_of(windows, model, table)
    edges = np.cumsum([len(window.motion) for window in windows])[:-1]
    predicted: list[dict[str, np.ndarray]] = [{} for _ in windows]
    for sensor in sensors_of(windows) if windows else ():
        output = columns(references, sensor) @ coefficients(model, sensor, values)
        for of_window, part in zip(predicted, np.split(output, edges)):
            of_window[sensor] = part
    return predicted


def measured(window: Window, sensor: str) -> np.ndarray:
    """Return the measured output of a sensor in a window, shape (n, 3)."""
    return window.force_s if sensor == 'accelerometer' else window.rate_s


def sample_sd_at_rest(windows: Sequence[Window], sensor: str) -> np.ndarray:
    """
    Return the sd of samples in static windows, shape (3,).

    It is at least that of rounding, and without any static windows it is the sd of second
    differences.
    """
    rest = [w for w in windows if w.kind == 'static' and len(w.time) > 8]
    if rest:
        rounding = np.sqrt(
            rounding_variance(np.concatenate([measured(w, sensor) for w in windows]))
        )
        return np.maximum(
            np.median([measured(w, sensor).std(axis=0) for w in rest], axis=0), rounding
        )
    return np.median(
        [
            np.diff(measured(w, sensor), 2, axis=0).std(axis=0) / np.sqrt(6)
            for w in windows
            if len(w.time) > 8
        ],
        axis=0,
    )


def simple_fit(windows: Sequence[Window], table: Table, model: SensorModel) -> np.ndarray:
    """Return the parameters of a model by least squares on thinned samples, all weighted alike."""
    values = np.where(np.isfinite(model.start()), model.start(), 0.0)
    prior, sd = model.prior()
    picked = [_thinned(window) for window in windows]
    normal = np.zeros((len(values) + 1,) * 2)
    references = references_of(picked, model, table)
    for sensor in sensors_of(windows):
        design = columns(references, sensor)
        outputs = [measured(w, sensor) for w in picked]
        output = np.concatenate(
            [
                o.mean(axis=0, keepdims=True) if w.kind == 'static' else o
                for w, o in zip(picked, outputs)
            ]
        )
        base = coefficients(model, sensor, values)
        slope = coefficient_jacobian(model, sensor, values)
        weight = 1 / sample_sd_at_rest(windows, sensor) ** 2
        for axis in range(3):
            rows = np.column_stack(
                [design @ slope[:, axis], output[:, axis] - design @ base[:, axis]]
            )
            normal += weight[axis] * rows.T @ rows
    return values + solve_normal(normal, np.arange(len(values)), sd, prior_mean=prior - values)[0]


def _thinned(window: Window, most: int = 50) -> Window:
    if window.kind == 'static' or len(window.time) <= most:
        return window
    return window.select(slice(None, None, len(window.time) // most))


def may_be_clipped(windows: Sequence[Window], sensor: str) -> bool:
    """
    Return whether several samples share the largest output exactly.

    They must be more than share any of the next smaller outputs.
    """
    size = np.concatenate([np.abs(measured(w, sensor)).ravel() for w in windows])
    level = size.max(initial=0.0)
    at = int((size >= level * (1 - 1e-12)).sum())
    if at < MIN_CLIPPED_SAMPLES or level == 0:
        return False
    # A coarse output repeats all its values, most of all the step at gravity; the values just below
    # the largest show how often.
    _, repeats = np.unique(
        size[(size < level * (1 - 1e-12)) & (size > 0.9 * level)], return_counts=True
    )
    return bool(at > 3 * repeats[-5:].max(initial=1))


def find_saturation(
    windows: Sequence[Window], predicted: list, noise_sd: np.ndarray, *, sensor: str
) -> Saturation | None:
    """
    Return the `Saturation` of a sensor, or None.

    Parameters
    ----------
    windows : sequence of Window
    predicted : list of dict
        Sensor -> prediction of a model without limit (`predictions`).
    noise_sd : array, shape (3,)
        Standard deviation of single samples.

    """
    if not may_be_clipped(windows, sensor):
        return None
    output = np.concatenate([measured(w, sensor) for w in windows])
    expected = np.concatenate(
        [np.broadcast_to(p[sensor], measured(w, sensor).shape) for w, p in zip(windows, predicted)]
    )
    level = np.abs(output).max()
    clipped = np.abs(output) >= level * (1 - 1e-12)
    beyond = norm_sf((level - np.abs(expected)) / noise_sd)
    n_expected = float(beyond.sum())
    if (
        n_expected < MIN_CLIPPED_SAMPLES
        or beyond[clipped].sum() < AGREEMENT * clipped.sum() * (beyond**2).sum() / n_expected
    ):
        return None
    far = np.abs(expected) > level
    before = output - expected
    after = output - np.clip(expected, -level, level)
    rms = [float(np.sqrt(np.mean(e[far] ** 2))) if far.any() else 0.0 for e in (before, after)]
    return Saturation(
        sensor, float(level), float(1e-4 * level), int(clipped.any(axis=1).sum()), n_expected, *rms
    )


def without_clipped(
    windows: Sequence[Window],
    predicted: list,
    levels: dict[str, float],
    *,
    noise_sd: dict[str, np.ndarray],
) -> list[Window]:
    """
    Return the windows without clipped samples.

    Also excluded are samples that are predicted within a few standard deviations of the limit.

    Parameters
    ----------
    levels : dict
        Sensor -> level.
    noise_sd : dict
        Sensor -> (3,).

    """
    kept = []
    for window, of_sensors in zip(windows, predicted):
        good = np.ones(len(window.time), bool)
        for sensor, level in levels.items():
            near = np.abs(of_sensors[sensor]) > level - CLIP_MARGIN_SDS * noise_sd[sensor]
            at = np.abs(measured(window, sensor)) >= level * (1 - 1e-12)
            good &= ~(near | at).any(axis=1)
        if good.all():
            kept.append(window)
        elif window.kind != 'static' and good.sum() >= MIN_LEFT_SAMPLES:
            kept.append(window.select(good))
    return kept


def windows_at(windows: Sequence[Window], rows: np.ndarray) -> list[Window]:
    """Return the windows of the rows that are true."""
    return [window for window, taken in zip(windows, rows) if taken]


def without_clipping(
    windows: list[Window], table: Table, model: SensorModel
) -> tuple[list[Window], np.ndarray, list[Saturation]]:
    """
    Return (windows without corrupted samples, mask of the locked ones, limits).

    Corrupted samples are corrupted by a limit, and the limits are estimated from all other windows.

    One fast swing may be all that reaches a limit: a window in which outputs pile up is not locked,
    where they do so at a limit.
    """
    locked = locked_windows(np.array([window.kind for window in windows]))
    piled = _piled(windows)
    limits, noise_sd, values = _limits(windows_at(windows, piled | ~locked), table, model)
    if not limits or values is None:
        return windows, locked, []
    locked &= ~piled

    # Windows are cut at their clipped samples: locked and other ones separately, then in the order
    # of time again.
    levels = {limit.sensor: limit.level for limit in limits}
    entries = []
    for is_locked in (False, True):
        part = windows_at(windows, locked == is_locked)
        predicted = predictions(part, table, model, values=values)
        for window in without_clipped(part, predicted, levels, noise_sd=noise_sd):
            entries.append((window.time[0], is_locked, window))
    entries.sort(key=lambda entry: entry[:2])
    kept = [window for _, _, window in entries]
    return kept, np.array([is_locked for _, is_locked, _ in entries]), limits


def _piled(windows: Sequence[Window]) -> np.ndarray:
    """Return which windows hold the largest output of a sensor, where several samples share it."""
    found = np.zeros(len(windows), bool)
    for sensor in sensors_of(windows):
        if may_be_clipped(windows, sensor):
            largest = np.array([np.abs(measured(window, sensor)).max() for window in windows])
            found |= largest >= largest.max() * (1 - 1e-12)
    return found


def _limits(
    windows: Sequence[Window], table: Table, model: SensorModel
) -> tuple[list[Saturation], dict[str, np.ndarray], np.ndarray | None]:
    """
    Return (limits found, standard deviation of single samples by sensor, parameters).

    The parameters are from a simple fit without corrupted samples.
    """
    suspects = [sensor for sensor in sensors_of(windows) if may_be_clipped(windows, sensor)]
    if not suspects:
        return [], {}, None

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
        # An output that is always at or near its limit does not determine it.
        if len(kept) < MIN_FOLD_WINDOWS:
            return [], {}, None

    values = simple_fit(kept, table, model)
    predicted = predictions(windows, table, model, values=values)
    limits = []
    for sensor in suspects:
        limit = find_saturation(windows, predicted, noise_sd[sensor], sensor=sensor)
        if limit:
            limits.append(limit)
    return limits, noise_sd, values
