"""
Evidence from a recording without a table.

Norms of gravity in poses, rates at rest, directions after turns, and their residual.

Poses are few, so that variances are estimated too and every pose is held out in turn.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from imu_calibration.core.distributions import f_sf
from imu_calibration.core.samples import AlignedArrays
from imu_calibration.effects.base import AXES, SENSORS, Effect
from imu_calibration.effects.sensor_model import BASE
from imu_calibration.estimation.noise_likelihood import NoiseLikelihood
from imu_calibration.estimation.noise_model import BiasProcess
from imu_calibration.estimation.noise_search import NATURAL
from imu_calibration.estimation.whitening import Whitening
from imu_calibration.kinematics.rotations import skew
from imu_calibration.kinematics.strapdown import integrate_turn
from imu_calibration.references.gravity.bias_movement import orthonormal_basis
from imu_calibration.references.gravity.equations import Poses, TurnData, between_middles, tangent
from imu_calibration.references.gravity.g_sensitivity import EARTH_UPWARDS_SD
from imu_calibration.references.gravity.hand_calibration import HandCalibration
from imu_calibration.references.gravity.hand_parameters import HandModel
from imu_calibration.selection.evidence import Evidence
from imu_calibration.selection.regime_variables import Variable, ranged
from imu_calibration.selection.regimes import (
    REGIME_LEVEL,
    AxisResidual,
    RegimeSearch,
    RestRegime,
    exchanges,
)
from imu_calibration.selection.residual_blocks import largest_axes
from imu_calibration.selection.unexplained import (
    MIN_EXPLAINED_WINDOWS,
    SIGNIFICANT_SDS,
    Unexplained,
    correlate,
    slow_explanations,
)


@dataclass(frozen=True, eq=False)
class Block(AlignedArrays):
    """
    Rows of one kind, ``residual = columns @ parameters + error``, in the unit of their sensor.
    """

    name: str
    """'poses' or 'turns'."""
    sensor: str
    """'accelerometer' or 'gyroscope'."""
    rows: np.ndarray
    """
    ``[columns | residual]`` at the baseline, shape (m, n_axes, q + 1); different axes have
    independent errors.
    """
    known: np.ndarray
    """Variance by the noise of the samples, shape (m, n_axes)."""
    floor: np.ndarray
    """The same plus the usual bias drift, shape (m, n_axes)."""
    pose: np.ndarray
    """Pose of each row (of a turn: the pose before it), shape (m,)."""
    time: np.ndarray
    """Seconds since the first sample, shape (m,)."""
    duration: np.ndarray | None = None
    """Of each turn, s, shape (m,): residuals of turns times it are angles; None for poses."""


@dataclass(frozen=True, eq=False)
class HandSpace:
    """
    Parameters of a diagnosis by hand.

    Baseline, Earth's rate about the vertical, then one run per column set.
    """

    parts: dict
    """
    Label of each run of columns (effect name, for a warm-up with the number of its time constant)
    -> slice.
    """
    prior_sd: np.ndarray
    """Shape (q,); wide for the baseline, which is linearised at its own solution."""
    size: int
    """Number of parameters."""


def build_rows(
    hand: HandCalibration,
    turns: Sequence[TurnData],
    effects: Sequence[Effect],
    *,
    constants: np.ndarray,
) -> tuple[list[Block], HandSpace]:
    """
    Return (blocks, HandSpace).

    Parameters
    ----------
    hand : HandCalibration
        Of the baseline.
    turns : list of TurnData
        Between consecutive poses.
    effects : sequence of Effect
        Effects under test.
    constants : array
        Time constants of warm-ups under test, s.

    """
    # Runs of columns: one for each effect, then for each warm-up one for each time constant.
    runs = [_Run(effect, effect.name) for effect in effects if not effect.time_constant]
    for effect in effects:
        if effect.time_constant:
            for number, tau in enumerate(constants):
                runs.append(_Run(effect, f'{effect.name}@{number}', float(tau)))

    # Places of the parameters: baseline, Earth's rate, runs.
    parts = {}
    widths = [FREE_SD_FACTOR * hand.hand_model.priors, np.array([EARTH_UPWARDS_SD])]
    start = hand.hand_model.size + 1
    for run in runs:
        parts[run.label] = slice(start, start + run.size)
        widths.append(run.effect.prior_sds()[: run.size])
        start += run.size
    space = HandSpace(parts, np.concatenate(widths), start)

    # Columns at rest in the poses.
    true = hand.gravity * hand.state.up
    still = np.zeros_like(true)
    at_rest: dict[str, dict[str, np.ndarray]] = {sensor: {} for sensor in SENSORS}
    for run in runs:
        if run.effect.sensor in at_rest:
            columns = _columns(
                hand,
                run.effect,
                run.time_constant,
                true,
                still,
                hand.poses.time,
                hand.poses.temperature_c,
            )
            at_rest[run.effect.sensor][run.label] = columns[:, :, : run.size]

    blocks = [
        _norm_block(hand, space, at_rest['accelerometer']),
        _rest_block(hand, space, at_rest['gyroscope']),
    ]
    between = gravity_turns(turns)
    if between:
        moving = []
        for run in runs:
            if run.effect.sensor == 'gyroscope' and run.time_constant is None:
                moving.append(run.effect)
        blocks.append(_turn_block(hand, between, space, at_rest['gyroscope'], moving))
    return blocks, space


FREE_SD_FACTOR = 1e3
"""Factor on the prior sds of the baseline, which is linearised at its own solution."""


@dataclass(frozen=True)
class _Run:
    """Columns of one effect, of a warm-up at one time constant."""

    effect: Effect
    """The effect under test."""
    label: str
    """Its name, for a warm-up with the number of the time constant."""
    time_constant: float | None = None
    """Time constant, s."""

    @property
    def size(self) -> int:
        """Number of columns."""
        return len(self.effect.amplitudes(self.effect.components))


def gravity_turns(turns: Sequence[TurnData]) -> list[TurnData]:
    """Return the turns between poses, with gravity as reference, without those of known angle."""
    return [turn for turn in turns if turn.rotation is None]


def _columns(
    hand: HandCalibration,
    effect: Effect,
    tau: float | None,
    force: np.ndarray,
    rate: np.ndarray,
    time: np.ndarray,
    temperature_c: np.ndarray | None,
) -> np.ndarray:
    """
    Return the contribution of the effect's parameters to its sensor's output.

    Shape (m, 3, p), at the baseline's solution.
    """
    point = {} if tau is None else {effect.name: effect.at_time_constant(tau)}
    sensors = replace(hand.model, accelerometer=BASE, gyroscope=BASE, point=point)
    sensors = sensors.with_effect(effect.sensor, effect.name)
    model = HandModel(sensors, hand.gravity)
    values = model.model.start_from(hand.model, hand.values)
    return model.further(
        effect.sensor, values, force, rate=rate, time=time, temperature_c=temperature_c
    )[1]


def _natural(poses: Poses, sensor: str) -> np.ndarray:
    """Return the variance of the usual bias drift, shape (3,)."""
    return NATURAL**2 * poses.noise[sensor].white_variance * poses.period


def _norm_block(
    hand: HandCalibration, space: HandSpace, at_rest: Mapping[str, np.ndarray]
) -> Block:
    """One row per pose: ``|true force| - gravity``."""
    poses = hand.poses
    count = len(poses.start)
    residual, base = hand.hand_model.norm_rows(hand.values, poses.force, **poses.conditions)
    # The derivative of the norm by the reading, as by the bias.
    back = base[:, 0:3]
    rows = np.zeros((count, space.size + 1))
    rows[:, : base.shape[1]] = base
    rows[:, -1] = residual
    for label, columns in at_rest.items():
        rows[:, space.parts[label]] = np.einsum('ki,kip->kp', back, columns)
    known = np.sum((back * poses.force_sem) ** 2, axis=1)
    floor = known + back**2 @ _natural(poses, 'accelerometer')
    return Block(
        'poses',
        'accelerometer',
        rows[:, None],
        known[:, None],
        floor[:, None],
        np.arange(count),
        poses.time,
    )


def _rest_block(
    hand: HandCalibration, space: HandSpace, at_rest: Mapping[str, np.ndarray]
) -> Block:
    """Three rows per pose: the rate at rest, with the Earth's rate about the vertical."""
    poses = hand.poses
    count = len(poses.start)
    residual, base = hand.rate_rows()
    earth = base.shape[2]
    rows = np.zeros((count, 3, space.size + 1))
    rows[:, :, :earth] = base
    rows[:, :, earth] = hand.state.up
    rows[:, :, -1] = residual
    for label, columns in at_rest.items():
        rows[:, :, space.parts[label]] = columns
    known = poses.rate_sem**2
    floor = known + _natural(poses, 'gyroscope')
    return Block('poses', 'gyroscope', rows, known, floor, np.arange(count), poses.time)


