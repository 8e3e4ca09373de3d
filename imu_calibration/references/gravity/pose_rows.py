"""Rows of a recording by hand for the search: norms in poses, rates at rest, turns."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.effects.base import SENSORS, Effect
from imu_calibration.effects.sensor_model import BASE
from imu_calibration.estimation.rows import Rows
from imu_calibration.estimation.sensor_noise import NATURAL
from imu_calibration.kinematics.rotations import skew
from imu_calibration.kinematics.strapdown import integrate_turn
from imu_calibration.references.gravity.equations import Poses, TurnData, between_middles, tangent
from imu_calibration.references.gravity.g_sensitivity import EARTH_UPWARDS_SD
from imu_calibration.references.gravity.hand_calibration import HandCalibration
from imu_calibration.references.gravity.hand_parameters import HandModel


@dataclass(frozen=True, eq=False)
class SearchParameters:
    """Parameters of the rows: those of the baseline, then one run per column set."""

    parts: dict[str, slice]
    """
    Label of each run of columns (effect name, for a warm-up with the number of its time constant)
    -> its parameters.
    """
    prior_sd: np.ndarray
    """Shape (q,); wide for the baseline, which is linearised at its own solution."""

    @property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.prior_sd)


def build_rows(
    hand: HandCalibration,
    turns: Sequence[TurnData],
    effects: Sequence[Effect],
    *,
    constants: np.ndarray,
) -> tuple[list[Rows], SearchParameters]:
    """
    Return the rows at rest and of turns, and their parameters.

    After those of the baseline the Earth's rate about the vertical is a parameter.

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
    space = SearchParameters(parts, np.concatenate(widths))

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
    hand: HandCalibration, space: SearchParameters, at_rest: Mapping[str, np.ndarray]
) -> Rows:
    """One row per pose: ``|true force| - gravity``."""
    poses = hand.poses
    count = len(poses)
    residual, base = hand.hand_model.norm_rows(hand.values, poses.force, **poses.conditions)
    # The derivative of the norm by the reading, as by the bias.
    back = base[:, 0:3]
    rows = np.zeros((count, space.size + 1))
    rows[:, : base.shape[1]] = base
    rows[:, -1] = residual
    for label, columns in at_rest.items():
        rows[:, space.parts[label]] = np.einsum('ki,kip->kp', back, columns)
    known = np.sum((back * poses.force_sem) ** 2, axis=1)
    drift = back**2 @ _natural(poses, 'accelerometer')
    return Rows(
        name='poses',
        sensor='accelerometer',
        equations=rows[:, None],
        variance=known[:, None],
        drift=drift[:, None],
        group=np.arange(count),
        time=poses.time,
    )


def _rest_block(
    hand: HandCalibration, space: SearchParameters, at_rest: Mapping[str, np.ndarray]
) -> Rows:
    """Three rows per pose: the rate at rest, with the Earth's rate about the vertical."""
    poses = hand.poses
    count = len(poses)
    residual, base = hand.rate_rows()
    earth = base.shape[2]
    rows = np.zeros((count, 3, space.size + 1))
    rows[:, :, :earth] = base
    rows[:, :, earth] = hand.state.up
    rows[:, :, -1] = residual
    for label, columns in at_rest.items():
        rows[:, :, space.parts[label]] = columns
    return Rows(
        name='poses',
        sensor='gyroscope',
        equations=rows,
        variance=poses.rate_sem**2,
        drift=np.tile(_natural(poses, 'gyroscope'), (count, 1)),
        group=np.arange(count),
        time=poses.time,
    )


def _turn_block(
    hand: HandCalibration,
    turns: Sequence[TurnData],
    space: SearchParameters,
    at_rest: Mapping[str, np.ndarray],
    moving: Sequence[Effect],
) -> Rows:
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
    rows = []
    known = []
    durations = []
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
    return Rows(
        name='turns',
        sensor='gyroscope',
        equations=np.array(rows),
        variance=np.array(known),
        group=np.array([turn.first for turn in turns]),
        time=np.array([turn.time.mean() for turn in turns]),
        duration=np.array(durations),
    )
