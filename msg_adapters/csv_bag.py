"""A text log as a recording: every verb reads it like a bag."""

import shutil
from pathlib import Path
from tempfile import mkdtemp

from msg_adapters.csv_log import read_csv
from msg_adapters.rosbag2 import Rosbag2
from msg_adapters.write import write_session


class CsvBag(Rosbag2):
    """
    A text log, converted into a temporary bag that `close` removes.

    Raises
    ------
    InputError
        When columns or units are ambiguous; `csv_log.read_csv` with explicit columns reads such a log.

    """

    def __init__(self, path: Path):
        log = read_csv(path)
        folder = mkdtemp(prefix='imu_calibration_')
        try:
            write_session(Path(folder, path.stem), log.imu, log.joints, temperature=log.temperature, storage='mcap')
            super().__init__(Path(folder, path.stem))
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        self.path, self.folder = path, folder
