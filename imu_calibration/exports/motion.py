"""The motion on which the loss of an export is measured: a recording, or one that the document's conditions suggest."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.calibration.document import Calibration
from imu_calibration.compensation.angular_acceleration import StampedDerivative, typical_period
from imu_calibration.compensation.stream import CompensationStream, derivative_for
from imu_calibration.constants import STANDARD_GRAVITY
from imu_calibration.errors import InputError
from imu_calibration.reference.reference_motion import Reference
from imu_calibration.samples import ImuSamples, TemperatureSamples

SECONDS, SAMPLES_PER_SECOND = 60.0, 50
FREQUENCIES = np.array([0.3, 0.4, 0.5])
"""Hz; of the rates about x, y, z."""
USUAL_RATE = 1.0
"""rad/s; default for a document without the speed of its motion."""
TURNS = 15
"""Turns of the spiral of gravity from nadir to zenith."""


@dataclass(frozen=True, eq=False)
class TrialMotion:
    """True motion on which a loss is measured."""

    reference: Reference
    """Specific force, rate and angular acceleration at our origin in our sensor frame."""
    temperature_c: np.ndarray
    """Temperature, degrees Celsius, shape (n,)."""
    text: str
    """Description."""


def motion_of(force: np.ndarray, rate: np.ndarray, alpha: np.ndarray, *, temperature_c: np.ndarray, text: str) -> TrialMotion:
    """Return a motion from its arrays, shapes (n, 3) and (n,)."""
    attitude = np.broadcast_to(np.eye(3), (len(force), 3, 3))
    reference = Reference(np.zeros(len(force)), attitude, force, rate, alpha, STANDARD_GRAVITY, temperature_c)
    return TrialMotion(reference, temperature_c, text)


def standard_motion(calibration: Calibration) -> TrialMotion:
    """
    Return the declared motion of a calibration: a minute with gravity in all directions and rates as large as in its recording.

    Gravity runs along a spiral from nadir to zenith; each rate swings with the calibration's largest rate, or 1 rad/s, at 0.3 to 0.5 Hz;
    the temperature runs through the calibration's range. The three are drawn independently of one another.
    """
    conditions = calibration.conditions
    largest = conditions.get('largest_rate') or USUAL_RATE
    gravity = conditions.get('gravity')
    gravity = gravity if isinstance(gravity, float) and gravity > 0 else STANDARD_GRAVITY
    time = np.arange(int(SECONDS * SAMPLES_PER_SECOND)) / SAMPLES_PER_SECOND
    height = np.linspace(-1.0, 1.0, len(time))
    turn, level = 2 * np.pi * TURNS * time / SECONDS, np.sqrt(1.0 - height**2)
    force = gravity * np.stack([level * np.cos(turn), level * np.sin(turn), height], axis=1)
    phase = 2 * np.pi * FREQUENCIES * time[:, None]
    rate, alpha = largest * np.sin(phase), largest * 2 * np.pi * FREQUENCIES * np.cos(phase)
    low, high = conditions.get('temperature_range_c') or [calibration.model.temperature_ref_c] * 2
    temperature = np.linspace(low, high, len(time))
    warmth = f'{low:g} C' if low == high else f'{low:g} to {high:g} C'
    text = f'a standard motion (gravity in all directions, {largest:.3g} rad/s at 0.3 to 0.5 Hz about each axis, {warmth})'
    return motion_of(force, rate, alpha, temperature_c=temperature, text=text)


def recorded_motion(calibration: Calibration, imu: ImuSamples, temperature: TemperatureSamples | None, *, name: str) -> TrialMotion:
    """
    Return the motion of a recording as the calibration sees it: its compensated readings.

    Angular acceleration is the slope of the compensated rates, by the filter of the compensation.

    Raises
    ------
    InputError
        When no part of it can be compensated.

    """
    corrected = CompensationStream(calibration, temperature=temperature).correct(imu)
    kept = np.isfinite(corrected.force).all(axis=1) & np.isfinite(corrected.rate).all(axis=1) & ~corrected.flagged
    if not kept.any():
        raise InputError(f'{name} must have readings that can be compensated, it has none; give another recording')
    stamps = imu.stamp_ns[kept]
    slope = StampedDerivative(derivative_for(calibration, typical_period(stamps[:10_000]) or 0.01))
    alpha = slope.push_block(stamps, corrected.rate[kept])
    return motion_of(corrected.force[kept], corrected.rate[kept], alpha, temperature_c=temperature_at(calibration, temperature, stamps),
                     text=f'{name} ({int(kept.sum())} samples)')


def temperature_at(calibration: Calibration, temperature: TemperatureSamples | None, stamp_ns: np.ndarray) -> np.ndarray:
    """Return the temperature at stamps, shape (n,): the calibration's reference where none was measured."""
    if temperature is None or not len(temperature):
        return np.full(len(stamp_ns), calibration.model.temperature_ref_c)
    first = temperature.stamp_ns[0]
    return np.interp((stamp_ns - first) * 1e-9, (temperature.stamp_ns - first) * 1e-9, temperature.temperature_c)
