"""Gauss-Newton iteration, for the least squares of any reference."""

from typing import Protocol, TypeVar

import numpy as np

from imu_calibration.estimation.scaled_solve import scaled_lstsq

StateT = TypeVar('StateT')
StepT = TypeVar('StepT')
TakenStepT = TypeVar('TakenStepT', contravariant=True)

RISE = 1e-12
"""Rise of a cost that is rounding, relative and absolute."""


class LeastSquares(Protocol[StateT, StepT]):
    """A sum of squares as a function of a state: parameters, maybe with nuisances."""

    def step(self, state: StateT) -> StepT:
        """Return the step to the minimum of the sum that is linearised at a state."""

    def moved(self, state: StateT, step: StepT) -> StateT:
        """Return the state after a step."""

    def is_last(self, state: StateT, step: StepT) -> bool:
        """Return whether a step, which led to a state, is small enough to be the last one."""


class DampedLeastSquares(Protocol[StateT, TakenStepT]):
    """A sum of squares of which a part of a step may be taken."""

    def after(self, state: StateT, step: TakenStepT, share: float) -> StateT:
        """Return the state after a share of a step."""

    def cost(self, state: StateT) -> float:
        """Return the sum of squares of a state."""


def gauss_newton(problem: LeastSquares[StateT, StepT], state: StateT, *, n_steps: int) -> StateT:
    """
    Return the state of least cost, after at most `n_steps` steps from a state.

    Each step solves the problem that is linearised at the state before it.
    """
    for _ in range(n_steps):
        step = problem.step(state)
        state = problem.moved(state, step)
        if problem.is_last(state, step):
            break
    return state


def halved(
    problem: DampedLeastSquares[StateT, StepT], state: StateT, step: StepT, *, n_halvings: int
) -> StateT:
    """
    Return the state after the longest share of a step that does not raise the cost.

    The shares are 1, 1/2, 1/4 and so on, halved at most `n_halvings` times; the state itself is
    returned if each raises the cost.
    """
    limit = problem.cost(state) * (1 + RISE) + RISE
    for number in range(n_halvings + 1):
        shorter = problem.after(state, step, 0.5**number)
        if problem.cost(shorter) <= limit:
            return shorter
    return state


def after_one_step(
    values: np.ndarray, design: np.ndarray, misfit: np.ndarray, *, free: np.ndarray
) -> np.ndarray:
    """
    Return the values after one step, which is exact where the rows are linear.

    Parameters
    ----------
    values : array, shape (n,)
        Where the rows are linearised.
    design, misfit : array, shape (m, n_free) and (m,)
        ``misfit = design @ change + error`` in standard deviations, measured minus predicted.
    free : array of bool, shape (n,)
        Parameters that move.

    """
    moved = values.copy()
    moved[free] += scaled_lstsq(design, misfit)
    return moved
