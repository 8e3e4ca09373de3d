"""zstd, from the standard library where it has it, else from the package that rosbags brings along."""

import sys


def zstd():
    """Return the zstd module."""
    if sys.version_info >= (3, 14):
        from compression import zstd as module
    else:
        from backports import zstd as module
    return module
