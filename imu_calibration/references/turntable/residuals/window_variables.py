"""Variables of regimes of windows: angles, rates and sides of the joints, speed, force, time."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from imu_calibration.core.units import DEG
from imu_calibration.effects.base import AXES
from imu_calibration.references.turntable.residuals.residual_blocks import BlockMeans
from imu_calibration.selection.regime_variables import FEWEST, N_BINS, Variable, block_means, ranged


def variables_of(blocks: BlockMeans, joint_names: Sequence[str]) -> list[Variable]:
    """Return the variables of regimes in this recording; the first is reported among equals."""
    ref = blocks.ref
    starts = blocks.starts
    of_value = partial(ranged, starts=starts)
    of_rate = partial(ranged, unit='deg/s', starts=starts, is_rate=True)

    # Joints.
    variables = []
    for k, name in enumerate(joint_names):
        if np.ptp(ref.joint_angle[:, k]) > 0.5:
            variables.append(_cyclic(f'angle of {name}', ref.joint_angle[:, k] / DEG, starts))
        joint_rate = ref.joint_rate[:, k] / DEG
        variables += of_rate(f'rate of {name}', joint_rate)
        variables += of_rate(f'speed of {name}', np.abs(joint_rate))
        variables += _approach(name, ref.joint_rate[:, k], starts)

    # Input of the sensor.
    speed = np.linalg.norm(ref.rate_s, axis=1)
    variables += of_rate('speed', speed / DEG)
    force = np.linalg.norm(ref.force_s, axis=1)
    variables += of_value('specific force', force, 'm/s^2', least=0.5)
    for k, axis in enumerate(AXES):
        variables += of_rate(f'rate about {axis}', ref.rate_s[:, k] / DEG)
        variables += of_value(f'specific force along {axis}', ref.force_s[:, k], 'm/s^2', least=0.5)

    # Time and temperature.
    variables += of_value('time', ref.time, 's')
    if blocks.warms and ref.temperature_c is not None:
        temperature = ref.temperature_c
        variables += of_value('temperature', temperature, 'C', least=0.5)
        # Slope of a polynomial, which smooths the steps of the thermometer: at least ten rows for
        # each degree.
        degree = min(12, len(temperature) // 10)
        course = np.polynomial.Chebyshev.fit(ref.time, temperature, degree)
        slope = np.gradient(course(ref.time))
        variables += _classes(
            'temperature', slope > 0, ('while it cools', 'while it warms up'), starts
        )

    # Motion, and time since its end, at most 1000 s.
    moving = speed > DEG
    variables += _classes('kind', moving, ('at rest', 'while it moves'), starts)
    last_moving = np.maximum.accumulate(np.where(moving, ref.time, -np.inf))
    since_motion = np.minimum(ref.time - last_moving, 1e3)
    variables += of_value(
        'time since motion', np.where(np.isfinite(last_moving), since_motion, 1e3), 's'
    )
    return variables


def _approach(name: str, rate: np.ndarray, starts: np.ndarray) -> list[Variable]:
    """
    Return the variable of the direction of a joint's last motion, none if one direction is rare.

    `rate` is that of the joint, rad/s, at each row, shape (n,).
    """
    # Direction at the last row that moves, up to each row; 0 before the first motion.
    moving = np.abs(rate) > 0.5 * DEG
    direction = np.where(moving, np.sign(rate), 0.0)
    last_moving = np.maximum.accumulate(np.where(moving, np.arange(len(rate)), -1))
    approach = np.where(last_moving >= 0, direction[np.maximum(last_moving, 0)], 0.0)
    if min((approach > 0).sum(), (approach < 0).sum()) < FEWEST:
        return []
    return _classes(
        f'approach of {name}',
        approach > 0,
        (f'after {name} turned backwards', f'after {name} turned forwards'),
        starts,
    )


def _cyclic(name: str, degrees: np.ndarray, starts: np.ndarray) -> Variable:
    """Return the variable of an angle in degrees at each row, in bins of equal width."""
    edges = np.linspace(0.0, 360.0, N_BINS + 1)

    def words(_: str, bounds: tuple[float, float]) -> str:
        # From 0 to 359 deg; the end of a full turn remains 360.
        low, high = (round(bound % 360.0) % 360 if bound != 360.0 else 360 for bound in bounds)
        return f'while the {name} is {low} to {high} deg'

    bins = np.minimum((degrees % 360.0 / 360.0 * N_BINS).astype(int), N_BINS - 1)
    return Variable(
        name,
        bins,
        edges,
        cyclic=True,
        words=words,
        values=degrees % 360.0,
        starts=starts,
    )


def _classes(
    name: str, mask: np.ndarray, words: tuple[str, str], starts: np.ndarray
) -> list[Variable]:
    """
    Return the variable of two classes of rows, none where one of them has too few blocks.

    `words` are the descriptions of the rows outside and inside of `mask`.
    """
    n_blocks_inside = block_means(mask.astype(float), starts).sum()
    if not FEWEST <= n_blocks_inside <= len(starts) - FEWEST:
        return []
    return [
        Variable(
            name,
            bins=mask.astype(int),
            edges=np.zeros(0),  # classes have no values that could be bounds
            cyclic=False,
            words=lambda chosen, _: words[chosen[0]],
            values=mask.astype(float),
            starts=starts,
        )
    ]
