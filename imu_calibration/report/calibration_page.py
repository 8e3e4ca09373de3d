"""The report of a calibration."""

from imu_calibration import workflow
from imu_calibration.report.page import render


def calibration_report(result):
    """
    Return the report of a calibration as HTML.

    Parameters
    ----------
    result : CalibrationResult

    """
    verdict, lines = workflow.summary(result)
    calibration = result.calibration
    rows = [{'name': n, 'value': f'{v:.6g}', 'sd': f'{s:.2g}', 'status': t}
            for n, v, s, t in zip(calibration.param_names, calibration.values, calibration.sd, calibration.status)]
    return render('calibration.html', verdict=verdict, lines=lines, rows=rows)
