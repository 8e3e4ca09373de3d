"""
Reading ahead in a thread.

Order, errors of the generator, an early end, and an interruption while the thread starts.
"""

import threading

import pytest

from msg_adapters.storage import read_ahead

SECONDS = 20.0


def pieces(closed, hold=None, count=10):
    """Yield numbers; `closed` is set at the end, and the first one waits for `hold`."""
    try:
        for number in range(count):
            if hold is not None:
                hold.wait(SECONDS)
            yield number
    finally:
        closed.set()


def test_pieces_come_in_order_and_an_early_end_closes_the_generator():
    closed = threading.Event()
    assert list(read_ahead(pieces(closed))) == list(range(10)) and closed.is_set()
    closed.clear()
    reading = read_ahead(pieces(closed))
    assert next(reading) == 0
    reading.close()
    assert closed.is_set()


def test_an_error_is_raised_at_its_place():
    def failing():
        yield 1
        raise OSError('damaged')

    reading = read_ahead(failing())
    assert next(reading) == 1
    with pytest.raises(OSError, match='damaged'):
        next(reading)


def test_an_interruption_while_the_thread_starts_is_passed_on(monkeypatch):
    """
    The thread is within the generator then, and closing it at once failed.

    It raised a ValueError in place of the interruption.
    """
    start, hold, closed, inside = (
        threading.Thread.start,
        threading.Event(),
        threading.Event(),
        threading.Event(),
    )

    def interrupted(thread):
        monkeypatch.setattr(threading.Thread, 'start', start)
        start(thread)
        inside.wait(SECONDS)
        threading.Timer(0.2, hold.set).start()
        raise KeyboardInterrupt

    def signalled():
        inside.set()
        yield from pieces(closed, hold)

    monkeypatch.setattr(threading.Thread, 'start', interrupted)
    with pytest.raises(KeyboardInterrupt):
        next(read_ahead(signalled()))
