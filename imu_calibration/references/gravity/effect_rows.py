"""A recording without a table as rows of linear equations: norms of gravity in poses, rates at rest, directions after turns."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.core.samples import AlignedArrays
from imu_calibration.effects.base import SENSORS, Effect
from imu_calibration.effects.sensor_model import BASE
from imu_calibration.estimation.noise_search import NATURAL
from imu_calibration.kinematics.rotations import skew
from imu_calibration.kinematics.strapdown import integrate_turn
from imu_calibration.references.gravity.equations import TurnData, between_middles, tangent
from imu_calibration.references.gravity.g_sensitivity import EARTH_UPWARDS_SD
from imu_calibration.references.gravity.hand_calibration import HandCalibration
from imu_calibration.references.gravity.hand_parameters import HandModel


@dataclass(frozen=True, eq=False)
class Block(AlignedArrays):
    """Rows of one kind, ``residual = columns @ parameters + error``, in the unit of their sensor."""

    name: str
    """'poses' or 'turns'."""
    sensor: str
    """'accelerometer' or 'gyroscope'."""
    rows: np.ndarray
    """``[columns | residual]`` at the baseline, shape (m, n_axes, q + 1); different axes have independent errors."""
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
    """Parameters of a diagnosis by hand: baseline, Earth's rate about the vertical, then one run per column set."""

    parts: dict
    """Label of each run of columns (effect name, for a warm-up with the number of its time constant) -> slice."""
    prior_sd: np.ndarray
    """Shape (q,); wide for the baseline, which is linearised at its own solution."""
    size: int
    """Number of parameters."""


def build_rows(hand: HandCalibration, turns: Sequence[TurnData], effects: Sequence[Effect], *,
               constants: np.ndarray) -> tuple[list[Block], HandSpace]:
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
    sets: list[tuple[Effect, str, float | None]] = [(effect, effect.name, None) for effect in effects if not effect.time_constant]
    sets += [(e, f'{e.name}@{k}', float(tau)) for e in effects if e.time_constant for k, tau in enumerate(constants)]
    base = hand.hand_model.size
    sizes = [len(effect.amplitudes(effect.components)) for effect, _, _ in sets]
    ends = np.cumsum([base + 1] + sizes)
    widths = np.concatenate([1e3 * hand.hand_model.priors, [EARTH_UPWARDS_SD], *(s[0].prior_sds()[:n] for s, n in zip(sets, sizes))])
    parts = {label: slice(a, b) for (_, label, _), a, b in zip(sets, ends, ends[1:])}
    space = HandSpace(parts, widths, int(ends[-1]))
    true, zero = hand.gravity * hand.state.up, np.zeros_like(hand.state.up)
    at_rest = {sensor: {label: _columns(hand, effect, tau, true, zero, hand.poses.time, hand.poses.temperature_c)[:, :, :size]
                        for (effect, label, tau), size in zip(sets, sizes) if effect.sensor == sensor} for sensor in SENSORS}
    blocks = [_norm_block(hand, space, at_rest['accelerometer']), _rest_block(hand, space, at_rest['gyroscope'])]
    if between := gravity_turns(turns):
        moving = [effect for effect, _, tau in sets if effect.sensor == 'gyroscope' and tau is None]
        blocks.append(_turn_block(hand, between, space, at_rest['gyroscope'], moving))
    return blocks, space


def gravity_turns(turns: Sequence[TurnData]) -> list[TurnData]:
    """Return the turns between poses, with gravity as reference, without those of known angle."""
    return [turn for turn in turns if turn.rotation is None]


def _columns(hand, effect, tau, force, rate, time, temperature_c):
    """Return the contribution of the effect's parameters to its sensor's output, shape (m, 3, p), at the baseline's solution."""
    point = {} if tau is None else {effect.name: effect.at_time_constant(tau)}
    names = {sensor: BASE + ((effect.name,) if effect.sensor == sensor else ()) for sensor in SENSORS}
    model = HandModel(replace(hand.model, **names, point=point), hand.gravity)
    values = model.model.start_from(hand.model, hand.values)
    return model.further(effect.sensor, values, force, rate=rate, time=time, temperature_c=temperature_c)[1]


