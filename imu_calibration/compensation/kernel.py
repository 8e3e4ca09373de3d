"""
Compensation of one sample after another: a function written for one calibration, in plain floats.

The text of the function is made of the texts of the column groups and of the coefficients that the
catalogue's own compensation uses (`compensation.compensate`), multiplied out; zeros are left out.
With bias, matrix and lever arms it is one straight line of products; every further effect adds
fixed-point steps.
"""

import ast
import re
from collections.abc import Callable
from contextlib import suppress
from itertools import chain

import numpy as np

from imu_calibration.compensation.compensate import (
    CONVERGED,
    MAX_INVERSION_STEPS,
    FittedErrors,
    Transfer,
    invertible_values,
)
from imu_calibration.core.errors import InputError
from imu_calibration.effects.base import AXES, LEVER, Role
from imu_calibration.effects.expressions import SCALAR_FUNCTIONS, added, as_text, scaled
from imu_calibration.effects.forward_equations import coefficients_at_point
from imu_calibration.effects.sensor_model import SensorModel

CONVERGED_CHANGE = 1e-13
"""
Sum of the changes in one fixed-point step (m/s^2, rad/s) below which the iteration has converged.
"""
MAX_KERNEL_CHARACTERS = 200_000
"""Largest number of characters of a kernel; compiling it needs about a second and 100 MB."""
MAX_OPERATIONS = 50_000
"""
Largest number of operations for one sample, in all fixed-point steps; they need about 1 ms.
"""
OPERATIONS_OF_A_CALL = 8
"""Operations of arithmetic that need as much time as the call of one function."""
BEFOREHAND = {'temperature', 'thermal branch', 'vibration', 'reference temperature'}
"""Quantities of a sample that are available before the correction of either sensor."""


def make_kernel(calibration: FittedErrors, transfer: Transfer | None = None) -> Callable:
    """
    Return the function that compensates one sample.

    ``kernel(fx, fy, fz, wx, wy, wz, ax, ay, az, warming, branch, sx, sy, sz)``
    ``-> (fx, fy, fz, wx, wy, wz)`` reads the measured specific force (m/s^2) and rate (rad/s), the
    derivative of the *measured* rate (rad/s^2; it is multiplied by the inverse gyroscope matrix
    here), and the temperature above the calibration's reference temperature (K). The thermal branch
    and the vibration ((m/s^2)^2; `kinematics.signal_history`) are 0 if they are not given.
    Where the non-linear effects cannot be inverted it returns NaN.

    Parameters
    ----------
    calibration : Calibration
    transfer : compensation.Transfer, optional
        Another point and frame.

    Raises
    ------
    InputError
        If an effect to be inverted has columns that a single sample does not determine, or if the
        effects need more than `MAX_OPERATIONS`.

    """
    namespace = dict(SCALAR_FUNCTIONS)
    text = kernel_text(calibration, transfer)
    if len(text) > MAX_KERNEL_CHARACTERS:
        raise InputError(
            f'the effects of a calibration must expand to at most {MAX_KERNEL_CHARACTERS}'
            f' characters of arithmetic, got {len(text)}; use fewer or shorter effects',
            code='effects_too_long',
        )
    cost = 'a sum that Python cannot compile'  # unless the operations can be counted
    with suppress(RecursionError, MemoryError):  # the compiler steps into each term of a sum
        n_operations = count_operations(ast.parse(text))
        if n_operations <= MAX_OPERATIONS:
            exec(compile(text, '<compensation kernel>', 'exec'), namespace)
            return namespace['kernel']
        cost = str(n_operations)
    raise InputError(
        f'the effects of a calibration must need at most {MAX_OPERATIONS} operations for one'
        f' sample, got {cost}; use fewer or shorter effects',
        code='effects_cost',
    )


def count_operations(tree: ast.Module) -> int:
    """Return the operations of a kernel for a sample that needs every fixed-point step."""
    n_operations = _operations_in(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.For):
            n_operations += (MAX_INVERSION_STEPS - 1) * _operations_in(node)
    return n_operations


def _operations_in(tree: ast.AST) -> int:
    """Return the operations of a tree that is executed once."""
    n_operations = 0
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            n_operations += OPERATIONS_OF_A_CALL
        elif isinstance(node, (ast.BinOp, ast.UnaryOp, ast.Compare)):
            n_operations += 1
    return n_operations


