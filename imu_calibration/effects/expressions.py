"""
Columns of effects as text.

A safe expression of the sensor inputs, its derivatives, and groups of columns.
"""

import ast
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import chain, product
from typing import Any, cast

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.kinematics.rotations import Reference

MAX_COLUMN_JOINTS = 7
"""Largest number of joints in a column."""
QUANTITIES: dict[str, dict[str, tuple]] = {
    'force': {f'f_{a}': ('force_s', k) for k, a in enumerate('xyz')},
    'rate': {f'w_{a}': ('rate_s', k) for k, a in enumerate('xyz')},
    'angular acceleration': {f'alpha_{a}': ('alpha_s', k) for k, a in enumerate('xyz')},
    'attitude': {
        f'c_{"xyz"[i]}{"xyz"[j]}': ('mat_sn', i, j) for i, j in product(range(3), repeat=2)
    },
    'joint angle': {f'angle_{k + 1}': ('joint_angle', k) for k in range(MAX_COLUMN_JOINTS)},
    'joint rate': {f'joint_rate_{k + 1}': ('joint_rate', k) for k in range(MAX_COLUMN_JOINTS)},
    'time': {'time': ('time',)},
    'temperature': {'temperature_c': ('temperature_c',)},
    'temperature rate': {'temperature_rate': ('temperature_rate',)},
    'thermal branch': {'thermal_branch': ('thermal_branch',)},
    'vibration': {f'vibration_{a}': ('vibration', k) for k, a in enumerate('xyz')},
    'reference temperature': {'temperature_ref_c': (None,)},
    'time constant': {'tau': (None,)},
}
"""
Quantity -> {name in a text: where a Reference holds it}: true specific force, rate and angular
acceleration in s, level frame to s, joints from the base outwards.
"""
VOCABULARY = (
    'f_x .. z, w_x .. z, alpha_x .. z, c_xx .. zz, angle_1 .. 7, joint_rate_1 .. 7, time,'
    ' temperature_c, temperature_rate, thermal_branch, vibration_x .. z, temperature_ref_c, tau'
)
"""The names, for messages."""
PLACES: dict[str, tuple] = {}
"""Name in a text -> (field of a Reference or None, indices behind the samples)."""
QUANTITY_OF: dict[str, str] = {}
"""Name in a text -> its quantity."""
for _quantity, _names in QUANTITIES.items():
    PLACES |= _names
    QUANTITY_OF |= dict.fromkeys(_names, _quantity)
FUNCTIONS = ('abs', 'sign', 'sqrt', 'exp', 'expm1', 'log', 'sin', 'cos', 'tanh')
# Limits of a column, so that no document costs more than arithmetic should.
MAX_CHARACTERS = 400
MAX_COLUMN_DEPTH = 30
MAX_EXPONENT = 9
MAX_PRODUCTS = 200
MAX_COLUMN_NUMBER = 1e30
LONGEST_EXPANDED = 5000
"""
Characters of a column at most when it is multiplied out: nested powers of a function multiply its
text by nine at each level.
"""
UNBOUNDED_FUNCTIONS = ('sqrt', 'exp', 'expm1', 'log')
"""Functions without a finite value everywhere."""
OPERATORS = (ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Pow)
SIGNS = (ast.UAdd, ast.USub)


Sum = dict[tuple[str, ...], float]
"""Products of factors -> their coefficients."""


def read(text: str) -> ast.expr:
    """
    Return the syntax tree of a column, with constants folded.

    Raises
    ------
    InputError
        When it contains anything but numbers, ``+ - * / **``, brackets, the names in `PLACES` and
        the `FUNCTIONS` of one argument; with the position.

    """
    try:
        text = ' '.join(text.split())
        if len(text) > MAX_CHARACTERS:
            raise _Refused(MAX_CHARACTERS, 'too long')
        for position, letter in enumerate(text):
            if not letter.isascii():
                raise _Refused(position, 'a letter that is not ASCII')
        with warnings.catch_warnings():
            warnings.simplefilter('ignore', SyntaxWarning)
            tree = ast.parse(text, mode='eval').body
        return _checked(tree, 0)
    except SyntaxError as error:
        raise _refusal(text, (error.offset or 1) - 1, 'this cannot be read') from error
    except _Refused as error:
        raise _refusal(text, error.position, error.why) from error
    except (AttributeError, TypeError, ValueError, RecursionError, MemoryError) as error:
        raise _refusal(text, 0, 'this cannot be read') from error


