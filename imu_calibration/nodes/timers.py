"""Timers of nodes that continue while simulated time is paused."""

from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node


def every(node: Node, seconds: float, callback: Callable[[], Any]) -> Any:
    """Call a function of a node every so many seconds of the steady clock; return the timer."""
    return node.create_timer(seconds, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))