def _turn_block(
    hand: HandCalibration,
    turns: Sequence[TurnData],
    space: HandSpace,
    at_rest: Mapping[str, np.ndarray],
    moving: Sequence[Effect],
) -> Block:
    """
    Two rows per turn.

    The direction after it against the direction before it rotated by the rates, over the turn's
    duration.

    The bias in a turn is the mean of the rates at rest before and after it, which removes its
    drift; the contributions of further effects at rest are removed with it. The variance of a row
    is ``N / T^2 + (s_i^2 + s_j^2) / 4`` with the noise N of the integrated rates, rad^2, the
    duration T and the standard errors s of the two means.
    """
    bias_f, matrix_f = hand.accelerometer
    matrix = hand.gyroscope[1]
    across = tangent(hand.state.up)
    rows, known, durations = [], [], []
    for turn in turns:
        # True inputs during the turn, and the columns of further effects less those at rest.
        i, j = turn.first, turn.last
        bias = 0.5 * (hand.poses.rate[i] + hand.poses.rate[j])
        force = np.linalg.solve(matrix_f, (turn.force - bias_f).T).T
        rate = np.linalg.solve(matrix, (turn.rate - bias).T).T
        further = [np.zeros((len(force), 3, 0))]
        for effect in moving:
            columns = _columns(hand, effect, None, force, rate, turn.time, turn.temperature_c)
            own = at_rest[effect.name]
            further.append(columns - 0.5 * (own[i] + own[j]))

        # The direction carried through the turn, and its derivative by a rotation psi.
        found = integrate_turn(
            turn.time,
            turn.rate,
            bias=bias,
            matrix=matrix,
            further=(np.zeros_like(force), np.concatenate(further, axis=2)),
        )
        carried = between_middles(hand.poses, turn, found.mat_ji) @ hand.state.up[i]
        by_psi = across[j].T @ skew(carried) / found.duration

        row = np.zeros((2, space.size + 1))
        row[:, hand.hand_model.gyro_matrix] = by_psi @ found.by_matrix.reshape(3, 9)
        start = 0
        for effect in moving:
            end = start + effect.size
            row[:, space.parts[effect.name]] = by_psi @ found.by_further[:, start:end]
            start = end
        row[:, -1] = -across[j].T @ carried / found.duration
        rows.append(row)
        durations.append(found.duration)
        of_bias = 0.25 * np.mean(hand.poses.rate_sem[[i, j]] ** 2, axis=1).sum()
        known.append(np.full(2, turn.noise_variance / found.duration**2 + of_bias))
    return Block(
        'turns',
        'gyroscope',
        np.array(rows),
        np.array(known),
        np.array(known),
        np.array([turn.first for turn in turns]),
        np.array([turn.time.mean() for turn in turns]),
        np.array(durations),
    )


