"""Residual of a calibration by hand that no effect explains, and where it is largest."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from imu_calibration.effects.base import AXES
from imu_calibration.estimation.rows import Rows, flat
from imu_calibration.references.gravity.hand_calibration import HandCalibration
from imu_calibration.references.rows.row_evidence import RowEvidence
from imu_calibration.selection.regime_variables import Variable, ranged
from imu_calibration.selection.regimes import (
    REGIME_LEVEL,
    AxisResidual,
    RegimeSearch,
    RestRegime,
    exchanges,
)
from imu_calibration.selection.unexplained import (
    MIN_EXPLAINED_WINDOWS,
    SIGNIFICANT_SDS,
    Unexplained,
    correlate,
    largest_axes,
    slow_explanations,
)

NORM = 'norm'
"""Without a table only the component of the accelerometer's error along gravity is observable."""
TURN_RESIDUAL_UNIT = 'rad/turn'
"""Unit of the residual of turns: the angle between predicted and measured gravity after a turn."""


def unexplained_by_hand(
    hand: HandCalibration,
    blocks: Sequence[Rows],
    evidence: RowEvidence,
    *,
    used: Sequence[int],
    sensor: str,
) -> Unexplained:
    """
    Return the unexplained residual of one sensor.

    Its rows at rest and its turns against the expectation from noise.

    Parameters
    ----------
    hand : HandCalibration
        Of the baseline.
    blocks : sequence of Rows
        Rows at rest and of turns.
    evidence : RowEvidence
        Of these rows.
    used : sequence of int
        Parameters of the model.
    sensor : str

    """
    residuals = evidence.residuals(used)
    sigma = -np.inf
    rms = 0.0
    chosen = None
    for block, residual in zip(blocks, residuals):
        if block.sensor != sensor:
            continue
        spare = residual.size - np.linalg.matrix_rank(flat(block.equations)[:, used])
        if spare < 3:
            continue
        own = (np.sum(residual**2 / block.floor) - spare) / np.sqrt(2 * spare)
        if block.name == 'poses' or own > max(sigma, SIGNIFICANT_SDS):
            # The residual of a turn is an angle, of a pose a rate.
            size = 1.0 if block.duration is None else block.duration[:, None] ** 2
            excess = np.sum(residual**2 * size) / spare - np.mean(block.floor * size)
            if own > sigma:
                sigma = own
                rms = float(np.sqrt(max(excess, 0.0)))
                chosen = block
    count = len(hand.poses)
    first = next(k for k, block in enumerate(blocks) if block.sensor == sensor)
    layers = residuals[first]
    noise_sd = np.sqrt(blocks[first].floor)
    significant = bool(sigma > SIGNIFICANT_SDS and count >= MIN_EXPLAINED_WINDOWS)
    unit = None if chosen is None or chosen.duration is None else TURN_RESIDUAL_UNIT
    sigma = float(max(sigma, -99.0))
    found = Unexplained(significant, rms, sigma, None, 0.0, layers, noise_sd, unit)
    if not significant:
        return found
    name, share = correlate(_explanations(hand), layers, noise_sd)
    if chosen is not None and chosen.name == 'turns' and name is None:
        name = 'motion (turns between poses)'
    heldout = evidence.heldout_residuals(used)[first]
    excess = ((heldout / noise_sd) ** 2 - 1.0).sum(axis=0)
    axes = largest_axes(excess) if len(excess) == len(AXES) and excess.max() > 0 else ()
    regimes = regimes_by_hand(hand, blocks[first], heldout)
    return replace(found, correlates_with=name, share=share, axes=axes, regimes=regimes)


def _explanations(hand: HandCalibration) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    poses, up = hand.poses, hand.state.up
    every = np.ones(len(up), bool)
    yield from slow_explanations(
        poses.time, np.full(len(up), np.nan) if poses.temperature_c is None else poses.temperature_c
    )
    yield 'direction of gravity', up, every
    yield (
        'direction of gravity',
        np.stack(
            [
                up[:, 0] ** 2 - up[:, 1] ** 2,
                up[:, 2] ** 2,
                up[:, 0] * up[:, 1],
                up[:, 1] * up[:, 2],
                up[:, 0] * up[:, 2],
            ],
            axis=1,
        ),
        every,
    )


def regimes_by_hand(
    hand: HandCalibration, block: Rows, residual: np.ndarray
) -> tuple[RestRegime, ...]:
    """
    Return the clearest regime of each axis.

    Regimes of larger scatter are not reported, since every other range of few poses has it.

    Parameters
    ----------
    hand : HandCalibration
        Of the baseline.
    block : Rows
        The sensor's rows in poses.
    residual : ndarray, shape (k, n_axes)
        Residual of each pose, by a fit without it.

    """
    names = AXES if residual.shape[1] == len(AXES) else (NORM,)
    poses = np.arange(len(residual))
    exchange = exchanges(poses, np.zeros(len(poses)), np.zeros(len(poses)))
    search = RegimeSearch(block.sensor, block.time, _variables(hand, block), exchange=exchange)
    found = []
    for axis, name in enumerate(names):
        sd = np.sqrt(block.floor[:, axis])
        rest = AxisResidual(
            np.column_stack([np.ones(len(sd)), residual[:, axis]]) / sd[:, None],
            np.zeros(1),
            np.zeros(1),
        )
        found += search.offsets(
            name, rest, partial(np.multiply, 1.0 / sd[:, None]), level=REGIME_LEVEL / len(names)
        )[:1]
    return tuple(found)


def _variables(hand: HandCalibration, block: Rows) -> list[Variable]:
    """
    Return the variables of regimes of poses.

    The attitude, the previous attitude, the time and the temperature.
    """
    force = hand.gravity * hand.state.up
    before = np.concatenate([force[:1], force[:-1]])
    of = partial(ranged, starts=np.arange(len(block.time)))
    found = of('time', block.time, 's')
    for k, axis in enumerate(AXES):
        found += of(f'specific force along {axis}', force[block.group, k], 'm/s^2', least=0.5)
        found += of(
            f'specific force along {axis} in the pose before',
            before[block.group, k],
            'm/s^2',
            least=0.5,
        )
    warm = hand.poses.temperature_c
    return found if warm is None else found + of('temperature', warm[block.group], 'C', least=0.5)
