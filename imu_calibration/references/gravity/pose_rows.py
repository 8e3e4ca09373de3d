"""Rows of a recording by hand for the search: norms in poses, rates at rest, turns."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.effects.base import SENSORS, Effect
from imu_calibration.effects.sensor_model import BASE
from imu_calibration.estimation.rows import Rows
from imu_calibration.estimation.sensor_noise import NATURAL
from imu_calibration.kinematics.rotations import skew
from imu_calibration.kinematics.strapdown import Turn, integrate_turn
from imu_calibration.references.gravity.equations import Poses, TurnData, between_middles, tangent
from imu_calibration.references.gravity.g_sensitivity import EARTH_UPWARDS_SD
from imu_calibration.references.gravity.hand_calibration import HandCalibration
from imu_calibration.references.gravity.hand_parameters import HandModel


@dataclass(frozen=True, eq=False)
class SearchParameters:
    """
    The q parameters of the rows.

    They are those of the baseline, the Earth's rate about the vertical, and those of each effect
    under test, of a warm-up for each time constant.
    """

    parts: dict[str, slice]
    """
    Label of an effect under test (its name, for a warm-up with the number of its time constant) ->
    its parameters.
    """
    prior_sd: np.ndarray
    """Prior sds, shape (q,); wide for the baseline, which is linearised at its own solution."""

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
    Return (three `Rows`: norms at rest, rates at rest, turns; their parameters).

    The third is absent without turns.

    Parameters
    ----------
    hand : HandCalibration
        Solution of the baseline, at which the rows are linearised.
    turns : list of TurnData
        Turns between consecutive poses.
    effects : sequence of Effect
        Effects under test.
    constants : array
        Time constants of warm-ups under test, s.

    """
    # Column groups: one of an effect, of a warm-up one for each time constant.
    groups = [_ColumnGroup(effect, effect.name) for effect in effects if not effect.time_constant]
    for effect in effects:
        if effect.time_constant:
            for number, tau in enumerate(constants):
                groups.append(_ColumnGroup(effect, f'{effect.name}@{number}', float(tau)))

    # Parameters in the order baseline, Earth's rate, column groups.
    parts = {}
    prior_sds = [FREE_SD_FACTOR * hand.hand_model.priors, np.array([EARTH_UPWARDS_SD])]
    start = hand.hand_model.size + 1
    for group in groups:
        n_columns = group.effect.n_amplitudes
        parts[group.label] = slice(start, start + n_columns)
        prior_sds.append(group.effect.prior_sds()[:n_columns])
        start += n_columns
    space = SearchParameters(parts, np.concatenate(prior_sds))

    # Derivatives of the outputs in the poses. The last parameter of a warm-up, its time constant,
    # is fixed and has no column.
    true_force = hand.gravity * hand.state.up
    at_rest: dict[str, dict[str, np.ndarray]] = {sensor: {} for sensor in SENSORS}
    for group in groups:
        if group.effect.sensor in at_rest:
            columns = _columns(
                hand, group.effect, true_force, tau=group.time_constant, **hand.poses.conditions
            )
            at_rest[group.effect.sensor][group.label] = columns[:, :, : group.effect.n_amplitudes]

    # Rows of the poses and of the turns.
    blocks = [
        _norm_block(hand, space, at_rest['accelerometer']),
        _rest_block(hand, space, at_rest['gyroscope']),
    ]
    turns_between_poses = gravity_turns(turns)
    if turns_between_poses:
        # Without warm-ups: a turn is short against their time constants, so that the mean of the
        # rests before and after it, which is subtracted, contains their output.
        turn_effects = []
        for group in groups:
            if group.effect.sensor == 'gyroscope' and group.time_constant is None:
                turn_effects.append(group.effect)
        blocks.append(
            _turn_block(hand, turns_between_poses, space, at_rest['gyroscope'], turn_effects)
        )
    return blocks, space


FREE_SD_FACTOR = 1e3
"""Factor on the prior sds of the baseline, which is linearised at its own solution."""


