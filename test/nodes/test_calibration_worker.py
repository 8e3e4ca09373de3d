"""
The thread behind calibration_node does not take its own work for silence of the sensor.

No ROS here.
"""

from types import SimpleNamespace

import pytest

from imu_calibration.api.resources import config_file
from imu_calibration.core.samples import SampleBlock
from imu_calibration.document.files import read_table
from imu_calibration.nodes import calibration_worker
from imu_calibration.nodes.calibration_worker import IDLE, CalibrationWorker, SessionFiles
from imu_calibration.nodes.diagnosis_thread import Listeners
from imu_calibration.preprocessing.stream_watch import SILENT_AFTER
from imu_calibration.references.turntable.live_windows import LiveCalibration

from worlds.physics import make_session

LONG = 2 * max(IDLE, SILENT_AFTER)
"""Seconds for which a solution keeps the thread busy."""


@pytest.fixture
def station(tmp_path, monkeypatch):
    """(A worker that is not started, the blocks that wait for its next look, its clock)."""
    clock, waiting = SimpleNamespace(now=100.0), []
    monkeypatch.setattr(calibration_worker, 'time', SimpleNamespace(monotonic=lambda: clock.now))
    gatherer = SimpleNamespace(flush=lambda: waiting.pop() if waiting else SampleBlock())
    live = LiveCalibration(read_table(config_file('table_simulated.yaml')))
    worker = CalibrationWorker(
        gatherer,
        live,
        lambda: live,
        session_files=SessionFiles(str(tmp_path / 'calibration.yaml')),
        autosave_period=0.0,
        listeners=Listeners(lambda text: None, lambda residuals: None),
        provenance={'serial': 'A-17'},
    )
    return worker, waiting, clock


def test_what_came_while_a_solution_was_made_is_no_silence(station):
    worker, waiting, clock = station
    waiting.append(make_session(1, profile='quick').block)
    worker._process_messages()
    clock.now += LONG  # a solution, on a slow machine; messages wait meanwhile
    worker._solve_when_due()
    worker._update_state()
    found = worker.live.result.calibration.provenance
    assert (found['serial'], found['mode'], found['solution']) == ('A-17', 'live', 1)
    assert worker.state.streams.silent == () and not worker._includes_pending
    worker._process_messages()  # and now nothing has come
    worker._solve_when_due()
    worker._update_state()
    assert worker.state.streams.silent == ('imu', 'joints') and worker._includes_pending


def test_a_diagnosis_follows_the_first_solution_after_the_end_though_it_is_late(
    station, monkeypatch
):
    worker, waiting, clock = station
    wanted = []
    monkeypatch.setattr(worker._diagnosis, 'want', lambda: wanted.append(clock.now))
    waiting.append(make_session(1, profile='quick').block)
    worker._process_messages()
    worker._solve_when_due()
    clock.now += LONG
    worker._process_messages()
    for is_due in (False, True, True):
        monkeypatch.setattr(worker._pacer, 'due', lambda now, is_due=is_due: is_due)
        worker._solve_when_due()
        assert len(wanted) == is_due
