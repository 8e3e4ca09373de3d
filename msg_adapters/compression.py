"""Compressed chunks, messages and files, decompressed within limits."""

import bz2
import shutil
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from imu_calibration.core.errors import InputError

IN_LIBRARY = sys.version_info >= (3, 14)

PACKED_PIECE_BYTES = 1 << 20
LARGEST_CHUNK, LARGEST_MESSAGE = 64 << 20, 32 << 20
"""
Bytes of a chunk and of a message when decompressed; recorders write chunks of a few megabytes.
"""
MESSAGE_BASE = 4 << 20
"""
A message may grow to this many bytes, plus `FILE_RATIO` times its compressed size; each of many may
be a bomb.
"""
MOST_FRAMES = 10_000
"""
Frames of one stream; each costs time and gives at least a megabyte in files that compress in
parallel.
"""
FILE_BASE, FILE_RATIO = 256 << 20, 100
"""
A file may grow to this many bytes, plus this many times its compressed size; recordings of sensors
shrink by a factor of ten at most.
"""


@cache
def zstd() -> ModuleType:
    """
    Return the zstd module: of Python 3.14, or of the package that rosbags requires.

    Raises
    ------
    InputError
        Without either.

    """
    try:
        return import_module('compression.zstd' if IN_LIBRARY else 'backports.zstd')
    except ModuleNotFoundError as error:
        raise _not_installed('zstd', 'backports.zstd') from error


def _lz4() -> Any:
    """Return the lz4 module; raises InputError without it."""
    try:
        return import_module('lz4.frame')
    except ModuleNotFoundError as error:
        raise _not_installed('lz4', 'lz4') from error


def _not_installed(compression: str, package: str) -> InputError:
    """Return the error for a compression whose Python package is missing."""
    return InputError(
        f'a recording compressed by {compression} needs the Python package {package} or a sourced'
        f" ROS 2 with rosbag2_py, both are absent; run 'pip install {package}'",
        code='compression_missing',
    )


def all_installed() -> bool:
    """Return whether this Python decompresses everything that rosbag2 compresses."""
    try:
        zstd()
        _lz4()
    except InputError:
        return False
    return True


def decompress(compression: str, packed: bytes | memoryview, limit: int) -> bytes:
    """
    Return at most `limit` bytes of a stream: zstd, lz4 or bz2.

    Raises
    ------
    KeyError
        For another compression; `decompression_errors` for damaged data.

    """
    make_decompressor = _decompressor(compression)
    parts = []  # content of each frame
    n_bytes = 0
    for _ in range(MOST_FRAMES):
        decompressor = make_decompressor()
        parts.append(decompressor.decompress(packed, limit - n_bytes))
        n_bytes += len(parts[-1])
        packed = decompressor.unused_data if decompressor.eof else b''
        if not packed or n_bytes >= limit:
            break
    return parts[0] if len(parts) == 1 else b''.join(parts)


def _decompressor(compression: str) -> Callable[[], Any]:
    """Return the function that makes a decompressor of one frame; KeyError if unknown."""
    if compression == 'lz4':
        return _lz4().LZ4FrameDecompressor
    if compression == 'bz2':
        return bz2.BZ2Decompressor
    return {'zstd': zstd}[compression]().ZstdDecompressor


def decompression_errors() -> tuple[type[Exception], ...]:
    """Return the errors of `decompress` for damaged data."""
    errors: tuple[type[Exception], ...] = (RuntimeError, EOFError, OSError, ValueError)
    with suppress(InputError):
        errors = (zstd().ZstdError, *errors)
    return errors


def decompress_chunk(compression: str, packed: memoryview, size: int) -> bytes:
    """
    Return the content of a chunk, or its readable part (raises ValueError).

    At most the `size` bytes that the chunk's header declares are returned.
    """
    if size > LARGEST_CHUNK:
        raise ValueError(
            f'a chunk of {size} bytes, more than the {LARGEST_CHUNK} that are accepted'
        )
    try:
        return decompress(compression, packed, size)
    except KeyError:
        raise ValueError(f'a chunk with the unknown compression {compression!r}') from None
    except decompression_errors() as error:
        raise ValueError(f'a chunk that cannot be decompressed ({error})') from error


def decompress_message(data: bytes) -> bytes:
    """
    Return one message of a bag that is compressed by message.

    It raises ValueError for a message that expands too much.
    """
    limit = min(LARGEST_MESSAGE, MESSAGE_BASE + FILE_RATIO * len(data))
    plain = decompress('zstd', data, limit)
    if len(plain) == limit:
        raise ValueError('a message expands beyond its limit')
    return plain


def largest_content(file_size: int) -> int:
    """Return how many bytes a compressed file of a size may contain."""
    return FILE_BASE + FILE_RATIO * file_size


def decompress_file(source: Path, target: Path) -> str | None:
    """
    Decompress a zstd file into another; return the error that ended it early, or None.

    Data decompressed before the damage are written in any case.

    Raises
    ------
    ValueError
        When it is much larger than a recording would be, or than the free space.

    """
    module = zstd()
    source = Path(source)
    limit = min(
        largest_content(source.stat().st_size), shutil.disk_usage(target.parent).free * 9 // 10
    )
    with source.open('rb') as packed, Path(target).open('wb') as plain:
        decompressor = module.ZstdDecompressor()
        n_frames = 0
        data = b''  # input that the decompressor has not received yet
        in_frame = True  # whether a frame is incomplete; an empty file lacks its first one
        try:
            while True:
                # More input is needed only after the output of earlier input.
                if not data and decompressor.needs_input:
                    data = packed.read(PACKED_PIECE_BYTES)
                    if not data:
                        break
                plain.write(decompressor.decompress(data, PACKED_PIECE_BYTES))
                data = b''
                in_frame = True
                # A file may have several frames: the input after this one begins the next.
                if decompressor.eof:
                    data = decompressor.unused_data
                    decompressor = module.ZstdDecompressor()
                    n_frames += 1
                    in_frame = bool(data)
                if plain.tell() > limit or n_frames > MOST_FRAMES:
                    raise ValueError(
                        f'it expands beyond the {limit} bytes or {MOST_FRAMES} frames that are'
                        ' accepted'
                    )
        except module.ZstdError as error:
            return str(error)
    return 'the stream is cut off' if in_frame else None


def compressor(name: str) -> Callable | type:
    """Return the function that compresses a chunk."""
    if name == 'zstd':
        return zstd().compress
    if name == 'lz4':
        return _lz4().compress
    return bytes
