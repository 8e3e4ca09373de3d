"""Loss of an export, and calibrations read from files of other programs."""

from dataclasses import dataclass
from typing import Any

import numpy as np

import imu_calibration
from imu_calibration.compensation.angular_acceleration import StampedDerivative, typical_period
from imu_calibration.compensation.compensate import invertible_values
from imu_calibration.compensation.stream import CompensationStream, derivative_for
from imu_calibration.core.errors import InputError
from imu_calibration.core.readings import RawReadings
from imu_calibration.core.samples import ImuSamples, TemperatureSamples
from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.document.calibration import UNKNOWN_SD, Calibration
from imu_calibration.document.calibration_text import check_numbers, from_mapping
from imu_calibration.document.decision import UNPROVEN
from imu_calibration.document.exports import affine
from imu_calibration.document.exports.affine import Capability
from imu_calibration.document.exports.target import Numbers, Read, Readings, Target
from imu_calibration.effects.base import INPUT_OF, SENSORS, Effect
from imu_calibration.effects.forward_equations import sensor_output
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import HELD, WEAK
from imu_calibration.kinematics.rotations import Reference

SPIRAL_SECONDS = 60.0
SAMPLES_PER_SECOND = 50
RATE_FREQUENCIES = np.array([0.3, 0.4, 0.5])
"""Hz; of the rates about x, y, z."""
USUAL_RATE = 1.0
"""rad/s; default for a document without the speed of its motion."""
SPIRAL_TURNS = 15
"""Turns of the spiral of gravity from nadir to zenith."""


@dataclass(frozen=True, eq=False)
class TrialMotion:
    """True motion on which a loss is measured."""

    reference: Reference
    """
    Specific force, rate and angular acceleration at our origin in our sensor frame, and the
    temperature.
    """
    text: str
    """Description of the motion, for the loss that is printed."""


def motion_of(
    force: np.ndarray, rate: np.ndarray, alpha: np.ndarray, *, temperature_c: np.ndarray, text: str
) -> TrialMotion:
    """Return a motion from its arrays, shapes (n, 3) and (n,)."""
    attitude = np.broadcast_to(np.eye(3), (len(force), 3, 3))
    # Time and attitude are placeholders: compensation inverts no effect that depends on them.
    reference = Reference(
        time=np.zeros(len(force)),
        mat_sn=attitude,
        force_s=force,
        rate_s=rate,
        alpha_s=alpha,
        gravity=STANDARD_GRAVITY,
        temperature_c=temperature_c,
    )
    return TrialMotion(reference, text)


def standard_motion(calibration: Calibration) -> TrialMotion:
    """
    Return a minute with gravity in all directions and rates as large as in the recording.

    Gravity runs along a spiral from nadir to zenith; each rate swings with the calibration's
    largest rate, or 1 rad/s, at 0.3 to 0.5 Hz; the temperature runs through the calibration's
    range. The three are drawn independently of one another.
    """
    conditions = calibration.conditions
    largest = conditions.get('largest_rate') or USUAL_RATE
    gravity = conditions.get('gravity')
    gravity = gravity if isinstance(gravity, float) and gravity > 0 else STANDARD_GRAVITY
    time = np.arange(int(SPIRAL_SECONDS * SAMPLES_PER_SECOND)) / SAMPLES_PER_SECOND
    # Unit vectors of equal area per height: z from -1 to 1, the azimuth proportional to the time.
    height = np.linspace(-1.0, 1.0, len(time))
    azimuth = 2 * np.pi * SPIRAL_TURNS * time / SPIRAL_SECONDS
    level = np.sqrt(1.0 - height**2)
    force = gravity * np.stack([level * np.cos(azimuth), level * np.sin(azimuth), height], axis=1)
    # Rates and their derivatives, shape (n, 3).
    phase = 2 * np.pi * RATE_FREQUENCIES * time[:, None]
    rate = largest * np.sin(phase)
    alpha = largest * 2 * np.pi * RATE_FREQUENCIES * np.cos(phase)
    low, high = conditions.get('temperature_range_c') or [calibration.model.temperature_ref_c] * 2
    temperature = np.linspace(low, high, len(time))
    warmth = f'{low:g} C' if low == high else f'{low:g} to {high:g} C'
    text = (
        f'a standard motion (gravity in all directions, {largest:.3g} rad/s at 0.3 to 0.5 Hz about'
        f' each axis, {warmth})'
    )
    return motion_of(force, rate, alpha, temperature_c=temperature, text=text)


