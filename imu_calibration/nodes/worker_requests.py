"""Requests to the thread of calibration_node, and receivers of its results."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from imu_calibration.calibration.result import CalibrationResult
from imu_calibration.segmentation.window import Window


@dataclass(frozen=True)
class Listeners:
    """Receivers of the worker's results."""

    calibration: Callable[[str], None]
    """Called with the text of each new calibration document."""
    residuals: Callable[[Any], None]
    """Called with ImuSamples."""
    coverage: Callable[[Any], None] = lambda coverage: None
    """Called with each new Coverage."""
    solution: Callable[[CalibrationResult, list[Window]], None] = lambda result, windows: None
    """Called with each new solution and the windows that are still there with their samples; none by hand."""


class Request:
    """A request to the worker."""

    def __init__(self, action: Callable[[], tuple[bool, str]]):
        self.action, self.done = action, threading.Event()
        self.success, self.message = False, ''

    def answer(self, success: bool, message: str) -> None:
        """Set the result."""
        self.success, self.message = success, message
        self.done.set()
