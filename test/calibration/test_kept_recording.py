"""A single recording on a table is read once, whatever the number of linearisations."""

import numpy as np
import pytest

from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable import session_data
from imu_calibration.references.turntable.table_calibration import KeptRecording
from imu_calibration.references.turntable.table_reference import TableReference

from worlds.misfit_coverage import COARSE
from worlds.misfit_worlds import make_pair

LAGS = CalibrationOptions('bias+matrix', 'bias+matrix+gyro_bandwidth', 'time_offset')
"""A model with columns at its own values: several passes."""


class Source:
    """Blocks of a recording that count how often they are read."""

    def __init__(self, block):
        self.block, self.n_reads = block, 0

    def __iter__(self):
        self.n_reads += 1
        return iter([self.block])


@pytest.fixture(scope='module')
def late():
    """A session on a shaft whose driver stamps late, and the table."""
    pair = make_pair('driver_lag', 31, table='shaft', profile='sweeps', **COARSE)
    return pair.first.block, Table.from_mapping(pair.table)


def test_a_single_recording_is_read_once_and_a_long_one_by_each_pass(late, monkeypatch):
    block, table = late
    source = Source(block)
    recording = TableReference(table).gather([source], LAGS)
    kept = recording.solved(LAGS).solution
    assert source.n_reads == 1
    assert sum(len(window.time) for window in recording.windows.windows) > 0.5 * len(block.imu)

    monkeypatch.setattr(session_data, 'KEPT_IN_MEMORY', 1000)
    source = Source(block)
    recording = TableReference(table).gather([source], LAGS)
    read_again = recording.solved(LAGS).solution
    assert source.n_reads > 1 and not recording.windows.windows
    np.testing.assert_array_equal(kept.values, read_again.values)
    np.testing.assert_array_equal(kept.sd, read_again.sd)


def test_several_recordings_are_read_by_each_pass(late):
    """Their windows together would have no limit."""
    block, table = late
    recordings = TableReference(table).gather([[block], [block]], LAGS)
    assert not isinstance(recordings, KeptRecording)


def test_a_recording_that_is_refused_leaves_no_windows_of_itself(late):
    """Those of a reading that an error has ended are not used by the next one."""
    block, table = late
    source = Source(block)
    recording = TableReference(table).gather([source], LAGS)

    class Broken(Source):
        def __iter__(self):
            yield self.block
            raise OSError('the file ends')

    broken = KeptRecording([Broken(block)], table, ('one',), windows=recording.windows)
    with pytest.raises(OSError):
        broken.solved(LAGS)
    n_left = len(recording.windows.windows)
    found = recording.solved(LAGS).solution
    assert n_left and source.n_reads == 1
    fresh = TableReference(table).gather([[block]], LAGS).solved(LAGS).solution
    np.testing.assert_array_equal(found.values, fresh.values)
