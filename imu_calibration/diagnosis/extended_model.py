"""The extended model, solved on all windows by the same solver that calibrates, from the reduced recording."""

from dataclasses import replace

import numpy as np

from imu_calibration.diagnosis.reduced_recording import own_coefficients, own_groups
from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.accumulator import Accumulator
from imu_calibration.estimation.band_misfit import NO_SAY
from imu_calibration.estimation.noise_model import WindowNoise
from imu_calibration.estimation.solver import solve
from imu_calibration.estimation.window_statistics import SensorStatistics, WindowStatistics


def extended_solution(space, noise, baseline, chosen, saturations=()):
    """
    Return the Solution of the baseline extended by the chosen effects.

    Parameters
    ----------
    space : Space
        Of a recording whose columns were taken at the point of the chosen effects.
    noise : dict
        Sensor -> SensorNoise.
    baseline : SensorModel
    chosen : sequence of Question
    saturations : sequence of Saturation
        Limits to write into the model.

    """
    lifted = space.lifted
    model = replace(baseline, point={**baseline.point, **lifted.model.point}, temperature_ref_c=lifted.model.temperature_ref_c)
    for question in chosen:
        model = model.with_effect(question.sensor, question.name)
    solution = solve(accumulate(lifted, model, noise), model, noise={s: window_noise(noise[s], space.slow_only[s]) for s in SENSORS})
    for limit in saturations:
        solution = _with_limit(solution, limit)
    return solution


def window_noise(noise, slow_only):
    """Return the noise as the solver knows it; fast parts have no say on axes where only the slow part is compared."""
    slow = {kind: factor / noise.inflation for kind, factor in noise.within.items()}
    scale = {kind: np.where(slow_only, NO_SAY * factor, factor) for kind, factor in slow.items()}
    return WindowNoise(noise.white, noise.inflation, noise.offset_sd, noise.wander_sd, noise.wander_time, scale, slow)


def accumulate(lifted, model, noise):
    """Return the Accumulator of a smaller model from the reduced recording."""
    accumulator = Accumulator()
    picked = {sensor: _picked(lifted, model, sensor) for sensor in SENSORS}
    for k, kind in enumerate(lifted.kind):
        sensors = {}
        for sensor in SENSORS:
            mean = picked[sensor][0][k]
            sensors[sensor] = SensorStatistics(mean, np.zeros((0, len(mean))), lifted.noise[sensor][0][k], lifted.noise[sensor][1][k])
        accumulator.add(WindowStatistics(str(kind), float(lifted.time[k]), float(lifted.duration[k]), int(lifted.count[k]), sensors,
                                         int(lifted.session[k])))
    for sensor in SENSORS:
        for kind in np.unique(lifted.kind[lifted.kind != 'static']):
            rows = lifted.kind == kind
            accumulator.within[sensor, str(kind)] = _root(picked[sensor][1][rows].sum(axis=0))
            accumulator.slow[sensor, str(kind)] = _root(picked[sensor][2][rows].sum(axis=0))
            accumulator.slow_rows[str(kind)] = int(lifted.slow_rows[rows].sum())
    return accumulator


def _picked(lifted, model, sensor):
    """Return (mean rows, products, products of the slow part) with the columns of `model` and the output instead of the residual."""
    start, places = 0, {}
    for name, width in own_groups(lifted.model, sensor):
        places[name] = np.arange(start, start + width)
        start += width
    n_rows = lifted.mean[sensor].shape[1]
    # A warp's change of the lever-arm terms is in its own columns already; columns for it stay empty.
    columns = np.concatenate([places.get(name, np.full(width, -1)) for name, width in model.groups(sensor)])
    known = np.flatnonzero(columns >= 0)
    join = np.zeros((n_rows, len(columns) + 3))
    join[columns[known], known] = 1.0
    join[:start, -3:] = own_coefficients(lifted.model, sensor, lifted.values)
    join[-3:, -3:] = np.eye(3)
    return lifted.mean[sensor] @ join, join.T @ (lifted.gram[sensor] @ join), join.T @ (lifted.slow[sensor] @ join)


def _root(gram):
    """Return rows whose products are `gram`, by the eigenvalues of the scaled matrix."""
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    eigenvalues, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    return np.sqrt(np.maximum(eigenvalues, 0.0))[:, None] * vectors.T * scale


def _with_limit(solution, limit):
    short = {'accelerometer': 'accel', 'gyroscope': 'gyro'}[limit.sensor]
    model = solution.model.with_effect(limit.sensor, f'{short}_saturation')
    place = model.slices[limit.sensor, f'{short}_saturation'].start

    def grown(matrix, corner):
        matrix = np.insert(np.insert(matrix, place, 0.0, axis=0), place, 0.0, axis=1)
        matrix[place, place] = corner
        return matrix
    return replace(solution, model=model, values=np.insert(solution.values, place, limit.level),
                   held=np.insert(solution.held, place, False), covariance=grown(solution.covariance, limit.level_sd**2),
                   information=grown(solution.information, limit.level_sd**-2))
