"""The equations of a calibration by hand: poses at rest, turns between them, and full turns of known angle."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.reference import skew
from imu_calibration.turn_integration import integrate_turn, small_rotation

LOWER = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))
"""Entries of the accelerometer matrix that the gauge leaves free."""
AXES = 'xyz'
PARAM_NAMES = (
    *(f'accelerometer.bias.{a}' for a in AXES), *(f'accelerometer.matrix.{AXES[i]}{AXES[j]}' for i, j in LOWER),
    *(f'gyroscope.bias.{a}' for a in AXES), *(f'gyroscope.matrix.{a}{b}' for a in AXES for b in AXES),
    *(f'gyroscope.gyro_g_sensitivity.{a}{b}' for a in AXES for b in AXES))
N_PARAMS = len(PARAM_NAMES)
ACCELEROMETER, GYRO_BIAS, GYRO_MATRIX, SENSITIVITY = slice(0, 9), slice(9, 12), slice(12, 21), slice(21, 30)
NOMINAL = np.array([0, 0, 0, 1, 0, 1, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, *[0] * 9], float)
"""Zero bias, identity matrices, no g-sensitivity."""
COMPONENTS = ('pose', 'drift', 'turn')
"""Scatter beyond the noise: of the accelerometer between poses, of the gyroscope's bias, of the turns."""


NEAR = 1e-3
"""rad; the square of it, times a turn's few radians, is what first order leaves out."""
CALM = 0.05
"""Least scatter of the drifts in units of the noise of the means, so that no row has infinite weight."""


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
    """Known rotation vector about a body axis, rad, shape (3,); None when gravity is the reference."""
    rotation_cov: np.ndarray | None = None
    """Covariance of `rotation`, shape (3, 3)."""


@dataclass(frozen=True, eq=False)
class State:
    """Everything that is estimated."""

    values: np.ndarray
    """Parameters in `PARAM_NAMES` order, shape (30,)."""
    up: np.ndarray
    """True direction of the specific force in each pose, unit vectors, shape (k, 3)."""
    drift: np.ndarray
    """Departure of the gyroscope's bias in each pose, rad/s, shape (k, 3)."""


@dataclass(frozen=True, eq=False)
class System:
    """Linearised equations ``residual = nuisance @ dn + main @ dp + error``, error of variance `noise` + `component`'s."""

    residual: np.ndarray
    """Measured minus predicted, shape (m,)."""
    nuisance: np.ndarray
    """Columns of directions (2 per pose) and drifts (3 per pose), shape (m, 5k)."""
    main: np.ndarray
    """Columns of the parameters, shape (m, 30)."""
    noise: np.ndarray
    """Known variance of each row, shape (m,)."""
    component: np.ndarray
    """Index into `COMPONENTS`, or -1, shape (m,)."""


def unpack(values):
    """Return (accelerometer bias, accelerometer matrix, gyroscope bias, gyroscope matrix, g-sensitivity)."""
    matrix = np.zeros((3, 3))
    for value, (i, j) in zip(values[3:9], LOWER):
        matrix[i, j] = value
    return values[0:3], matrix, values[GYRO_BIAS], values[GYRO_MATRIX].reshape(3, 3), values[SENSITIVITY].reshape(3, 3)


def tangent(up):
    """Return two unit vectors orthogonal to each row of `up`, shape (k, 3, 2)."""
    helper = np.eye(3)[np.argmin(np.abs(up), axis=1)]
    one = np.cross(up, helper)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    return np.stack([one, np.cross(up, one)], axis=2)


def moved(state, step, n_poses):
    """Return the state after a step (nuisance, then parameters)."""
    turn = np.einsum('kij,kj->ki', tangent(state.up), step[:2 * n_poses].reshape(-1, 2))
    up = state.up + turn
    return State(state.values + step[5 * n_poses:], up / np.linalg.norm(up, axis=1, keepdims=True),
                 state.drift + step[2 * n_poses:5 * n_poses].reshape(-1, 3))


def norm_rows(values, force, gravity):
    """
    Return ``|matrix^-1 (force - bias)| - gravity`` and minus its derivative by the nine accelerometer parameters.

    Parameters
    ----------
    values : array, shape (9,) or (30,)
    force : array, shape (k, 3)
        Mean readings at rest.
    gravity : float

    """
    bias, matrix = unpack(np.concatenate([values[:9], NOMINAL[9:]]))[:2]
    true = np.linalg.solve(matrix, (force - bias).T).T
    norm = np.linalg.norm(true, axis=1)
    back = np.linalg.solve(matrix.T, (true / norm[:, None]).T).T
    columns = [back] + [(back[:, i] * true[:, j])[:, None] for i, j in LOWER]
    return norm - gravity, np.hstack(columns)


def build_system(state, poses, turns, gravity, memory=None):
    """
    Stack the rows of poses, bias drifts and turns at the current state.

    Parameters
    ----------
    state : State
    poses : Poses
    turns : list of TurnData
    gravity : float
    memory : dict, optional
        Turns integrated before; near their parameters they are corrected to first order instead of being integrated anew.

    """
    memory = {} if memory is None else memory
    across = tangent(state.up)
    rows = [_pose_rows(state, poses, gravity, across), _drift_rows(state, poses, gravity), _calm_rows(state, poses)]
    for key, turn in enumerate(turns):
        rows.append(_gravity_turn_rows(state, turn, key, memory, across) if turn.rotation is None else _known_turn_rows(state, turn))
    return System(*(np.concatenate(parts) for parts in zip(*rows)))


