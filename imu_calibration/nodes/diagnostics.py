"""
Diagnostics: the state of a node, once per second on /diagnostics and at once when it changes.

Levels by convention: OK: works as intended, including the start; WARN: works and needs attention;
ERROR: does not fulfil its purpose. STALE is set by the receiver when messages are missing.
"""

import re
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from imu_calibration.core.errors import printable, shortened
from imu_calibration.nodes.lifecycle import every

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
DIAGNOSTICS_SECONDS = 1.0
"""Seconds between two messages; diagnostic aggregators call a status stale after five."""


def make_status(
    level: Any,
    name: str,
    message: str,
    *,
    values: Mapping[str, Any] | None = None,
    hardware_id: str = '',
) -> DiagnosticStatus:
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
    pairs = [
        KeyValue(key=str(key), value=value if isinstance(value, str) else str(value))
        for key, value in (values or {}).items()
    ]
    return DiagnosticStatus(
        level=level, name=name, message=message, hardware_id=hardware_id, values=pairs
    )


class DiagnosticsPublisher:
    """
    Publishes the list of DiagnosticStatus that `collect` returns.

    It publishes every `DIAGNOSTICS_SECONDS`, and on `publish_now`.

    The timer runs on the steady clock, so that diagnostics continue while simulated time is paused.
    """

    def __init__(self, node: Node, collect: Callable[[], list]):
        self._node = node
        self._collect = collect
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._timer = every(node, DIAGNOSTICS_SECONDS, self.publish_now)

    def publish_now(self) -> None:
        """Publish the present state, or the error that prevents its collection."""
        try:
            statuses = self._collect()
        except Exception as error:  # diagnostics must not end their node
            statuses = [
                make_status(
                    ERROR,
                    'diagnostics',
                    shortened(f'state not available: {type(error).__name__}: {error}', 300),
                )
            ]
        array = DiagnosticArray(status=statuses)
        array.header.stamp = self._node.get_clock().now().to_msg()
        prefix = self._node.get_fully_qualified_name().lstrip('/')
        for status in array.status:
            status.name = f'{prefix}: {status.name}'
        try:
            self._publisher.publish(array)
        except Exception:
            if self._node.context.ok():  # otherwise the node is ending
                raise


LOG_INFO, LOG_WARN, LOG_ERROR = 'info', 'warning', 'error'
REMINDER = 60.0
"""Interval at which a lasting fault is logged again, s."""
REPEAT_SECONDS = 10.0
"""Least interval between two lines about an intermittent fault, s."""
MOST_KINDS = 1000
"""Largest number of kinds whose last time is stored: it bounds the memory."""


def say(logger: Any, level: str, line: str) -> None:
    """
    Log a line without control characters.

    One call per severity, because rclpy allows one severity per line of code.
    """
    line = printable(line)
    if level == LOG_ERROR:
        logger.error(line)
    elif level == LOG_WARN:
        logger.warning(line)
    else:
        logger.info(line)


class Complaints:
    """
    Logs lines for a node.

    Two lines are of the same kind when they differ in their numbers only, or have the same
    ``subject: ``, where the subject ends with a topic in brackets (see `kind_of`).

    Parameters
    ----------
    logger : logger of a node
    clock : callable
        Seconds of a steady clock.

    """

    def __init__(self, logger: Any, clock: Callable[[], float] = time.monotonic):
        self._logger = logger
        self._clock = clock
        self._logged_at: dict[str, float] = {}
        """Kind of a line -> time of the last one, s, the oldest first."""
        self._open: dict[str, str] = {}
        """Kind of a present fault -> its last line."""

    def now(
        self,
        source: str,
        warnings: Iterable[str] = (),
        errors: Iterable[str] = (),
        *,
        patience: float = REPEAT_SECONDS,
        replaces: bool = False,
    ) -> None:
        """
        Log the present faults of `source` and the end of earlier ones.

        A fault that returns after its end is logged `patience` seconds after its last line at the
        earliest. With `replaces` the lines of the source are states of one fault, which ends when
        there is no line.
        """
        present = {kind_of(source, line): (LOG_WARN, line) for line in warnings}
        present |= {kind_of(source, line): (LOG_ERROR, line) for line in errors}
        for kind in list(self._open):
            if kind.startswith(source + ':') and kind not in present:
                ended = self._open.pop(kind)
                if not (replaces and present):
                    say(self._logger, LOG_INFO, f'no longer: {ended}')
        for kind, (level, line) in present.items():
            if self._due(kind, REMINDER if kind in self._open else patience):
                say(self._logger, level, line)
                self._open[kind] = line

    def event(self, line: str, level: str = LOG_WARN) -> None:
        """Log an event, which has no end."""
        if self._due(kind_of('', line), REPEAT_SECONDS):
            say(self._logger, level, line)

    def _due(self, kind: str, pause: float) -> bool:
        """Return whether the last line of a kind is `pause` s ago; record a new one if it is."""
        now = self._clock()
        if now - self._logged_at.get(kind, float('-inf')) < pause:
            return False
        self._logged_at.pop(kind, None)  # so that it becomes the newest entry
        self._logged_at[kind] = now
        while len(self._logged_at) > MOST_KINDS:
            del self._logged_at[next(iter(self._logged_at))]
        return True


def kind_of(source: str, line: str) -> str:
    """Return the kind of a line: its text before ``): ``, or all of it, without numbers."""
    subject, bracket, _ = line.partition('): ')
    return source + ':' + re.sub(r'[\d.]+', '#', subject if bracket else line)
