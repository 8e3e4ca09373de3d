"""
The live diagnosis says what the verb says of the same recording; what it finds joins the model.

It never holds up the rest. No ROS here.
"""

import threading
from dataclasses import replace

import numpy as np
import pytest
from refusal import refused
from test_live_calibration import assert_same, blocks

from imu_calibration.calibration.calibrate import calibrate_by_evidence
from imu_calibration.calibration.diagnosis.diagnose import diagnose_recording
from imu_calibration.calibration.from_solution import ModelExtension
from imu_calibration.calibration.live import LiveSettings
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.errors import DocumentError
from imu_calibration.core.progress import LiveState, report
from imu_calibration.core.samples import SampleBlock
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.kinematics.table import Table
from imu_calibration.nodes.diagnosis_thread import DiagnosisThread
from imu_calibration.references.turntable.live_diagnosis import (
    Answer,
    live_state_of,
    question_about,
)
from imu_calibration.references.turntable.live_windows import LiveCalibration
from imu_calibration.references.turntable.table_calibration import TableRecordings
from imu_calibration.references.turntable.table_reference import TableReference

from ros.threads import until
from worlds import physics
from worlds.misfit_coverage import COARSE
from worlds.misfit_worlds import make_pair

CANDIDATES = 'accel_quadratic+time_offset'
OPTIONS = CalibrationOptions(catalogue=CATALOGUE.with_candidates(CANDIDATES))
QUICK = {'profile': 'quick', 'imu_rate': 50.0, 'joint_rate': 50.0}


class Station:
    """A LiveCalibration fed as calibration_node feeds it."""

    def __init__(self, session, **settings):
        self.live = LiveCalibration(
            Table.from_mapping(session.table), OPTIONS, settings=LiveSettings(**settings)
        )
        for block in blocks(session.imu, session.joints):
            self.live.push(block)
        self.live.solve(pending=True)

    def question(self):
        """Return the question about the session."""
        return question_about(self.live)


@pytest.fixture(scope='module')
def hidden():
    """A session with quadratic terms that the model lacks."""
    return physics.make_session(3, {'accel_quadratic': None}, **QUICK)


@pytest.fixture(scope='module')
def expected(hidden):
    """What the verb diagnose says of it, and hands over."""
    return diagnose_recording(
        [SampleBlock(hidden.imu, hidden.joints)],
        TableReference(Table.from_mapping(hidden.table)),
        OPTIONS,
    )


@pytest.fixture(scope='module')
def station(hidden):
    """A session whose question is answered, and the answer."""
    station = Station(hidden)
    station.before = station.live.result.calibration
    station.answer = station.question().answer()
    return station


def test_the_answer_is_that_of_the_verb(station, expected):
    """The same effect, with the very same figures, sizes of the calibration included."""
    first, state = expected.diagnosis.findings[0], station.answer.state
    assert (
        first.effect == 'accel_quadratic' and state.values['windows'] == expected.diagnosis.windows
    )
    assert state.word == 'found' and state.message.startswith(
        f'accel_quadratic: {first.explanation}'
    )
    assert state.values['p-value'] == f'{first.p_value:.2g}'
    assert (
        state.values['held-out reduction'] == f'{first.gain.reduction:.3f}'
        and first.gain.reduction > 0.05
    )
    for name, (value, sd, unit) in first.parameters.items():
        assert state.values[name] == f'{value:.4g} +- {sd:.2g} {unit}'


def test_what_is_found_joins_the_model_and_the_live_result_is_that_of_calibrate(station, expected):
    live = station.live
    assert live.adopt(station.answer.extension)
    found = live.solve(pending=True).calibration
    assert 'accel_quadratic' in found.statistics['added'] and not {'added', 'denied'} & set(
        station.before.statistics
    )
    assert found.statistics['added'] == expected.calibration.statistics['added']
    assert_same(found, expected.calibration)
    for sensor, entry in expected.calibration.proof.items():
        assert found.proof[sensor].after == pytest.approx(entry.after, rel=1e-9)
    assert sum('accel_quadratic (' in line for line in found.notes) == 1
    again = station.question().answer()  # about a session whose model is wide already
    assert again.extension.added == station.answer.extension.added
    assert live.adopt(again.extension)
    assert_same(live.solve(pending=True).calibration, expected.calibration)


