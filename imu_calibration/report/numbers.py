"""Numbers as the report prints them: a real minus sign, thin units, no more digits than are known."""

import numpy as np

from imu_calibration.core.units import for_people, significant, with_sd


def text(value: float | None, digits: int = 3) -> str:
    """Return a number with `digits` significant digits and a real minus sign; an en dash for None and non-finite values."""
    if value is None or not np.isfinite(value):
        return '–'
    shown = significant(float(value), digits)
    if 'e' in shown:
        mantissa, _, power = shown.partition('e')
        shown = f'{mantissa}·10{_raised(int(power))}'
    return shown.replace('-', '−')


def _raised(power):
    return str(power).translate(str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'))


def fixed(value: float, places: int) -> str:
    """Return a number with so many decimals and a real minus sign."""
    if value is None or not np.isfinite(value):
        return '–'
    return f'{round(value, places) + 0.0:.{places}f}'.replace('-', '−')


def pair(value: float, sd: float) -> tuple[str, str]:
    """Return (value, sd) as text with the digits that the sd supports."""
    shown, spread = (part.replace('-', '−') for part in with_sd(value, sd))
    return shown, spread


def people(value: float, sd: float, unit: str, *, quantity: str = '') -> tuple[str, str, str]:
    """Return (value, sd, unit) as text in the units of `units.for_people`, '' for the unit of a ratio."""
    factor, shown = for_people(unit, quantity)
    return (*pair(value * factor, sd * factor), '' if shown == '1' else shown)


def in_unit(value: float, unit: str, digits: int = 3, *, quantity: str = '') -> str:
    """Return a value with its unit of `units.for_people`."""
    factor, shown = for_people(unit, quantity)
    return text(value * factor, digits) + ('' if shown == '1' else f' {shown}')
