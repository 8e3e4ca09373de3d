"""Named constants that are texts."""

from enum import Enum


class StrEnum(str, Enum):
    """``enum.StrEnum`` of Python 3.11, also for Python 3.10: str() and format() give the value."""

    __str__ = str.__str__
