"""Compressed files, chunks and messages; a stream that is cut off gives what came before the cut."""

import sys
from functools import cache
from pathlib import Path
from types import ModuleType

from msg_adapters.mcap_records import McapDamage

PIECE = 1 << 20


@cache
def zstd() -> ModuleType:
    """Return the zstd module: of the standard library where it has it, else of the package that rosbags brings along."""
    if sys.version_info >= (3, 14):
        from compression import zstd as module
    else:
        from backports import zstd as module
    return module


def decompress_chunk(compression: str, packed: memoryview) -> bytes:
    """Return the content of a chunk, or what can be had of it (raises McapDamage)."""
    if compression not in ('zstd', 'lz4'):
        raise McapDamage(f'a chunk with the unknown compression {compression!r}')
    whole, partial = _decompressors(compression)
    try:
        try:
            return whole(packed)
        except _errors():
            return partial(packed)   # what comes before the cut
    except _errors() as error:
        raise McapDamage(f'a chunk that cannot be decompressed ({error})') from error


def _decompressors(compression):
    """Return (function for a whole stream, function that takes a stream which is cut off)."""
    if compression == 'zstd':
        return zstd().decompress, zstd().ZstdDecompressor().decompress
    from lz4 import frame
    return frame.decompress, frame.LZ4FrameDecompressor().decompress


def _errors():
    return zstd().ZstdError, RuntimeError, EOFError


def decompress_message(data: bytes) -> bytes:
    """Return one message of a bag that is compressed by message."""
    return zstd().decompress(data)


def decompress_file(source: Path, target: Path) -> str | None:
    """
    Decompress a zstd file into another; return the error that ended it early, or None.

    What was decompressed before the damage is written in any case.
    """
    module, source = zstd(), Path(source)
    with source.open('rb') as packed, Path(target).open('wb') as plain:
        decompressor, started = module.ZstdDecompressor(), True
        try:
            while data := packed.read(PIECE):
                while data:
                    plain.write(decompressor.decompress(data))
                    data = b''
                    if decompressor.eof:   # a file may hold several frames
                        data, decompressor = decompressor.unused_data, module.ZstdDecompressor()
                        started = bool(data)
                    else:
                        started = True
        except module.ZstdError as error:
            return str(error)
    return 'the stream is cut off' if started else None