def _pose_rows(state, poses, gravity, across):
    """``force = bias + matrix @ (gravity * up)``: three rows per pose, two of them spent on its direction."""
    bias, matrix, *_ = unpack(state.values)
    count = len(state.up)
    true = gravity * state.up
    residual = poses.force - bias - true @ matrix.T
    main = np.zeros((count, 3, N_PARAMS))
    main[:, :, 0:3] = np.eye(3)
    for column, (i, j) in enumerate(LOWER):
        main[:, i, 3 + column] = true[:, j]
    nuisance = np.zeros((count, 3, 5 * count))
    blocks = gravity * matrix @ across
    for k in range(count):
        nuisance[k, :, 2 * k:2 * k + 2] = blocks[k]
    return _flat(residual, nuisance, main, poses.force_sem**2, 0)


def _drift_rows(state, poses, gravity):
    """``rate = bias + sensitivity @ (gravity * up) + drift`` at rest."""
    count = len(state.up)
    residual = poses.rate - state.values[GYRO_BIAS] - gravity * state.up @ unpack(state.values)[4].T - state.drift
    main = np.zeros((count, 3, N_PARAMS))
    main[:, :, GYRO_BIAS] = np.eye(3)
    main[:, :, SENSITIVITY] = np.einsum('ip,kq->kipq', np.eye(3), gravity * state.up).reshape(count, 3, 9)
    return _flat(residual, _drift_columns(count), main, poses.rate_sem**2, -1)


def _calm_rows(state, poses):
    """``0 = drift`` within its own scatter."""
    count = len(state.up)
    return _flat(-state.drift, _drift_columns(count), np.zeros((count, 3, N_PARAMS)), (CALM * poses.rate_sem)**2, 1)


def _drift_columns(count):
    nuisance = np.zeros((count, 3, 5 * count))
    for k in range(count):
        nuisance[k, :, 2 * count + 3 * k:2 * count + 3 * k + 3] = np.eye(3)
    return nuisance


def _integrated(state, data, bias, key, memory):
    """Return (mat_ji, Turn), from memory when the gyroscope's parameters have hardly moved since."""
    _, _, _, matrix, sensitivity = unpack(state.values)
    if key in memory:
        (old_bias, old_matrix, old_sensitivity), turn = memory[key]
        psi = (turn.by_bias @ (bias - old_bias) + turn.by_matrix.reshape(3, 9) @ (matrix - old_matrix).ravel()
               + turn.by_sensitivity.reshape(3, 9) @ (sensitivity - old_sensitivity).ravel())
        if np.linalg.norm(psi) < NEAR:
            return small_rotation(-psi) @ turn.mat_ji, turn
    turn = integrate_turn(data.time, data.rate, bias, matrix, sensitivity, _true_force(state, data))
    memory[key] = ((bias, matrix, sensitivity), turn)
    return turn.mat_ji, turn


def _gravity_turn_rows(state, data, key, memory, across):
    """The direction before the turn, carried along by the gyroscope, against the direction after it: two rows."""
    count, i, j = len(state.up), data.first, data.last
    mat_ji, turn = _integrated(state, data, state.values[GYRO_BIAS] + 0.5 * (state.drift[i] + state.drift[j]), key, memory)
    carried = mat_ji @ state.up[i]
    across_i, across_j = across[i], across[j]
    by_psi = across_j.T @ skew(carried)
    main, nuisance = np.zeros((2, N_PARAMS)), np.zeros((2, 5 * count))
    main[:, GYRO_BIAS] = by_psi @ turn.by_bias
    main[:, GYRO_MATRIX] = by_psi @ turn.by_matrix.reshape(3, 9)
    main[:, SENSITIVITY] = by_psi @ turn.by_sensitivity.reshape(3, 9)
    nuisance[:, 2 * i:2 * i + 2] += across_j.T @ mat_ji @ across_i
    nuisance[:, 2 * j:2 * j + 2] -= (carried @ state.up[j]) * np.eye(2)
    for pose in (i, j):
        nuisance[:, 2 * count + 3 * pose:2 * count + 3 * pose + 3] += 0.5 * main[:, GYRO_BIAS]
    return -across_j.T @ carried, nuisance, main, np.full(2, data.noise_variance), np.full(2, 2)


def _known_turn_rows(state, data):
    """``matrix^-1 integral(measured - bias) = rotation`` for a turn about a fixed body axis, whitened: three rows."""
    _, _, bias, matrix, sensitivity = unpack(state.values)
    force = _true_force(state, data)
    turn = integrate_turn(data.time, data.rate, bias, matrix, sensitivity, force)
    impulse = 0.5 * np.diff(data.time) @ (force[:-1] + force[1:])
    inverse = np.linalg.inv(matrix)
    rotation = inverse @ turn.integral
    main = np.zeros((3, N_PARAMS))
    main[:, GYRO_BIAS] = -turn.duration * inverse
    main[:, GYRO_MATRIX] = -np.einsum('rp,q->rpq', inverse, rotation).reshape(3, 9)
    main[:, SENSITIVITY] = -np.einsum('rp,q->rpq', inverse, impulse).reshape(3, 9)
    white = np.linalg.inv(np.linalg.cholesky(data.rotation_cov + data.noise_variance * np.eye(3)))
    return (white @ (data.rotation - rotation), np.zeros((3, 5 * len(state.up))), white @ main, np.ones(3), np.full(3, -1))


def _true_force(state, data):
    bias, matrix = unpack(state.values)[:2]
    return np.linalg.solve(matrix, (data.force - bias).T).T


def _flat(residual, nuisance, main, noise, component):
    return (residual.ravel(), nuisance.reshape(-1, nuisance.shape[-1]), main.reshape(-1, N_PARAMS), noise.ravel(),
            np.full(residual.size, component))