POSE_FOLDS = 12
"""Number of folds of the poses; with up to `ONE_BY_ONE` poses each pose is a fold."""
ONE_BY_ONE = 24
SCATTER_RATIOS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
"""Candidate scatter of poses or turns beyond the noise of their samples, in units of that noise."""
BIASES = (0.0, 0.5, 1.0, 2.0, 4.0)
"""Candidate bias processes, in units of offset and noise together."""
BIAS_TIMES = (100.0, 300.0)
"""Its correlation times, s."""
FEWEST_SPARE_ROWS = 3
"""Fewest degrees of freedom of a test."""
DEPENDENT = 1e-9
"""
Singular value of scaled columns, over the largest, up to which one of them depends on the others.
"""
MIN_COLUMN_DIFFERENCE = 0.1
"""Columns that differ by less than this count as collinear."""
MIN_COLUMN_SINE = 0.2
"""Least sine of the angle between a column and the baseline's columns for the column to count."""


class HandEvidence(Evidence):
    """
    Losses of choices of parameters on all poses and on held-out poses.

    Losses are ``n log(mean square)`` per block: the variance is not known but estimated from the
    same few rows.

    Parameters
    ----------
    blocks : sequence of Block
    space : HandSpace
    smooth : sequence of int
        Parameters of effects that are smooth in time, included when the noise is estimated.
    baseline : sequence of int
        Parameters of the model under diagnosis.

    """

    def __init__(
        self,
        blocks: Sequence[Block],
        space: HandSpace,
        smooth: Sequence[int],
        *,
        baseline: Sequence[int],
    ):
        self.blocks = blocks
        self.space = space
        # Smooth effects are included: the noise is not estimated from what they explain.
        self._noise = []
        for block in blocks:
            acting = [k for k in smooth if np.any(block.rows[:, :, k])]
            self._noise.append(_noise(block, [*baseline, *acting]))
        poses = np.unique(np.concatenate([block.pose for block in blocks]))
        n_folds = len(poses) if len(poses) <= ONE_BY_ONE else POSE_FOLDS
        self.folds = [np.searchsorted(poses, block.pose) % n_folds for block in blocks]
        self._white = self._whitened()
        self._bases: dict[tuple[int, ...], np.ndarray] = {}
        total = self._products(self._white)
        without = [self._products(self._whitened(number)) for number in range(n_folds)]
        super().__init__(
            total, np.array(without), prior_sd=space.prior_sd, prior_mean=np.zeros(space.size)
        )

    @staticmethod
    def _products(white: Sequence[np.ndarray]) -> np.ndarray:
        """Return the normal matrix of white rows, shape (q + 1, q + 1)."""
        return np.sum([rows.T @ rows for rows in white], axis=0)

    def _whitened(self, number: int | None = None) -> list[np.ndarray]:
        """
        Return the rows of each block, without fold `number`.

        As independent rows of unit variance, a list of (m, q + 1).
        """
        white = []
        for block, (variance, processes), fold in zip(self.blocks, self._noise, self.folds):
            kept = fold != number
            whitening = Whitening(
                variance[kept], block.time[kept], [np.arange(kept.sum())], processes=processes
            )
            white.append(whitening(block.rows[kept]).reshape(-1, self.space.size + 1))
        return white

    def residuals(self, used: Sequence[int]) -> list[np.ndarray]:
        """Return the residual rows of each block under the fit to all poses, shape (m, n_axes)."""
        values = self.fit(used)[0]
        return [
            block.rows[:, :, -1] - block.rows[:, :, list(used)] @ values for block in self.blocks
        ]

    def heldout_residuals(self, used: Sequence[int]) -> list[np.ndarray]:
        """
        Return the residual of every row under the fit without its pose.

        Shape (m, n_axes) per block.
        """
        left = self.left_by_others(used)
        return [
            np.einsum('mac,mc->ma', block.rows, left[fold])
            for block, fold in zip(self.blocks, self.folds)
        ]

    def against_noise(self, used: Sequence[int]) -> dict[str, np.ndarray]:
        """
        Return sensor -> squares of the same in units of noise and usual bias drift, of each block.

        Shape (n_blocks, 1).
        """
        found: dict[str, list[list[float]]] = {sensor: [] for sensor in SENSORS}
        for block, residual in zip(self.blocks, self.heldout_residuals(used)):
            found[block.sensor].append([np.sum(residual**2 / block.floor)])
        return {sensor: np.array(squares) for sensor, squares in found.items()}

    @property
    def numbers(self) -> dict[str, np.ndarray]:
        """Sensor -> number of the squares of each block."""
        return {
            sensor: np.array([block.known.size for block in self.blocks if block.sensor == sensor])
            for sensor in SENSORS
        }

    def _heldout(self, used: Sequence[int]) -> float:
        loss = 0.0
        for residual, noise in zip(self.heldout_residuals(used), self._noise):
            variance, processes = noise
            squares = residual**2 / (variance + sum(process.sd**2 for process in processes))
            loss += squares.size * np.log(squares.mean())
        return float(loss)

    def _loss(self, used: Sequence[int]) -> float:
        loss = 0.0
        for white in self._white:
            loss += len(white) * np.log(np.mean(self._left(white, used) ** 2))
        return float(loss)

    def _left(self, white: np.ndarray, used: Sequence[int]) -> np.ndarray:
        return white[:, -1] - white[:, list(used)] @ self.fit(used)[0]

    def p_value(self, smaller: Sequence[int], larger: Sequence[int]) -> float:
        """
        Return the p-value of `larger` against `smaller`.

        F test on the blocks that contain the new columns.
        """
        added = [k for k in larger if k not in set(smaller)]
        of_smaller = of_larger = 0.0
        n_rows = 0
        in_use = np.zeros(len(larger), bool)
        for white in self._white:
            if np.any(white[:, added]):
                of_smaller += np.sum(self._left(white, smaller) ** 2)
                of_larger += np.sum(self._left(white, larger) ** 2)
                n_rows += len(white)
                in_use |= np.any(white[:, list(larger)] != 0, axis=0)
        rank = max(self.rank(added, smaller), 1)
        spare = n_rows - int(in_use.sum())
        if spare < FEWEST_SPARE_ROWS or of_larger <= 0:
            return 1.0
        fall = max(of_smaller - of_larger, 0.0)
        return float(f_sf(fall / rank / (of_larger / spare), rank, spare))

    def rank(self, added: Sequence[int], smaller: Sequence[int]) -> int:
        """
        Return how many combinations of the added columns are not collinear with the smaller choice.
        """
        known = self._basis_of(tuple(smaller))
        new = orthonormal_basis(np.concatenate(self._white)[:, list(added)], MIN_COLUMN_DIFFERENCE)
        if not new.shape[1]:
            return 0
        sines = np.linalg.svd(new - known @ (known.T @ new), compute_uv=False)
        return int(np.sum(sines > MIN_COLUMN_SINE))

    def _basis_of(self, used: tuple[int, ...]) -> np.ndarray:
        """Return a basis of the columns of a choice, which is met with many larger choices."""
        if used not in self._bases:
            white = np.concatenate(self._white)
            self._bases[used] = orthonormal_basis(white[:, list(used)], DEPENDENT)
        return self._bases[used]


