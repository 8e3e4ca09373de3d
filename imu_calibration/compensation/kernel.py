"""
Compensation of one sample after another: a function written for one calibration, in plain floats.

The text of the function is made from the same coefficients that the catalogue's own compensation uses (`compensation`); zeros
are left out. With bias, matrix and lever arms it is one straight line of products; every further effect adds fixed-point steps.
"""

import numpy as np

from imu_calibration.compensation.compensate import CONVERGED, ITERATIONS, invertible_values
from imu_calibration.effects.base import AXES, SENSORS
from imu_calibration.effects.forward_equations import coefficients_at_point
from imu_calibration.effects.regressors import CUBES, SQUARES

SETTLED = 1e-13
"""Sum of the changes in one fixed-point step (m/s^2, rad/s) after which there is nothing left to gain."""
OWN = {'accelerometer': 'force', 'gyroscope': 'rate'}
LEVER = ('-(yy + zz)', 'xy - gz', 'xz + gy', 'xy + gz', '-(xx + zz)', 'yz - gx', 'xz - gy', 'yz + gx', '-(xx + yy)')
"""Entries of ``[alpha x] + [omega x]^2`` by rows, from products of rates and the angular acceleration g."""
PRODUCTS = ('xx', 'yy', 'zz', 'xy', 'xz', 'yz', 'gx', 'gy', 'gz')
LEVER_OF_PRODUCTS = np.array([[0, -1, -1, 0, 0, 0, 0, 0, 0], [0, 0, 0, 1, 0, 0, 0, 0, -1], [0, 0, 0, 0, 1, 0, 0, 1, 0],
                              [0, 0, 0, 1, 0, 0, 0, 0, 1], [-1, 0, -1, 0, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 1, -1, 0, 0],
                              [0, 0, 0, 0, 1, 0, 0, -1, 0], [0, 0, 0, 0, 0, 1, 1, 0, 0], [-1, -1, 0, 0, 0, 0, 0, 0, 0]], float)
"""The same as a matrix, rows as in `LEVER`, columns as in `PRODUCTS`."""


def make_kernel(calibration, transfer=None):
    """
    Return the function that compensates one sample.

    ``kernel(fx, fy, fz, wx, wy, wz, ax, ay, az, dt) -> (fx, fy, fz, wx, wy, wz)`` takes the measured specific force (m/s^2) and
    rate (rad/s), the derivative of the *measured* rate (rad/s^2; it goes through the inverse gyroscope matrix here), and the
    temperature above the calibration's reference temperature (K). Where the non-linear effects cannot be undone it returns NaN.

    Parameters
    ----------
    calibration : Calibration
    transfer : compensation.Transfer, optional
        Another point and frame.

    """
    namespace = {}
    exec(compile(kernel_text(calibration, transfer), '<compensation kernel>', 'exec'), namespace)
    return namespace['kernel']


def kernel_text(calibration, transfer=None):
    """Return the Python text of the function that `make_kernel` compiles."""
    model, values = invertible_values(calibration)
    parts = {sensor: _Part(model, sensor, values) for sensor in SENSORS}
    accel, gyro = parts['accelerometer'], parts['gyroscope']
    turn, arm = (np.eye(3), np.zeros(3)) if transfer is None else (transfer.mat_ts, transfer.mat_ts.T @ transfer.arm_t)
    lines = ['def kernel(fx, fy, fz, wx, wy, wz, ax, ay, az, dt):']
    lines += [f'    v{k} = {_sum(row, ("wx", "wy", "wz"), c)}' for k, row, c in zip(AXES, gyro.inverse, gyro.constant)]
    straight = set(accel.rest) <= {'lever'} and not gyro.rest
    if not straight:
        lines += [f'    g{k} = {_sum(row, ("ax", "ay", "az"))}' for k, row in zip(AXES, gyro.inverse)]
        lines += _iteration(accel, gyro)
    lever = (accel.rest['lever'] if straight and 'lever' in accel.rest else np.zeros((9, 3))) + np.kron(np.eye(3), arm[:, None])
    lever = LEVER_OF_PRODUCTS.T @ lever
    if straight:
        lever[6:] = gyro.inverse.T @ lever[6:]
        lines += _outcome(('fx', 'fy', 'fz'), accel.inverse, accel.constant, ('ax', 'ay', 'az'), lever, turn)
    else:
        lines += _outcome(('ux', 'uy', 'uz'), np.eye(3), np.zeros(3), ('gx', 'gy', 'gz'), lever, turn)
    return '\n'.join(lines) + '\n'