@dataclass(frozen=True)
class _ColumnGroup:
    """The columns of one effect, of a warm-up at one time constant."""

    effect: Effect
    """The effect under test."""
    label: str
    """Its name, for a warm-up with the number of the time constant."""
    time_constant: float | None = None
    """Time constant, s."""


def gravity_turns(turns: Sequence[TurnData]) -> list[TurnData]:
    """Return the turns between poses, with gravity as reference, without those of known angle."""
    return [turn for turn in turns if turn.rotation is None]


def _columns(
    hand: HandCalibration,
    effect: Effect,
    force: np.ndarray,
    *,
    tau: float | None = None,
    **inputs: np.ndarray | None,
) -> np.ndarray:
    """
    Return the derivative of a sensor's output by the parameters of an effect, shape (m, 3, p).

    It is computed at the baseline's solution, for the true force, shape (m, 3), and the further
    inputs of `HandModel.further_output`; `tau`: the time constant of a warm-up, s.
    """
    # A model in which the effect is the only one beyond bias and matrix, linearised at the time
    # constant: what `further_output` returns is then of this effect alone.
    point = {} if tau is None else {effect.name: effect.at_time_constant(tau)}
    sensors = replace(hand.model, accelerometer=BASE, gyroscope=BASE, point=point)
    sensors = sensors.with_effect(effect.sensor, effect.name)
    model = HandModel(sensors, hand.gravity)
    values = model.model.start_from(hand.model, hand.values)
    _, columns = model.further_output(effect.sensor, values, force, **inputs)
    return columns


def _natural_variance(poses: Poses, sensor: str) -> np.ndarray:
    """Return the variance of the usual bias drift (`NATURAL`), shape (3,)."""
    return NATURAL**2 * poses.noise[sensor].white_variance * poses.period


def _norm_block(
    hand: HandCalibration, space: SearchParameters, at_rest: Mapping[str, np.ndarray]
) -> Rows:
    """
    Return one row per pose: ``|true force| - gravity``.

    `at_rest`: label of an effect -> derivative of the reading in each pose, shape (k, 3, p).
    """
    poses = hand.poses
    count = len(poses)
    residual, baseline_columns = hand.hand_model.norm_rows(
        hand.values, poses.force, **poses.conditions
    )
    # Columns. The derivative of the norm by the reading is, but for the sign, that by the bias.
    by_reading = baseline_columns[:, 0:3]
    rows = np.zeros((count, space.size + 1))
    rows[:, : baseline_columns.shape[1]] = baseline_columns
    rows[:, -1] = residual
    for label, columns in at_rest.items():
        rows[:, space.parts[label]] = np.einsum('ki,kip->kp', by_reading, columns)

    # Variance of the norm by the noise of the mean, and by the usual drift of the bias.
    variance = np.sum((by_reading * poses.force_sem) ** 2, axis=1)
    drift = by_reading**2 @ _natural_variance(poses, 'accelerometer')
    return Rows(
        name='poses',
        sensor='accelerometer',
        equations=rows[:, None],
        variance=variance[:, None],
        drift=drift[:, None],
        group=np.arange(count),
        time=poses.time,
    )


def _rest_block(
    hand: HandCalibration, space: SearchParameters, at_rest: Mapping[str, np.ndarray]
) -> Rows:
    """
    Return three rows per pose: the rate at rest, with the Earth's rate about the vertical.

    `at_rest` as for `_norm_block`.
    """
    poses = hand.poses
    count = len(poses)
    residual, baseline_columns = hand.rate_rows()
    earth = baseline_columns.shape[2]  # the place after the parameters of the baseline
    rows = np.zeros((count, 3, space.size + 1))
    rows[:, :, :earth] = baseline_columns
    rows[:, :, earth] = hand.state.up
    rows[:, :, -1] = residual
    for label, columns in at_rest.items():
        rows[:, :, space.parts[label]] = columns
    return Rows(
        name='poses',
        sensor='gyroscope',
        equations=rows,
        variance=poses.rate_sem**2,
        drift=np.tile(_natural_variance(poses, 'gyroscope'), (count, 1)),
        group=np.arange(count),
        time=poses.time,
    )


