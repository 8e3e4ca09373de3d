"""
Sessions of white noise and wandering biases: do reported standard deviations match the scatter?
"""

from dataclasses import dataclass

import numpy as np

from imu_calibration.core.samples import SampleBlock
from imu_calibration.effects.forward_equations import References, coefficients, columns
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation import sensor_noise
from imu_calibration.preprocessing.window import Window
from imu_calibration.preprocessing.window_finder import MotionGatherer
from imu_calibration.references.turntable import noise_model
from imu_calibration.references.turntable.accumulator import Accumulator
from imu_calibration.references.turntable.estimation.solver import solve
from imu_calibration.references.turntable.window_statistics import reduce_windows
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.sensor_noise import GRADES, SimulatedNoise, gauss_markov_samples
from imu_calibration.simulation.session import SimulationOptions, random_values, simulate_session

from worlds.tables import three_axis_table

TABLE = three_axis_table(height=150.0)
INDUSTRIAL = GRADES['industrial'].noise
WHITE = (INDUSTRIAL.accel_density * 10.0, INDUSTRIAL.gyro_density * 10.0)
"""Standard deviation of single samples at 100 Hz."""
FULL = SensorModel(
    accelerometer=('bias', 'matrix', 'accel_size_effect', 'lever_arm'), reference=('table_tilt',)
)


def windows_of_a_short_session():
    """
    Windows of a short full session, as long as its noise allows.

    Their outputs are replaced by each user.
    """
    profile = make_profile('quick', 0, TABLE)
    white = SimulatedNoise(
        accel_density=INDUSTRIAL.accel_density, gyro_density=INDUSTRIAL.gyro_density
    )
    imu, joints, _ = simulate_session(
        SensorModel(),
        SensorModel().start(),
        TABLE,
        profile=profile,
        options=SimulationOptions(noise=white),
        seed=0,
    )
    gatherer = MotionGatherer(TABLE)
    return gatherer.push(SampleBlock(imu, joints)) + gatherer.finish()


def accumulate(windows, model, column_function=columns):
    """Return the least-squares system of windows."""
    accumulator = Accumulator()
    for window in windows:
        accumulator.add(reduce_windows([window], model, TABLE, column_function=column_function)[0])
    return accumulator


class SameMotion:
    """Columns of windows whose motion is the same in every trial, worked out once."""

    def __init__(self):
        self.known = {}

    def __call__(self, references, sensor):
        key = sensor, id(references.motion)
        if key not in self.known:
            self.known[key] = columns(references, sensor)
        return self.known[key]

    def outputs(self, session, values, rng):
        """
        Return the session's windows with outputs of FULL, white noise, and biases that wander.
        """
        found, times = [], np.arange(0.0, session[-1].time[-1] + 1.0, 0.5)
        wander = [
            gauss_markov_samples(sd, 100.0, 0.5, shape=(len(times), 3), rng=rng)
            for sd in (INDUSTRIAL.accel_instability, INDUSTRIAL.gyro_instability)
        ]
        for window in session:
            n, near = len(window.time), np.rint(window.time / 0.5).astype(int)
            references = References(FULL, TABLE, window.motion)
            force, rate = (
                self(references, sensor) @ coefficients(FULL, sensor, values)
                + rng.normal(0, sd, (n, 3))
                + bias[near]
                for sensor, sd, bias in zip(('accelerometer', 'gyroscope'), WHITE, wander)
            )
            found.append(Window(**{**vars(window), 'force_s': force, 'rate_s': rate}))
        return found


def true_values(model, seed):
    """Return a random IMU on a slightly tilted table."""
    values = random_values(model, 'industrial', seed)
    if ('reference', 'table_tilt') in model.slices:
        values[model.slices['reference', 'table_tilt']] = np.random.default_rng(seed).normal(
            0, 5e-4, 2
        )
    values[model.slices['accelerometer', 'lever_arm']] = np.random.default_rng(seed + 1).normal(
        0, 0.02, 3
    )
    return values


@dataclass(frozen=True)
class Scatter:
    """Errors of all parameters over the sessions, in reported standard deviations."""

    mean_square: float
    """Mean square of the errors over their standard deviations; 1 if these are right."""
    coverage: float
    """Share of the errors within their 95 % interval."""
    least_ratio: float
    """Smallest sd of the errors of a parameter over its median reported one."""
    largest_ratio: float
    """The largest of these."""
    widest_share: float
    """Share of standard deviations above 1.5 times the median one of the parameter."""
    over_bound: float
    """Rms error over the Cramer-Rao bound of an estimator which knows the noise."""


def scatter(session, seeds):
    """Return the Scatter of sessions with an IMU and noise of each seed."""
    normalised, errors, deviations, bounds, same = [], [], [], [], SameMotion()
    for seed in seeds:
        truth, rng = true_values(FULL, seed), np.random.default_rng([seed, 99])
        system = accumulate(same.outputs(session, truth, rng), FULL, same)
        solution = solve(system, FULL)
        error = solution.values - truth
        normalised.append(error / solution.sd)
        errors.append(error)
        deviations.append(solution.sd)
        if seed % 6 == 0:  # it depends on the values of the IMU by parts in a thousand
            bounds.append(cramer_rao(system, FULL))
    normalised, errors, deviations = (np.array(x) for x in (normalised, errors, deviations))
    usual = np.median(deviations, axis=0)
    ratio = errors.std(axis=0) / usual
    efficiency = np.sqrt((errors**2).mean(axis=0) / np.mean(bounds, axis=0))
    return Scatter(
        mean_square=float((normalised**2).mean()),
        coverage=float((np.abs(normalised) < 1.96).mean()),
        least_ratio=float(ratio.min()),
        largest_ratio=float(ratio.max()),
        widest_share=float((deviations > 1.5 * usual).mean()),
        over_bound=float(np.sqrt((efficiency**2).mean())),
    )


def cramer_rao(system, model):
    """Return the variances that an estimator reaches which knows the noise exactly."""
    known = {
        sensor: noise_model.NoiseModel(
            np.full(3, sd**2), np.ones(3), bias_processes=(sensor_noise.BiasProcess(wander, 100.0),)
        )
        for sensor, sd, wander in zip(
            ('accelerometer', 'gyroscope'),
            WHITE,
            (INDUSTRIAL.accel_instability, INDUSTRIAL.gyro_instability),
        )
    }
    return np.diag(solve(system, model, noise=known).covariance)
