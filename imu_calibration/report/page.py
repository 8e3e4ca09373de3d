"""Rendering of a page, and the numbers in it with their digits."""

from functools import cache
from typing import Any

import numpy as np

from imu_calibration.core.units import DEG, error_text, for_people, significant, with_sd
from imu_calibration.document.decision import ratio_text
from imu_calibration.effects.base import UNITS


def render(template: str, **content: Any) -> str:
    """
    Return the HTML of one of the package's templates.

    Numbers are printed by the filters `number`, `fixed`, `in_unit` and `chance`.
    """
    return _environment().get_template(template).render(**content)


@cache
def _environment():
    """Return the templates with their filters; each is compiled once per process."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader('imu_calibration.report', 'templates'),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        'number': number_text,
        'fixed': fixed,
        'in_unit': in_unit,
        'chance': chance,
        'printed': printed,
        'in_type': in_type,
        'bar': bar_length,
    }
    environment.globals |= {
        'people': people,
        'pair': pair,
        'for_people': for_people,
        'error_text': error_text,
        'ratio_text': ratio_text,
        'UNITS': UNITS,
        'DEG': DEG,
    }
    return environment


def number_text(value: float | None, digits: int = 3) -> str:
    """
    Return a number with `digits` significant digits and a real minus sign.

    An en dash for None and non-finite values.
    """
    if value is None or not np.isfinite(value):
        return '–'
    shown = significant(float(value), digits)
    if 'e' in shown:
        mantissa, _, power = shown.partition('e')
        shown = f'{mantissa}·10{raised(int(power))}'
    return shown.replace('-', '−')


def raised(power: int) -> str:
    """Return a raised exponent."""
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
    """
    Return (value, sd, unit) as text in the units of `units.for_people`, '' for the unit of a ratio.
    """
    factor, shown = for_people(unit, quantity)
    return (*pair(value * factor, sd * factor), '' if shown == '1' else shown)


def in_unit(value: float, unit: str, digits: int = 3, *, quantity: str = '') -> str:
    """Return a value with its unit of `units.for_people`."""
    factor, shown = for_people(unit, quantity)
    return number_text(value * factor, digits) + ('' if shown == '1' else f' {shown}')


def chance(probability: float) -> str:
    """Return a probability as text; an underflow is not shown as zero."""
    return number_text(probability, 2) if probability > 1e-99 else 'below 10⁻⁹⁹'


def in_type(sentence: str) -> str:
    """Return a sentence with printed signs."""
    return sentence.replace(' +- ', ' ± ').replace(' -', ' −').replace('^2', '²').replace('^3', '³')


def printed(unit: str) -> str:
    """Return an SI unit with raised powers."""
    return unit.replace('^-1', '⁻¹').replace('^-2', '⁻²').replace('^2', '²')


def bar_length(share: float) -> float:
    """
    Return the length of the bar of a standard deviation in tolerances, percent.

    Logarithmic, from a thousandth to ten.
    """
    return round(float(np.clip((np.log10(max(share, 1e-9)) + 3) / 4, 0.02, 1.0)) * 100, 1)
