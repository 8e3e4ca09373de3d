"""The report of a calibration: the verdict first, then the supporting evidence."""

from typing import Any

from imu_calibration.calibration.result import CalibrationResult
from imu_calibration.core.units import error_text
from imu_calibration.document.trust import usage
from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.solution import DETERMINED
from imu_calibration.report.calibration_sections import (
    budget_section,
    observability_section,
    origin_section,
    proof_section,
    reading_tables,
    recording_facts,
)
from imu_calibration.report.figures import derived_section, lever_section
from imu_calibration.report.navigation_section import navigation_section
from imu_calibration.report.page import parameter_groups, render
from imu_calibration.report.residuals import draw_windows, residual_section


def calibration_report(result: CalibrationResult) -> str:
    """
    Return the report of a calibration, on a table or by hand, as one self-contained HTML page.

    The same input gives the same bytes.

    Parameters
    ----------
    result : CalibrationResult

    """
    errors = result.window_errors()
    at_rest, moving = reading_tables(result, errors)
    navigation = navigation_section(result, errors)
    return render('calibration.html', title='IMU calibration', verdict=result.verdict, usage=usage(result.calibration),
                  facts=recording_facts(result), proof=proof_section(result.calibration), tiles=tiles(result, navigation),
                  groups=parameter_groups(result),
                  derived=derived_section(result), residuals=residual_section(result),
                  errors=[draw_windows(errors, sensor) for sensor in SENSORS],
                  observability=observability_section(result), levers=lever_section(result), navigation=navigation, at_rest=at_rest,
                  moving=moving, budget=budget_section(result), origin=origin_section(result), observations=result.observations)


def tiles(result: CalibrationResult, navigation: dict[str, Any]) -> list[dict[str, str | None]]:
    """Return the main figures: the determined parameters, and the errors before and after."""
    asked = list(result.calibration.requested.values())
    found = [_tile('parameters determined', f'{asked.count(DETERMINED)} of {len(asked)}', None, 'to their tolerances')]
    for sensor, entry in result.calibration.proof.items():
        after, before = (error_text(entry[which], entry['unit']) for which in ('after', 'before'))
        found.append(_tile(f'{sensor} error on held-out data', after, before, f'{entry["windows"]} windows'))
    if navigation['rest']:
        after, before = navigation['rest']['position'][::-1]
        found.append(_tile('position error after 50 s at rest', f'{after} m', f'{before} m',
                           f"part of the calibration: {navigation['rest']['parts'][0][2]} m"))
    return found


def _tile(what, after, before, note):
    number, _, unit = after.partition(' ')
    return {'what': what, 'number': number, 'unit': unit, 'before': before, 'note': note}