def recorded_motion(
    calibration: Calibration, imu: ImuSamples, temperature: TemperatureSamples | None, *, name: str
) -> TrialMotion:
    """
    Return the motion of a recording: its readings, compensated with the calibration.

    Angular acceleration is the derivative of the compensated rates by the compensation's filter.

    Raises
    ------
    InputError
        When no part of it can be compensated.

    """
    corrected = CompensationStream(calibration, temperature=temperature).correct(imu)
    valid = np.isfinite(corrected.force).all(axis=1)
    valid &= np.isfinite(corrected.rate).all(axis=1)
    valid &= ~corrected.flagged
    if not valid.any():
        raise InputError(
            f'{name} must have readings that can be compensated, it has none; give another'
            ' recording'
        )

    # The period is that of the first samples; a single sample counts as one at 100 Hz.
    stamps = imu.stamp_ns[valid]
    period = typical_period(stamps[:10_000]) or 0.01
    derivative = StampedDerivative(derivative_for(calibration, period))
    alpha = derivative.push_block(stamps, corrected.rate[valid])
    return motion_of(
        corrected.force[valid],
        corrected.rate[valid],
        alpha,
        temperature_c=measured_temperature(calibration, temperature, stamps),
        text=f'{name} ({int(valid.sum())} samples)',
    )


def measured_temperature(
    calibration: Calibration, temperature: TemperatureSamples | None, stamp_ns: np.ndarray
) -> np.ndarray:
    """
    Return the temperature at stamps, interpolated, degrees Celsius, shape (n,).

    It is the calibration's reference temperature if none was measured.
    """
    if temperature is None or not len(temperature):
        return np.full(len(stamp_ns), calibration.model.temperature_ref_c)
    first = temperature.stamp_ns[0]
    return np.interp(
        (stamp_ns - first) * 1e-9, (temperature.stamp_ns - first) * 1e-9, temperature.temperature_c
    )


ROUNDING_LOSS = 1e-9
"""m/s^2, rad/s; smaller differences are rounding."""
IMPORTED_FROM_AUTOPILOT = RawReadings(axes='flu')
"""Readings of an imported calibration: numbers of autopilots are brought into the axes of ROS."""


@dataclass(frozen=True)
class LostEffect:
    """An effect of the calibration that a program cannot hold, or not wholly."""

    effect: Effect
    """The effect."""
    in_part: bool
    """Whether the program can hold a part of its values."""
    rms: float
    """Rms contribution of the values that it cannot hold to the readings, per component, SI."""


@dataclass(frozen=True, eq=False)
class Loss:
    """Loss of an export on a motion."""

    effects: tuple[LostEffect, ...]
    """Effects that are not represented, in the catalogue's order."""
    estimated: tuple[Effect, ...]
    """Effects that the program finds by itself; they count as known here."""
    remaining: dict[str, float]
    """
    Sensor -> rms difference per component between the program's readings and the full compensation,
    SI.
    """
    raw: dict[str, float]
    """Sensor -> rms difference per component between raw readings and the full compensation, SI."""
    motion: str
    """Description of the motion."""

    @property
    def nothing(self) -> bool:
        """Whether the program's readings equal the full compensation."""
        return not self.effects and max(self.remaining.values()) < ROUNDING_LOSS


