"""Variables of regimes of windows: angles, rates and sides of the joints, speed, force, time."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from imu_calibration.core.units import DEG
from imu_calibration.effects.base import AXES
from imu_calibration.references.turntable.residuals.residual_blocks import RestBlocks
from imu_calibration.selection.regime_variables import FEWEST, N_BINS, Variable, block_means, ranged


def variables_of(blocks: RestBlocks, joint_names: Sequence[str]) -> list[Variable]:
    """Return the variables of regimes in this recording; the first is reported among equals."""
    ref = blocks.ref
    starts = blocks.starts
    found = []
    each = partial(ranged, starts=starts)
    rates = partial(ranged, unit='deg/s', starts=starts, is_rate=True)
    for k, name in enumerate(joint_names):
        if np.ptp(ref.joint_angle[:, k]) > 0.5:
            found.append(_cyclic(f'angle of {name}', ref.joint_angle[:, k] / DEG, starts))
        joint_rate = ref.joint_rate[:, k] / DEG
        found += rates(f'rate of {name}', joint_rate)
        found += rates(f'speed of {name}', np.abs(joint_rate))
        found += _before_rest(name, ref.joint_rate[:, k], starts)
    speed = np.linalg.norm(ref.rate_s, axis=1)
    found += rates('speed', speed / DEG)
    found += each('specific force', np.linalg.norm(ref.force_s, axis=1), 'm/s^2', least=0.5)
    for k, axis in enumerate(AXES):
        found += rates(f'rate about {axis}', ref.rate_s[:, k] / DEG)
        found += each(f'specific force along {axis}', ref.force_s[:, k], 'm/s^2', least=0.5)
    found += each('time', ref.time, 's')
    if blocks.warms and ref.temperature_c is not None:
        warm = ref.temperature_c
        found += each('temperature', warm, 'C', least=0.5)
        slope = np.gradient(
            np.polynomial.Chebyshev.fit(ref.time, warm, min(12, len(warm) // 10))(ref.time)
        )
        found += _classes('temperature', slope > 0, ('while it cools', 'while it warms up'), starts)
    moving = speed > DEG
    found += _classes('kind', moving, ('at rest', 'while it moves'), starts)
    last = np.maximum.accumulate(np.where(moving, ref.time, -np.inf))
    return found + each(
        'time since motion', np.where(np.isfinite(last), np.minimum(ref.time - last, 1e3), 1e3), 's'
    )


def _before_rest(name: str, rate: np.ndarray, starts: np.ndarray) -> list[Variable]:
    """Return from which side a joint reached its rest."""
    moving = np.abs(rate) > 0.5 * DEG
    side = np.where(moving, np.sign(rate), 0.0)
    place = np.maximum.accumulate(np.where(moving, np.arange(len(rate)), -1))
    came = np.where(place >= 0, side[np.maximum(place, 0)], 0.0)
    if min((came > 0).sum(), (came < 0).sum()) < FEWEST:
        return []
    return _classes(
        f'approach of {name}',
        came > 0,
        (f'after {name} turned backwards', f'after {name} turned forwards'),
        starts,
    )


def _cyclic(name: str, degrees: np.ndarray, starts: np.ndarray) -> Variable:
    edges = np.linspace(0.0, 360.0, N_BINS + 1)

    def words(_: str, bounds: tuple[float, float]) -> str:
        low, high = (round(bound % 360.0) % 360 if bound != 360.0 else 360 for bound in bounds)
        return f'while the {name} is {low} to {high} deg'

    bins = np.minimum((degrees % 360.0 / 360.0 * N_BINS).astype(int), N_BINS - 1)
    return Variable(name, bins, edges, True, words, degrees % 360.0, starts)


def _classes(
    name: str, mask: np.ndarray, words: tuple[str, str], starts: np.ndarray
) -> list[Variable]:
    if not FEWEST <= block_means(mask.astype(float), starts).sum() <= len(starts) - FEWEST:
        return []
    return [
        Variable(
            name,
            mask.astype(int),
            np.zeros(0),
            False,
            lambda chosen, _: words[chosen[0]],
            mask.astype(float),
            starts,
        )
    ]