def kernel_text(calibration: FittedErrors, transfer: Transfer | None = None) -> str:
    """
    Return the Python text of the function that `make_kernel` compiles.

    It computes the true force u, rate v and angular acceleration g from the measured force f, rate
    w and derivative of the rate a. With the arm r and the rotation of a transfer, and the lever
    matrix L::

        g = inverse gyroscope matrix @ a
        output = mat_ts (u - L(v, g) r), mat_ts v
    """
    model, values = invertible_values(calibration)
    replacements = _replacements(model.temperature_ref_c)
    accel = _SensorSums(model, 'accelerometer', values, replacements)
    gyro = _SensorSums(model, 'gyroscope', values, replacements)

    mat_ts = np.eye(3)
    arm_s = np.zeros(3)
    if transfer is not None:
        mat_ts = transfer.mat_ts
        arm_s = transfer.mat_ts.T @ transfer.arm_t
    lever = LEVER.products(replacements)
    force_of_arm = [_sum(arm_s, lever[start : start + 3]) for start in (0, 3, 6)]

    slope = _turned(gyro.inverse, _vector('a'))
    lines = [
        'def kernel(fx, fy, fz, wx, wy, wz, ax, ay, az, warming,'
        ' branch=0.0, sx=0.0, sy=0.0, sz=0.0):'
    ]
    # No iteration where the rate follows from its readings only, and the disturbance of the force
    # from the rate and, linearly, from the slope.
    rate_is_explicit = gyro.uses <= BEFOREHAND
    force_is_explicit = accel.uses <= BEFOREHAND | {'rate', 'angular acceleration'}
    if rate_is_explicit and force_is_explicit and not accel.has_nonlinear_slope:
        lines += _assigned('v', _less(gyro.linear, gyro.disturbance), '    ')
        force = _less(_less(accel.linear, accel.disturbance), force_of_arm)
        force = [_with_slope(row, slope) for row in force]
    else:
        lines += _assigned('g', slope, '    ') + _iteration(accel, gyro)
        force = _less(_vector('u'), force_of_arm)
    outputs = _turned(mat_ts, force) + _turned(mat_ts, _vector('v'))
    assignments, texts = _worked_out(outputs, '    ')
    return '\n'.join([*lines, *assignments, f'    return ({", ".join(texts)})']) + '\n'


class _SensorSums:
    """
    The equation of one sensor: true = linear - disturbance(true).

    With the matrix M, the bias b and the other inverted effects e::

        reading = b + M true + e(true)
        linear = M^-1 (reading - b)
        disturbance = M^-1 e(true)

    Each vector is three sums of products (`effects.expressions`) in the variables of the kernel.

    Parameters
    ----------
    model, values : SensorModel, ndarray
        The inverted effects.
    sensor : str
    replacements : dict
        As `_replacements`.

    """

    def __init__(self, model: SensorModel, sensor: str, values: np.ndarray, replacements: dict):
        matrix = model.value(sensor, Role.LINEAR, values)
        bias = model.value(sensor, Role.OFFSET, values)
        assert matrix is not None and bias is not None, 'every model has both'
        self.inverse = np.linalg.inv(matrix)
        """M^-1, shape (3, 3)."""
        readings = _turned(self.inverse, _vector('f' if sensor == 'accelerometer' else 'w'))
        constants = self.inverse @ bias
        self.linear = [added(row, {(): -constant}) for row, constant in zip(readings, constants)]
        """Sums in the measured readings, one per axis."""

        # Coefficients of the columns of the other effects, shape (n_columns, 3).
        further = coefficients_at_point(model, sensor, values)
        further[model.columns_of(sensor, Role.OFFSET)] -= bias
        further[model.columns_of(sensor, Role.LINEAR)] -= matrix.T
        further = further @ self.inverse.T
        self.disturbance: list[dict] = [{}, {}, {}]
        """Sums in the true motion and the conditions, one per axis."""
        self.uses: set[str] = set()
        """Quantities on which the disturbance depends, as `BEFOREHAND`."""
        layout = model.layout(sensor)
        for name, group in layout.groups.items():
            block = further[layout.rows[name]]
            if np.any(block):
                columns = group.products(replacements)
                for axis in range(3):
                    self.disturbance[axis] = added(
                        self.disturbance[axis], _sum(block[:, axis], columns)
                    )
                self.uses |= group.uses

    @property
    def has_nonlinear_slope(self) -> bool:
        """Whether the angular acceleration enters the disturbance in a product or a function."""
        for factors in chain.from_iterable(self.disturbance):
            product_text = ' '.join(factors)
            # Longer than the name itself, e.g. 'gx'.
            if re.search(r'\bg[xyz]\b', product_text) and len(product_text) > 2:
                return True
        return False


