"""Requests to the thread of calibration_node, and receivers of its results."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Listeners:
    """Receivers of the worker's results."""

    calibration: Callable[[str], None]
    """Called with the text of each new calibration document."""
    residuals: Callable[[Any], None]
    """Called with ImuSamples."""
    coverage: Callable[[Any], None] = lambda coverage: None
    """Called with each new Coverage."""


class Request:
    """A request to the worker."""

    def __init__(self, action: Callable[[], tuple[bool, str]]):
        self.action, self.done = action, threading.Event()
        self.success, self.message = False, ''

    def answer(self, success: bool, message: str) -> None:
        """Set the result."""
        self.success, self.message = success, message
        self.done.set()
