"""A progress bar on standard error, only on a terminal."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def progress_bar(label: str, total: int, unit: str = 'samples') -> Iterator[Callable]:
    """Give a function that is called with the number of items done since the last call."""
    if not sys.stderr.isatty() or not total:
        yield lambda count: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
    columns = (TextColumn('{task.description}'), BarColumn(), TaskProgressColumn(), TextColumn('{task.fields[rate]}'),
               TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(label, total=total, rate='')

        def advance(count):
            progress.update(task, advance=count)
            speed = progress.tasks[task].speed
            progress.update(task, rate=f'{speed:,.0f} {unit}/s' if speed else '')
        yield advance
