"""``ros2 doctor``: the Imu topics of the running system, their type, quality of service, stamps, units, frames and covariances."""

from collections.abc import Callable
from functools import cache

import rclpy
from ros2cli.node.direct import DirectNode
from ros2doctor.api import DoctorCheck, DoctorReport, Report, Result
from ros2doctor.api.format import doctor_error, doctor_warn

from imu_calibration.preflight.evidence import REFUSE, WARNING
from imu_calibration.ros2.imu_streams import StreamFindings, look

CATEGORY = 'imu'


@cache
def _streams() -> list[StreamFindings]:
    """Return the findings, computed once for check and report."""
    with DirectNode(None) as direct:
        return look(direct.node, rclpy.spin_once)


class ImuCheck(DoctorCheck):
    """Check that Imu messages follow the conventions of sensor_msgs."""

    def category(self) -> str:
        """Return the name that links the check and its report."""
        return CATEGORY

    def check(self) -> Result:
        """Return the faults of each topic."""
        result = Result()
        kinds: dict[str, tuple[Callable, Callable]] = {REFUSE: (doctor_error, result.add_error), WARNING: (doctor_warn, result.add_warning)}
        for stream in _streams():
            for finding in stream.findings:
                if finding.severity in kinds:
                    tell, count = kinds[finding.severity]
                    tell(f'{stream.topic}: {finding.check.replace("_", " ")}: {finding.text}')
                    count()
        return result


class ImuReport(DoctorReport):
    """Report the properties of every Imu topic."""

    def category(self) -> str:
        """Return the name that links the check and its report."""
        return CATEGORY

    def report(self) -> Report:
        """Return a line for each finding."""
        report = Report('IMU STREAMS')
        for stream in _streams():
            report.add_to_report('topic', stream.source)
            for finding in stream.findings:
                report.add_to_report(finding.check.replace('_', ' '), f'{finding.severity}: {finding.text}')
        if not report.items:
            report.add_to_report('topic', 'none of type sensor_msgs/msg/Imu has a publisher')
        return report
