"""
The equations of a calibration by hand.

Poses at rest, turns between them, and full turns of known angle.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from imu_calibration.estimation.noise_model import NoiseModel
from imu_calibration.estimation.row_estimate import RowSet
from imu_calibration.kinematics.rotations import skew, unit_rows
from imu_calibration.kinematics.strapdown import integrate_turn, small_rotation
from imu_calibration.references.gravity.hand_parameters import HandModel

COMPONENTS = ('pose', 'drift', 'turn')
"""
Scatter beyond the noise: of the accelerometer between poses, of the gyroscope's bias, of the turns.
"""
SCATTER_SD = (0.002, 1e-4, 2e-3)
"""
Their standard deviations when there are too few poses or turns to estimate them, m/s^2, rad/s, rad.
"""


OF_DIRECTION, OF_DRIFT = slice(0, 2), slice(2, 5)
"""
Nuisances of a pose: components of its direction, departure of the gyroscope's bias; pose after
pose, so that the rows form a band.
"""
MAX_FIRST_ORDER_ANGLE = 1e-3
"""rad; its square, times a turn's few radians, is the error of the first-order correction."""
CALM = 0.05
"""
Least scatter of the drifts in units of the noise of the means, so that no row has infinite weight.
"""


@dataclass(frozen=True, eq=False)
class Poses:
    """Means over the intervals at rest."""

    force: np.ndarray
    """Mean accelerometer reading, m/s^2, shape (k, 3)."""
    rate: np.ndarray
    """Mean gyroscope reading, rad/s, shape (k, 3)."""
    force_sem: np.ndarray
    """Sd of `force` from the scatter within the intervals, shape (k, 3)."""
    rate_sem: np.ndarray
    """Sd of `rate` from the scatter within the intervals, shape (k, 3)."""
    start: np.ndarray
    """Index of the first sample, shape (k,)."""
    stop: np.ndarray
    """Index after the last sample, shape (k,)."""
    time: np.ndarray
    """Middle of each interval, seconds since the first sample, shape (k,)."""
    temperature_c: np.ndarray | None = None
    """Mean temperature, shape (k,), when it was recorded."""
    noise: dict[str, NoiseModel] = field(default_factory=dict)
    """Sensor -> noise within the intervals."""
    period: float = 0.0
    """Time from sample to sample, s."""
    half_turn: np.ndarray | None = None
    """
    Angle by which the attitude creeps across gravity from the middle of each interval to its end,
    rad, shape (k, 3); not in `rate`.
    """
    hidden: 'HiddenRates | None' = None
    """Errors of `rate` that are the same in all poses."""

    @property
    def conditions(self) -> dict[str, Any]:
        """Time and temperature, as the functions of `HandModel` take them."""
        return {'time': self.time, 'temperature_c': self.temperature_c}


@dataclass(frozen=True)
class HiddenRates:
    """Errors of small rates that no number of rests averages, of each axis of the gyroscope."""

    dead_band: tuple[float, ...]
    """Largest rate that is given as zero in all poses, rad/s; 0 without a dead band."""
    rounding_sd: tuple[float, ...]
    """Standard deviation of the error of a mean of rounded readings, rad/s."""
    step: tuple[float, ...]
    """Step of the readings, rad/s; rounding errors of faster motions average."""


@dataclass(frozen=True, eq=False)
class TurnData:
    """Samples of a stretch of motion."""

    time: np.ndarray
    """Seconds, shape (n,)."""
    rate: np.ndarray
    """Measured rate, rad/s, shape (n, 3)."""
    force: np.ndarray
    """Measured specific force, m/s^2, shape (n, 3)."""
    first: int = -1
    """Pose before the turn."""
    last: int = -1
    """Pose after the turn."""
    noise_variance: float = 0.0
    """Variance of the integrated rate noise per axis, rad^2."""
    rotation: np.ndarray | None = None
    """
    Known rotation vector about a body axis, rad, shape (3,); None when gravity is the reference.
    """
    rotation_cov: np.ndarray | None = None
    """Covariance of `rotation`, shape (3, 3)."""
    temperature_c: np.ndarray | None = None
    """Temperature, shape (n,), when it was recorded."""


@dataclass(frozen=True, eq=False)
class State:
    """Estimated quantities."""

    values: np.ndarray
    """Parameters in the order of the model, shape (n,)."""
    up: np.ndarray
    """True direction of the specific force in each pose, unit vectors, shape (k, 3)."""
    drift: np.ndarray
    """Departure of the gyroscope's bias in each pose, rad/s, shape (k, 3)."""


