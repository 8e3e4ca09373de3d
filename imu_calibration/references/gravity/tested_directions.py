"""
Cross terms of the accelerometer that the attitudes of a calibration by hand do not test.

Rests on the six faces of a board determine the angles between the accelerometer's axes only through
small tilts, where any error of a rest counts many times, and held-out rests have the same
directions.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.core.distributions import f_sf
from imu_calibration.effects.base import AXES
from imu_calibration.estimation.gauss_newton import gauss_newton, halved
from imu_calibration.references.gravity.equations import Poses, TurnData
from imu_calibration.references.gravity.hand_parameters import CROSS_TERMS, HandModel
from imu_calibration.references.gravity.placements import placements
from imu_calibration.references.gravity.pose_solver import NormSquares, first_state
from imu_calibration.references.gravity.poses import ATTITUDES_APART
from imu_calibration.references.rows.group_variances import student_factor

OFF_AXIS = 0.15
"""
Product of two components of the unit vector of gravity from which a rest tests the cross term of
these axes: 9 deg from both axes. Faces within 3 deg have 0.05.
"""
LEAST_PLACEMENTS = 2
"""Fewest placements off the axes: one can be held out."""
TESTING_TURNS = 4
"""Fewest turns between different attitudes that test the angles between axes."""
FEWEST_SPARE = 3
"""Degrees of freedom of the placements that a likelihood ratio needs."""
DEMANDED = 0.01
"""
p-value of the likelihood ratio below which the placements demand the cross terms, also without any
one of them. Of 268 generated boards without cross terms (normal and heavy-tailed errors of
placements) none demands them, with a wandering bias 3 %, up to 2.3 sd wrong; of 134 boards with 1
to 5 deg, 45 % do, up to 3.1 sd wrong.
"""
PLACEMENT_STEPS = 8
"""Gauss-Newton steps of a fit of the placements."""
PLACEMENT_HALVINGS = 3
"""Largest number of times that a step is halved which does not lower the errors."""
TURNS_CONTRADICT = 3.84
"""Increase of ``n log(mean square)`` of turns by which they contradict the cross terms."""


def directions(model: HandModel, poses: Poses) -> np.ndarray:
    """
    Return the direction of gravity in each pose, unit vectors, shape (k, 3).

    They are computed with cross terms at their prior: estimated ones, if wrong, would turn them.
    """
    return first_state(replace(model, held_terms=CROSS_TERMS), poses).up


def off_axis_lacking(up: np.ndarray) -> tuple[str, ...]:
    """
    Return the cross terms for which too few placements are off the axes of the sensor.

    Parameters
    ----------
    up : array, shape (k, 3)
        Direction of gravity in each pose, with cross terms at their prior (`directions`).

    """
    first = placements(up)
    lacking = []
    for name in CROSS_TERMS:
        i, j = (AXES.index(axis) for axis in name[-2:])  # the name ends in two axes, as 'yx'
        if np.count_nonzero(np.abs(up[first, i] * up[first, j]) >= OFF_AXIS) < LEAST_PLACEMENTS:
            lacking.append(name)
    return tuple(lacking)


@dataclass(frozen=True, eq=False)
class PlacementFit:
    """
    The accelerometer fitted to the mean reading of each placement, which is one observation.

    The rests of a placement have the same error: they count once.
    """

    index: np.ndarray
    """Estimated parameters, indices of shape (m,)."""
    values: np.ndarray
    """All parameters, shape (n_params,), SI."""
    squares: float
    """Sum of squared errors of the norm, (m/s^2)^2."""
    spare: int
    """Degrees of freedom of the errors."""
    covariance: np.ndarray | None
    """Covariance of the estimated parameters, shape (m, m), SI; None with too few placements."""

    def demands(self, held: 'PlacementFit') -> bool:
        """Return whether an F test prefers this fit to `held`, which has fewer parameters."""
        n_additional = held.spare - self.spare
        if self.spare < FEWEST_SPARE or n_additional <= 0 or self.squares <= 0.0:
            return False
        gain = max(held.squares - self.squares, 0.0)
        ratio = (gain / n_additional) / (self.squares / self.spare)
        return bool(f_sf(ratio, n_additional, self.spare) < DEMANDED)


class _PlacementSquares(NormSquares):
    """The norms of placements without priors."""

    def step(self, values: np.ndarray) -> np.ndarray:
        """Return the step of the estimated parameters."""
        errors, columns = self.rows(values)
        return np.linalg.lstsq(columns, errors, rcond=1e-9)[0]

    def moved(self, values: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Return the values after the longest share of a step that does not raise the errors."""
        return halved(self, values, step, n_halvings=PLACEMENT_HALVINGS)

    def after(self, values: np.ndarray, step: np.ndarray, share: float) -> np.ndarray:
        """Return the values after a share of a step."""
        return super().moved(values, share * step)

    def is_last(self, values: np.ndarray, step: np.ndarray) -> bool:
        """Return whether a step is lost in rounding: the next ones would be the same."""
        return bool(np.all(values[self.index] + step == values[self.index]))


