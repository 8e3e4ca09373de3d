"""Bars on standard error, only on a terminal; with `verbose` one line per phase with its time."""

import sys
import time
from typing import Any


class ProgressBars:
    """Listens to `imu_calibration.core.progress`; one bar per phase, removed at the end."""

    def __init__(self, *, verbose: bool = False):
        self._verbose, self._tasks = verbose, {}
        self._live: Any = None
        self._phase, self._since = '', time.monotonic()

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self._change('')
        if self._live is not None:
            self._live.stop()

    def __call__(self, phase: str, done: float, total: float) -> None:
        """Show the amount done of a phase."""
        if phase != self._phase:
            self._change(phase)
        if not sys.stderr.isatty():
            return
        if self._live is None:
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
            self._live = Progress(TextColumn('{task.description}', markup=False), BarColumn(), TaskProgressColumn(), TimeElapsedColumn(),
                                  console=Console(stderr=True), transient=True)
            self._live.start()
        if phase not in self._tasks:
            for task in self._tasks.values():
                self._live.update(task, visible=False)
            self._tasks[phase] = self._live.add_task(phase, total=None)
        self._live.update(self._tasks[phase], completed=done, total=total or None, visible=True)

    def _change(self, phase):
        if self._verbose and self._phase:
            print(f'{self._phase}: {time.monotonic() - self._since:.1f} s', file=sys.stderr)
        self._phase, self._since = phase, time.monotonic()
