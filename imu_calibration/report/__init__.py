"""The reports: one self-contained HTML page each, that a person reads and a colleague believes."""

from imu_calibration.report.calibration_page import calibration_report
from imu_calibration.report.diagnosis_page import diagnosis_report

__all__ = ['calibration_report', 'diagnosis_report']
