"""
Diagnostics: what a node knows about itself, once per second on /diagnostics and at once when it changes.

Levels by convention: OK works as it should, a start included; WARN works and somebody should look; ERROR does not do what it is for. STALE
is for those who listen, when nothing comes any more.
"""

from collections.abc import Callable, Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from imu_calibration.errors import shortened
from imu_calibration.nodes.timers import every

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
PERIOD = 1.0
"""Seconds between two messages; diagnostic aggregators call a status stale after five."""


def make_status(level: Any, name: str, message: str, *, values: Mapping[str, Any] | None = None, hardware_id: str = '') -> DiagnosticStatus:
    """
    Return one DiagnosticStatus.

    Parameters
    ----------
    level : bytes
        `OK`, `WARN` or `ERROR`.
    name : str
        What the status is about; the publisher puts the node's name in front.
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
    Publishes what `collect` returns (a list of DiagnosticStatus) every `PERIOD`, and on `publish_now`.

    The timer runs on the steady clock, so that diagnostics go on while simulated time stands still.
    """

    def __init__(self, node: Node, collect: Callable[[], list]):
        self._node, self._collect = node, collect
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._timer = every(node, PERIOD, self.publish_now)

    def publish_now(self) -> None:
        """Publish the present state; when it cannot be told, that is told."""
        try:
            statuses = self._collect()
        except Exception as error:   # diagnostics must not end what they speak of
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
