"""The live diagnosis says what the verb says of the same recording; its windows are bounded; it never holds up the rest. No ROS here."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from test_live_calibration import blocks

from imu_calibration.calibration.live import LiveCalibration
from imu_calibration.calibration.live_settings import LiveSettings
from imu_calibration.diagnosis.diagnose import diagnose
from imu_calibration.diagnosis.live import DiagnosisState, LiveDiagnosis, RecentWindows, describe
from imu_calibration.diagnosis.workflow import diagnose_recording
from imu_calibration.reference.table import Table
from imu_calibration.samples import SampleBlock

from worlds import physics

pytest.importorskip('rclpy')
from imu_calibration.nodes.diagnosis_thread import DiagnosisThread  # noqa: E402


class Station:
    """A LiveCalibration with its LiveDiagnosis, fed as calibration_node feeds them."""

    def __init__(self, session, diagnosis_samples=300_000):
        self.live = LiveCalibration(Table.from_mapping(session.table), settings=LiveSettings())
        self.diagnosis = LiveDiagnosis(diagnosis_samples)
        for block in blocks(session.imu, session.joints):
            self.diagnosis.add(self.live.push(block))
        self.live.solve(pending=True)

    def question(self):
        """Return the Question about the session."""
        return self.diagnosis.question(self.live)


@pytest.fixture(scope='module')
def hidden():
    """A session with quadratic terms that the model lacks."""
    return physics.make_session(3, {'accel_quadratic': None})


def test_the_first_finding_is_that_of_the_verb(hidden):
    station = Station(hidden)
    table = Table.from_mapping(hidden.table)
    expected = diagnose_recording(lambda: iter([SampleBlock(hidden.imu, hidden.joints)]), table).diagnosis
    question = station.question()
    assert len(question.windows) == expected.windows
    state = question.answer()
    first = expected.findings[0]
    assert first.effect == 'accel_quadratic'
    # the verb tells the parameters of its calibration, which has levelling and arms beside the finding: the size may differ by some sd
    assert state.word == 'found' and state.message.startswith('accel_quadratic: ' + first.explanation.partition(' Its size')[0])
    assert state.values['p-value'] == f'{first.p_value:.2g}'
    assert state.values['held-out reduction'] == f'{first.gain.reduction:.3f}' and first.gain.reduction > 0.05
    for name, (value, sd, unit) in first.parameters.items():
        size, _, rest = state.values[name].partition(' +- ')
        assert abs(float(size) - value) < 2 * sd and rest.endswith(unit)


def test_nothing_is_found_where_nothing_is_hidden():
    state = Station(physics.make_session(3)).question().answer()
    assert state.word == 'nothing found' and 'no effect of the catalogue' in state.message


def test_without_windows_or_with_nothing_kept_nothing_is_asked(hidden):
    assert LiveDiagnosis(300_000).question(LiveCalibration(Table.from_mapping(hidden.table))) is None
    assert Station(hidden, diagnosis_samples=0).question() is None


def test_windows_are_bounded_and_the_oldest_go(hidden):
    question = Station(hidden, diagnosis_samples=5000).question()
    assert sum(len(window) for window in question.windows) <= 5000 + 2 * 2000 and question.forgotten > 0
    assert question.windows[-1].time[-1] > 0.9 * hidden.truth['temperature_c'].size / 100
    full = Station(hidden).question().windows
    assert [w.time[0] for w in question.windows] == [w.time[0] for w in full[-len(question.windows):]]


def test_a_window_keeps_no_chunk_alive(hidden):
    windows = Station(hidden).question().windows
    recent = RecentWindows(10**6)
    recent.add(windows[:3])
    assert all(np.shares_memory(w.force_s, r.force_s) is False for w, r in zip(windows, recent.list()))


class Slow:
    """A question whose answer takes as long as the test wants."""

    def __init__(self, words):
        self.go, self.words, self.asked = threading.Event(), words, 0

    def __call__(self):
        self.asked += 1
        return self

    def answer(self, progress):
        """Wait, look whether to go on, answer."""
        while not self.go.wait(0.01):
            progress(0.5)
        return DiagnosisState('found', self.words)


def until(condition):
    """Wait a little."""
    deadline = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_the_thread_answers_when_asked_and_once_at_a_time():
    thread, question = DiagnosisThread(3600.0), Slow('first')
    thread.ask_when_due(question, True)
    assert question.asked == 0 and thread.state.word == 'waiting'   # the period is not over
    thread.want()
    thread.ask_when_due(question, True)
    thread.want()
    thread.ask_when_due(question, True)
    assert question.asked == 1 and thread.is_running
    question.go.set()
    until(lambda: not thread.is_running)
    assert thread.state.message == 'first' and thread.n_answers == 1
    thread.ask_when_due(question, False)
    until(lambda: thread.n_answers == 2)   # it was wanted while the first was being answered


def test_a_session_started_anew_forgets_the_question_and_an_ending_one_stops_it():
    thread, question = DiagnosisThread(3600.0), Slow('old')
    for ending in (thread.forget, thread.end):
        thread.want()
        thread.ask_when_due(question, True)
        assert thread.is_running
        ending()
        until(lambda: not thread.is_running)
        assert thread.state.word == 'waiting' and thread.n_answers == 0


def test_a_failure_is_a_status_and_zero_is_off():
    class Broken:
        def answer(self, progress):
            raise ValueError('broken')
    thread = DiagnosisThread(3600.0)
    thread.want()
    thread.ask_when_due(Broken, True)
    until(lambda: not thread.is_running)
    assert thread.state.word == 'failed' and 'broken' in thread.state.message
    off = DiagnosisThread(0.0)
    off.want()
    off.ask_when_due(Broken, True)
    assert off.state.word == 'off' and not off.is_running


def test_what_stays_unexplained_is_said(hidden):
    question = Station(hidden).question()
    diagnosis = diagnose(question.windows, question.table, question.model)
    rest = {sensor: replace(found, significant=sensor == 'gyroscope', rms=1e-3) for sensor, found in diagnosis.unexplained.items()}
    state = describe(replace(diagnosis, findings=(), unexplained=rest))
    assert state.word == 'unexplained' and state.message.startswith('unexplained: ') and 'gyroscope' in state.message
