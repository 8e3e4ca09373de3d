"""
What is wrong, on the terminal: said when it begins, now and then while it lasts, and when it is over.

Each thing by a clock of its own.
"""

import re
import time
from collections.abc import Callable, Iterable
from typing import Any

from imu_calibration.errors import printable

INFO, WARNING, ERROR = 'info', 'warning', 'error'
REMINDER = 60.0
"""Seconds after which what still holds is said again."""
PATIENCE = 10.0
"""What comes and goes is not said more often than after so many seconds."""
MOST_KINDS = 1000
"""Things that are remembered as said; whatever comes, memory stays bounded."""


def say(logger: Any, level: str, line: str) -> None:
    """Log a line without control characters; rclpy ties a place in the code to one severity, so each has a separate place."""
    line = printable(line)
    if level == ERROR:
        logger.error(line)
    elif level == WARNING:
        logger.warning(line)
    else:
        logger.info(line)


class Complaints:
    """
    Logs lines for a node.

    Two lines are about the same thing when they differ in their numbers only, or stand behind the same ``subject: ``, where the subject
    ends with a topic in brackets (see `kind_of`).

    Parameters
    ----------
    logger : logger of a node
    clock : callable
        Seconds of a steady clock.

    """

    def __init__(self, logger: Any, clock: Callable[[], float] = time.monotonic):
        self._logger, self._clock = logger, clock
        self._said: dict[str, float] = {}
        self._open: dict[str, str] = {}

    def now(self, source: str, warnings: Iterable[str] = (), errors: Iterable[str] = (), *, patience: float = PATIENCE) -> None:
        """Take all present faults of `source`; a fault that it no longer has is over, and is repeated at most every `patience` seconds."""
        present = {kind_of(source, line): (level, line) for level, lines in ((WARNING, warnings), (ERROR, errors)) for line in lines}
        for kind in [kind for kind in self._open if kind.startswith(source + ':') and kind not in present]:
            say(self._logger, INFO, f'over: {self._open.pop(kind)}')
        for kind, (level, line) in present.items():
            if self._due(kind, REMINDER if kind in self._open else patience):
                say(self._logger, level, line)
                self._open[kind] = line

    def event(self, line: str, level: str = WARNING) -> None:
        """Take something that happened, which has no end."""
        if self._due(kind_of('', line), PATIENCE):
            say(self._logger, level, line)

    def _due(self, kind: str, pause: float) -> bool:
        now = self._clock()
        if now - self._said.get(kind, float('-inf')) < pause:
            return False
        self._said.pop(kind, None)
        self._said[kind] = now
        while len(self._said) > MOST_KINDS:
            del self._said[next(iter(self._said))]
        return True


def kind_of(source: str, line: str) -> str:
    """Return what a line is about: what stands before ``): ``, else the line, without numbers."""
    subject, bracket, _ = line.partition('): ')
    return source + ':' + re.sub(r'[\d.]+', '#', subject if bracket else line)
