"""Runs of a turntable that carries a tri-axis accelerometer, and the designs made of them that are compared for Zhang's lever arms."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from imu_calibration.constants import STANDARD_GRAVITY
from imu_calibration.errors import InputError
from imu_calibration.reference.reference_motion import lever_matrix

DESIGNS = ('Z0', 'Z60', 'O', 'M')
"""Zhang's own runs, the same with the fixture skewed by 60 deg, oscillations, and a mixture with two-axis turns."""


@dataclass(frozen=True, eq=False)
class Run:
    """True motion during one run; a run whose reading is constant is one row, the mean."""

    name: str
    """What the table does."""
    force: np.ndarray
    """Specific force at the reference point, m/s^2, shape (n, 3)."""
    rate: np.ndarray
    """Body rate, rad/s, shape (n, 3)."""
    alpha: np.ndarray
    """Angular acceleration, rad/s^2, shape (n, 3)."""
    noise_sd: float
    """Sd of one row, m/s^2."""


def face(up: np.ndarray, noise_sd: float, tilt: float = 0.0, *, azimuth: float = 0.0) -> Run:
    """Return one position at rest; the table is off level by `tilt` (rad) towards `azimuth` about the body's up axis."""
    up = _unit(up)
    level = _square_to(up)
    force = np.cos(tilt) * up + np.sin(tilt) * (np.cos(azimuth) * level + np.sin(azimuth) * np.cross(up, level))
    return Run('face', STANDARD_GRAVITY * force[None], np.zeros((1, 3)), np.zeros((1, 3)), noise_sd)


def spin(axis: np.ndarray, rate_deg_s: float, noise_sd: float) -> Run:
    """Return a spin at constant rate about a vertical axis; gravity and arms give constant readings."""
    axis = _unit(axis)[None]
    return Run('spin', STANDARD_GRAVITY * axis, np.deg2rad(rate_deg_s) * axis, np.zeros((1, 3)), noise_sd)


def oscillation(axis: np.ndarray, amplitude_deg: float, frequency_hz: float, *, noise_sd: float,
                n_samples: int = 100, delay: float = 0.0) -> Run:
    """Return one period of ``amplitude sin(2 pi f t)`` about a vertical axis; `delay` (s) is how late the samples are stamped."""
    axis, angular = _unit(axis), 2 * np.pi * frequency_hz
    phase = angular * (np.arange(n_samples) / n_samples / frequency_hz - delay)
    amplitude = np.deg2rad(amplitude_deg)
    return Run('oscillation', np.tile(STANDARD_GRAVITY * axis, (n_samples, 1)), np.outer(amplitude * angular * np.cos(phase), axis),
               np.outer(-amplitude * angular**2 * np.sin(phase), axis), noise_sd)


def two_axis(inner: np.ndarray, inner_deg_s: float, outer_deg_s: float, *, noise_sd: float, n_samples: int = 100,
             delay: float = 0.0) -> Run:
    """Return one turn of a horizontal body axis `inner` at constant rate while the vertical outer axis turns as well."""
    inner, (inner_rate, outer_rate) = _unit(inner), np.deg2rad([inner_deg_s, outer_deg_s])
    turned = inner_rate * (np.arange(n_samples) / n_samples * 2 * np.pi / abs(inner_rate) - delay)
    start = _square_to(inner)
    up = np.outer(np.cos(turned), start) - np.outer(np.sin(turned), np.cross(inner, start))
    rate, alpha = inner_rate * inner + outer_rate * up, -inner_rate * outer_rate * np.cross(inner, up)
    return Run('two-axis', STANDARD_GRAVITY * up, rate, alpha, noise_sd)


def design_runs(name: str, sample_sd: float = 1e-3 * STANDARD_GRAVITY, n_samples: int = 100) -> list[Run]:
    """
    Return the runs of a named design: six faces and nine dynamic runs of `n_samples` samples each.

    Parameters
    ----------
    name : str
        One of `DESIGNS`.
    sample_sd : float
        White noise of one sample, m/s^2; runs with constant readings carry ``sample_sd / sqrt(n_samples)``.

    """
    if name not in DESIGNS:
        raise InputError(f"design must be one of {', '.join(DESIGNS)}, got '{name}'; choose one of them")
    mean_sd, axes = sample_sd / np.sqrt(n_samples), np.eye(3)
    runs = [face(sign * axis, mean_sd) for sign in (1, -1) for axis in axes]
    if name in ('Z0', 'Z60'):
        skew_deg = {'Z0': 0.0, 'Z60': 60.0}[name]
        return runs + [spin(axis, rate, mean_sd) for axis in skewed_axes(skew_deg) for rate in (100, 150, 200)]
    if name == 'O':
        kinds = ((10, 1.0), (5, 2.0), (90, 0.5))
        return runs + [oscillation(axis, *kind, noise_sd=sample_sd, n_samples=n_samples) for axis in axes for kind in kinds]
    return (runs + [spin(axis, 200, mean_sd) for axis in axes]
            + [oscillation(axis, 10, 1.0, noise_sd=sample_sd, n_samples=n_samples) for axis in axes]
            + [two_axis(axis, 200, 200, noise_sd=sample_sd, n_samples=n_samples) for axis in axes])


def skewed_axes(skew_deg: float) -> np.ndarray:
    """Return three orthonormal spin axes, one per row, for a fixture turned by `skew_deg` about the body diagonal (1, 1, 1)."""
    return Rotation.from_rotvec(np.deg2rad(skew_deg) * np.ones(3) / np.sqrt(3)).as_matrix().T


def average_headings(tilt: float, up: np.ndarray, noise_sd: float, *, n_headings: int = 4) -> Run:
    """Return the mean of a tilted position over equally spaced headings: what takes levelling out of the static reference."""
    parts = [face(up, noise_sd, tilt, azimuth=2 * np.pi * k / n_headings) for k in range(n_headings)]
    return replace(parts[0], force=np.mean([part.force for part in parts], axis=0))


def stack_runs(runs: Sequence[Run]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return forces (n, 3), lever-arm matrices (n, 3, 3) and noise sd (n,) of all rows of the runs in order."""
    noise = np.concatenate([np.full(len(run.force), run.noise_sd) for run in runs])
    arm_matrix = np.concatenate([lever_matrix(run.rate, run.alpha) for run in runs])
    return np.concatenate([run.force for run in runs]), arm_matrix, noise


def _unit(vector):
    vector = np.asarray(vector, float)
    return vector / np.linalg.norm(vector)


def _square_to(axis):
    """Return the unit vector square to `axis` that the next body axis comes closest to."""
    following = np.roll(np.eye(3), 1, axis=1)[np.argmax(np.abs(axis))]
    return _unit(following - (following @ axis) * axis)