class _Part:
    """One sensor: true = inverse @ measured + constant - rest(true)."""

    def __init__(self, model, sensor, values):
        matrix = values[model.slices[sensor, 'matrix']].reshape(3, 3)
        bias = values[model.slices[sensor, 'bias']]
        self.inverse = np.linalg.inv(matrix)
        self.constant = -self.inverse @ bias
        self.rest = {}
        start, total = 0, coefficients_at_point(model, sensor, values)
        for group, width in model.groups(sensor):
            block = total[start:start + width]
            block = block - (bias if group == 'one' else matrix.T if group == OWN[sensor] else 0.0)
            start += width
            if np.any(np.abs(block) > 0) and group not in ('one', OWN[sensor]):
                self.rest[group] = block @ self.inverse.T


def _iteration(accel, gyro):
    """Return the lines that leave the true force in u and the true rate in v, by the same steps as `compensation.compensate`."""
    # The arguments ax, ay, az have gone into gx, gy, gz by now: a is the force, b the rate, that matrix and bias alone would give.
    lines = [f'    a{k} = {_sum(row, ("fx", "fy", "fz"), c)}' for k, row, c in zip(AXES, accel.inverse, accel.constant)]
    lines += ['    bx, by, bz, ux, uy, uz = vx, vy, vz, ax, ay, az',
              f'    for _ in range({ITERATIONS}):', '        px, py, pz, qx, qy, qz = ux, uy, uz, vx, vy, vz']
    for part, names, known in ((gyro, 'v', 'b'), (accel, 'u', 'a')):
        columns, block = [], []
        for group, coefficients in part.rest.items():
            used = np.flatnonzero(np.any(coefficients != 0, axis=1))
            columns += [_columns(group)[k] for k in used]
            block.append(coefficients[used])
        if not columns:
            continue
        block = np.concatenate(block)
        if 'lever' in part.rest:
            lines += ['        xx, yy, zz, xy, xz, yz = vx * vx, vy * vy, vz * vz, vx * vy, vx * vz, vy * vz']
        lines += [f'        c{k} = {text}' for k, text in enumerate(columns)]
        lines += [f'        {names}{axis} = {known}{axis} - ({_sum(block[:, i], [f"c{k}" for k in range(len(columns))])})'
                  for i, axis in enumerate(AXES)]
    change = ' + '.join(f'abs({a}{k} - {b}{k})' for a, b in (('u', 'p'), ('v', 'q')) for k in AXES)
    return lines + [f'        change = {change}', f'        if change < {SETTLED}:', '            break',
                    f'    if not change < {CONVERGED}:', "        return (float('nan'),) * 6"]


def _columns(group):
    """Return the expressions of a column group in the true force u, the true rate v, products, angular acceleration g and dt."""
    vector = ['ux', 'uy', 'uz'] if group.startswith('force') else ['vx', 'vy', 'vz']
    kind = group.partition('_')[2]
    if group == 'lever':
        return [f'({text})' for text in LEVER]
    if group == 'temperature':
        return ['dt']
    if kind == 'squares':
        return [f'{vector[j]} * {vector[k]}' for j, k in SQUARES]
    if kind == 'cubes':
        return [f'{vector[i]} * {vector[j]} * {vector[k]}' for i, j, k in CUBES]
    if kind == 'signed':
        return [f'(({vi} > 0) - ({vi} < 0)) * {vj}' for vi in vector for vj in vector]
    if kind == 'temperature':
        return [f'{v} * dt' for v in vector]
    return vector


def _outcome(force, inverse, constant, alpha, lever, turn):
    """Return the lines that take out what is left of the lever arms, turn into the target frame and return."""
    lever, inverse, constant = lever @ turn.T, turn @ inverse, turn @ constant
    lines = []
    if np.any(lever[:6]):
        lines += ['    xx, yy, zz, xy, xz, yz = vx * vx, vy * vy, vz * vz, vx * vy, vx * vz, vy * vz']
    names = [*force, *PRODUCTS[:6], *alpha]
    texts = [_sum(np.concatenate([inverse[i], -lever[:, i]]), names, constant[i]) for i in range(3)]
    texts += [_sum(row, ('vx', 'vy', 'vz')) for row in turn]
    return lines + ['    return (' + ', '.join(texts) + ')']


def _sum(coefficients, names, constant=0.0):
    """Return the text of a linear combination without its zeros."""
    terms = [repr(float(constant))] if constant else []
    for c, name in zip(coefficients, names):
        if c == 1.0:
            terms.append(name)
        elif c:
            terms.append(f'{float(c)!r} * {name}')
    return ' + '.join(terms) or '0.0'
