"""Regimes of the residual of windows on a table."""

from collections.abc import Sequence

import numpy as np

from imu_calibration.effects.base import AXES
from imu_calibration.references.turntable.residuals.residual_blocks import (
    BlockMeans,
    BlockWhitener,
    WhitenedAxis,
)
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
    blocks: BlockMeans,
    problem: LinearisedProblem,
    used: Sequence[int],
    *,
    joint_names: Sequence[str],
    axes: Sequence[str] = AXES,
    formula: np.ndarray | None = None,
) -> list[RestRegime]:
    """
    Return the regimes of a sensor's axes, the likeliest of each axis first.

    An axis has regimes of another offset, or, without any, those of a larger scatter.

    Parameters
    ----------
    blocks : BlockMeans
    problem : LinearisedProblem
    used : sequence of int
        Parameters of the model, numbers in the space of the problem.
    joint_names : sequence of str
    axes : sequence of str
        Axes with an excess over noise, on which an offset is searched.
    formula : ndarray, shape (b, k, 3), optional
        Columns of a formula for the residual, which a regime must exceed.

    """
    # By chance: residuals exchanged between windows of one kind and about the same rate.
    exchange = exchanges(
        blocks.window,
        problem.recording.kind[blocks.window],
        np.linalg.norm(blocks.means(blocks.ref.rate_s), axis=1),
    )
    search = ScatterSearch(
        blocks.sensor, blocks.time, variables_of(blocks, joint_names), exchange=exchange
    )
    # Regimes of another offset. Two tests on each axis share the level: of an offset, and of a
    # larger scatter.
    level = REGIME_LEVEL / len(AXES) / 2
    offsets_of: dict[str, list[RestRegime]] = {}
    if axes:
        # The whitening of all blocks, locked ones too, is common to the axes.
        whitener = BlockWhitener(blocks, np.ones(len(blocks.time), bool))
        for name in axes:
            axis = AXES.index(name)
            whitening = WhitenedAxis(whitener, axis)
            # Parameters of the model that act on the axis: their columns in its design.
            places = np.flatnonzero(np.isin(blocks.index[axis], list(used)))
            parameters = blocks.index[axis][places]
            residual = AxisResidual(
                whitening.whiten(blocks.design[axis][:, [*places, -1]]),
                information=1 / problem.space.prior_sd[parameters] ** 2,
                mean=problem.space.prior_mean[parameters],
            )
            offsets_of[name] = search.offsets(
                name,
                residual,
                whitening,
                level=level,
                formula=None if formula is None else formula[:, :, axis],
            )

    # Without any, those of a larger scatter.
    regimes: list[RestRegime] = []
    for axis, name in enumerate(AXES):
        regimes += offsets_of.get(name) or search.scatters(
            name, blocks.rough[:, axis], blocks.freedom, level=level
        )
    return regimes