class _Refused(Exception):
    """A forbidden part of a column, and its position."""

    def __init__(self, position: int, why: str):
        super().__init__(why)
        self.position = position
        self.why = why


def _refusal(text: str, position: int, why: str) -> InputError:
    """Return the error of a column that is refused because of the part at a position."""
    shown = ' '.join(str(text)[position : position + 30].split())
    return InputError(
        f'a column must be arithmetic of at most {MAX_CHARACTERS} characters in {VOCABULARY} with'
        f' {", ".join(FUNCTIONS)} and powers up to {MAX_EXPONENT}, got {why} at character'
        f' {position + 1}: {shown!r}; correct it',
        code='not_arithmetic',
    )


def _checked(node: Any, depth: int) -> Any:
    """
    Return a copy of a tree of permitted operations, with constants folded into finite floats.

    An integer could grow without limit, a float raises. `depth` is that of the node in its column.
    """
    if depth > MAX_COLUMN_DEPTH:
        raise _Refused(node.col_offset, 'too many brackets')
    deeper = depth + 1
    match node:
        case ast.BinOp(left=left, op=ast.Pow() as op, right=exponent):
            power = exponent.value if isinstance(exponent, ast.Constant) else None
            if type(power) is not int or not 0 <= power <= MAX_EXPONENT:  # a bool is no power
                raise _Refused(
                    exponent.col_offset, f'a power that is not an integer up to {MAX_EXPONENT}'
                )
            return _folded(ast.BinOp(_checked(left, deeper), op, exponent), node)
        case ast.BinOp(left=left, op=op, right=right) if isinstance(op, OPERATORS):
            return _folded(ast.BinOp(_checked(left, deeper), op, _checked(right, deeper)), node)
        case ast.UnaryOp(op=op, operand=operand) if isinstance(op, SIGNS):
            return _folded(ast.UnaryOp(op, _checked(operand, deeper)), node)
        case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]) if name in FUNCTIONS:
            return _folded(ast.Call(node.func, [_checked(argument, deeper)], []), node)
        case ast.Name(id=name) if name in PLACES:
            return ast.copy_location(ast.Name(name, ast.Load()), node)
        case ast.Name(id=name):
            raise _Refused(node.col_offset, f"the unknown name '{name[:30]}'")
        # Booleans are integers in Python, and no numbers of a formula.
        case ast.Constant(value=int() | float() as value) if (
            not isinstance(value, bool) and abs(value) < MAX_COLUMN_NUMBER
        ):
            return ast.copy_location(ast.Constant(float(value)), node)
    raise _Refused(node.col_offset, 'an operation that is not arithmetic')


def _folded(operation: Any, source: Any) -> Any:
    """
    Return an operation, or its value as a constant if all its operands are constants.

    `operation` is made of checked operands; `source` is the same operation in the tree of the text,
    for its position there. Raises _Refused for a division by zero and a value that is too large.
    """
    match operation:
        # The divisor may be the value of a folded operation: 1 / (2 - 2).
        case ast.BinOp(op=ast.Div(), right=ast.Constant(value=0.0)):
            raise _Refused(source.col_offset, 'a division by zero')
        case ast.BinOp():
            operands = [operation.left, operation.right]
        case ast.UnaryOp():
            operands = [operation.operand]
        case _:  # a call
            operands = operation.args
    if not all(isinstance(operand, ast.Constant) for operand in operands):
        return ast.copy_location(operation, source)

    # No operand is a name, so that the operation has a value without any quantity.
    value_of = array_function([operation])
    with np.errstate(all='ignore'):
        value = float(value_of({})[0])
    if not abs(value) < MAX_COLUMN_NUMBER:  # also for NaN
        raise _Refused(source.col_offset, 'a number that is not finite')
    return ast.copy_location(ast.Constant(value), source)


