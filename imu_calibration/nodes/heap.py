"""The heap of a long session: memory freed by a solution or a diagnosis is returned to the system."""

import ctypes
from typing import Any

THRESHOLD = 256 * 1024
"""Bytes from which an array has separate pages, which are returned when it is freed; glibc raises its threshold to 32 MB, so that arrays
remain in a fragmented heap: 265 MB instead of 128 MB after a diagnosis."""
_M_MMAP_THRESHOLD = -3


def _libc() -> Any:
    """Return the C library where it has these functions (glibc), or None."""
    library = ctypes.CDLL(None)
    return library if hasattr(library, 'mallopt') and hasattr(library, 'malloc_trim') else None


def give_arrays_own_pages() -> None:
    """Fix the size from which arrays have pages of their own."""
    if (libc := _libc()) is not None:
        libc.mallopt(_M_MMAP_THRESHOLD, THRESHOLD)


def return_freed_memory() -> None:
    """Return the free pages of the heap to the system."""
    if (libc := _libc()) is not None:
        libc.malloc_trim(0)
