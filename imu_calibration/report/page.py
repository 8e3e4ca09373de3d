"""Rendering of a page, numbers with their digits, tables of parameters."""

from typing import Any

import numpy as np

from imu_calibration.calibration.diagnosis.diagnosis_workflow import DiagnosisResult
from imu_calibration.calibration.result import CalibrationResult
from imu_calibration.core.units import for_people, significant, with_sd
from imu_calibration.estimation.solution import COMMON_SCALE, DETERMINED, FIXED, HELD, LIKELIHOOD_RATIO, REPLACEMENT


def render(template: str, **content: Any) -> str:
    """Return the HTML of one of the package's templates."""
    from jinja2 import Environment, PackageLoader, StrictUndefined
    environment = Environment(loader=PackageLoader('imu_calibration.report', 'templates'), autoescape=True, undefined=StrictUndefined,
                              trim_blocks=True, lstrip_blocks=True)
    return environment.get_template(template).render(**content)


def text(value: float | None, digits: int = 3) -> str:
    """Return a number with `digits` significant digits and a real minus sign; an en dash for None and non-finite values."""
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
    """Return (value, sd, unit) as text in the units of `units.for_people`, '' for the unit of a ratio."""
    factor, shown = for_people(unit, quantity)
    return (*pair(value * factor, sd * factor), '' if shown == '1' else shown)


def in_unit(value: float, unit: str, digits: int = 3, *, quantity: str = '') -> str:
    """Return a value with its unit of `units.for_people`."""
    factor, shown = for_people(unit, quantity)
    return text(value * factor, digits) + ('' if shown == '1' else f' {shown}')


def tile(what: str, number: str, unit: str = '', *, before: str | None = None, note: str = '') -> dict[str, str | None]:
    """Return one of the main figures at the head of a page, with its value before and a note."""
    return {'what': what, 'number': number, 'unit': unit, 'before': before, 'note': note}


SENSOR_TITLES = {'accelerometer': 'Accelerometer', 'gyroscope': 'Gyroscope', 'reference': 'Table and clock'}
USE = {'exact': 'removed by compensation', 'flagged': 'cannot be removed, samples are marked',
       'none': 'belongs to the table or the session, not removed'}

COMMON_GRAVITY = 'An error of the gravity used as reference scales all readings. The sds of the other parameters are given without it.'
HELD_BY_WEAK_DATA = 'fixed at its prior: its sd would exceed half of the prior sd'
REPLACED = {
    REPLACEMENT: 'fixed at its prior: the estimate is weak and within one sd of it, so that the prior has the smaller expected error',
    LIKELIHOOD_RATIO: 'fixed at its prior, which is not significantly worse than the weak estimate (likelihood ratio)'}


def parameter_groups(result: CalibrationResult | DiagnosisResult) -> list[dict[str, Any]]:
    """Return the table: groups with title, explanation and rows."""
    calibration, groups = result.calibration, []
    for effect in calibration.model.effects:
        part = calibration.model.slices[effect.key]
        rows = [_row(calibration.param_names[index], effect.components[k], calibration.values[index], sd=calibration.own_sd[index],
                     tolerance=result.tolerances[index], unit=effect.unit_of(k), status=calibration.status[index],
                     why=_why(calibration, index, calibration.own_sd[index] / result.tolerances[index]))
                for k, index in enumerate(range(part.start, part.stop))]
        groups.append({'sensor': SENSOR_TITLES[effect.section], 'title': effect.heading, 'name': effect.name,
                       'explanation': effect.explanation, 'use': USE[effect.compensation], 'rows': rows, 'unit': effect.unit_of(0)})
    if common := calibration.common_scale:
        groups.append({'sensor': SENSOR_TITLES['accelerometer'], 'title': 'Common scale', 'name': COMMON_SCALE, 'unit': '1',
                       'use': 'its value is 1, not removed', 'explanation': COMMON_GRAVITY,
                       'rows': [_row(COMMON_SCALE, 'scale', 1.0, sd=common['sd'], tolerance=common['tolerance'], unit='1',
                                     status=common['status'], why='the local gravity was not given exactly')]})
    return groups


def _row(name, component, value, *, sd, tolerance, unit, status, why):
    shown = people(value, sd, unit, quantity=name)
    share = sd / tolerance
    return {'name': name, 'component': component, 'value': shown[0], 'sd': shown[1], 'unit': shown[2],
            'si': '' if unit == '1' else ' ± '.join(pair(value, sd)) + f' {printed(unit)}',
            'tolerance': in_unit(tolerance, unit, 2, quantity=name), 'share': text(share, 2),
            'bar': _bar(share), 'status': status, 'why': why}


def printed(unit: str) -> str:
    """Return an SI unit with raised powers."""
    return unit.replace('^-1', '⁻¹').replace('^-2', '⁻²').replace('^2', '²')


def _bar(share):
    """Return the length of the bar in percent: logarithmic, a thousandth of the tolerance to ten times it."""
    return round(float(np.clip((np.log10(max(share, 1e-9)) + 3) / 4, 0.02, 1.0)) * 100, 1)


def _why(calibration, index, share):
    status, name = calibration.status[index], calibration.param_names[index]
    if status == FIXED:
        return 'fixed by the choice of axes'
    if status == DETERMINED:
        return ''
    if status == HELD:
        return REPLACED.get(calibration.held_reason.get(name), HELD_BY_WEAK_DATA)
    return f'estimated, but its sd is {text(share, 2)} times the tolerance'
