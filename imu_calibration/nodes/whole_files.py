"""Files that are whole or not there at all."""

import os
from pathlib import Path

from imu_calibration.errors import InputError


def write_whole(path, data, to_disk=True):
    """
    Write bytes beside the file and rename.

    Parameters
    ----------
    path : path-like
    data : bytes
    to_disk : bool
        Wait until the disk has them, so that they outlast a power failure; a busy disk takes seconds.

    Raises
    ------
    InputError
        When the place cannot be written; what was there stays.

    """
    path = Path(path)
    beside = path.with_name(f'.{path.name}.{os.getpid()}')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(beside, 'wb') as stream:
            stream.write(data)
            if to_disk:
                stream.flush()
                os.fsync(stream.fileno())
        os.replace(beside, path)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise InputError(f'{path} must be writable: {error.strerror}; choose another place') from error
