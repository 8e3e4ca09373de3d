"""The report of a calibration: the verdict first, then everything that supports it."""

from imu_calibration.calibration import DETERMINED
from imu_calibration.report.budget_section import budget_section
from imu_calibration.report.geometry import derived_section, lever_section
from imu_calibration.report.navigation_section import navigation_section, rest_growth
from imu_calibration.report.numbers import in_unit, text
from imu_calibration.report.observability_section import observability_section
from imu_calibration.report.origin import origin_section, recording_facts
from imu_calibration.report.page import render
from imu_calibration.report.parameters import parameter_groups
from imu_calibration.report.readings import reading_tables
from imu_calibration.report.residuals import UNIT, residual_section
from imu_calibration.report.window_errors import window_errors
from imu_calibration.report.worked_sample import worked_sample
from imu_calibration.verdict import judge, requested


def calibration_report(result):
    """
    Return the report of a calibration, on a table or by hand, as one HTML page that needs nothing else.

    The same input gives the same bytes.

    Parameters
    ----------
    result : CalibrationResult

    """
    errors = window_errors(result)
    at_rest, moving = reading_tables(result, errors)
    return render('calibration.html', title='IMU calibration', verdict=judge(result.calibration, result.tolerances), facts=recording_facts(result),
                  tiles=tiles(result, errors), groups=parameter_groups(result), sample=worked_sample(result), derived=derived_section(result),
                  residuals=residual_section(result, errors), observability=observability_section(result), levers=lever_section(result),
                  navigation=navigation_section(result, errors), at_rest=at_rest, moving=moving, budget=budget_section(result), origin=origin_section(result),
                  by_hand=result.table is None)


def tiles(result, errors):
    """Return the figures that matter most: what was determined, and the errors before and after."""
    names = [name for name in result.calibration.param_names if requested(name)]
    done = sum(status == DETERMINED for name, status in zip(result.calibration.param_names, result.calibration.status) if requested(name))
    found = [{'what': 'parameters determined', 'after': f'{done} of {len(names)}', 'before': None, 'note': 'to their tolerances'}]
    for sensor in ('accelerometer', 'gyroscope'):
        found.append({'what': f'{sensor} error', 'before': in_unit(errors.rms(sensor, 'before'), UNIT[sensor]), 'after': in_unit(errors.rms(sensor, 'after'), UNIT[sensor]),
                      'note': f'rms of {len(errors.time)} window means'})
    runs = rest_growth(result, errors)
    if runs:
        before, after = (run.last()[1] for run in runs)
        found.append({'what': 'position after 50 s at rest', 'before': f'{text(before)} m', 'after': f'{text(after)} m', 'note': 'dead reckoning, median over poses'})
    return found