def _noise(block: Block, used: Sequence[int]) -> tuple[np.ndarray, tuple[BiasProcess, ...]]:
    """
    Return (independent variance of each row (m, n_axes), bias processes).

    Scatter between rows, for poses a bias process too.
    """
    count, axes, width = block.rows.shape
    basis = orthonormal_basis(block.rows.reshape(-1, width)[:, used], DEPENDENT)
    rows = np.concatenate([basis.reshape(count, axes, -1), block.rows[:, :, -1:]], axis=2)
    likelihood = NoiseLikelihood(rows, block.known, block.time, sessions=[np.arange(count)])
    biases = (
        [(share, time) for share in BIASES[1:] for time in BIAS_TIMES]
        if block.name == 'poses'
        else []
    )
    shapes = [
        (offset, share * max(offset, 1.0), time)
        for offset in SCATTER_RATIOS
        for share, time in [(0.0, BIAS_TIMES[0]), *biases]
    ]
    offset, bias, time = min(shapes, key=likelihood.loss)
    unit = likelihood.typical
    return block.known + (offset * unit) ** 2, (BiasProcess(bias * unit, time),) if bias else ()


NORM = 'norm'
"""Without a table only the component of the accelerometer's error along gravity is observable."""
TURN_RESIDUAL_UNIT = 'rad/turn'
"""Unit of the residual of turns: the angle between predicted and measured gravity after a turn."""


