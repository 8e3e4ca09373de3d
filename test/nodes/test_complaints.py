"""
What is wrong is said when it begins, now and then while it lasts, and when it is over.

Each thing by a clock of its own.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus

from imu_calibration.calibration.coverage import GroupState, group_states
from imu_calibration.core.progress import LiveState
from imu_calibration.document.calibration import Calibration
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.nodes.calibration_status import (
    MIN_ADVICE_SECONDS,
    CalibrationGuide,
    WorkerState,
    advice_of,
    statuses_of,
)
from imu_calibration.nodes.diagnostics import MOST_KINDS, REMINDER, Complaints
from imu_calibration.preprocessing.stamping import COUNTED, REGULAR, StampLine
from imu_calibration.preprocessing.stream_watch import StreamState


class Heard(list):
    """Stands for a logger."""

    def __getattr__(self, level):
        return lambda line: self.append(f'{level}: {line}')


@pytest.fixture
def now():
    """Seconds of the clock, in a list."""
    return [1000.0]


def test_each_complaint_has_a_clock_of_its_own(now):
    heard = Heard()
    complaints = Complaints(heard, lambda: now[0])
    for second in range(130):
        now[0] = 1000.0 + second
        complaints.now(
            'node',
            [f'{second} samples lost'] + ['two publishers'] * (second >= 5),
            ['no disk'] * (5 <= second < 50),
        )
    assert (
        sum('lost' in line for line in heard) == 1 + 129 // int(REMINDER)
        and sum('two publishers' in line for line in heard) == 3
    )
    assert [line.split(':')[0] for line in heard if line.endswith(': no disk')] == ['error', 'info']


def test_what_comes_and_goes_is_not_said_each_time(now):
    heard = Heard()
    complaints = Complaints(heard, lambda: now[0])
    for second in range(20):
        now[0] = 1000.0 + second
        complaints.now('node', ['flicker'] if second % 2 else [])
    assert sum(line == 'warning: flicker' for line in heard) == 2


def test_a_fault_that_goes_on_with_another_text_has_not_ended(now):
    heard = Heard()
    complaints = Complaints(heard, lambda: now[0])
    for lines in (['bias about x'], ['bias about y'], []):
        complaints.now('health', lines, replaces=True)
    assert [line.split(': ')[0] for line in heard] == ['warning', 'warning', 'info']
    assert heard[-1].endswith('bias about y')


def test_memory_stays_bounded_whatever_is_wrong(now):
    complaints = Complaints(Heard(), lambda: now[0])
    for number in range(3 * MOST_KINDS):
        complaints.event(f'trouble {chr(65 + number % 26)}{"x" * number}')
    assert len(complaints._logged_at) <= MOST_KINDS


def test_figures_that_are_not_known_are_left_out_and_no_status_is_stale():
    group = GroupState(
        'accelerometer',
        'bias',
        'held',
        'accelerometer.bias.x',
        float('nan'),
        0.01,
        'm/s^2',
        'turn it over',
    )
    for status in statuses_of(WorkerState(groups=[group], verdict='harms', faults=('no disk',))):
        assert all(value.value != 'nan' for value in status.values) and 'nan' not in status.message
        assert status.level != DiagnosticStatus.STALE


def test_parameters_of_the_reference_warn_nobody_and_need_no_motion():
    """The Earth's rate is weak on every table without azimuth; nothing is to be done."""
    model = SensorModel(reference=('table_tilt',))
    weak = ('determined',) * (len(model.param_names) - 2) + ('weak',) * 2
    result = SimpleNamespace(
        calibration=Calibration(model, model.start(), np.eye(len(weak)), weak),
        tolerances=np.ones(len(weak)),
        needed={name: ('spin', 0.1) for name in model.param_names[-2:]},
    )
    groups = group_states(result)
    by_sensor = {group.sensor: group.counts for group in groups}
    assert by_sensor == {'accelerometer': True, 'gyroscope': True, 'reference': False}
    state = WorkerState(groups=groups, verdict='helps', complete=True)
    assert {status.level for status in statuses_of(state)} == {DiagnosticStatus.OK}
    assert advice_of(state) == ''
    of_sensor = replace(state, groups=[replace(group, counts=True) for group in groups])
    assert DiagnosticStatus.WARN in {status.level for status in statuses_of(of_sensor)}
    assert advice_of(of_sensor) == 'spin'


class Topic:
    """Stands for an input."""

    def source(self):
        """Return where it comes from."""
        return '/imu from /driver, reliable'


def test_stamps_that_change_their_kind_are_logged_at_most_once_a_minute(now):
    guide = CalibrationGuide({}, '', 'window', clock=lambda: now[0])
    lines = [StampLine(COUNTED, 5e6), StampLine(REGULAR, 6e6)]
    heard = []
    for second in range(121):
        now[0] = 1000.0 + second
        streams = StreamState('good', '', {}, stamping=lines[second % 2])
        heard += list(guide.lines(WorkerState(streams=streams)))
    assert len(heard) == 2  # at 0 s and 61 s


def test_the_guide_says_every_change_once(now):
    guide = CalibrationGuide(
        {'imu': Topic(), 'joints': Topic()},
        'the command that saves',
        'window',
        clock=lambda: now[0],
    )
    counted = StreamState(
        'good',
        'Imu messages come',
        {},
        (),
        ('imu', 'joints'),
        stamping=StampLine(COUNTED, 5e6, 0.0, 3.5e7, 8.0),
    )
    states = [
        WorkerState(),
        WorkerState(streams=StreamState('good', '', {}, ('joints',), ('imu',))),
        WorkerState(streams=counted),
        WorkerState(
            streams=counted,
            gathered=3,
            verdict='unproven',
            judged='unproven',
            lines=('bias: known less well', 'next: turn about x'),
        ),
        WorkerState(
            streams=counted,
            gathered=5,
            verdict='unproven',
            judged='unproven',
            lines=('bias: known less well', 'next: turn about y'),
        ),
        WorkerState(
            streams=counted,
            gathered=8,
            verdict='helps',
            judged='helps',
            complete=True,
            lines=('all is well',),
        ),
        WorkerState(
            streams=counted,
            gathered=8,
            verdict='helps',
            judged='helps',
            complete=True,
            diagnosis=LiveState('found', 'the gyroscopes feel gravity', {'effect': 'g'}),
        ),
        WorkerState(
            streams=counted,
            gathered=9,
            verdict='harms',
            judged='harms',
            lines=('residuals are large',),
        ),
    ]
    said = []
    for state in states:
        for _ in range(3):
            now[0] += MIN_ADVICE_SECONDS
            said += guide.lines(state)
    wanted = [
        ('Imu', '/imu', '/driver', 'reliable'),
        ('JointState', '/imu', '/driver', 'reliable'),
        ('Imu', ' 8 '),
        ('window',),
        ('unproven', 'bias: known less well', 'next: turn about x'),
        ('next: turn about x',),
        ('next: turn about y',),
        ('helps', '`the command that saves`'),
        ('the gyroscopes feel gravity',),
        ('harms', 'residuals are large'),
    ]
    assert [
        [value for value in values if value not in line]
        for (_, line), values in zip(said, wanted, strict=True)
    ] == [[]] * len(wanted), said
    assert said[-1][0] == 'warning'
