"""Foxglove view of calibration_node: the progress of the calibration."""

from collections.abc import Sequence
from functools import partial
from typing import Any

from imu_calibration.calibration.coverage import Coverage
from imu_calibration.calibration.result import CalibrationResult
from imu_calibration.nodes.live_view import FoxgloveSettings, LiveView
from imu_calibration.segmentation.window import Window
from imu_calibration.use_cases.foxglove_file import scene_of
from imu_calibration.use_cases.view_messages import PARAMETERS, RESIDUAL, SPECTRUM, SPHERE, parameters, residual, spectrum


class CalibrationView(LiveView):
    """Shows parameters with their bands, window errors before and after, the spectrum of the residuals, the sphere."""

    def __init__(self, node: Any, settings: FoxgloveSettings):
        super().__init__(node, (PARAMETERS, RESIDUAL, SPECTRUM, SPHERE), settings)

    def take_solution(self, result: CalibrationResult, windows: Sequence[Window]) -> None:
        """Show a solution and its residuals within some windows."""
        self.show(PARAMETERS, partial(parameters, result.calibration, result.tolerances))
        self.show(RESIDUAL, partial(residual, result))
        self.show(SPECTRUM, partial(spectrum, result, windows))

    def take_coverage(self, coverage: Coverage) -> None:
        """Show a sphere."""
        self.show(SPHERE, partial(scene_of, coverage, coverage.frame_id or 'imu_link'))
