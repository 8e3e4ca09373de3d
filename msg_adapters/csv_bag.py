"""A text log as a recording: every verb reads it like a bag."""

import shutil
from functools import lru_cache
from pathlib import Path
from tempfile import mkdtemp
from weakref import finalize

from msg_adapters.csv_log import read_csv
from msg_adapters.rosbag2 import Rosbag2
from msg_adapters.write import write_session


class CsvBag(Rosbag2):
    """
    A text log, converted into a temporary bag.

    Raises
    ------
    InputError
        When columns or units are ambiguous; `csv_log.read_csv` with explicit columns reads such a log.

    """

    def __init__(self, path: Path):
        status = path.stat()
        self.converted = _converted(path, status.st_mtime_ns, status.st_size)
        super().__init__(self.converted.bag)
        self.path = path


class ConvertedLog:
    """The temporary bag of a text log; its folder is removed with the last reference, or at exit."""

    def __init__(self, path: Path):
        log, folder = read_csv(path), mkdtemp(prefix='imu_calibration_')
        finalize(self, shutil.rmtree, folder, ignore_errors=True)
        self.bag = Path(folder, path.stem)
        write_session(self.bag, log.imu, log.joints, temperature=log.temperature, storage='mcap')


@lru_cache(maxsize=1)
def _converted(path, _modified_ns, _size):
    """Return the ConvertedLog: a verb opens a recording several times, and converts an unchanged file once."""
    return ConvertedLog(path)
