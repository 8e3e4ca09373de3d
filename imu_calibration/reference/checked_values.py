"""Numbers, vectors and mappings of a table description, checked one by one."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from imu_calibration.errors import InputError

LARGEST = 1e6
"""Largest number of a table (axis, place, angle, speed); products of larger numbers would overflow."""


def require_keys(mapping: Any, known: Sequence[str], what: str) -> None:
    """Refuse values that are not a mapping, and keys that are not `known`."""
    if not isinstance(mapping, Mapping):
        raise InputError(f'{what} must be a mapping with the keys {", ".join(known)}, got {mapping!r}; see the table description',
                         code='not_a_mapping')
    for key in mapping:
        if key not in known:
            raise InputError(f"{what}: key '{key}' is unknown; the keys here are {', '.join(known)}", code='key_unknown')


def unit_vector(value: Any, what: str) -> tuple[float, float, float]:
    """Return the direction of three numbers as a unit vector; a unit vector is returned unchanged."""
    vector = np.array(three_numbers(value, what))
    norm = np.linalg.norm(vector)
    if norm < 1e-9:
        raise InputError(f'table: {what} must not be zero, got {list(value)}; give a direction of three numbers', code='zero_vector')
    # Idempotent, so that a table written and read again is equal.
    return tuple((vector / norm if abs(norm - 1) > 4e-16 else vector).tolist())


def three_numbers(value: Any, what: str) -> tuple[float, float, float]:
    """Return three finite numbers."""
    x, y, z = several_numbers(value, 3, what)
    return x, y, z


def several_numbers(value: Any, count: int, what: str) -> tuple[float, ...]:
    """Return `count` finite numbers."""
    words = {2: 'two', 3: 'three'}[count]
    if isinstance(value, (str, bytes)) or not hasattr(value, '__len__') or len(value) != count:
        raise InputError(f'table: {what} must be {words} numbers, got {value!r}; correct it', code='three_numbers')
    return tuple(finite_number(item, what, None, high=None, advice=f'give {words} numbers') for item in value)


def finite_number(value: Any, what: str, low: float | None, *, high: float | None, advice: str) -> float:
    """Return one finite number within [low, high], by default the limits of any number of a table."""
    low, high = -LARGEST if low is None else low, LARGEST if high is None else high
    # YAML 1.1 reads 1e-5, without a point, as text.
    try:
        number = float('nan') if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = float('nan')
    if not np.isfinite(number):
        raise InputError(f'table: {what} must be a finite number, got {value!r}; {advice}', code='not_finite')
    if not low <= number <= high:
        raise InputError(f'table: {what} must lie in [{low:g}, {high:g}], got {value!r}; {advice}', code='out_of_range')
    return number