def loss_of(
    target: Target,
    calibration: Calibration,
    numbers: Numbers,
    *,
    placement: affine.Placement,
    motion: TrialMotion,
) -> Loss:
    """
    Return the loss of a target on a motion.

    Readings are simulated without noise by the model that compensation inverts, with the effects
    that the target estimates at their priors. The target's formula is applied to them; the result
    is compared with the true motion in its frame, at its origin.

    Parameters
    ----------
    target : Target
    calibration : Calibration
    numbers : dict
        Content of the target's file.
    placement : Placement
        Frame, origin and axes of its numbers.
    motion : TrialMotion

    """
    model, values = invertible_values(calibration)
    ref = motion.reference
    estimated = [
        effect for effect in model.effects if affine.capability_of(effect, target.estimates)
    ]
    values_unestimated = values.copy()
    for effect in estimated:
        values_unestimated[model.slices[effect.key]] = effect.prior_values()
    # In the frame of the program: true (force, rate), and readings by the formula of the program.
    true = placement.truth(ref.force_s, ref.rate_s, ref.alpha_s)
    # The whole document represents all effects of the full compensation.
    corrected = true
    lost = []
    if not target.whole:
        assert ref.temperature_c is not None  # a trial motion has it
        force, rate = placement.readings(
            sensor_output(model, 'accelerometer', values_unestimated, ref=ref),
            sensor_output(model, 'gyroscope', values_unestimated, ref=ref),
        )
        readings = Readings(
            force=force,
            rate=rate,
            alpha=ref.alpha_s @ placement.mat_ts.T,
            temperature_c=ref.temperature_c,
        )
        corrected = target.corrected(numbers, readings)
        for effect in model.effects:
            if effect in estimated:
                continue
            lost_effect = _lost_effect(calibration, effect, target.holds, motion)
            if lost_effect is not None:
                lost.append(lost_effect)

    # Errors by the formula of the program, and of raw readings.
    remaining = {}
    raw_error = {}
    for sensor, result, true_result in zip(SENSORS, corrected, true, strict=True):
        remaining[sensor] = _rms(result - true_result)
        raw = sensor_output(model, sensor, values, ref=ref)
        raw_error[sensor] = _rms(raw - getattr(ref, INPUT_OF[sensor]))
    return Loss(
        effects=tuple(lost),
        estimated=tuple(estimated),
        remaining=remaining,
        raw=raw_error,
        motion=motion.text,
    )


def _lost_effect(
    calibration: Calibration,
    effect: Effect,
    holds: tuple[Capability, ...],
    motion: TrialMotion,
) -> LostEffect | None:
    """
    Return the loss by an effect: readings with all its values against those that a program has.

    None if the target represents the whole effect.
    """
    capability = affine.capability_of(effect, holds)
    represented = affine.represented_values(calibration, effect, capability)
    if np.array_equal(represented, calibration.values[calibration.model.slices[effect.key]]):
        return None
    model, values = invertible_values(calibration)
    values_of_program = values.copy()
    values_of_program[model.slices[effect.key]] = represented
    output = sensor_output(model, effect.sensor, values, ref=motion.reference)
    output_of_program = sensor_output(model, effect.sensor, values_of_program, ref=motion.reference)
    return LostEffect(effect, in_part=capability is not None, rms=_rms(output - output_of_program))


def _rms(values: np.ndarray) -> float:
    """Return the root mean square of all components."""
    return float(np.sqrt(np.mean(values**2)))


