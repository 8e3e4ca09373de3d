"""A function on several items at the same time, in processes."""

import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from contextlib import contextmanager
from typing import Any, TypeVar

Returned = TypeVar('Returned')
"""What the function returns."""


def in_processes(
    function: Callable[..., Returned],
    items: Sequence[tuple],
    jobs: int,
    *,
    advance: Callable[[int], object] = lambda n_done: None,
) -> list[Returned]:
    """
    Return the results of a function, in the order of the items.

    Parameters
    ----------
    function : callable
        With more than one process it is sent there, as are its arguments.
    items : sequence of tuple
        Arguments of each call.
    jobs : int
        Number of processes; one runs in this process.
    advance : callable
        Called with 1 as soon as a result is available.

    """
    n_processes = min(jobs, len(items))
    if n_processes <= 1:
        results = []
        for item in items:
            results.append(function(*item))
            advance(1)
        return results

    # Here, because most verbs need no pool, and the imports are slow.
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor

    # Spawned, not forked: a fork of a process with threads can stop for ever.
    context = multiprocessing.get_context('spawn')
    with ProcessPoolExecutor(n_processes, mp_context=context) as pool:
        try:
            with _interruptions_blocked():
                futures = [pool.submit(_until_sigterm, function, item) for item in items]
            for future in as_completed(futures):
                future.result()
                advance(1)
        except BaseException:
            # Public from Python 3.14: terminate_workers.
            for worker in list((pool._processes or {}).values()):
                worker.terminate()
            pool.shutdown(wait=True, cancel_futures=True)
            raise
        return [future.result() for future in futures]


@contextmanager
def _interruptions_blocked() -> Iterator[None]:
    """
    Keep Ctrl+C, which a terminal sends to all its processes, from those that are started here.

    This process ends them.
    """
    from multiprocessing import resource_tracker  # here, because its import is slow

    resource_tracker.ensure_running()  # its start would end the block
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _until_sigterm(function: Callable[..., Returned], item: tuple[Any, ...]) -> Returned:
    """
    Run in a worker.

    SIGTERM interrupts the item, so that its temporary files are removed, and otherwise ends the
    process.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        return function(*item)
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
