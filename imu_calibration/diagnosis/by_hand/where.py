"""Where the rest of a recording by hand sits: attitudes, times and temperatures at which the output has another offset."""

import numpy as np

from imu_calibration.beyond.regime_variables import Variable, ranged
from imu_calibration.beyond.regimes import RestRegime, cleanest, tested_offset
from imu_calibration.by_hand.calibrate import HandCalibration
from imu_calibration.by_hand.effect_rows import Block
from imu_calibration.effects.base import AXES

BY_CHANCE = 0.01
"""Significance level of a regime, for all ranges of all variables."""
MOST_OF_IT = 0.8
"""Least share of an axis' residual that an offset there explains."""
NORM = 'norm'
"""Without a table only the component of the accelerometer's error along gravity is observable."""


def regimes_by_hand(hand: HandCalibration, block: Block, residual: np.ndarray) -> tuple[RestRegime, ...]:
    """
    Return the clearest regime of each axis.

    Poses are too few for separate selection and test: the p-value of the likeliest range is multiplied by the number of ranges. Regimes
    of larger scatter are not reported, since every other range of few poses has it.

    Parameters
    ----------
    hand : HandCalibration
        Of the baseline.
    block : Block
        The sensor's rows in poses.
    residual : ndarray, shape (k, n_axes)
        Residual of each pose, by a fit without it.

    """
    variables = _variables(hand, block)
    names = AXES if residual.shape[1] == len(AXES) else (NORM,)
    found = []
    for axis, name in enumerate(names):
        sd = np.sqrt(block.floor[:, axis])
        rows = np.column_stack([np.ones(len(sd)), residual[:, axis]]) / sd[:, None]
        regimes = [regime for variable in variables if (regime := _of_variable(block, name, rows, sd, variable)) is not None]
        number = len(names) * sum(variable.marks.shape[1]**2 // 2 for variable in variables)
        sure = [regime for regime in regimes if regime.p_value * number < BY_CHANCE and regime.share >= MOST_OF_IT]
        found += sorted(sure, key=lambda regime: regime.cost)[:1]
    return tuple(found)


def _of_variable(block, axis, rows, sd, variable):
    """Return the range of a variable in which an offset explains most, or None where it has too few values."""
    prior, marks = (np.zeros(1), np.zeros(1)), variable.marks / sd[:, None]
    best = next((chosen for chosen, offset in cleanest(rows, marks, prior, bins=variable.bins, cyclic=variable.cyclic) if offset), None)
    if best is None:
        return None
    mark = marks[:, best].sum(axis=1)
    share, p_value = tested_offset(rows, mark, prior, n_windows=len(rows))
    bounds = variable.bounds(best)
    return RestRegime(block.sensor, axis, variable.name, variable.words(best, bounds) + ', by another offset', share, p_value,
                      np.isin(variable.bins, best), block.time, True, p_value, bounds)


def _variables(hand: HandCalibration, block: Block) -> list[Variable]:
    """Return the variables of regimes of poses: the attitude, the previous attitude, the time and the temperature."""
    force = hand.gravity * hand.state.up
    before = np.concatenate([force[:1], force[:-1]])
    found = ranged('time', block.time, 's')
    for k, axis in enumerate(AXES):
        found += ranged(f'specific force along {axis}', force[block.pose, k], 'm/s^2', least=0.5)
        found += ranged(f'specific force along {axis} in the pose before', before[block.pose, k], 'm/s^2', least=0.5)
    warm = hand.poses.temperature_c
    return found if warm is None else found + ranged('temperature', warm[block.pose], 'C', least=0.5)
