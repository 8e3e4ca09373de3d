"""Regimes of the residual of windows on a table."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from imu_calibration.effects.base import AXES
from imu_calibration.references.turntable.residuals.residual_blocks import BlockWhitener, RestBlocks
from imu_calibration.references.turntable.residuals.scatter_regimes import ScatterSearch
from imu_calibration.references.turntable.residuals.window_variables import variables_of
from imu_calibration.references.turntable.selection.linearised_problem import LinearisedProblem
from imu_calibration.selection.regimes import (
    REGIME_LEVEL,
    AxisResidual,
    RestRegime,
    exchanges,
)


def find_regimes(
    blocks: RestBlocks,
    problem: LinearisedProblem,
    used: Sequence[int],
    *,
    joint_names: Sequence[str],
    axes: Sequence[str] = AXES,
    formula: np.ndarray | None = None,
) -> list[RestRegime]:
    """
    Return the regimes of a sensor's axes, the likeliest of each axis first.

    Parameters
    ----------
    blocks : RestBlocks
    problem : LinearisedProblem
    used : sequence of int
        Parameters of the model.
    joint_names : sequence of str
    axes : sequence of str
        Axes with an excess over noise, on which an offset is searched.
    formula : ndarray, shape (b, k, 3), optional
        Columns of a formula for the residual, which a regime must exceed.

    """
    exchange = exchanges(
        blocks.window,
        problem.recording.kind[blocks.window],
        np.linalg.norm(blocks.means(blocks.ref.rate_s), axis=1),
    )
    search = ScatterSearch(
        blocks.sensor, blocks.time, variables_of(blocks, joint_names), exchange=exchange
    )
    level = REGIME_LEVEL / len(AXES)
    white, found = None, []
    for axis, name in enumerate(AXES):
        offsets = []
        if name in axes:
            white = white or BlockWhitener(blocks, np.ones(len(blocks.time), bool))
            at = np.flatnonzero(np.isin(blocks.index[axis], list(used)))
            own = blocks.index[axis][at]
            scaled = partial(white, axis=axis)
            prior = 1 / problem.space.prior_sd[own] ** 2, problem.space.prior_mean[own]
            rest = AxisResidual(scaled(blocks.design[axis][:, [*at, -1]]), *prior)
            offsets = search.offsets(
                name,
                rest,
                scaled,
                level=level / 2,
                formula=None if formula is None else formula[:, :, axis],
            )
        found += offsets or search.scatters(
            name, blocks.rough[:, axis], blocks.freedom, level=level / 2
        )
    return found
