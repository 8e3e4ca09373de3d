"""Windows distributed over blocks, at constant memory: sums of each fold, and its prediction from the remaining folds."""

from dataclasses import dataclass, field

import numpy as np

from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.accumulator import Accumulator, restrict, selected_columns, stack
from imu_calibration.estimation.pieces import AXES, count_pieces
from imu_calibration.estimation.prior import fixed_parameters, make_prior
from imu_calibration.estimation.scaled_solve import scaled_lstsq
from imu_calibration.estimation.solution import Solution
from imu_calibration.estimation.triangular import triangular
from imu_calibration.estimation.weighted_system import WeightedSystem
from imu_calibration.estimation.window_statistics import WindowStatistics

FOLDS = 8
"""Folds of the cross-validation."""
BLOCKS = 3 * FOLDS
"""Blocks that are resampled for an interval; block k belongs to fold k modulo FOLDS."""


@dataclass(eq=False)
class HeldOutBlock:
    """Every so many-th window of each kind."""

    accumulator: Accumulator = field(default_factory=lambda: Accumulator(in_blocks=False, share=BLOCKS))
    """For fitting."""
    pieces: dict[tuple[str, str], np.ndarray] = field(default_factory=dict)
    """(sensor, regime) -> triangular factor of the rows of short pieces, for judging."""
    counts: dict[str, int] = field(default_factory=dict)
    """Regime -> number of pieces."""
    judged: int = 0
    """Windows with kept pieces."""

    def add(self, window: WindowStatistics, judged: bool = True) -> None:
        """Add a window, and its pieces if it is judged."""
        self.accumulator.add(window)
        if not judged:
            return
        self.judged += 1
        for sensor in SENSORS:
            for regime, rows in window.pieces[sensor].items():
                stack(self.pieces, (sensor, regime), rows if len(rows) <= rows.shape[1] else triangular(rows))
        for regime, rows in window.pieces[SENSORS[0]].items():
            count = count_pieces(window.duration) if window.kind == 'static' else len(rows)
            self.counts[regime] = self.counts.get(regime, 0) + count

    def merge(self, other: 'HeldOutBlock') -> None:
        """Add the content of another block."""
        self.accumulator.merge(other.accumulator)
        for key, factor in other.pieces.items():
            stack(self.pieces, key, factor)
        for regime, count in other.counts.items():
            self.counts[regime] = self.counts.get(regime, 0) + count
        self.judged += other.judged

    def copy(self) -> 'HeldOutBlock':
        """Return an independent copy."""
        return HeldOutBlock(self.accumulator.copy(), dict(self.pieces), dict(self.counts), self.judged)

    def restricted(self, wide: SensorModel, narrow: SensorModel) -> 'HeldOutBlock':
        """Return the block with the columns of the model `narrow` only."""
        chosen = {sensor: np.concatenate([columns[:-AXES], np.arange(-2 * AXES, 0)])
                  for sensor, columns in selected_columns(wide, narrow).items()}
        return HeldOutBlock(restrict(self.accumulator, wide, narrow), {key: rows[:, chosen[key[0]]] for key, rows in self.pieces.items()},
                            self.counts, self.judged)


@dataclass(eq=False)
class HeldOut:
    """
    Blocks of windows.

    Undivided windows of each kind are assigned to blocks in turn, so that every block has windows of each kind, and memory does not grow
    with the session.
    """

    blocks: list[HeldOutBlock] = field(default_factory=lambda: [HeldOutBlock() for _ in range(BLOCKS)])

    def add(self, window: WindowStatistics, judged: bool = True) -> None:
        """Add a window, and its pieces if it is judged."""
        dealt = sum(block.accumulator.windows.get(window.kind, 0) for block in self.blocks)
        self.blocks[dealt % BLOCKS].add(window, judged)

    def merge(self, other: 'HeldOut') -> None:
        """Add the content of another object; its windows follow the existing ones."""
        for mine, its in zip(self.blocks, other.blocks):
            mine.merge(its)

    def copy(self) -> 'HeldOut':
        """Return an independent copy."""
        return HeldOut([block.copy() for block in self.blocks])

    def restricted(self, wide: SensorModel, narrow: SensorModel) -> 'HeldOut':
        """Return the same with the columns of the model `narrow` only."""
        return self if wide is narrow else HeldOut([block.restricted(wide, narrow) for block in self.blocks])

    @property
    def n_windows(self) -> int:
        """Windows dealt out."""
        return sum(sum(block.accumulator.windows.values()) for block in self.blocks)

    @property
    def n_judged(self) -> int:
        """Windows with kept pieces."""
        return sum(block.judged for block in self.blocks)

    def values_without(self, solution: Solution) -> list[np.ndarray]:
        """
        Return the parameters without each fold: one Gauss-Newton step from the solution, on the rows of the remaining folds.

        Noise and held parameters are those of the solution; a parameter that only the fold determines is set to its prior.
        """
        model, prior, values = solution.model, make_prior(solution.model), solution.values
        free = ~fixed_parameters(model) & ~solution.held
        parts = [_linearised(self.blocks[fold::FOLDS], solution, prior) for fold in range(FOLDS)]
        known = np.column_stack([prior.root, prior.root @ (values - prior.mean)])
        found = []
        for fold in range(FOLDS):
            rows = np.concatenate([known, *(part for k, part in enumerate(parts) if k != fold)])
            moved = values.copy()
            moved[free] -= scaled_lstsq(rows[:, :-1][:, free], rows[:, -1])
            found.append(moved)
        return found


def _linearised(blocks, solution, prior):
    """Return the triangular factor of ``[derivative of the residuals | residuals]`` of all windows of some blocks, weighed by noise."""
    n_params, rows = len(solution.values), []
    for block in blocks:
        if block.accumulator.rows:
            system = WeightedSystem(block.accumulator, solution.model, prior)
            factors = {sensor: system.factors(sensor, solution.noise[sensor]) for sensor in SENSORS}
            residuals = system.residuals(solution.values, factors)[:-len(prior.root)]
            rows.append(np.column_stack([system.jacobian(solution.values, factors), residuals]))
    return triangular(np.concatenate(rows)) if rows else np.zeros((0, n_params + 1))