def unexplained_by_hand(
    hand: HandCalibration,
    blocks: Sequence[Block],
    evidence: HandEvidence,
    *,
    used: Sequence[int],
    sensor: str,
) -> Unexplained:
    """
    Return the unexplained residual of one sensor.

    Its rows at rest and its turns against the expectation from noise.

    Parameters
    ----------
    hand : HandCalibration
        Of the baseline.
    blocks : sequence of Block
        Rows at rest and of turns.
    evidence : HandEvidence
        Of these rows.
    used : sequence of int
        Parameters of the model.
    sensor : str

    """
    residuals, sigma, rms, chosen = evidence.residuals(used), -np.inf, 0.0, None
    for block, residual in zip(blocks, residuals):
        if block.sensor != sensor:
            continue
        spare = residual.size - np.linalg.matrix_rank(
            block.rows[:, :, used].reshape(residual.size, -1)
        )
        if spare < 3:
            continue
        own = (np.sum(residual**2 / block.floor) - spare) / np.sqrt(2 * spare)
        if block.name == 'poses' or own > max(sigma, SIGNIFICANT_SDS):
            # The residual of a turn is an angle, of a pose a rate.
            size = 1.0 if block.duration is None else block.duration[:, None] ** 2
            excess = np.sum(residual**2 * size) / spare - np.mean(block.floor * size)
            if own > sigma:
                sigma, rms, chosen = own, float(np.sqrt(max(excess, 0.0))), block
    count = len(hand.poses.start)
    first = next(k for k, block in enumerate(blocks) if block.sensor == sensor)
    layers, noise_sd = residuals[first], np.sqrt(blocks[first].floor)
    significant = bool(sigma > SIGNIFICANT_SDS and count >= MIN_EXPLAINED_WINDOWS)
    unit = None if chosen is None or chosen.duration is None else TURN_RESIDUAL_UNIT
    if not significant:
        return Unexplained(False, rms, float(max(sigma, -99.0)), None, 0.0, layers, noise_sd, unit)
    name, share = correlate(_explanations(hand), layers / noise_sd)
    if chosen is not None and chosen.name == 'turns' and name is None:
        name = 'motion (turns between poses)'
    heldout = evidence.heldout_residuals(used)[first]
    excess = ((heldout / noise_sd) ** 2 - 1.0).sum(axis=0)
    axes = largest_axes(excess) if len(excess) == len(AXES) and excess.max() > 0 else ()
    return Unexplained(
        True,
        rms,
        float(sigma),
        name,
        share,
        layers,
        noise_sd,
        unit,
        axes,
        regimes_by_hand(hand, blocks[first], heldout),
    )


