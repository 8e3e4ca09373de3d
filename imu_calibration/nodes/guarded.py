"""Callbacks whose exceptions are handled: in an executor an exception ends the node."""

from collections.abc import Callable
from typing import Any


def guarded(callback: Callable[..., Any], failed: Callable[[Exception], Any]) -> Callable[..., None]:
    """Return `callback` with its exceptions passed to `failed`."""
    def call(*arguments: Any) -> None:
        try:
            callback(*arguments)
        except Exception as error:
            failed(error)
    return call
