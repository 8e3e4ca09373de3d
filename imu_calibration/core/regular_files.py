"""Opening untrusted files: regular files only, and archives only up to a size."""

import io
import os
import zipfile
from errno import EINVAL
from os import PathLike
from stat import S_ISREG
from typing import Any, BinaryIO, cast

import numpy as np

ARRAYS_BASE, ARRAYS_RATIO = 64 << 20, 20
"""Largest size of arrays: this many bytes, plus this many times their compressed size."""


def open_regular(path: str | PathLike[str]) -> BinaryIO:
    """
    Open a regular file, or a link to one, for reading; a FIFO would block, and a device may never end.

    Raises
    ------
    OSError
        When it cannot be opened or is not a regular file.

    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)   # opening a FIFO would wait for its writer
    if not S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(EINVAL, 'it is not a regular file', str(path))
    return cast(BinaryIO, os.fdopen(descriptor, 'rb'))


def load_arrays(data: bytes) -> Any:
    """
    Return the arrays of an .npz archive as a context manager; each is decompressed at its first use.

    Raises
    ------
    ValueError, zipfile.BadZipFile
        If it is no such archive, or its arrays need much more memory than a session.

    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        n_bytes, limit = sum(member.file_size for member in archive.infolist()), ARRAYS_BASE + ARRAYS_RATIO * len(data)
    if n_bytes > limit:
        raise ValueError(f'its arrays need {n_bytes} bytes, at most {limit} are accepted')
    return np.load(io.BytesIO(data), allow_pickle=False)