def tangent(up: np.ndarray) -> np.ndarray:
    """Return two unit vectors orthogonal to each row of `up`, shape (k, 3, 2)."""
    helper = np.eye(3)[np.argmin(np.abs(up), axis=1)]
    one = unit_rows(np.cross(up, helper))
    return np.stack([one, np.cross(up, one)], axis=2)


@dataclass(frozen=True, eq=False)
class GravityRows:
    """Poses, drifts of the bias and turns as rows of an estimate (`row_estimate.RowReference`)."""

    model: HandModel
    """Parameters."""
    poses: Poses
    """Means at rest."""
    turns: Sequence[TurnData]
    """Turns between them."""
    memory: dict = field(default_factory=dict)
    """
    Turns integrated before; for similar parameters they are corrected to first order instead of
    being integrated again.
    """

    nominal = property(lambda self: self.model.nominal)
    priors = property(lambda self: self.model.priors)
    fixed = property(lambda self: self.model.fixed)

    def moved(self, state: State, step: np.ndarray) -> State:
        """
        Return the state after a step.

        Pose after pose 2 components of its direction and 3 of its drift, then the parameters.
        """
        own = step[: 5 * len(state.up)].reshape(-1, 5)
        up = state.up + np.einsum('kij,kj->ki', tangent(state.up), own[:, :2])
        return State(state.values + step[own.size :], unit_rows(up), state.drift + own[:, 2:])

    def linearise(self, state: State) -> RowSet:
        """Return the rows of poses, bias drifts, calm drifts and turns at a state."""
        model, poses, across = self.model, self.poses, tangent(state.up)
        rows = [
            _pose_rows(model, state, poses, across),
            _drift_rows(model, state, poses),
            _calm_rows(model, state, poses),
        ]
        for key, turn in enumerate(self.turns):
            rows.append(
                _gravity_turn_rows(model, state, turn, key, self.memory, across, poses)
                if turn.rotation is None
                else _known_turn_rows(model, state, turn)
            )
        return RowSet(*(np.concatenate(parts) for parts in zip(*rows)))


def _pose_rows(model, state, poses, across):
    """
    ``force = bias + matrix @ (gravity * up) + further effects``.

    Three rows per pose, two of them used for its direction.
    """
    bias, matrix, *_ = model.linear(state.values)
    count = len(state.up)
    true = model.gravity * state.up
    more, slopes = model.further('accelerometer', state.values, true, **poses.conditions)
    main = np.zeros((count, 3, model.size))
    main[:, :, 0:3] = np.eye(3)
    for i in range(3):
        main[:, i, 3 + 3 * i : 4 + 4 * i] = true[:, : i + 1]
    main[:, :, model.extra_index('accelerometer')] = slopes
    return _flat(
        poses.force - bias - true @ matrix.T - more,
        OF_DIRECTION,
        model.gravity * matrix @ across,
        main,
        poses.force_sem**2,
        0,
    )


def _drift_rows(model, state, poses):
    """``rate = bias + further effects (gravity * up) + drift`` at rest."""
    rate, main = model.rate_rows(
        state.values, model.gravity * state.up, poses.rate, **poses.conditions
    )
    return _flat(rate - state.drift, OF_DRIFT, np.eye(3), main, poses.rate_sem**2, -1)


def _calm_rows(model, state, poses):
    """``0 = drift`` within the scatter of the drifts."""
    return _flat(
        -state.drift,
        OF_DRIFT,
        np.eye(3),
        np.zeros((len(state.up), 3, model.size)),
        (CALM * poses.rate_sem) ** 2,
        1,
    )


def _integrated(model, state, data, bias, key, memory):
    """
    Return (mat_ji, Turn), from memory when the gyroscope's parameters have hardly changed since.
    """
    matrix, further = model.linear(state.values)[3], state.values[model.extra_index('gyroscope')]
    if key in memory:
        (old_bias, old_matrix, old_further), turn = memory[key]
        psi = (
            turn.by_bias @ (bias - old_bias)
            + turn.by_matrix.reshape(3, 9) @ (matrix - old_matrix).ravel()
            + turn.by_further @ (further - old_further)
        )
        if np.linalg.norm(psi) < MAX_FIRST_ORDER_ANGLE:
            return small_rotation(-psi) @ turn.mat_ji, turn
    turn = integrate_turn(
        data.time,
        data.rate,
        bias=bias,
        matrix=matrix,
        further=_further_of_turn(model, state, data, bias),
    )
    memory[key] = ((bias, matrix, further), turn)
    return turn.mat_ji, turn


