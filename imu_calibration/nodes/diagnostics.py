"""
Diagnostics: the state of a node, once per second on /diagnostics and at once when it changes.

Levels by convention: OK: works as intended, including the start; WARN: works and needs attention; ERROR: does not fulfil its purpose. STALE
is set by the receiver when messages are missing.
"""

from collections.abc import Callable, Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from imu_calibration.core.errors import shortened
from imu_calibration.nodes.lifecycle import every

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
DIAGNOSTICS_SECONDS = 1.0
"""Seconds between two messages; diagnostic aggregators call a status stale after five."""


def make_status(level: Any, name: str, message: str, *, values: Mapping[str, Any] | None = None, hardware_id: str = '') -> DiagnosticStatus:
    """
    Return one DiagnosticStatus.

    Parameters
    ----------
    level : bytes
        `OK`, `WARN` or `ERROR`.
    name : str
        Subject of the status; the publisher prepends the node's name.
    message : str
        One line.
    values : dict, optional
        Further details: key -> anything that prints.
    hardware_id : str
        The sensor, usually its frame_id.

    """
    pairs = [KeyValue(key=str(key), value=value if isinstance(value, str) else str(value)) for key, value in (values or {}).items()]
    return DiagnosticStatus(level=level, name=name, message=message, hardware_id=hardware_id, values=pairs)


class DiagnosticsPublisher:
    """
    Publishes the list of DiagnosticStatus that `collect` returns every `DIAGNOSTICS_SECONDS`, and on `publish_now`.

    The timer runs on the steady clock, so that diagnostics continue while simulated time is paused.
    """

    def __init__(self, node: Node, collect: Callable[[], list]):
        self._node, self._collect = node, collect
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._timer = every(node, DIAGNOSTICS_SECONDS, self.publish_now)

    def publish_now(self) -> None:
        """Publish the present state, or the error that prevents its collection."""
        try:
            statuses = self._collect()
        except Exception as error:   # diagnostics must not end their node
            statuses = [make_status(ERROR, 'diagnostics', shortened(f'state not available: {type(error).__name__}: {error}', 300))]
        array = DiagnosticArray(status=statuses)
        array.header.stamp = self._node.get_clock().now().to_msg()
        prefix = self._node.get_fully_qualified_name().lstrip('/')
        for status in array.status:
            status.name = f'{prefix}: {status.name}'
        try:
            self._publisher.publish(array)
        except Exception:
            if self._node.context.ok():   # otherwise the node is ending
                raise