def _natural(poses, sensor):
    """Return the variance of the usual bias drift, shape (3,)."""
    return NATURAL**2 * poses.noise[sensor].white_variance * poses.period


def _norm_block(hand, space, at_rest):
    """One row per pose: ``|true force| - gravity``."""
    poses, count = hand.poses, len(hand.poses.start)
    residual, base = hand.hand_model.norm_rows(hand.values, poses.force, **poses.conditions)
    back = base[:, 0:3]
    rows = np.zeros((count, space.size + 1))
    rows[:, :base.shape[1]], rows[:, -1] = base, residual
    for label, columns in at_rest.items():
        rows[:, space.parts[label]] = np.einsum('ki,kip->kp', back, columns)
    known = np.sum((back * poses.force_sem)**2, axis=1)
    floor = known + back**2 @ _natural(poses, 'accelerometer')
    return Block('poses', 'accelerometer', rows[:, None], known[:, None], floor[:, None], np.arange(count), poses.time)


def _rest_block(hand, space, at_rest):
    """Three rows per pose: the rate at rest, with the Earth's rate about the vertical."""
    poses, count = hand.poses, len(hand.poses.start)
    residual, base = hand.rate_rows()
    rows = np.zeros((count, 3, space.size + 1))
    rows[:, :, :base.shape[2]], rows[:, :, base.shape[2]], rows[:, :, -1] = base, hand.state.up, residual
    for label, columns in at_rest.items():
        rows[:, :, space.parts[label]] = columns
    known = poses.rate_sem**2
    floor = known + _natural(poses, 'gyroscope')
    return Block('poses', 'gyroscope', rows, known, floor, np.arange(count), poses.time)


def _turn_block(hand, turns, space, at_rest, moving):
    """
    Two rows per turn: the direction after it against the direction before it rotated by the rates, over the turn's duration.

    The bias in a turn is the mean of the rates at rest before and after it, which removes its drift; the contributions of
    further effects at rest are removed with it. The variance of a row is ``N / T^2 + (s_i^2 + s_j^2) / 4`` with the noise N of the
    integrated rates, rad^2, the duration T and the standard errors s of the two means.
    """
    bias_f, matrix_f = hand.accelerometer
    matrix = hand.gyroscope[1]
    across, rows, known, durations = tangent(hand.state.up), [], [], []
    for turn in turns:
        i, j = turn.first, turn.last
        bias = 0.5 * (hand.poses.rate[i] + hand.poses.rate[j])
        force, rate = np.linalg.solve(matrix_f, (turn.force - bias_f).T).T, np.linalg.solve(matrix, (turn.rate - bias).T).T
        further = [_columns(hand, e, None, force, rate, turn.time, turn.temperature_c) - 0.5 * (at_rest[e.name][i] + at_rest[e.name][j])
                   for e in moving]
        stacked = np.concatenate([np.zeros((len(force), 3, 0)), *further], axis=2)
        found = integrate_turn(turn.time, turn.rate, bias=bias, matrix=matrix, further=(np.zeros_like(force), stacked))
        carried = between_middles(hand.poses, turn, found.mat_ji) @ hand.state.up[i]
        by_psi = across[j].T @ skew(carried) / found.duration
        row = np.zeros((2, space.size + 1))
        row[:, hand.hand_model.gyro_matrix] = by_psi @ found.by_matrix.reshape(3, 9)
        place = 0
        for effect in moving:
            row[:, space.parts[effect.name]] = by_psi @ found.by_further[:, place:place + effect.size]
            place += effect.size
        row[:, -1] = -across[j].T @ carried / found.duration
        rows.append(row)
        durations.append(found.duration)
        of_bias = 0.25 * np.mean(hand.poses.rate_sem[[i, j]]**2, axis=1).sum()
        known.append(np.full(2, turn.noise_variance / found.duration**2 + of_bias))
    return Block('turns', 'gyroscope', np.array(rows), np.array(known), np.array(known), np.array([turn.first for turn in turns]),
                 np.array([turn.time.mean() for turn in turns]), np.array(durations))
