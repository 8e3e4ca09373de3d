"""
Requirements of documents: declared once for each type of document, checked by one function.

A requirement is a function of a value and its place that raises `Unmet`; the functions below make
them. A type of document is a `Document`, declared in the module that reads it. Values are checked,
not converted. Other parts than the declared ones are allowed unless `closed` is set.
"""

import math
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Real
from typing import Any

import numpy as np

from imu_calibration.core.errors import DocumentError, InputError, did_you_mean, shortened

CODES = {
    'mapping': 'not_a_mapping',
    'missing': 'keys_missing',
    'unknown': 'key_unknown',
    'type': 'part_type',
    'range': 'part_range',
    'length': 'part_length',
}
"""Kind of fault -> code of its error, unless the document or the requirement has its own."""
Requirement = Callable[[Any, str], None]


class Unmet(Exception):
    """A value does not meet its requirement: kind, place, requirement, value, code, a hint."""

    def __init__(
        self, kind: str, place: str, required: str, *, received: Any, code: str = '', hint: str = ''
    ):
        super().__init__(place)
        self.kind = kind
        self.place = place
        self.required = required
        self.received = received
        self.code = code
        self.hint = hint


@dataclass(frozen=True)
class Document:
    """A type of document."""

    name: str
    """Name in errors, such as 'noise document'."""
    parts: Requirement
    """Requirement of the whole."""
    remedy: str
    """What a user can do, the end of each error."""
    codes: Mapping[str, str] = field(default_factory=dict)
    """Kind of fault -> code, where it differs from `CODES`."""
    error: type[InputError] = DocumentError
    """Class of its errors."""


def require(value: Any, document: Document, parts: Requirement | None = None) -> None:
    """
    Check a value against a declaration.

    Parameters
    ----------
    value : any
    document : Document
    parts : callable, optional
        Requirement in place of that of the whole document, for a part whose form depends on
        another part.

    Raises
    ------
    InputError
        Of the class of the document, with the path of keys, requirement, received value, remedy.

    """
    try:
        (parts or document.parts)(value, '')
    except Unmet as unmet:
        # Each may contain text of the document.
        place = f" '{shortened(unmet.place, 80)}'" if unmet.place else ''
        received = shortened(repr(unmet.received), 100)
        raise document.error(
            f'{document.name}:{place} must {shortened(unmet.required, 200)}, got {received}'
            f'{unmet.hint}; {document.remedy}',
            code=unmet.code or document.codes.get(unmet.kind, CODES[unmet.kind]),
        ) from unmet


def anything(_value: Any, _place: str) -> None:
    """Accept every value."""


def number(
    low: float = -math.inf,
    high: float = math.inf,
    *,
    above: bool = False,
    finite: bool = True,
    code: str = '',
) -> Requirement:
    """
    Require a number that a float can hold, in [low, high].

    `above`: larger than `low`. Without `finite`, every float is accepted, infinite values and NaN
    too, and the limits hold for other numbers only.
    """

    def check(value: Any, place: str) -> None:
        # Most values are floats, which need no search among the kinds of numbers.
        is_number = type(value) is float or (
            isinstance(value, Real) and not isinstance(value, bool)
        )
        if is_number and not finite and isinstance(value, float):
            return
        if not is_number or not abs(value) <= sys.float_info.max:
            raise Unmet('type', place, 'be a finite number', received=value, code=code)
        if not low <= value <= high or (above and value == low):
            limits = f'be above {low:g}' if above else f'lie in [{low:g}, {high:g}]'
            raise Unmet('range', place, limits, received=value, code=code)

    return check


def whole(low: float = 0, high: float = 2**62) -> Requirement:
    """Require an integer in [low, high]."""

    def check(value: Any, place: str) -> None:
        if (
            not isinstance(value, (int, np.integer))
            or isinstance(value, bool)
            or not low <= value <= high
        ):
            raise Unmet('type', place, f'be an integer in [{low}, {high}]', received=value)

    return check


def text(*choices: str, code: str = '') -> Requirement:
    """Require a text, one of `choices` if there are any."""

    def check(value: Any, place: str) -> None:
        if not isinstance(value, str):
            raise Unmet('type', place, 'be a text', received=value, code=code)
        if choices and value not in choices:
            raise Unmet('range', place, f'be {" or ".join(choices)}', received=value, code=code)

    return check


