"""Residual of a calibration by hand that no effect explains, and where it is largest."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
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
    IndependentErrors,
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


@dataclass(frozen=True)
class _Excess:
    """Excess of a residual over the expectation from noise."""

    sigma: float = -np.inf
    """Excess of chi^2, in standard deviations."""
    rms: float = 0.0
    """Its root mean square, in the unit of a reading, of turns rad."""
    is_of_turns: bool = False
    """Whether it is the residual of turns."""


def unexplained_by_hand(
    hand: HandCalibration,
    evidence: RowEvidence,
    *,
    used: Sequence[int],
    sensor: str,
) -> Unexplained:
    """
    Return the unexplained residual of one sensor, at rest or in turns.

    A block has the excess ``(chi^2 - dof) / sqrt(2 dof)`` over the expectation from noise, in
    standard deviations. The block with the larger one determines sigma and rms; turns only if they
    are significant.

    Parameters
    ----------
    hand : HandCalibration
        Solution of the baseline.
    evidence : RowEvidence
        Of blocks of rows at rest and of turns; those at rest are the first of each sensor.
    used : sequence of int
        Parameters of the model, columns of the rows.
    sensor : str
        Its rows are examined.

    """
    blocks = evidence.blocks
    residuals = evidence.residuals(used)
    largest = _Excess()
    for block, residual in zip(blocks, residuals):
        if block.sensor != sensor:
            continue
        spare = residual.size - np.linalg.matrix_rank(flat(block.equations)[:, used])
        if spare < 3:  # too few degrees of freedom for a normal distribution of chi^2
            continue
        sigma = (np.sum(residual**2 / block.floor) - spare) / np.sqrt(2 * spare)
        if sigma > largest.sigma and (block.name == 'poses' or sigma > SIGNIFICANT_SDS):
            # Rows of turns are angles over their duration, and their rms is one of angles.
            square_unit = 1.0 if block.duration is None else block.duration[:, None] ** 2
            noise_square = np.mean(block.floor * square_unit)
            excess_square = np.sum(residual**2 * square_unit) / spare - noise_square
            rms = float(np.sqrt(max(excess_square, 0.0)))
            largest = _Excess(sigma, rms, is_of_turns=block.duration is not None)

    at_rest = next(k for k, block in enumerate(blocks) if block.sensor == sensor)
    noise_sd = np.sqrt(blocks[at_rest].floor)
    significant = bool(largest.sigma > SIGNIFICANT_SDS and len(hand.poses) >= MIN_EXPLAINED_WINDOWS)
    unexplained = Unexplained(
        significant=significant,
        rms=largest.rms,
        # Minus infinity, which no document holds, where no block has enough rows.
        sigma=float(max(largest.sigma, -99.0)),
        correlates_with=None,
        share=0.0,
        residual=residuals[at_rest],
        noise_sd=noise_sd,
        unit=TURN_RESIDUAL_UNIT if largest.is_of_turns else None,
    )
    if not significant:
        return unexplained

    # Where it is largest: the variable, the axes, and ranges of the variables.
    name, share = correlate(_explanations(hand), residuals[at_rest], noise_sd)
    if largest.is_of_turns and name is None:
        name = 'motion (turns between poses)'
    heldout = evidence.heldout_residuals(used)[at_rest]
    excess = ((heldout / noise_sd) ** 2 - 1.0).sum(axis=0)
    axes = ()
    if len(excess) == len(AXES) and excess.max() > 0:
        axes = largest_axes(excess)
    regimes = regimes_by_hand(hand, blocks[at_rest], heldout)
    return replace(unexplained, correlates_with=name, share=share, axes=axes, regimes=regimes)


def _explanations(hand: HandCalibration) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yield (name, columns (k, m), mask of the poses (k,)) of the variables for `correlate`."""
    poses = hand.poses
    up = hand.state.up
    all_poses = np.ones(len(up), bool)
    temperature_c = poses.temperature_c
    if temperature_c is None:
        temperature_c = np.full(len(up), np.nan)
    yield from slow_explanations(poses.time, temperature_c)
    yield 'direction of gravity', up, all_poses

    # Polynomials of the second degree on the sphere.
    x, y, z = up.T
    second_degree = np.stack([x**2 - y**2, z**2, x * y, y * z, x * z], axis=1)
    yield 'direction of gravity', second_degree, all_poses


def regimes_by_hand(
    hand: HandCalibration, block: Rows, residual: np.ndarray
) -> tuple[RestRegime, ...]:
    """
    Return for each axis the range of a variable in which the residual is offset most clearly.

    Ranges of larger scatter are not reported, since many ranges of few poses have it by chance.

    Parameters
    ----------
    hand : HandCalibration
        Of the baseline.
    block : Rows
        The sensor's rows in poses.
    residual : ndarray, shape (k, n_axes)
        Residual of each pose, by a fit without it.

    """
    # Each pose is a window; all are of one kind, at rest, so that any two may be exchanged.
    names = AXES if residual.shape[1] == len(AXES) else (NORM,)
    poses = np.arange(len(residual))
    exchange = exchanges(poses, np.zeros(len(poses)), np.zeros(len(poses)))
    search = RegimeSearch(block.sensor, block.time, _variables(hand, block), exchange=exchange)
    regimes = []
    for axis, name in enumerate(names):
        sd = np.sqrt(block.floor[:, axis])
        # A model of a constant without prior information, and the residual, whitened.
        white = np.column_stack([np.ones(len(sd)), residual[:, axis]]) / sd[:, None]
        axis_residual = AxisResidual(white, np.zeros(1), np.zeros(1))
        whitening = IndependentErrors(sd)
        offsets = search.offsets(name, axis_residual, whitening, level=REGIME_LEVEL / len(names))
        regimes += offsets[:1]
    return tuple(regimes)


def _variables(hand: HandCalibration, block: Rows) -> list[Variable]:
    """
    Return the variables whose ranges are regimes of poses.

    They are time, attitude, attitude of the pose before, and temperature.
    """
    force = hand.gravity * hand.state.up
    force_before = np.concatenate([force[:1], force[:-1]])
    variables_of = partial(ranged, starts=np.arange(len(block.time)))
    variables = variables_of('time', block.time, 's')
    for k, axis in enumerate(AXES):
        name = f'specific force along {axis}'
        variables += variables_of(name, force[block.group, k], 'm/s^2', least=0.5)
        variables += variables_of(
            f'{name} in the pose before', force_before[block.group, k], 'm/s^2', least=0.5
        )
    temperature_c = hand.poses.temperature_c
    if temperature_c is not None:
        variables += variables_of('temperature', temperature_c[block.group], 'C', least=0.5)
    return variables
