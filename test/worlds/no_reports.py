"""Reports that are not drawn, where the pages are not the subject: a third of a calibration."""

import contextlib
from collections.abc import Iterator
from unittest.mock import patch

REPORTS = (
    'calibration_sections.calibration_report',
    'diagnosis_page.diagnosis_report',
    'plan_page.plan_report',
)


@contextlib.contextmanager
def without_reports() -> Iterator[None]:
    """Let the reports of calibrations, diagnoses and plans be empty."""
    with contextlib.ExitStack() as stack:
        for name in REPORTS:
            stack.enter_context(patch(f'imu_calibration.report.{name}', lambda *of: ''))
        yield