def flag(code: str = '') -> Requirement:
    """Require true or false."""

    def check(value: Any, place: str) -> None:
        if not isinstance(value, bool):
            raise Unmet('type', place, 'be true or false', received=value, code=code)

    return check


def equal(wanted: Any, *, code: str = '') -> Requirement:
    """Require one value."""

    def check(value: Any, place: str) -> None:
        if value != wanted:
            raise Unmet('range', place, f'be {wanted}', received=value, code=code)

    return check


def maybe(requirement: Requirement) -> Requirement:
    """Require null or a value that meets a requirement."""

    def check(value: Any, place: str) -> None:
        if value is not None:
            requirement(value, place)

    return check


def list_of(
    each: Requirement,
    *lengths: int,
    most: int | None = None,
    distinct: bool = False,
    rising: bool = False,
    including: Collection[str] = (),
    code: str = '',
) -> Requirement:
    """
    Require a list whose items meet a requirement.

    Parameters
    ----------
    each : callable
    lengths : int
        Permitted numbers of items; none: any.
    most : int, optional
        Largest number of items.
    distinct, rising : bool
        Whether items must differ, or must not be smaller than the one before.
    including : collection of str
        Items that must be among them.
    code : str
        Of a wrong length.

    """

    def check(value: Any, place: str) -> None:
        is_list = isinstance(value, (Sequence, np.ndarray)) and not isinstance(value, (str, bytes))
        if not is_list or (lengths and len(value) not in lengths):
            count = ' or '.join(map(str, lengths)) or 'any number of'
            hint = f' ({len(value)} values)' if is_list else ''
            raise Unmet(
                'length',
                place,
                f'be a list of {count} values',
                received=value,
                code=code,
                hint=hint,
            )
        for index, item in enumerate(value):
            each(item, f'{place}[{index}]')
        if (distinct and len(set(value)) < len(value)) or (most is not None and len(value) > most):
            raise Unmet('range', place, f'have at most {most} different items', received=value)
        if rising and any(later < earlier for earlier, later in zip(value, value[1:])):
            raise Unmet('range', place, 'be in rising order', received=value)
        for needed in including:
            if needed not in value:
                raise Unmet('missing', place, f'contain {needed}', received=value)

    return check


def one_or_each(each: Requirement, *lengths: int, code: str = '') -> Requirement:
    """Require one value, or a list of values, that meet a requirement."""
    many = list_of(each, *lengths, code=code)

    def check(value: Any, place: str) -> None:
        (many if isinstance(value, (list, tuple)) else each)(value, place)

    return check


def array(shape: tuple[int, ...], each: Requirement) -> Requirement:
    """Require nested lists of a shape whose items meet a requirement."""

    def check(value: Any, place: str) -> None:
        items = np.array(value, dtype=object)
        if items.shape != shape:
            raise Unmet(
                'shape', place, f'have the shape {shape}', received=items.shape, code='shape'
            )
        for index, item in np.ndenumerate(items):
            try:
                each(item, place)
            except Unmet:
                # Only errors name their item: a text for each is most of the time of a covariance.
                each(item, f'{place}{list(index)}')

    return check


def mapping(
    needed: Mapping[str, Requirement] | None = None,
    optional: Mapping[str, Requirement] | None = None,
    *,
    each: Requirement = anything,
    closed: bool = False,
    code: str = '',
) -> Requirement:
    """
    Require a mapping.

    Parameters
    ----------
    needed, optional : mapping
        Key -> requirement of its value.
    each : callable
        Requirement of the values of all other keys.
    closed : bool
        Whether other keys are refused.
    code : str
        Of a missing or an unknown key.

    """
    needed = needed or {}
    optional = optional or {}
    known = {**needed, **optional}

    def check(value: Any, place: str) -> None:
        if not isinstance(value, Mapping):
            keys = f' with the keys {", ".join(known)}' if known else ''
            raise Unmet('mapping', place, f'be a mapping{keys}', received=value)
        for key in value:  # a misspelt key is both unknown and missing
            if closed and key not in known:
                keys = f'have the keys {", ".join(known)} only'
                hint = did_you_mean(str(key), known)
                raise Unmet('unknown', place, keys, received=key, code=code, hint=hint)
        for key in needed:
            if key not in value:
                raise Unmet('missing', place, f'have {key}', received=dict(value), code=code)
        for key, item in value.items():
            known.get(key, each)(item, f'{place}.{key}' if place else str(key))

    return check
