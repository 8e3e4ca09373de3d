"""
A third reference: poses of motion capture.

The rotation of the IMU over blocks of a second is that between the poses at their ends. All that an
estimate, a search, a proof and a document need of it is here; the engine is the one of a table and
of gravity.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from imu_calibration.calibration.calibrate import conclude
from imu_calibration.calibration.from_solution import ModelChanges, ModelExtension
from imu_calibration.calibration.gathered_data import GatheredData
from imu_calibration.calibration.held_out_data import (
    HeldOutData,
    JudgedData,
    errors_of_rows,
    masks_in_turn,
)
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.result import Needs
from imu_calibration.calibration.solved import Solved
from imu_calibration.document.statistics import RecordingStatistics, SensorEntry
from imu_calibration.document.trust import Uncorrected
from imu_calibration.effects.base import Role
from imu_calibration.effects.forward_equations import output_of_effects
from imu_calibration.effects.sensor_model import BASE, SensorModel
from imu_calibration.estimation.rows import Rows, flat
from imu_calibration.estimation.sensor_noise import SensorNoise
from imu_calibration.estimation.solution import Solution
from imu_calibration.kinematics.rotations import Reference
from imu_calibration.kinematics.strapdown import integrate_turn, small_rotation
from imu_calibration.references.rows.row_estimate import estimate_rows
from imu_calibration.references.rows.row_search import RowProblem, choose_effects
from imu_calibration.references.rows.scalar_rows import scalar_rows
from imu_calibration.selection.questions import Question

BLOCK = 1.0
"""Length of a block, s."""
LARGEST_STEPS = (0.03, 0.05)
"""Largest steps of the reference and of the IMU at a block, s."""
MARGIN = 0.1
"""Distance of blocks from the ends of the recording, s."""
READING_SD = 1e-6
"""Known noise of a rotation, rad; the scatter beyond it is estimated."""
ATTITUDE_SD = np.radians(0.2)
"""Usual noise of the attitude, rad."""
FOLDS = 4
"""Number of held-out parts."""
ABSENT = ('accelerometer',)
"""Poses determine the gyroscope here."""
CANDIDATES = ('gyro_scale_asymmetry', 'gyro_quadratic', 'gyro_rate_product')
"""Effects that rotations of blocks show."""


@dataclass(frozen=True, eq=False)
class PoseBlocks:
    """What is gathered: readings, and rotations of blocks by the poses (`Observations`)."""

    time: np.ndarray
    """Seconds since the first sample, shape (n,)."""
    rate: np.ndarray
    """Readings, rad/s, shape (n, 3)."""
    poses: Slerp
    """Attitudes of the body in the room, interpolated."""
    turns: dict = field(default_factory=dict)
    """(effects, values) -> rotations of the blocks by the readings, see `PoseRows.turns`."""

    unit: ClassVar[str] = 'windows'
    reference: ClassVar[str] = 'poses of motion capture'
    gravity: ClassVar[float] = 9.81
    absent: ClassVar[tuple[str, ...]] = ABSENT
    tested: ClassVar[tuple[str, ...]] = ()

    @cached_property
    def blocks(self):
        """(samples, rotation by the poses) of each block without a gap."""
        known, found = self.poses.times, []
        start, end = max(self.time[0], known[0]) + MARGIN, min(self.time[-1], known[-1]) - MARGIN
        edges = np.searchsorted(self.time, np.arange(start, end, BLOCK))
        for block in map(slice, edges, edges[1:] + 1):
            ends = self.time[[block.start, block.stop - 1]]
            near = np.searchsorted(known, ends)
            steps = (known[near] - known[near - 1]).max(), np.diff(self.time[block]).max()
            if np.all(np.array(steps) <= LARGEST_STEPS):
                first, last = self.poses(ends).as_matrix()
                found.append((block, last.T @ first))
        return found

    @property
    def period(self):
        return float(np.median(np.diff(self.time)))

    @property
    def gathered(self):
        end = int(1e9 * self.time[-1])
        largest = float(np.linalg.norm(self.rate, axis=1).max())
        return GatheredData(first_stamp_ns=0, last_stamp_ns=end, largest_rate=largest)

    def gauge(self, solution):
        return {'origin': 'sensor', 'axes': 'body of the poses'}

    def findings(self, solution):
        return ()

    def with_reference_errors(self, solution):
        return solution

    def uncorrected(self, solution):
        return Uncorrected()

    def statistics(self, solution):
        noise_sd = [float(value) for value in solution.noise['gyroscope'].white_sd]
        windows = {'blocks': len(self.blocks)}
        sensors = {'gyroscope': SensorEntry(noise_sd=noise_sd)}
        return RecordingStatistics(sensors=sensors, windows=windows, dropped={})

    def needs(self, solution, tolerances, *, quality):
        return Needs({}, ())

    def held_out(self, solution):
        return HeldOutBlocks.of(self, solution)


@dataclass(frozen=True, eq=False)
class PoseState:
    """Parameters, and the nuisance of all blocks."""

    values: np.ndarray
    """Parameters of both sensors, shape (n,)."""
    lag: float = 0.0
    """Delay of the poses, s."""


@dataclass(frozen=True, eq=False)
class PoseRows:
    """Rows of the rotations: ``mat_ref = exp(-[psi]) mat(values)``, three of psi for each block."""

    data: PoseBlocks
    model: SensorModel
    left_out: np.ndarray | None = None
    """Mask of blocks without weight."""

    @cached_property
    def nominal(self):
        return np.nan_to_num(self.model.prior()[0])

    @cached_property
    def priors(self):
        """Those of the model, wide for bias and matrix: any sensor, in any units."""
        sd = self.model.prior()[1].copy()
        sd[self.model.part('gyroscope', Role.OFFSET)] = 0.2
        sd[self.model.part('gyroscope', Role.LINEAR)] = 0.3
        return sd

    @cached_property
    def fixed(self):
        return np.char.startswith(self.model.param_names, ABSENT[0])

    def moved(self, state, step):
        return PoseState(state.values + step[1:], state.lag + step[0])

    def turns(self, values):
        """
        Return (first rate, last rate, turn) of each block at parameters.

        They are remembered: the search and all folds begin at the same ones.
        """
        model = self.model
        effects = [effect for effect in model.further if effect.sensor == 'gyroscope']
        key = tuple(effect.name for effect in effects), values.tobytes()
        if key in self.data.turns:
            return self.data.turns[key]
        bias = values[model.part('gyroscope', Role.OFFSET)]
        matrix = values[model.part('gyroscope', Role.LINEAR)].reshape(3, 3)
        found = []
        for block, _ in self.data.blocks:
            time, rate = self.data.time[block], self.data.rate[block]
            true = np.linalg.solve(matrix, (rate - bias).T).T
            further = None
            if effects:
                further = output_of_effects(effects, model, values, ref=still(time, true))
            turn = integrate_turn(time, rate, bias=bias, matrix=matrix, further=further)
            found.append((true[0], true[-1], turn))
        self.data.turns[key] = found
        return found

    def linearise(self, state):
        own = ~self.fixed
        residual, late_columns, main = [], [], []
        turns = self.turns(state.values)
        for (_, mat_ref), (first, last, turn) in zip(self.data.blocks, turns, strict=True):
            late = (
                small_rotation(state.lag * last) @ turn.mat_ji @ small_rotation(-state.lag * first)
            )
            residual.append(-Rotation.from_matrix(mat_ref @ late.T).as_rotvec())
            late_columns.append((late @ first - last)[:, None])
            rows = np.zeros((3, len(own)))
            rows[:, own] = np.hstack([turn.by_bias, turn.by_matrix.reshape(3, 9), turn.by_further])
            main.append(rows)
        count = len(residual)
        noise = np.full((count, 3), READING_SD**2)
        if self.left_out is not None:
            noise[self.left_out] = 1e6
        return scalar_rows(
            np.concatenate(late_columns),
            np.concatenate(main),
            np.concatenate(residual),
            variance=noise.ravel(),
            component=np.zeros(3 * count, int),
            group=np.repeat(np.arange(count), 3),
        )


def still(time, rate):
    """Return a motion with these rates for the columns of effects of the gyroscope."""
    zero = np.zeros_like(rate)
    return Reference(time, np.zeros((len(time), 3, 3)), zero, rate, zero, 9.81)


def solve(data, model, left_out=None):
    """Return the solution of a model, and where it was linearised."""
    reference = PoseRows(data, model, left_out)
    start = PoseState(reference.nominal)
    found = estimate_rows(reference, start, fallback=np.array([ATTITUDE_SD**2]))
    sd = np.sqrt(found.scatter.variance[0])
    noise = SensorNoise(np.full(3, sd**2), np.ones(3))
    solution = Solution(
        model,
        found.state.values,
        found.terms,
        found.held | reference.fixed,
        {sensor: noise for sensor in ('accelerometer', 'gyroscope')},
        {'gyroscope': {}, 'accelerometer': {}},
        found.factor.T @ found.factor,
        {},
    )
    return solution, found.state


@dataclass(frozen=True, eq=False)
class HeldOutBlocks(HeldOutData):
    """Blocks in folds, each predicted without it."""

    data: PoseBlocks
    lags: list[float]
    """Delay of the poses, estimated without each fold, s."""

    @classmethod
    def of(cls, data, solution):
        masks = masks_in_turn(len(data.blocks), FOLDS)
        folds, lags = [], []
        for out in masks:
            without, state = solve(data, solution.model, out)
            folds.append(without.values)
            lags.append(state.lag)
        return cls(solution, folds, masks, data, lags)

    @property
    def judged(self):
        n = len(self.data.blocks)
        return {'gyroscope': JudgedData(np.ones((n, 1)), 'rad', n, 3, piece_time=BLOCK)}

    def errors(self, sensor, folds):
        """Return the rotations that are missed."""
        rows = PoseRows(self.data, self.solution.model)
        errors = np.zeros((len(self.data.blocks), 3))
        for out, values, lag in zip(self.masks, folds, self.lags):
            missed = rows.linearise(PoseState(values, lag)).residual.reshape(-1, 3)
            errors[out] = missed[out]
        return errors_of_rows(errors)

    def nominal(self, sensor, folds):
        return [PoseRows(self.data, self.solution.model).nominal] * FOLDS

    def plain_equations(self, sensor, applied):
        yield from ()

    def fits_elsewhere(self, sensor, estimate, applied):
        yield from ()


def select(data, solution, state):
    """Return the effects that the rotations support beyond bias and matrix."""
    wide = solution.model
    for name in CANDIDATES:
        wide = wide.with_effect('gyroscope', name)
    values = wide.start_from(solution.model, solution.values)
    rows = PoseRows(data, wide).linearise(replace(state, values=values))
    own = np.flatnonzero(~PoseRows(data, wide).fixed)
    columns = np.column_stack([rows.columns[:, own], flat(rows.equations)[:, [0, -1]]])
    count = len(data.blocks)
    known = np.full((count, 3), solution.noise['gyroscope'].white_variance)
    block = Rows(
        name='blocks',
        sensor='gyroscope',
        equations=columns.reshape(count, 3, -1) / BLOCK,
        variance=known / BLOCK**2,
        group=np.arange(count),
        time=np.array([data.time[part].mean() for part, _ in data.blocks]),
    )
    # Places of the parameters in the columns: bias, matrix, effects, and last the lag.
    place = {int(index): column for column, index in enumerate(own)}
    lag = len(own)
    prior_sd = np.append(PoseRows(data, wide).priors[own], 1.0)
    questions = []
    for name in CANDIDATES:
        part = wide.slices['gyroscope', name]
        columns_of = tuple(place[index] for index in range(part.start, part.stop))
        effect = next(effect for effect in wide.effects if effect.name == name)
        questions.append(Question(effect, columns_of, len(columns_of), name))
    of_effects = set()
    for question in questions:
        of_effects.update(question.parameters)
    base = [column for column in range(lag) if column not in of_effects]
    prior_sd[base] *= 1e3
    return choose_effects(RowProblem([block], prior_sd, questions, baseline=(*base, lag)))


def calibrate(data, options=CalibrationOptions()):
    """Return the result of a calibration against poses, with the effects that they support."""
    asked = SensorModel(BASE, BASE)
    solution, state = solve(data, asked)
    chosen = select(data, solution, state)
    model = asked
    for question in chosen.named:
        model = model.with_effect('gyroscope', question.name)
    if chosen.named:
        solution, state = solve(data, model)
    changes = ModelChanges(added=tuple(question.name for question in chosen.named))
    return conclude(Solved(solution, data, ModelExtension(changes=changes), chosen), options)