def _replacements(temperature_ref_c: float) -> dict[str, dict]:
    """Return name in a column -> the sum of products that replaces it in the kernel."""
    letters = {'f': 'u', 'w': 'v', 'alpha': 'g', 'vibration': 's'}
    vectors = {}
    for name, variable in letters.items():
        for k in AXES:
            vectors[f'{name}_{k}'] = {(f'{variable}{k}',): 1.0}
    return vectors | {
        'temperature_c': {('warming',): 1.0, (): temperature_ref_c},
        'temperature_ref_c': {(): temperature_ref_c},
        'thermal_branch': {('branch',): 1.0},
    }


def _iteration(accel: _SensorSums, gyro: _SensorSums) -> list[str]:
    """
    Return the lines that compute the true force in u and the true rate in v.

    By the same steps as `compensation.compensate`. Variables of the kernel: a and b are force and
    rate from matrix and bias only, p and q those of the previous step. The derivative of the rate,
    formerly in a, is already in g.
    """
    lines = _assigned('a', accel.linear, '    ') + _assigned('b', gyro.linear, '    ')
    lines += [
        '    ux, uy, uz, vx, vy, vz = ax, ay, az, bx, by, bz',
        f'    for _ in range({MAX_INVERSION_STEPS}):',
        '        px, py, pz, qx, qy, qz = ux, uy, uz, vx, vy, vz',
    ]
    for sums, true, linear in ((gyro, 'v', 'b'), (accel, 'u', 'a')):
        if any(sums.disturbance):
            lines += _assigned(true, _less(_vector(linear), sums.disturbance), '        ')
    # The sum of the changes in a step.
    components = ('ux', 'uy', 'uz', 'vx', 'vy', 'vz')
    previous = ('px', 'py', 'pz', 'qx', 'qy', 'qz')
    change = ' + '.join(f'abs({new} - {old})' for new, old in zip(components, previous))
    return lines + [
        f'        change = {change}',
        f'        if change < {CONVERGED_CHANGE}:',
        '            break',
        f'    if not change < {CONVERGED}:',
        "        return (float('nan'),) * 6",
    ]


def _vector(letter: str) -> list[dict]:
    """Return the components of a vector of the kernel as sums, e.g. fx, fy, fz."""
    return [{(letter + axis,): 1.0} for axis in AXES]


def _sum(coefficients: np.ndarray, rows: list[dict]) -> dict:
    """Return the linear combination of sums of products."""
    return added(*(scaled(row, float(c)) for c, row in zip(coefficients, rows)))


def _turned(matrix: np.ndarray, rows: list[dict]) -> list[dict]:
    """Return ``matrix @ rows`` of a vector of sums."""
    return [_sum(coefficients, rows) for coefficients in matrix]


def _less(rows: list[dict], subtracted: list[dict]) -> list[dict]:
    """Return the difference of two vectors of sums."""
    return [added(row, scaled(other, -1.0)) for row, other in zip(rows, subtracted)]


def _with_slope(row: dict, slope: list[dict]) -> dict:
    """
    Return a sum with g, the angular acceleration, replaced by its sums in the measured derivative.

    Each term contains a component of g not at all or as its only factor.
    """
    slope_of = {(f'g{axis}',): measured for axis, measured in zip(AXES, slope)}
    terms = []
    for factors, coefficient in row.items():
        if factors in slope_of:
            terms.append(scaled(slope_of[factors], coefficient))
        else:
            terms.append({factors: coefficient})
    return added(*terms)


def _assigned(letter: str, rows: list[dict], indent: str) -> list[str]:
    """Return the lines that assign three sums to the components of a vector, all at once."""
    lines, texts = _worked_out(rows, indent)
    return [*lines, f'{indent}{", ".join(letter + axis for axis in AXES)} = {", ".join(texts)}']


def _worked_out(rows: list[dict], indent: str) -> tuple[list[str], list[str]]:
    """Return (lines that compute each function and product once, the sums as texts)."""
    names: dict[str, str] = {}
    lines: list[str] = []
    sums = []

    def name_of(text: str) -> str:
        """Return the variable of a function or product, assigned at its first use."""
        if text not in names:
            names[text] = f'm{len(names)}'
            lines.append(f'{indent}{names[text]} = {text}')
        return names[text]

    for row in rows:
        # Functions are named before all products of the sum.
        named = []
        for factors in row:
            named.append([f if f.isidentifier() else name_of(f) for f in factors])
        # A product of several factors becomes one name; the constant has none.
        terms: dict[tuple[str, ...], float] = {}
        for factors, coefficient in zip(named, row.values()):
            if len(factors) > 1:
                factors = [name_of(' * '.join(factors))]
            terms[tuple(factors)] = coefficient
        sums.append(terms)
    return lines, [as_text(terms) for terms in sums]
