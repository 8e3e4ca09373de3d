"""Held-out data of a reference, with the errors of any parameters on them."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Generic

import numpy as np

from imu_calibration.calibration.from_solution import Estimate
from imu_calibration.effects.forward_equations import Centre, applied_values
from imu_calibration.estimation.solution import Solution

HARDLY_WORSE = 1.02
"""
Error on held-out data, relative to that of the solution, up to which a plain fit is applied: an
unexplained residual differs in other sessions, so that the solution has to be better by more.
"""


@dataclass(frozen=True, eq=False)
class HeldOutErrors:
    """Errors of one sensor on held-out data with one set of parameters for each fold."""

    squares: np.ndarray
    """Sum of squared errors by block and regime, shape (n_blocks, n_regimes)."""
    delay: float | None = None
    """Delay of the readings in addition to these parameters, s; None where it is not estimated."""
    without_delay: float | None = None
    """Sum of squared errors without an estimate of the delay."""


def errors_of_rows(errors: np.ndarray) -> HeldOutErrors:
    """Return errors of shape (n, components), each row of which is a block."""
    return HeldOutErrors((errors**2).sum(axis=1, keepdims=True))


@dataclass(frozen=True, eq=False)
class JudgedData:
    """The held-out data of one sensor, in blocks that have independent errors."""

    counts: np.ndarray
    """Number of errors per component by block and regime, shape (n_blocks, n_regimes)."""
    unit: str
    """Unit of the errors."""
    windows: int
    """Number of windows, poses or turns."""
    components: int
    """Number of components of an error."""
    regimes: tuple[str, ...] = ()
    """Regimes of motion, in the order of the columns of `counts`; empty: not told apart."""
    piece_time: float | None = None
    """Length of the data behind an error, s; None where poses or turns are counted."""
    one_attitude: bool = False
    """`ProofEntry.one_attitude`."""
    few_directions: bool = False
    """`ProofEntry.few_directions`."""

    def rms(self, errors: HeldOutErrors) -> float:
        """Return the rms error per component."""
        of_blocks = errors.squares.sum(axis=1)
        return float(np.sqrt(of_blocks.sum() / (self.components * self.counts.sum())))


@dataclass(frozen=True, eq=False)
class PlainEstimate:
    """Bias and matrix of one sensor by least squares, its further effects at their prior."""

    replaced: np.ndarray
    """True for the parameters that the fit replaces in a solution, shape (n_params,)."""
    fitted: np.ndarray
    """True for the parameters that the fit estimates, shape (n_params,)."""
    dropped: tuple[str, ...]
    """Names of the effects that are at their prior in the fit."""
    values: np.ndarray
    """Parameters from all data, shape (n_params,); of use where `replaced`."""
    folds: list[np.ndarray]
    """Parameters without the data of each fold, each shape (n_params,)."""


@dataclass(frozen=True, eq=False)
class PlainEquations(ABC):
    """Equations of bias and matrix of one sensor, for blocks of windows or poses."""

    n_steps: ClassVar[int] = 1
    """Number of steps to the estimate from all data; 1 for linear equations."""
    plan: PlainEstimate
    """The parameters that are estimated, with their start values."""

    @abstractmethod
    def moved(self, values: np.ndarray, kept: np.ndarray) -> np.ndarray:
        """Return the parameters after a step with the blocks or poses of a mask."""

    def estimate(self, masks: Sequence[np.ndarray]) -> PlainEstimate:
        """Return the estimate from all data, and one step from it without the data of each mask."""
        values = self.plan.values
        for _ in range(self.n_steps):
            values = self.moved(values, np.ones_like(masks[0]))
        return replace(self.plan, values=values, folds=[self.moved(values, ~out) for out in masks])


@dataclass(frozen=True, eq=False)
class PlainFit:
    """A plain estimate, and the errors with which it and a solution predict held-out data."""

    sensor: str
    """The sensor."""
    estimate: PlainEstimate
    """Bias and matrix of the sensor."""
    error: float
    """Rms error of the plain estimate on held-out data, in `unit`."""
    error_of_solution: float
    """Rms error of the solution on the same data."""
    unit: str
    """Unit of both errors."""

    @property
    def is_close(self) -> bool:
        """Whether the plain fit is better than the solution, or hardly worse."""
        return self.error < HARDLY_WORSE * self.error_of_solution

    @property
    def is_better(self) -> bool:
        """Whether the solution predicts the data worse than the plain fit."""
        return self.error_of_solution > HARDLY_WORSE * self.error

    def merged(self, folds: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return parameters of folds with those of the fit."""
        merged = []
        for values, fitted in zip(folds, self.estimate.folds, strict=True):
            merged.append(np.where(self.estimate.replaced, fitted, values))
        return merged


@dataclass(frozen=True, eq=False)
class HeldOutData(ABC, Generic[Estimate]):
    """Data in folds; each fold is predicted with parameters that were estimated without it."""

    solution: Estimate
    """The solution of all data."""
    folds: list[np.ndarray]
    """
    Parameters without each fold, as compensation applies them (`applied_values`), each shape
    (n_params,).
    """
    masks: Sequence[np.ndarray]
    """True for the blocks, poses or other parts of the data in each fold, each shape (n_parts,)."""

    @property
    @abstractmethod
    def judged(self) -> Mapping[str, JudgedData]:
        """Sensor -> its held-out data; a sensor with too few data is left out."""

    @abstractmethod
    def errors(self, sensor: str, folds: Sequence[np.ndarray]) -> HeldOutErrors:
        """Return the errors of the judged data of a sensor with parameters for each fold."""

    @abstractmethod
    def nominal(self, sensor: str, folds: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return parameters of folds with those of the data sheet for a sensor."""

    def descriptions(self, folds: Sequence[np.ndarray]) -> Iterator[Sequence[np.ndarray]]:
        """Yield the parameters with the reference as estimated and as described."""
        yield folds

    @abstractmethod
    def plain_equations(self, sensor: str, applied: np.ndarray) -> Iterator[PlainEquations]:
        """
        Yield the equations of a plain fit of a sensor, those with the reference as described first.

        A reference that yields none has no plain fits. `applied`: parameters of the solution and of
        plain fits of other sensors, shape (n_params,).
        """

    @abstractmethod
    def fits_elsewhere(
        self, sensor: str, estimate: PlainEstimate, applied: np.ndarray
    ) -> Iterator[PlainFit]:
        """
        Yield plain fits with the errors on complete regimes, or parts of the session, held out.

        `estimate`: the plain estimate of the sensor; `applied` as for `plain_equations`.
        """


def masks_in_turn(n_parts: int, n_folds: int) -> list[np.ndarray]:
    """Return the mask of each fold; parts are assigned to folds in turn."""
    number = np.arange(n_parts)
    return [number % n_folds == fold for fold in range(n_folds)]


def applied_folds(
    solution: Solution, without: Iterable[np.ndarray], centre: Centre
) -> list[np.ndarray]:
    """Return the parameters `without` each fold as compensation applies them."""
    return [
        applied_values(solution.model, values, centre, absent=solution.absent) for values in without
    ]