def _turn_block(
    hand: HandCalibration,
    turns: Sequence[TurnData],
    space: SearchParameters,
    at_rest: Mapping[str, np.ndarray],
    effects: Sequence[Effect],
) -> Rows:
    """
    Return two rows per turn, rad/s: the error of rotated gravity over the duration T of the turn.

    With the directions u of the poses i and j and the tangents of u_j::

        residual = -tangent' mat_ji u_i / T

    The bias in a turn is the mean of the rates at rest before and after it, which removes its
    drift; the output of `effects` at rest, with the derivatives `at_rest`, is removed with it. The
    variance of a row is ``N / T^2 + (s_i^2 + s_j^2) / 4`` with the noise N of the integrated rates,
    rad^2, and the standard errors s of the two means.
    """
    across = tangent(hand.state.up)
    rows = []  # of each turn, shape (2, q + 1): columns of all parameters, then the residual
    variances = []  # shape (2,)
    durations = []
    for turn in turns:
        i, j = turn.first, turn.last
        integrated = _integrated(hand, turn, at_rest, effects)
        duration = integrated.duration

        # Residual, and its derivatives through the error psi of the rotation.
        carried = between_middles(hand.poses, turn, integrated.mat_ji) @ hand.state.up[i]
        by_psi = across[j].T @ skew(carried) / duration
        row = np.zeros((2, space.size + 1))
        row[:, hand.hand_model.gyro_matrix] = by_psi @ integrated.by_matrix.reshape(3, 9)
        start = 0
        for effect in effects:
            end = start + effect.size
            row[:, space.parts[effect.name]] = by_psi @ integrated.by_further[:, start:end]
            start = end
        row[:, -1] = -across[j].T @ carried / duration
        rows.append(row)
        durations.append(duration)

        # Noise of the integrated rates, and of the mean of both rates at rest.
        bias_variance = 0.25 * np.mean(hand.poses.rate_sem[[i, j]] ** 2, axis=1).sum()
        variances.append(np.full(2, turn.noise_variance / duration**2 + bias_variance))
    return Rows(
        name='turns',
        sensor='gyroscope',
        equations=np.array(rows),
        variance=np.array(variances),
        group=np.array([turn.first for turn in turns]),
        time=np.array([turn.time.mean() for turn in turns]),
        duration=np.array(durations),
    )


def _integrated(
    hand: HandCalibration,
    turn: TurnData,
    at_rest: Mapping[str, np.ndarray],
    effects: Sequence[Effect],
) -> Turn:
    """
    Return a turn integrated with the mean rate of the rests before and after it as the bias.

    `Turn.by_further` has the derivatives by the parameters of the `effects`, one after the other:
    of their output in the turn less the mean of their output in both rests (`at_rest`).
    """
    # True inputs during the turn.
    i, j = turn.first, turn.last
    force_bias, force_matrix = hand.accelerometer
    matrix = hand.gyroscope.matrix
    bias = 0.5 * (hand.poses.rate[i] + hand.poses.rate[j])
    force = np.linalg.solve(force_matrix, (turn.force - force_bias).T).T
    rate = np.linalg.solve(matrix, (turn.rate - bias).T).T

    further = [np.zeros((len(force), 3, 0))]
    for effect in effects:
        columns = _columns(
            hand, effect, force, rate=rate, time=turn.time, temperature_c=turn.temperature_c
        )
        columns_at_rest = at_rest[effect.name]
        further.append(columns - 0.5 * (columns_at_rest[i] + columns_at_rest[j]))
    return integrate_turn(
        turn.time,
        turn.rate,
        bias=bias,
        matrix=matrix,
        further=(np.zeros_like(force), np.concatenate(further, axis=2)),
    )