@np.errstate(all='ignore')  # `check_numbers` refuses non-finite values
def import_file(target: Target, content: bytes, path: Any, *, frame_id: str = '') -> Calibration:
    """
    Return the calibration in a file of another program.

    Values are those of the file; where it states its rotation to the sensor frame, as exported
    files do, they are rotated back. Standard deviations are those of the priors, since the file has
    none: a value in the file is weak, a value that the format lacks is fixed at its prior. Without
    a proof each sensor is unproven.

    Parameters
    ----------
    target : Target
    content : bytes
        The file.
    path : path-like
        Where it is: some programs write two files side by side.
    frame_id : str
        Frame of the Imu messages.

    Raises
    ------
    InputError
        When it is no such file, or its numbers can belong to no IMU.

    """
    assert target.read is not None  # `find_target` gives no other
    file = target.read(content, path)
    if target.whole:
        return from_mapping(file.numbers)
    assert target.imu is not None
    imu = target.imu(file.numbers)
    pose = affine.find_pose(content)
    if pose is not None:  # a file of an export, which states its placement
        placement, parent = pose
        back = placement.inverse()
        axes = 'mount'
        frame_id = frame_id or parent
    else:
        back = target.back(imu)
        if target.forward_right_down:
            back = affine.forward_right_down(IMPORTED_FROM_AUTOPILOT)
        axes = target.axes
    imu = affine.calibration_moved(imu, back)
    return _imported(target, file, imu, axes=axes, path=path, frame_id=frame_id)


def _imported(
    target: Target, file: Read, imu: affine.AffineImu, *, axes: str, path: Any, frame_id: str
) -> Calibration:
    """
    Return the calibration of an IMU that was read from the file at `path`.

    Parameters
    ----------
    target : Target
    file : Read
    imu : AffineImu
        In the frame of the calibration.
    axes : str
        The convention that fixes its axes, as named by the gauge.
    path, frame_id
        As of `import_file`.

    """
    holds = tuple(capability for capability in target.holds if capability not in file.lacks)
    # Bias and matrix always, further effects where the file gives them a value.
    capabilities = [*affine.OFFSETS, *affine.MATRICES]
    capabilities += [capability for capability in holds if np.any(imu.value(capability))]
    effects: dict[str, Any] = {}
    for sensor in SENSORS:
        names = [capability.effect.name for capability in affine.of(sensor, capabilities)]
        effects[sensor] = tuple(dict.fromkeys(names))  # several may have the same effect
    model = SensorModel(**effects, temperature_ref_c=imu.temperature_ref_c)

    # Standard deviations are those of the priors; values in the file are weak.
    values, sd = model.prior()
    status = np.full(len(values), HELD, dtype=object)
    for effect in model.effects:
        capability = affine.capability_of(effect, holds)
        parameters = model.slices[effect.key]
        if capability is not None:
            values[parameters] = imu.value(capability).ravel()
            in_file = True
            if capability.own_axis:
                in_file = np.eye(3).ravel() > 0
            status[parameters] = np.where(in_file, WEAK, HELD)
    name = getattr(path, 'name', str(path))
    reason = (
        f'imported from {target.title} ({name}) without uncertainties, its error was not measured'
        ' on a recording'
    )
    statistics = {sensor: {'noise_sd': [sd] * 3} for sensor, sd in file.sample_sd.items()}
    conditions = {}
    if imu.temperature_range_c:
        conditions['temperature_range_c'] = list(imu.temperature_range_c)
    gauge = {'origin': 'mean_of_sensitive_points' if np.any(imu.arms) else UNKNOWN_SD, 'axes': axes}
    provenance = {
        'software': imu_calibration.__version__,
        'imported': {'from': target.name, 'file': name},
        'uncertainty': UNKNOWN_SD,
    }
    readings = RawReadings()
    if target.forward_right_down:
        readings = IMPORTED_FROM_AUTOPILOT
    return check_numbers(
        Calibration(
            model=model,
            values=values,
            covariance=np.diag(sd**2),
            status=tuple(status),
            frame_id=frame_id,
            gauge=gauge,
            statistics=statistics,
            conditions=conditions,
            provenance=provenance,
            decision=dict.fromkeys(SENSORS, str(UNPROVEN)),
            decision_reasons=dict.fromkeys(SENSORS, reason),
            readings=readings,
            notes=("next: measure its error on a recording: 'imu_calibration check'",),
        )
    )