def _explanations(hand: HandCalibration) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    poses, up = hand.poses, hand.state.up
    every = np.ones(len(up), bool)
    yield from slow_explanations(
        poses.time, np.full(len(up), np.nan) if poses.temperature_c is None else poses.temperature_c
    )
    yield 'direction of gravity', up, every
    yield (
        'direction of gravity',
        np.stack(
            [
                up[:, 0] ** 2 - up[:, 1] ** 2,
                up[:, 2] ** 2,
                up[:, 0] * up[:, 1],
                up[:, 1] * up[:, 2],
                up[:, 0] * up[:, 2],
            ],
            axis=1,
        ),
        every,
    )


def regimes_by_hand(
    hand: HandCalibration, block: Block, residual: np.ndarray
) -> tuple[RestRegime, ...]:
    """
    Return the clearest regime of each axis.

    Regimes of larger scatter are not reported, since every other range of few poses has it.

    Parameters
    ----------
    hand : HandCalibration
        Of the baseline.
    block : Block
        The sensor's rows in poses.
    residual : ndarray, shape (k, n_axes)
        Residual of each pose, by a fit without it.

    """
    names = AXES if residual.shape[1] == len(AXES) else (NORM,)
    poses = np.arange(len(residual))
    exchange = exchanges(poses, np.zeros(len(poses)), np.zeros(len(poses)))
    search, found = (
        RegimeSearch(block.sensor, block.time, _variables(hand, block), exchange=exchange),
        [],
    )
    for axis, name in enumerate(names):
        sd = np.sqrt(block.floor[:, axis])
        rest = AxisResidual(
            np.column_stack([np.ones(len(sd)), residual[:, axis]]) / sd[:, None],
            np.zeros(1),
            np.zeros(1),
        )
        found += search.offsets(
            name, rest, partial(np.multiply, 1.0 / sd[:, None]), level=REGIME_LEVEL / len(names)
        )[:1]
    return tuple(found)


def _variables(hand: HandCalibration, block: Block) -> list[Variable]:
    """
    Return the variables of regimes of poses.

    The attitude, the previous attitude, the time and the temperature.
    """
    force = hand.gravity * hand.state.up
    before = np.concatenate([force[:1], force[:-1]])
    of = partial(ranged, starts=np.arange(len(block.time)))
    found = of('time', block.time, 's')
    for k, axis in enumerate(AXES):
        found += of(f'specific force along {axis}', force[block.pose, k], 'm/s^2', least=0.5)
        found += of(
            f'specific force along {axis} in the pose before',
            before[block.pose, k],
            'm/s^2',
            least=0.5,
        )
    warm = hand.poses.temperature_c
    return found if warm is None else found + of('temperature', warm[block.pose], 'C', least=0.5)
