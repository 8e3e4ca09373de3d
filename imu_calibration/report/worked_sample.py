"""How to apply the calibration: the formula, the numbers to copy, and one sample carried through."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from imu_calibration.calibration.document import Calibration
from imu_calibration.calibration.result import CalibrationResult
from imu_calibration.compensation.compensate import arms_of, compensate, invertible
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.reference.kinematics import reference_motion
from imu_calibration.reference.reference_motion import lever_matrix
from imu_calibration.report.numbers import fixed, text


def worked_sample(result: CalibrationResult) -> dict[str, Any]:
    """Return the section: matrices, arms, one raw sample, each step and the outcome."""
    calibration = result.calibration
    sample = _sample(result)
    force, rate, alpha = (getattr(sample, name) for name in ('force', 'rate', 'alpha'))
    corrected = compensate(calibration, force[None], rate[None], alpha_s=alpha[None], temperature_c=sample.temperature)
    inverses = {s: np.linalg.inv(calibration.of(s, Role.LINEAR)) for s in SENSORS}
    arms = arms_of(calibration)
    return {
        'matrices': [{'name': name, 'bias': [fixed(v, 6) for v in calibration.of(s, Role.OFFSET)], 'unit': unit,
                      'inverse': [[fixed(v, 7) for v in row] for row in inverses[s]]}
                     for name, s, unit in (('Accelerometer', 'accelerometer', 'm/s²'), ('Gyroscope', 'gyroscope', 'rad/s'))],
        'arms': [[fixed(v * 1e3, 3) for v in row] for row in arms] if np.any(arms) else None, 'further': further_effects(calibration),
        'where': sample.where, 'steps': _steps(result, sample, corrected),
        'reference_known': sample.true_force is not None}


def further_effects(calibration: Calibration) -> list[str]:
    """Return the effects other than bias, matrix and size effect that compensation removes."""
    return [effect.name for effect in invertible(calibration.model).further if effect.role is not Role.ARMS]


def _steps(result, sample, corrected):
    calibration, arms = result.calibration, arms_of(result.calibration)
    turning = lever_matrix(corrected.rate, sample.alpha[None])[0]
    felt = np.einsum('ij,jk,ik->i', calibration.of('accelerometer', Role.LINEAR), turning, arms)
    plain = not further_effects(calibration)
    steps = [('raw rate', 'rad/s', sample.rate, ''),
             ('corrected rate', 'rad/s', corrected.rate[0], 'M⁻¹ (raw − b), gyroscope' if plain else ''),
             ('raw specific force', 'm/s²', sample.force, '')]
    if np.any(arms):
        steps.append(('lever-arm terms u', 'm/s²', felt, 'uᵢ = row i of M · (α × rᵢ + ω × (ω × rᵢ))'))
    how = 'M⁻¹ (raw − b − u), accelerometer' if np.any(arms) else 'M⁻¹ (raw − b), accelerometer'
    steps.append(('corrected specific force', 'm/s²', corrected.force[0], how if plain else ''))
    if sample.true_force is not None:
        steps += [('reference of the table: rate', 'rad/s', sample.true_rate, 'the difference is the noise of one sample'),
                  ('reference of the table: force', 'm/s²', sample.true_force, '')]
    return [{'what': what, 'unit': unit, 'values': [fixed(v, 5) for v in values], 'how': how, 'mark': what.startswith('corrected')}
            for what, unit, values, how in steps]


def _sample(result):
    """Return the sample of the worked example: the fastest of the kept ones, else a pose."""
    kept = [window for window in result.gathered.kept if len(window.motion) == len(window.time)]
    if kept:
        return _moving_sample(result, kept)
    force, rate = result.first_rest()
    return SimpleNamespace(force=force, rate=rate, alpha=np.zeros(3), temperature=_reference_temperature(result), true_force=None,
                           true_rate=None, where='the mean of the first pose at rest')


def _reference_temperature(result):
    return np.full(1, result.calibration.model.temperature_ref_c)


def _moving_sample(result, kept):
    speeds = [np.linalg.norm(window.rate_s, axis=1) for window in kept]
    best = int(np.argmax([speed.max() for speed in speeds]))
    window, index = kept[best], int(np.argmax(speeds[best]))
    ref = reference_motion(result.table, window.motion.select(slice(index, index + 1)))
    arm = result.calibration.of('accelerometer', Role.ARM)
    true_force = ref.force_s[0] + (0.0 if arm is None else lever_matrix(ref.rate_s, ref.alpha_s)[0] @ arm)
    temperature = _reference_temperature(result) if window.temperature_c is None else window.temperature_c[index:index + 1]
    alpha = ', '.join(fixed(a, 3) for a in ref.alpha_s[0])
    where = (f'the fastest sample that was kept, at {text(window.time[index], 4)} s, with the table’s angular acceleration '
             f'α = ({alpha}) rad/s²')
    return SimpleNamespace(force=window.force_s[index], rate=window.rate_s[index], alpha=ref.alpha_s[0], temperature=temperature,
                           true_force=true_force, true_rate=ref.rate_s[0], where=where)