def between_middles(poses: Poses, turn: TurnData, mat_ji: np.ndarray) -> np.ndarray:
    """
    Return the matrix of a turn, (3, 3).

    From the middle of the pose before it to that of the one after.
    """
    if poses.half_turn is None:
        return mat_ji
    return (
        small_rotation(-poses.half_turn[turn.last])
        @ mat_ji
        @ small_rotation(-poses.half_turn[turn.first])
    )


def _gravity_turn_rows(model, state, data, key, memory, across, poses):
    """
    The direction before the turn, rotated by the gyroscope, against the direction after it.

    Two rows, from middle to middle.
    """
    i, j = data.first, data.last
    mat_ji, turn = _integrated(
        model,
        state,
        data,
        state.values[model.gyro_bias] + 0.5 * (state.drift[i] + state.drift[j]),
        key,
        memory,
    )
    mat_ji = between_middles(poses, data, mat_ji)
    carried = mat_ji @ state.up[i]
    across_i, across_j = across[i], across[j]
    by_psi = across_j.T @ skew(carried)
    main, nuisance = np.zeros((2, model.size)), np.zeros((2, len(state.up), 5))
    main[:, model.gyro_bias] = by_psi @ turn.by_bias
    main[:, model.gyro_matrix] = by_psi @ turn.by_matrix.reshape(3, 9)
    main[:, model.extra_index('gyroscope')] = by_psi @ turn.by_further
    nuisance[:, i, OF_DIRECTION] = across_j.T @ mat_ji @ across_i
    nuisance[:, j, OF_DIRECTION] = -(carried @ state.up[j]) * np.eye(2)
    nuisance[:, [i, j], OF_DRIFT] = 0.5 * main[:, None, model.gyro_bias]
    return (
        -across_j.T @ carried,
        nuisance.reshape(2, -1),
        main,
        np.full(2, data.noise_variance),
        np.full(2, 2),
        np.tile([i, j], (2, 1)),
    )


def _known_turn_rows(model, state, data):
    """
    Equation of the rotation for a turn about a fixed body axis, three rows.

    It is ``matrix^-1 integral(measured - bias - further effects) = rotation``, whitened.
    """
    _, _, bias, matrix = model.linear(state.values)
    further = _further_of_turn(model, state, data, bias)
    turn = integrate_turn(data.time, data.rate, bias=bias, matrix=matrix, further=further)
    inverse = np.linalg.inv(matrix)
    rotation = inverse @ turn.integral
    main = np.zeros((3, model.size))
    main[:, model.gyro_bias] = -turn.duration * inverse
    main[:, model.gyro_matrix] = -np.einsum('rp,q->rpq', inverse, rotation).reshape(3, 9)
    impulse = np.einsum('m,mip->ip', np.diff(data.time), 0.5 * (further[1][:-1] + further[1][1:]))
    main[:, model.extra_index('gyroscope')] = -inverse @ impulse
    white = np.linalg.inv(np.linalg.cholesky(data.rotation_cov + data.noise_variance * np.eye(3)))
    count = len(state.up)
    return (
        white @ (data.rotation - rotation),
        np.zeros((3, 5 * count)),
        white @ main,
        np.ones(3),
        np.full(3, -1),
        np.full((3, 2), count),
    )


def _further_of_turn(model, state, data, bias):
    """
    Return output and columns of the gyroscope's further effects along a turn.

    They are at the forces and rates without the further effects.
    """
    bias_f, matrix_f, _, matrix = model.linear(state.values)
    force, rate = (
        np.linalg.solve(matrix_f, (data.force - bias_f).T).T,
        np.linalg.solve(matrix, (data.rate - bias).T).T,
    )
    return model.further(
        'gyroscope',
        state.values,
        force,
        rate=rate,
        time=data.time,
        temperature_c=data.temperature_c,
    )


def _flat(residual, place, blocks, main, noise, component):
    """
    Return three rows per pose; `blocks`: their columns of the pose's own nuisances at `place`.
    """
    own, nuisance = np.arange(len(residual)), np.zeros((*residual.shape, len(residual), 5))
    nuisance[own, :, own, place] = blocks
    return (
        residual.ravel(),
        nuisance.reshape(residual.size, -1),
        main.reshape(residual.size, -1),
        noise.ravel(),
        np.full(residual.size, component),
        np.repeat(own, 3)[:, None].repeat(2, axis=1),
    )
