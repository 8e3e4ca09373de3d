"""The noise of a session given a model: first from rest, then from the residuals of the fit."""

from dataclasses import replace

import numpy as np

from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.forward_equations import coefficient_jacobian
from imu_calibration.estimation.band_misfit import BandMisfit, band_misfit, misfit_along, own_misfit
from imu_calibration.estimation.noise_at_rest import shaken_means, white_noise
from imu_calibration.estimation.noise_model import BiasProcess, NoiseModel, ReferenceNoise
from imu_calibration.estimation.noise_search import estimate_offsets
from imu_calibration.estimation.prior import fixed_parameters
from imu_calibration.estimation.weighted_system import WeightedSystem


def first_noise(system: WeightedSystem, values: np.ndarray, known: dict[str, tuple[BiasProcess, ...]]) -> dict[str, NoiseModel]:
    """Return the initial noise without residuals; fast parts have weight zero where slow parts can be fitted better."""
    return {sensor: _with_bands(system, sensor,
                                replace(_at_rest(system, sensor, values), known=known.get(sensor, ()))) for sensor in SENSORS}


def updated_noise(system: WeightedSystem, values: np.ndarray, noises: dict[str, NoiseModel]) -> dict[str, NoiseModel]:
    """Return the noise estimated from the residuals at `values`."""
    return {sensor: _updated(system, sensor, values, noises[sensor]) for sensor in SENSORS}


def _at_rest(system, sensor, values):
    white = white_noise(system.accumulator.rows, sensor)
    reference = ReferenceNoise.of_steps(max(row.encoder_step for row in system.accumulator.rows), sensor)
    if white is not None:
        return NoiseModel(*white, reference=reference, shaken=shaken_means(system.accumulator.rows, sensor))
    variance = np.full(3, 1e-30)
    for kind in system.within[sensor]:
        variance = np.maximum(variance, _misfit_of(system, sensor, kind, values).noise)
    if not system.within[sensor]:
        variance = np.full(3, system.means[sensor][:, -3:].var() + 1e-12)
    return NoiseModel(variance, np.ones(3), reference=reference)


def _with_bands(system, sensor, noise):
    """Return the noise with weight zero for the fast parts where slow parts, fitted separately, have a smaller residual variance."""
    misfits = {kind: _misfit_of(system, sensor, kind) for kind in system.within[sensor]}
    return replace(noise, moving={kind: misfit.without_fast().factors(noise) for kind, misfit in misfits.items() if misfit.apart.any()})


def _updated(system, sensor, values, noise):
    if white_noise(system.accumulator.rows, sensor) is None:
        noise = replace(_at_rest(system, sensor, values), known=noise.known, left_out=noise.left_out)
    noise = replace(noise, moving={kind: _judged(system, sensor, kind, values).factors(noise) for kind in system.within[sensor]})
    rows, information = system.linearised(sensor, values, noise)
    white = system.mean_variance(noise, beside_bias=False)
    return replace(noise, **estimate_offsets(rows, white, system.times, sessions=system.sessions, information=information,
                                             known=noise.known, durations=system.durations))


def _judged(system, sensor, kind, values) -> BandMisfit:
    """Return the misfit of the centred rows of a kind; of the fast part at least the misfit along the parameters."""
    misfit = _misfit_of(system, sensor, kind, values)
    if not misfit.apart.any():
        return misfit
    dc = coefficient_jacobian(system.model, sensor, values)[:, :, ~fixed_parameters(system.model)]
    along = np.zeros(3)
    for axis in range(3):
        every, slow = (np.column_stack([rows[:, :-3] @ dc[:, axis], system.misfit(sensor, rows, values)[:, axis]])
                       for rows in (system.within[sensor][kind], system.accumulator.slow[sensor, kind]))
        squares, rank = misfit_along((every.T @ every - slow.T @ slow)[None])
        along[axis] = squares / max(rank, 1)
    return replace(misfit, fast=np.where(misfit.apart, np.maximum(misfit.fast, along), misfit.fast))


def _misfit_of(system, sensor, kind, values=None) -> BandMisfit:
    """Return the misfit of the centred rows of a kind at `values`; without them, of each part at its own best fit."""
    rows, n_slow = system.within[sensor][kind], system.accumulator.slow_rows.get(kind, 0) - system.accumulator.windows[kind]
    slow = system.accumulator.slow[sensor, kind] if n_slow > 0 else rows[:0]
    misfits = [own_misfit(part) if values is None else system.misfit(sensor, part, values) for part in (rows, slow)]
    total, of_slow = ((misfit**2).sum(axis=0) for misfit in misfits)
    return band_misfit(total, system.dof_within[kind], of_slow, dof_slow=n_slow)
