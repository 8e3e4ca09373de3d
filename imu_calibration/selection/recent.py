"""A bounded cache."""

from typing import Any


class Recent(dict):
    """
    The last results by key; beyond `most` the oldest is dropped and computed again on demand.

    Parameters
    ----------
    most : int
        Results kept at most.

    """

    def __init__(self, most: int):
        super().__init__()
        self._most = most

    def __setitem__(self, key: Any, value: Any) -> None:
        """Keep a result."""
        super().__setitem__(key, value)
        if len(self) > self._most:
            del self[next(iter(self))]