def fit_placements(
    model: HandModel, values: np.ndarray, poses: Poses, *, up: np.ndarray, used: np.ndarray
) -> PlacementFit:
    """
    Return the fit of bias, matrix and further effects of the accelerometer to the placements.

    Parameters
    ----------
    model : HandModel
        Its `held` parameters are not estimated.
    values : array, shape (n_params,)
        Start of the iteration.
    poses : Poses
        Mean readings of the k poses.
    up : array, shape (k, 3)
        Direction of gravity in each pose, with cross terms at their prior (`directions`).
    used : array of bool, shape (k,)
        Poses that are fitted; False for outliers.

    """
    # Means of readings, times and temperatures over the rests of each placement.
    first = placements(up[used])
    n_rests = np.diff(np.append(first, np.count_nonzero(used)))
    force = np.add.reduceat(poses.force[used], first, axis=0) / n_rests[:, None]
    conditions = {}
    for name, condition in poses.conditions.items():
        if condition is not None:
            conditions[name] = np.add.reduceat(condition[used], first) / n_rests

    # Gauss-Newton steps, since the norm is not linear in the parameters: a cross term c also
    # changes it by ``g c^2 / 2``, 0.1 m/s^2 for 0.15.
    index = np.concatenate([model.base_index('accelerometer'), model.extra_index('accelerometer')])
    index = index[~model.always_held[index]]
    values = values.copy()
    values[model.always_held] = model.nominal[model.always_held]
    squares = _PlacementSquares(model, force, conditions, index)
    values = gauss_newton(squares, values, n_steps=PLACEMENT_STEPS)

    # Variance of a placement from the errors. Few of them estimate it poorly, so that it is
    # widened by the factor of Student's t.
    errors, columns = squares.rows(values)
    sum_of_squares = float(errors @ errors)
    rank = int(np.linalg.matrix_rank(columns))
    spare = len(errors) - rank
    covariance = None
    if spare >= FEWEST_SPARE and rank == len(index):
        information = columns.T @ columns
        variance = float(student_factor(np.array([spare]))[0]) * sum_of_squares / spare
        covariance = variance * np.linalg.inv(information)
    return PlacementFit(
        index=index, values=values, squares=sum_of_squares, spare=spare, covariance=covariance
    )


def placements_demand(
    free: HandModel, held: HandModel, poses: Poses, *, up: np.ndarray, used: np.ndarray
) -> bool:
    """
    Return whether the norms demand the cross terms, whichever placement is left out.

    Parameters
    ----------
    free, held : HandModel
        Models with estimated cross terms, and with cross terms at their prior.
    poses : Poses
    up, used : array
        As for `fit_placements`.

    """
    free_fit = fit_placements(free, free.nominal, poses, up=up, used=used)
    held_fit = fit_placements(held, held.nominal, poses, up=up, used=used)
    if free_fit.spare <= FEWEST_SPARE or not free_fit.demands(held_fit):
        return False
    # One wrong placement imitates cross terms: the result must not depend on any single one.
    placement = np.searchsorted(placements(up), np.arange(len(up)), side='right')
    for omitted in np.unique(placement[used]):
        kept = used & (placement != omitted)
        free_without = fit_placements(free, free_fit.values, poses, up=up, used=kept)
        held_without = fit_placements(held, held_fit.values, poses, up=up, used=kept)
        if not free_without.demands(held_without):
            return False
    return True


def turns_between(up: np.ndarray, turns: Sequence[TurnData]) -> list[TurnData]:
    """Return the turns between different attitudes, which test the angles between axes."""
    largest_cosine = np.cos(ATTITUDES_APART)
    testing_turns = []
    for turn in turns:
        if turn.rotation is None and up[turn.first] @ up[turn.last] < largest_cosine:
            testing_turns.append(turn)
    return testing_turns


def contradicted_by_turns(free: np.ndarray, held: np.ndarray) -> bool:
    """
    Return whether turns contradict the cross terms: ``n log(mean square)`` is larger with them.

    Parameters
    ----------
    free, held : array, shape (n,)
        Angle errors of the turns with estimated cross terms, and with cross terms at their prior.

    """
    increase = len(free) * np.log(np.mean(free**2) / np.mean(held**2))
    return bool(increase > TURNS_CONTRADICT)
