"""Compensation of whole arrays, for notebooks and programs."""

from collections.abc import Sequence
from typing import overload

import numpy as np

from imu_calibration.compensation.compensate import arms_of
from imu_calibration.compensation.fitted import FittedErrors
from imu_calibration.compensation.stream import CompensationStream
from imu_calibration.errors import InputError
from imu_calibration.samples import ImuSamples, TemperatureSamples

Vectors = Sequence[Sequence[float]] | np.ndarray
Temperatures = Sequence[float] | np.ndarray | TemperatureSamples | float


@overload
def compensate_readings(calibration: FittedErrors, samples: ImuSamples, rate_s: None = None, *, time: None = None,
                        temperature_c: Temperatures | None = None) -> ImuSamples: ...


@overload
def compensate_readings(calibration: FittedErrors, samples: Vectors, rate_s: Vectors | None = None, *,
                        time: Sequence[float] | np.ndarray | None = None,
                        temperature_c: Temperatures | None = None) -> tuple[np.ndarray, np.ndarray]: ...


@overload
def compensate_readings(calibration: FittedErrors, samples: Vectors | ImuSamples, rate_s: Vectors | None = None, *,
                        time: Sequence[float] | np.ndarray | None = None,
                        temperature_c: Temperatures | None = None) -> tuple[np.ndarray, np.ndarray] | ImuSamples: ...


def compensate_readings(calibration: FittedErrors, samples: Vectors | ImuSamples, rate_s: Vectors | None = None, *,
                        time: Sequence[float] | np.ndarray | None = None,
                        temperature_c: Temperatures | None = None) -> tuple[np.ndarray, np.ndarray] | ImuSamples:
    """
    Return readings without the calibrated errors.

    Parameters
    ----------
    calibration : Calibration
    samples : ImuSamples, or array_like, shape (n, 3)
        Readings of one IMU in order of time, or measured specific force in the sensor frame, m/s^2.
    rate_s : array_like, shape (n, 3), optional
        Measured angular rate at the samples of specific force, rad/s.
    time : array_like, shape (n,), optional
        Times of the arrays, s: a causal filter of the rates gives the angular acceleration.
    temperature_c : float, array_like of shape (n,), or TemperatureSamples, optional
        Needed when the calibration has thermal effects, degrees Celsius.

    Returns
    -------
    ImuSamples, or (ndarray, ndarray)
        Specific force and rate as they were given; NaN where a reading cannot be corrected.

    Raises
    ------
    InputError
        When shapes do not fit, or times or temperatures are missing that the calibration needs.

    """
    imu = samples if isinstance(samples, ImuSamples) else _as_samples(calibration, samples, rate_s, time)
    stream = CompensationStream(calibration, temperature=_as_temperatures(temperature_c, imu.stamp_ns))
    corrected = stream.correct(imu)
    if isinstance(samples, ImuSamples):
        return ImuSamples(imu.stamp_ns, corrected.force, corrected.rate, imu.frame_id)
    return corrected.force, corrected.rate


def _as_samples(calibration, force_s, rate_s, time):
    """Return arrays as ImuSamples; times may be missing if no arm needs angular acceleration."""
    force, rate = (_vectors(values, name) for values, name in ((force_s, 'specific force'), (rate_s, 'angular rate')))
    if len(force) != len(rate):
        raise InputError(f'specific force and angular rate must be of the same instants, got {len(force)} and {len(rate)}; give both',
                         code='lengths_differ')
    if time is None:
        if np.any(arms_of(calibration)):
            raise InputError('the calibration has lever arms and needs the time of each reading, none was given; give `time` in seconds',
                             code='time_missing')
        time = np.arange(len(force)) * 0.01
    seconds = np.asarray(time, float)
    if seconds.shape != (len(force),):
        raise InputError(f'there must be one time for each reading, shape ({len(force)},), got {seconds.shape}; correct `time`',
                         code='time_shape')
    start = seconds[0] if len(seconds) else 0.0
    return ImuSamples(np.round((seconds - start) * 1e9).astype(np.int64), force, rate, calibration.frame_id)


def _vectors(values, name):
    array = np.asarray(values, float) if values is not None else np.empty(0)
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f'the {name} must be an array of shape (n, 3), got {array.shape if values is not None else "none"}; correct it',
                         code='shape')
    return array


def _as_temperatures(temperature_c, stamp_ns):
    if temperature_c is None or isinstance(temperature_c, TemperatureSamples):
        return temperature_c
    return TemperatureSamples(stamp_ns, np.broadcast_to(np.asarray(temperature_c, float), stamp_ns.shape))
