"""Work side by side: in processes of this machine, or on a cluster."""

import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any

from imu_calibration.core.errors import InputError


def jobs_for(asked: int | None, n_items: int) -> int:
    """Return the number of processes: as requested, by default one per processor; at most the number of items."""
    if asked is not None and asked < 1:
        raise InputError(f'at least one process must work, got {asked}; omit the number to use every processor', key='jobs')
    return max(1, min(asked or os.cpu_count() or 1, n_items))


def process_mapper(jobs: int, done: Callable = lambda item: None) -> Callable:
    """
    Return a function like `map` that runs in `jobs` processes and returns a list in the order of the items.

    Parameters
    ----------
    jobs : int
        Number of processes; one runs in this process.
    done : callable
        Called with each result as soon as it is available.

    """
    def mapped(function, items):
        items = list(items)
        if min(jobs, len(items)) <= 1:
            return [_told(function(item), done) for item in items]
        # Spawned, not forked: a fork of a process with threads can stop for ever.
        with ProcessPoolExecutor(min(jobs, len(items)), mp_context=multiprocessing.get_context('spawn')) as pool:
            return _in_order([pool.submit(function, item) for item in items], as_completed, done, pool)
    return mapped


def _told(result, done):
    done(result)
    return result


def _in_order(futures, as_completed, done, pool):
    try:
        for future in as_completed(futures):
            done(future.result())
    except BaseException:
        pool.shutdown(wait=True, cancel_futures=True)
        raise
    return [future.result() for future in futures]


def cluster_mapper(address: str, done: Callable[[Any], object] = lambda item: None) -> Callable:
    """
    Return a function like `map` that runs on the workers of a dask scheduler; they must see the same paths and have this package.

    Raises
    ------
    InputError
        When dask is not installed or the scheduler does not respond.

    """
    try:
        from dask import distributed
    except ImportError as error:
        raise InputError('a scheduler needs dask.distributed, which is not installed; install imu_calibration[dask], or omit it',
                         key='scheduler') from error

    def mapped(function, items):
        try:
            client = distributed.Client(address, timeout='10s', set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError(f'a dask scheduler must be reachable at {address}: {" ".join(str(error).split())}; '
                             'start one with dask scheduler', key='scheduler') from error
        with client, client.as_current():
            futures = client.map(function, list(items), pure=False)
            for future in distributed.as_completed(futures):
                done(future.result())
            return [future.result() for future in futures]
    return mapped
