"""Reading and decompressing in a second thread while the first one decodes."""

import queue
import threading
from collections.abc import Generator
from typing import Any, TypeVar

T = TypeVar('T')

DEPTH = 2
"""Pieces that wait at most; bounds the memory."""

_END = object()


def read_ahead(pieces: Generator[T, None, None]) -> Generator[T, None, None]:
    """
    Run a generator in a thread and yield its items in order; its exceptions are raised here.

    The thread ends with the generator, or soon after the consumer has closed this one.
    """
    waiting: queue.Queue[Any] = queue.Queue(DEPTH)
    stop = threading.Event()

    def put(item):
        while not stop.is_set():
            try:
                return waiting.put(item, timeout=0.2)
            except queue.Full:
                continue

    def run():
        try:
            for piece in pieces:
                put((piece, None))
                if stop.is_set():
                    break
            put((_END, None))
        except BaseException as error:   # handed over to the consumer
            put((_END, error))
        finally:
            pieces.close()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        while True:
            piece, error = waiting.get()
            if error is not None:
                raise error
            if piece is _END:
                return
            yield piece
    finally:
        stop.set()
        thread.join()