@pytest.mark.long
def test_windows_after_the_adoption_count_like_those_before(hidden, expected):
    live = LiveCalibration(Table.from_mapping(hidden.table), OPTIONS)
    every = list(blocks(hidden.imu, hidden.joints))
    for block in every[: 3 * len(every) // 4]:
        live.push(block)
    live.solve(pending=True)
    assert live.adopt(live.last.evidence().extension)
    for block in every[3 * len(every) // 4 :]:
        live.push(block)
    named = {key for key, part in live.solve(pending=True).model.slices.items()}
    assert ('accelerometer', 'accel_quadratic') in named
    live.adopt(live.last.evidence().extension)
    assert_same(live.solve(pending=True).calibration, expected.calibration)


@pytest.mark.long
def test_a_delay_is_taken_at_its_size_like_offline():
    """
    Columns that depend on their own value.

    Those of all windows are taken anew where the search found the delay.
    """
    pair = make_pair('driver_lag', 31, table='shaft', profile='sweeps', **COARSE)
    table = Table.from_mapping(pair.table)
    live = LiveCalibration(table, OPTIONS)
    for block in blocks(pair.first.imu, pair.first.joints):
        live.push(block)
    live.solve(pending=True)
    assert live.adopt(live.last.evidence().extension)
    recordings = TableRecordings.of([[pair.first.block]], table)
    expected = calibrate_by_evidence(recordings, OPTIONS).calibration
    found = live.solve(pending=True).calibration
    assert 'time_offset' in found.statistics['added']
    assert_same(found, expected)


@pytest.mark.long
def test_the_model_as_asked_stays(hidden):
    live = LiveCalibration(Table.from_mapping(hidden.table), replace(OPTIONS, as_asked=True))
    for block in blocks(hidden.imu, hidden.joints):
        live.push(block)
    before = live.solve(pending=True).calibration
    answer = question_about(live).answer()
    # It is said, and that is all.
    assert answer.state.word == 'found' and not live.adopt(answer.extension)
    after = live.solve(pending=True).calibration
    assert after.param_names == before.param_names and 'added' not in after.statistics
    np.testing.assert_array_equal(after.sd, before.sd)


def test_what_cannot_join_is_said_and_widens(hidden):
    """The store was too small for the motion: calibrate the recording offline."""
    station = Station(hidden, store_samples=500)
    before, answer = station.live.result.calibration, station.question().answer()
    assert answer.extension.changes.lacking == ('accel_quadratic',) and not answer.extension.added
    assert station.live.adopt(answer.extension)
    after = station.live.solve(pending=True).calibration
    assert (
        after.param_names == before.param_names
        and (after.sd >= before.sd).all()
        and np.max(after.sd / before.sd) > 1.5
    )
    lines = [line for line in after.notes if 'accel_quadratic' in line or 'offline' in line]
    assert len(lines) == 2 and 'accel_quadratic' in lines[0]


@pytest.mark.long
def test_a_resumed_session_keeps_what_joined(station, hidden):
    """
    Saved with the wide model, the session goes on with it, and stays with it.

    The columns of before cannot be taken anew.
    """
    station.live.adopt(station.answer.extension)
    station.live.solve(pending=True)
    saved = station.live.saved(pending=True)
    table = Table.from_mapping(hidden.table)
    resumed = LiveCalibration(table, OPTIONS, saved=saved)
    assert resumed.extension.added == station.live.extension.added and resumed.model.has_columns_of(
        station.live.model
    )
    assert_same(resumed.solve().calibration, station.live.solve(pending=True).calibration)
    assert (
        resumed.result.calibration.statistics['added']
        == station.live.result.calibration.statistics['added']
    )
    assert question_about(resumed) is None  # the windows of before have no samples any more
    half = hidden.imu.stamp_ns[len(hidden.imu) // 2]
    later = 10**12
    for block in blocks(
        replace(hidden.imu, stamp_ns=hidden.imu.stamp_ns + later).select(
            hidden.imu.stamp_ns < half
        ),
        replace(hidden.joints, stamp_ns=hidden.joints.stamp_ns + later).select(
            hidden.joints.stamp_ns < half
        ),
    ):
        resumed.push(block)
    resumed.solve(pending=True)
    answer = question_about(resumed).answer()
    assert (
        answer.extension.added == station.live.extension.added
        and not answer.extension.changes.lacking
    )
    with refused(DocumentError, 'other_model', 'accel_quadratic'):
        LiveCalibration(table, replace(OPTIONS, as_asked=True), saved=saved)


def test_nothing_is_found_where_nothing_is_hidden():
    station = Station(physics.make_session(3, **QUICK))
    before, answer = station.live.result.calibration, station.question().answer()
    assert answer.state.word == 'nothing found'
    assert answer.extension.is_nothing and not station.live.adopt(answer.extension)
    np.testing.assert_array_equal(station.live.solve(pending=True).calibration.sd, before.sd)


def test_without_windows_nothing_is_asked(hidden):
    live = LiveCalibration(Table.from_mapping(hidden.table), OPTIONS)
    assert question_about(live) is None


def test_a_window_keeps_no_chunk_alive(station):
    """A window that was cut from a chunk of 20 s would keep all of it."""
    for window in station.live.last.gathered.for_search[0].windows:
        assert all(
            array.base is None
            for array in (window.force_s, window.rate_s, window.stamp_ns, window.motion.position)
        )


class Slow:
    """A question whose answer takes as long as the test wants."""

    def __init__(self, words):
        self.go, self.words, self.asked = threading.Event(), words, 0

    def __call__(self):
        self.asked += 1
        return self

    def answer(self):
        """Wait, look whether to go on, answer."""
        while not self.go.wait(0.01):
            report('waiting', 0.5, 1.0)
        return Answer(LiveState('found', self.words), ModelExtension())

    @property
    def samples(self):
        """Return a number that no other question has."""
        return id(self)


def test_the_thread_answers_when_asked_and_once_at_a_time(monkeypatch):
    # A busy machine makes the first answer long, and the pause after it.
    monkeypatch.setattr('imu_calibration.nodes.diagnosis_thread.MAX_DIAGNOSIS_SHARE', 1.0)
    thread, question = DiagnosisThread(3600.0), Slow('first')
    thread.ask_when_due(question, True)
    assert question.asked == 0 and thread.state.word == 'waiting'  # the period is not over
    thread.want()
    thread.ask_when_due(question, True)
    thread.want()
    thread.ask_when_due(question, True)
    assert question.asked == 1 and thread.is_running
    question.go.set()
    until(lambda: not thread.is_running, 'the answer', 10.0)
    assert thread.state.message == 'first' and thread.n_answers == 1
    assert question not in vars(thread).values()  # its windows would remain in memory
    # It was wanted while the first was being answered.
    until(
        lambda: thread.ask_when_due(question, False) or thread.n_answers == 2,
        'the second question',
        10.0,
    )


def test_a_session_started_anew_forgets_the_question_and_an_ending_one_stops_it():
    thread, question = DiagnosisThread(3600.0), Slow('old')
    for ending in (thread.forget, thread.end):
        thread.want()
        thread.ask_when_due(question, True)
        assert thread.is_running
        ending()
        until(lambda: not thread.is_running, 'the answer', 10.0)
        assert thread.state.word == 'waiting' and thread.n_answers == 0


def test_a_failure_is_a_status_and_zero_is_off():
    class Broken:
        samples = 0

        def answer(self):
            raise ValueError('broken')

    thread = DiagnosisThread(3600.0)
    thread.want()
    thread.ask_when_due(Broken, True)
    until(lambda: not thread.is_running, 'the answer', 10.0)
    assert thread.state.word == 'failed' and 'broken' in thread.state.message
    off = DiagnosisThread(0.0)
    off.want()
    off.ask_when_due(Broken, True)
    assert off.state.word == 'off' and not off.is_running


def test_who_saves_waits_for_the_answer_and_asks_the_same_once():
    thread, question = DiagnosisThread(3600.0), Slow('first')
    threading.Timer(0.2, question.go.set).start()
    thread.settle(question)
    assert (
        thread.n_answers == 1
        and thread.take_extension() is not None
        and thread.take_extension() is None
    )
    thread.settle(question)
    thread.settle(None)
    assert thread.n_answers == 1
    later = Slow('second')
    later.go.set()
    thread.settle(later)
    assert thread.n_answers == 2 and thread.state.message == 'second'


def test_what_stays_unexplained_is_said(expected):
    diagnosis = expected.diagnosis
    rest = {
        sensor: replace(found, significant=sensor == 'gyroscope', rms=1e-3)
        for sensor, found in diagnosis.unexplained.items()
    }
    state = live_state_of(replace(diagnosis, findings=(), unexplained=rest))
    assert (
        state.word == 'unexplained'
        and state.message.startswith('unexplained: ')
        and 'gyroscope' in state.message
    )


def test_a_session_is_solved_before_the_next_rest_when_its_columns_were_extended(hidden):
    """Rests had no centred rows, of the former width: a solution before the next rest failed."""
    live = LiveCalibration(Table.from_mapping(hidden.table), OPTIONS)
    every = list(blocks(hidden.imu, hidden.joints))
    for block in every[: len(every) // 2]:
        live.push(block)
    collector = live._collector
    wide = replace(collector.model, gyroscope=(*collector.model.gyroscope, 'gyro_g_sensitivity'))
    collector.take_model(wide)
    accumulator = collector.gathered.accumulator
    width = accumulator.rows[0].sensors['gyroscope'].mean.size
    assert accumulator.rows[0].kind == 'static'
    assert {each.sensors['gyroscope'].within.shape[1] for each in accumulator.rows} == {width}
    assert accumulator.within['gyroscope', 'static'].shape[1] == width
    live.solve()
