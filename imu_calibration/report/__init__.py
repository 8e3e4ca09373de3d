"""The report: one self-contained HTML page that a person reads and a colleague believes."""

from imu_calibration.report.calibration_page import calibration_report

__all__ = ['calibration_report']
