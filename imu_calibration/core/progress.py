"""
Progress of long work and states for the user.

The core reports phases, which have no effect without a listener.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, TypeVar


@dataclass(frozen=True)
class LiveState:
    """State of one part of a live system, for the user."""

    word: str
    """Its value, from an enumeration of that part."""
    message: str
    """One line: the state and the remedy or next step."""
    values: dict[str, Any] = field(default_factory=dict)
    """Figures by name."""


Item = TypeVar('Item')
Listener = Callable[[str, float, float], None]
"""Receives the name of a phase, the amount done and the total; a total of 0 means unknown."""

# Receivers of reports and of remarks in this context.
_listener: ContextVar[Listener | None] = ContextVar('listener', default=None)
_reader: ContextVar[Callable[[str], None] | None] = ContextVar('reader', default=None)


@contextmanager
def listening(listener: Listener | None) -> Iterator[None]:
    """Send the reports of this context to a listener."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


@contextmanager
def reading_remarks(reader: Callable[[str], None] | None) -> Iterator[None]:
    """Send the remarks of this context to a reader."""
    token = _reader.set(reader)
    try:
        yield
    finally:
        _reader.reset(token)


def remark(text: str) -> None:
    """Send one line about an assumption, such as guessed units, to the reader, if there is one."""
    reader = _reader.get()
    if reader is not None:
        reader(text)


def report(phase: str, done: float = 0.0, total: float = 0.0) -> None:
    """Report the amount done of a phase."""
    listener = _listener.get()
    if listener is not None:
        listener(phase, done, total)


def counter(phase: str, total: float) -> Callable[[float], None]:
    """
    Return a function of the amount done since its last call; a total of 0 suppresses the reports.
    """
    done = 0.0

    def advance(amount):
        nonlocal done
        done += amount
        if total:
            report(phase, done, total)

    advance(0)
    return advance


def reported(phase: str, items: Iterable[Item], total: int) -> Iterator[Item]:
    """Yield items and report how many of them are done."""
    advance = counter(phase, total)
    for item in items:
        yield item
        advance(1)
