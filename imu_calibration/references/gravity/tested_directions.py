"""
Cross terms of the accelerometer that the attitudes of a calibration by hand do not test.

Rests on the six faces of a board determine the angles between the accelerometer's axes only through
small tilts, where any error of a rest counts many times, and held-out rests have the same
directions.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from imu_calibration.core.distributions import f_sf
from imu_calibration.effects.base import AXES
from imu_calibration.references.gravity.equations import Poses, TurnData
from imu_calibration.references.gravity.hand_parameters import CROSS_TERMS, HandModel
from imu_calibration.references.gravity.pose_solver import first_state
from imu_calibration.references.gravity.poses import ATTITUDES_APART

OFF_AXIS = 0.15
"""
Product of two components of the unit vector of gravity from which a rest tests the cross term of
these axes: 9 deg from both axes. Faces within 3 deg have 0.05.
"""
LEAST_PLACEMENTS = 2
"""Fewest placements off the axes: one can be held out."""
PLACED_AGAIN = 0.0125
"""Consecutive rests within this angle are one placement, rad: they have the same error."""
TESTING_TURNS = 4
"""Fewest turns between different attitudes that test the angles between axes."""
FEWEST_SPARE = 3
"""Degrees of freedom of the placements that a likelihood ratio needs."""
DEMANDED = 0.05
"""p-value of the likelihood ratio below which the placements demand the cross terms."""
TURNS_CONTRADICT = 3.84
"""Increase of ``n log(mean square)`` of turns by which they contradict the cross terms."""


def directions(model: HandModel, poses: Poses) -> np.ndarray:
    """
    Return the direction of gravity in each pose without cross terms, unit vectors, shape (k, 3).

    Estimated cross terms, if they are wrong, would turn it.
    """
    return first_state(replace(model, untested=CROSS_TERMS), poses).up


def off_axis_lacking(up: np.ndarray) -> tuple[str, ...]:
    """
    Return the cross terms for which too few placements are off the axes of the sensor.

    Parameters
    ----------
    up : array, shape (k, 3)
        `directions`, as for the other functions of this module.

    """
    first = placements(up)
    lacking = []
    for name in CROSS_TERMS:
        i, j = (AXES.index(axis) for axis in name[-2:])
        if np.count_nonzero(np.abs(up[first, i] * up[first, j]) >= OFF_AXIS) < LEAST_PLACEMENTS:
            lacking.append(name)
    return tuple(lacking)


def placements(up: np.ndarray) -> np.ndarray:
    """Return the first rest of each placement, indices, for unit vectors of shape (k, 3)."""
    step = np.linalg.norm(np.diff(up, axis=0), axis=1)
    return np.flatnonzero(np.append(True, step > PLACED_AGAIN))


def demanded_by_placements(
    model: HandModel, values: np.ndarray, poses: Poses, *, up: np.ndarray, names: Sequence[str]
) -> bool:
    """
    Return whether the norms demand the cross terms `names`.

    F test of the mean norm of each placement, which is one independent observation.
    """
    first = placements(up)
    count = np.diff(np.append(first, len(up)))
    norms, columns = model.norm_rows(values, poses.force, **poses.conditions)
    residual = np.add.reduceat(norms, first) / count
    columns = np.add.reduceat(columns, first) / count[:, None]
    estimated = np.concatenate(
        [model.base_index('accelerometer'), model.extra_index('accelerometer')]
    )
    cross = np.isin(np.array(model.model.param_names)[estimated], names)
    left, spare = _left(residual, columns[:, estimated])
    # the residual with the cross terms at zero, fitted by the other parameters
    at_zero = residual + columns[:, estimated[cross]] @ values[estimated[cross]]
    without, more = _left(at_zero, columns[:, estimated[~cross]])
    if spare < FEWEST_SPARE or more <= spare or left <= 0:
        return False
    ratio = max(without - left, 0.0) / (more - spare) / (left / spare)
    return bool(f_sf(ratio, more - spare, spare) < DEMANDED)


def _left(residual, columns):
    """Return (sum of squares after the fit, degrees of freedom)."""
    fitted, _, rank, _ = np.linalg.lstsq(columns, residual, rcond=1e-9)
    return float(np.sum((residual - columns @ fitted) ** 2)), len(residual) - int(rank)


def turns_between(up: np.ndarray, turns: Sequence[TurnData]) -> list[TurnData]:
    """Return the turns between different attitudes, which test the angles between axes."""
    least = np.cos(ATTITUDES_APART)
    return [
        turn for turn in turns if turn.rotation is None and up[turn.first] @ up[turn.last] < least
    ]


def contradicted_by_turns(free: np.ndarray, held: np.ndarray) -> bool:
    """
    Return whether turns contradict the cross terms.

    Parameters
    ----------
    free, held : array, shape (n,)
        Angle errors of the turns with estimated cross terms, and with cross terms at their prior.

    """
    return bool(len(free) * np.log(np.mean(free**2) / np.mean(held**2)) > TURNS_CONTRADICT)
