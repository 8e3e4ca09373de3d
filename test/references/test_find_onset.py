"""
Changes at one moment are found with their time and both states.

Gradual changes are none, and clocks are identified.
"""

import numpy as np
import pytest

from imu_calibration.calibration.diagnosis.diagnosis_workflow import diagnosis_lines
from imu_calibration.effects.base import Role
from imu_calibration.references.turntable.diagnosis_of_windows import build_diagnosis
from imu_calibration.references.turntable.selection.investigation import investigate

from worlds.candidates import with_candidates
from worlds.hiding import record
from worlds.moments import Clock, Moment, Wander

CLOCKS = 'time_offset+clock_rate+clock_step+encoder_zero'
MOMENTS = 'time_offset+encoder_zero'
SEED = 6


def investigated(cause, candidates=MOMENTS, profile='quick'):
    options = {'profile': profile, 'imu_rate': 50.0, 'joint_rate': 50.0}
    recording = record(SEED, None, 'realistic', through_bag=False, cause=cause, **options)
    model = with_candidates(recording.model, candidates)
    return recording, investigate(recording.windows, recording.table, model)


def moment_of(recording, share):
    """
    Return the moment of a share of the session, s.

    Windows begin after the first sample by less than a second.
    """
    return share * max(window.time[-1] for window in recording.windows)


@pytest.mark.long
@pytest.mark.parametrize(
    'kind, what, axes',
    [
        ('axes', 'accelerometer', 'xy'),
        ('mount', 'accelerometer and gyroscope', 'xyz'),
        ('belt', 'encoder_zero', ''),
    ],
)
def test_a_change_at_one_moment_is_found_with_both_states(kind, what, axes):
    # Exchanged axes leave little to find in the shortest session.
    recording, found = investigated(Moment(kind), profile='random' if kind == 'axes' else 'quick')
    onset = found.onset
    assert (
        onset.what == what
        and onset.share > 0.95
        and set(onset.axes) == set(axes) == set(onset.to_mapping()['axes'])
    )
    assert abs(onset.time - moment_of(recording, 0.55)) < 1.5 and onset.time_sd < 1.5
    changes = {name: onset.after[name] - value for name, value in onset.before.items()}
    if kind == 'axes':  # row x senses y; scale factors differ from one by less than a percent
        assert changes['accelerometer.matrix.xx'] == pytest.approx(-1.0, abs=0.03) and changes[
            'accelerometer.matrix.xy'
        ] == pytest.approx(1.0, abs=0.03)
    elif kind == 'mount':
        # To first order the change of a matrix is that of the frame.
        for sensor in (
            'accelerometer',
            'gyroscope',
        ):
            turn = 0.5 * np.array(
                [
                    changes[f'{sensor}.matrix.{b}{a}'] - changes[f'{sensor}.matrix.{a}{b}']
                    for a, b in ('yz', 'zx', 'xy')
                ]
            )
            np.testing.assert_allclose(np.abs(turn), [0.01, 0.006, 0.008], atol=5e-4)
    else:
        # Columns at zero: slip^2 / 2.
        assert changes == {'reference.encoder_zero.middle': pytest.approx(-0.03, abs=6e-4)}
    # The longer part, in which nothing is left to find.
    assert not found.named and len(found.used) < 0.7 * len(recording.windows)
    diagnosis = build_diagnosis(found)
    assert diagnosis.onset is onset and set(onset.to_mapping()['parameters']) == set(changes)
    assert any(f'{onset.time:.1f} +-' in line for line in diagnosis_lines(diagnosis))
    assert not any(rest.significant for rest in diagnosis.unexplained.values())


@pytest.mark.long
@pytest.mark.parametrize(
    'shock, what, axes',
    [
        (((0.03, 0.0, 0.0), (0.0, 2e-3, 0.0)), 'accelerometer and gyroscope', 'xy'),
        # A wander of all axes alike followed such a step, and nothing was found.
        (
            ((0.02, -0.03, 0.025), (1.4e-3, 0.9e-3, -1.7e-3)),
            'accelerometer and gyroscope',
            'xyz',
        ),
    ],
)
def test_a_step_of_the_biases_is_found_with_both_states(shock, what, axes):
    recording, found = investigated(Moment('shock', shock=shock))
    onset = found.onset
    assert onset.what == f'bias of {what}' and onset.share > 0.95 and set(onset.axes) == set(axes)
    truth = dict(zip(('accelerometer', 'gyroscope'), shock))
    for sensor, changed in onset.sensor_axes.items():
        assert sorted(changed) == ['xyz'[k] for k in range(3) if truth[sensor][k]], sensor
    assert abs(onset.time - moment_of(recording, 0.55)) < 1.5 and onset.time_sd < 1.5
    for name, before in onset.before.items():
        sensor, axis = name.split('.')[0], 'xyz'.index(name[-1])
        change = onset.after[name] - before
        assert abs(change - truth[sensor][axis]) < 4 * onset.sd[name], name
    assert not found.named
    printed = ' '.join(diagnosis_lines(build_diagnosis(found)))
    assert all(f'{name} ' in printed for name in onset.before)
    for sensor, changed in onset.sensor_axes.items():
        assert not changed or f'{sensor} {" and ".join(changed)}' in printed


def test_a_wandering_bias_is_no_onset():
    found = investigated(Wander(sd=(0.02, 1.2e-3)))[1]
    assert found.onset is None


@pytest.mark.parametrize('cause', [None, Moment('creep'), Clock(share=0.35, bend=4e-3)])
def test_no_change_and_a_gradual_change_are_no_onset(cause):
    found = investigated(cause, CLOCKS)[1]
    assert found.onset is None
    assert 'clock_step' not in {question.name for question in found.named}


def test_a_clock_of_another_rate_is_named():
    _, found = investigated(Clock(rate=200e-6), CLOCKS)
    assert [question.name for question in found.named] == ['clock_rate'] and found.onset is None
    (value,) = found.problem.values(found.named)[list(found.named[0].parameters)]
    # Stamps run at this rate by themselves.
    assert value == pytest.approx(200e-6 / (1 + 200e-6), abs=1e-7)


@pytest.mark.long
def test_a_step_of_the_clock_is_named_with_its_time():
    recording, found = investigated(Clock(step=8e-3), CLOCKS)
    assert [question.name for question in found.named] == ['clock_step'] and found.onset is None
    step, time = found.problem.values(found.named)[list(found.named[0].parameters)]
    assert step == pytest.approx(8e-3, abs=1e-4) and abs(time - moment_of(recording, 0.6)) < 1.5
    model = found.problem.recording.model
    # Least squares does not move it.
    assert model.prior()[0][model.slices['reference', 'clock_step']][1] == time
    assert model.find('reference', Role.DELAY) is not None