def names_in(tree: ast.expr) -> set[str]:
    """Return the names of quantities in a tree."""
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and node.id in PLACES}


def may_fail(tree: ast.expr) -> bool:
    """
    Return whether a column may be without a finite value somewhere.

    It divides, or calls a function that is not defined everywhere.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
            if not isinstance(node.right, ast.Constant):
                return True
        if isinstance(node, ast.Call) and called(node) in UNBOUNDED_FUNCTIONS:
            return True
    return False


def called(node: ast.Call) -> str:
    """Return the name of the function of a call; `read` accepts only calls by name."""
    return node.func.id if isinstance(node.func, ast.Name) else ''


def array_function(trees: Sequence[ast.expr]) -> Callable:
    """Return ``function({name: array or number}) -> tuple of arrays``, one for each tree."""
    source = ast.Expression(ast.Tuple(list(trees), ast.Load()))
    code = compile(ast.fix_missing_locations(source), '<columns>', 'eval')
    functions = {
        '__builtins__': {},
        **{name: getattr(np, name) for name in FUNCTIONS},
        'abs': _abs,
        'sign': _sign,
    }
    # The trees contain only arithmetic: see `read`.
    return lambda values: eval(code, functions, values)


def _sign(x: Any) -> Any:
    """Return the sign of the real part: its derivative, an imaginary part, is zero."""
    return np.sign(np.real(x))


def _abs(x: Any) -> Any:
    """Return x or -x by the sign of the real part, so that an imaginary derivative is kept."""
    return np.where(np.real(x) < 0, -x, x) if np.iscomplexobj(x) else np.abs(x)


def products(tree: ast.expr, sum_of: dict[str, Sum]) -> Sum:
    """
    Return a column as a sum of products, {factors: coefficient}.

    The factors are a sorted tuple of Python expressions in plain floats.

    Parameters
    ----------
    sum_of : dict
        Name of a quantity -> its sum of products.

    Raises
    ------
    InputError
        When it contains an undefined name or too many products.

    """
    match node := tree:
        case ast.Constant():
            return {(): float(node.value)}  # type: ignore[arg-type]   # `read` accepts no other
        case ast.Name():
            if node.id not in sum_of:
                raise InputError(
                    f"a column that compensation undoes must do without '{node.id}'"
                    f' ({QUANTITY_OF[node.id]}), which is not known there; declare the effect with'
                    " compensation 'none'",
                    code='variable_unavailable',
                )
            return sum_of[node.id]
        case ast.UnaryOp():
            sign = -1.0 if isinstance(node.op, ast.USub) else 1.0
            return scaled(products(node.operand, sum_of), sign)
        case ast.Call():
            argument = as_text(products(node.args[0], sum_of))
            factor = f'{called(node)}({argument})'
            # A call costs more than all the arithmetic.
            if called(node) == 'sign' and argument.isidentifier():
                factor = f'(({argument} > 0) - ({argument} < 0))'
            return {(factor,): 1.0}
        case ast.BinOp():
            return _of_two(node, sum_of)
    raise TypeError(f'{ast.dump(tree):.60} is no arithmetic')  # `read` accepts none


def _of_two(node: ast.BinOp, sum_of: dict[str, Sum]) -> Sum:
    """Return an operation on two columns as a sum of products; `sum_of` as in `products`."""
    left = products(node.left, sum_of)
    if isinstance(node.op, ast.Pow):
        result: Sum = {(): 1.0}
        for _ in range(cast(ast.Constant, node.right).value):  # type: ignore[arg-type]   # `read` accepts integer powers
            result = _multiplied(result, left)
        return result
    right = products(node.right, sum_of)
    if isinstance(node.op, ast.Mult):
        return _multiplied(left, right)
    if isinstance(node.op, ast.Div):
        # The product of no factors is a constant.
        constant_divisor = right[()] if right.keys() == {()} else 0.0
        if constant_divisor:
            return scaled(left, 1.0 / constant_divisor)
        return {(f'divided({as_text(left)}, {as_text(right)})',): 1.0}
    return added(left, right if isinstance(node.op, ast.Add) else scaled(right, -1.0))


def added(*sums: Sum) -> Sum:
    """Return the sum of sums of products; products that cancel are omitted."""
    total: Sum = {}
    for terms in sums:
        for factors, coefficient in terms.items():
            total[factors] = total.get(factors, 0.0) + coefficient
    return {factors: coefficient for factors, coefficient in total.items() if coefficient != 0.0}


def scaled(terms: Sum, factor: float) -> Sum:
    """Return a multiple of a sum of products; products that become zero are omitted."""
    multiple = {}
    for factors, coefficient in terms.items():
        if factor * coefficient != 0.0:
            multiple[factors] = factor * coefficient
    return multiple


def _multiplied(left: Sum, right: Sum) -> Sum:
    """Return the product of two sums of products, multiplied out."""
    if len(left) * len(right) > MAX_PRODUCTS:
        raise InputError(
            f'a column must have at most {MAX_PRODUCTS} products when it is multiplied out, this'
            ' one has more; write it shorter',
            code='column_expands',
        )
    terms = []
    for left_factors, left_coefficient in left.items():
        for right_factors, right_coefficient in right.items():
            factors = tuple(sorted(left_factors + right_factors))
            terms.append({factors: left_coefficient * right_coefficient})
    result = added(*terms)
    if sum(map(len, chain.from_iterable(result))) > LONGEST_EXPANDED:
        raise InputError(
            f'a column must have at most {LONGEST_EXPANDED} characters when it is multiplied out,'
            ' this one has more; write it without powers inside of powers',
            code='column_expands',
        )
    return result


def as_text(terms: Sum) -> str:
    """
    Return a sum of products as a Python expression, without coefficients of 1.

    Raises
    ------
    InputError
        When a coefficient is not finite: `inf` and `nan` are no numbers in an expression.

    """
    if not all(math.isfinite(coefficient) for coefficient in terms.values()):
        raise InputError(
            'the coefficients of effects must be finite when they are multiplied out, got one that'
            ' overflows; correct the values of the calibration',
            code='column_overflows',
        )
    texts = []
    for factors, coefficient in terms.items():
        if coefficient != 1.0 or not factors:
            factors = (repr(float(coefficient)), *factors)
        texts.append(' * '.join(factors))
    return ' + '.join(texts) or '0.0'


def _or_nan(function: Callable[..., float]) -> Callable[..., float]:
    """Return a function that is NaN where `function` is undefined or overflows."""

    def careful(*arguments: float) -> float:
        try:
            return function(*arguments)
        except (ValueError, OverflowError, ZeroDivisionError):
            return math.nan

    return careful


SCALAR_FUNCTIONS = {
    'abs': abs,
    'sign': lambda x: (x > 0) - (x < 0),
    'divided': _or_nan(lambda a, b: a / b),
    **{name: _or_nan(getattr(math, name)) for name in FUNCTIONS if hasattr(math, name)},
}
"""Functions in the expressions of `products`: of plain floats, NaN where undefined."""


COMPLEX_STEP = 1e-30
"""Complex step of the derivative by a time constant."""


@dataclass(frozen=True, eq=False)
class ColumnCentre:
    """
    The part of a group of columns that bias and matrix describe: ``constant + slope @ true``.

    Compensation applies it for effects that it cannot invert.
    """

    constant: np.ndarray
    """Part of the bias, shape (width,)."""
    slope: np.ndarray
    """Part of the matrix, per unit of the true input, shape (width, 3)."""
    true_input: str
    """Field of a `Reference` with the true input of the sensor."""

    def at(self, ref: Reference) -> np.ndarray:
        """Return this part of the columns, shape (n, width)."""
        return self.constant + getattr(ref, self.true_input) @ self.slope.T


@dataclass(frozen=True)
class ColumnGroup:
    """
    Columns that belong together, by one text for each.

    The texts (`effects.expressions`) define them completely: arrays of columns, the compensation of
    a sample and the data that the columns need are derived from them. A group with a time constant
    `tau` has each column and its derivative by `tau`.
    """

    name: str
    """Effects of one sensor that name the same group share its columns."""
    text: tuple
    """One expression for each column."""
    owner: str = ''
    """The effect whose last value is `tau`, where the text contains it."""

    def __reduce__(self):
        """Pickle without cached values: code cannot be pickled."""
        return ColumnGroup, tuple(getattr(self, f.name) for f in fields(self))

    @cached_property
    def _trees(self) -> list[ast.expr]:
        """Syntax tree of each text."""
        return [read(text) for text in self.text]

    @cached_property
    def names(self) -> frozenset[str]:
        """Names of `expressions.PLACES` in the texts."""
        return frozenset().union(*map(names_in, self._trees))

    @cached_property
    def uses(self) -> frozenset[str]:
        """Quantities of `expressions.QUANTITIES` that the columns are made of."""
        return frozenset(QUANTITY_OF[name] for name in self.names)

    @cached_property
    def width(self) -> int:
        """Number of columns."""
        return len(self.text) * (2 if 'tau' in self.names else 1)

    @cached_property
    def _function(self) -> Callable:
        """``function({name: array or number}) -> tuple``, an array for each text."""
        return array_function(self._trees)

    @cached_property
    def _may_fail(self) -> bool:
        """Whether a column may be without a finite value somewhere."""
        return any(map(may_fail, self._trees))

    @cached_property
    def _places(self) -> list[tuple[str, str, tuple]]:
        """(name in a text, field of a Reference, index of that array) of each name."""
        places = []
        for name in sorted(self.names):
            field, *index = PLACES[name]
            if field:  # other names are not fields of a Reference
                places.append((name, field, (slice(None), *index)))
        return places

    def columns(self, ref: Reference, point: dict[str, Any]) -> np.ndarray:
        """
        Return the columns, shape (n, width).

        Parameters
        ----------
        ref : Reference
            The true motion.
        point : dict
            'temperature_ref_c', effect name -> values where columns depend on them, 'centre': group
            -> `ColumnCentre` to subtract (``SensorModel.full_point``).

        Raises
        ------
        InputError
            When a column is not finite everywhere.

        """
        try:
            values = {name: getattr(ref, field)[index] for name, field, index in self._places}
        except IndexError as error:
            raise InputError(
                f"the columns of '{self.name}' refer to more joints than exist:"
                f' {", ".join(self.text)}; correct them'
            ) from error
        values['temperature_ref_c'] = np.float64(point.get('temperature_ref_c', 25.0))
        result = np.empty((len(ref), self.width))
        count = len(self.text)
        if 'tau' in self.names:
            # Complex step: d column / d tau = Im(column(tau + i h)) / h, without cancellation.
            values['tau'] = point[self.owner][-1] + 1j * COMPLEX_STEP
        with np.errstate(all='ignore'):
            for k, column in enumerate(self._function(values)):
                result[:, k] = np.real(column)
                if self.width > count:
                    result[:, count + k] = np.imag(column) / COMPLEX_STEP
        if self.name in point.get('centre', ()):
            result -= point['centre'][self.name].at(ref)
        if self._may_fail and not np.all(np.isfinite(result)):
            raise InputError(
                f"the columns of '{self.name}' must be finite in the whole recording,"
                f' {", ".join(self.text)} is not; do not divide by a quantity that passes through'
                ' zero, and use no root or logarithm of a negative quantity',
                code='column_not_finite',
            )
        return result

    def products(self, sum_of: dict[str, Sum]) -> list[Sum]:
        """Return each column as a sum of products (`expressions.products`)."""
        return [products(tree, sum_of) for tree in self._trees]
