"""Is this IMU on this table? What does not tell the motion of the joints is refused, with the cause."""

from dataclasses import replace

import numpy as np
import pytest
from refusal import refused

from imu_calibration.calibration.live import LiveCalibration
from imu_calibration.errors import InputError
from imu_calibration.preflight.on_table import _a_period_late, same_motion, signs_or_delay
from imu_calibration.reference.joint_motion import JointMotion
from imu_calibration.reference.kinematics import reference_motion
from imu_calibration.reference.table import Table
from imu_calibration.segmentation.window import Window, WindowKind
from imu_calibration.use_cases.calibrate import calibrate
from imu_calibration.use_cases.diagnose import diagnose

from worlds.misfit_worlds import make_pair


@pytest.fixture(scope='module')
def gimbals():
    pair = make_pair(None, 1)
    return pair.first.block, Table.from_mapping(pair.table)


@pytest.fixture(scope='module')
def shaft():
    pair = make_pair(None, 1, table='shaft', profile='sweeps')
    return pair.first.block, Table.from_mapping(pair.table)


def later(block, seconds):
    return replace(block, imu=replace(block.imu, stamp_ns=block.imu.stamp_ns + int(seconds * 1e9)))


def still(block):
    rng = np.random.default_rng(0)
    force = np.array([0.0, 0.0, 9.81]) + rng.normal(0.0, 0.01, block.imu.force_s.shape)
    return replace(block, imu=replace(block.imu, force_s=force, rate_s=rng.normal(0.0, 1e-3, force.shape)))


def joints(block, names=None, sign=1.0):
    known = block.joints
    return replace(block, joints=replace(known, position=sign * known.position, velocity=sign * known.velocity, names=names or known.names))


@pytest.mark.parametrize(('change', 'words'), [
    (still, ('this IMU does not turn when the table does', 'right topic')),
    (lambda block: joints(block, ('middle', 'outer', 'inner')), ('outer turns as middle should', 'middle turns as outer should')),
    (lambda block: joints(block, sign=-1.0), ('outer turns the other way round', 'inner turns the other way round')),
    (lambda block: later(block, 2.0), ('about 2.0 s behind those of the joints', 'set both clocks by one source')),
    (lambda block: later(block, 9.0), ('turns otherwise than the table', 'do both clocks agree')),
], ids=('another IMU', 'exchanged joints', 'wrong signs', 'apart in time', 'farther apart than is looked for'))
def test_an_imu_that_does_not_move_as_the_joints_say_is_refused_with_the_cause(gimbals, change, words):
    block, table = gimbals
    with pytest.raises(InputError) as caught:
        calibrate(change(block), table)
    assert all(word in str(caught.value) for word in words) and '\n' not in str(caught.value)
    assert ('--imu-topic' in caught.value.told({'imu_topic': '--imu-topic'})) == ('right topic' in str(caught.value))


@pytest.mark.parametrize(('seconds', 'delay', 'side'), [(0.5, '0.5 s', 'behind'), (-0.5, '0.5 s', 'ahead'), (2.0, '2.0 s', 'behind')])
def test_streams_that_are_apart_in_time_are_told_from_a_wrong_imu(shaft, seconds, delay, side):
    with refused(InputError, 'on_table', delay, side):
        calibrate(later(shaft[0], seconds), shaft[1])


def test_one_joint_the_other_way_round_is_told_from_a_wrong_imu(shaft):
    with refused(InputError, 'handedness', 'x'):
        calibrate(joints(shaft[0], sign=-1.0), shaft[1])


@pytest.mark.parametrize('swing', [0.0, 0.6])
@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_half_a_period_of_delay_is_told_from_a_wrong_sign_as_far_as_sweeps_differ(shaft, sign, swing):
    """Sweeps of 2 s to and fro: one second of delay and a wrong sign are one thing when all are alike, and told apart when every other one is larger."""
    table, time = shaft[1], np.arange(6000) * 0.01
    position = np.stack([(1.0 + swing * np.sin(0.77 * t)) * np.sin(np.pi * t) for t in (time, time - 1.0)])
    rates = [np.gradient(each, 0.01) for each in position]
    zero = np.zeros((len(time), 1))
    motion = JointMotion(time, position[0][:, None], rates[0][:, None], zero, zero)
    felt = reference_motion(table, replace(motion, rate=sign * rates[1 if sign > 0 else 0][:, None])).rate_s
    window = Window(WindowKind.DYNAMIC, (1e9 * time).astype(np.int64), time, np.zeros_like(felt), felt, motion)
    assert _a_period_late([window], table) is None, 'opposite rates are not a clock that is late by a whole period'
    found = signs_or_delay([window], table)
    if swing and sign < 0:
        assert found is None
    else:
        assert found.sure == (swing > 0) and 'about 1.0 s' in found.words


def frozen(block, *, joint, start, stop):
    position, velocity = block.joints.position.copy(), block.joints.velocity.copy()
    position[start:stop, joint], velocity[start:stop, joint] = position[start, joint], 0.0
    return replace(block, joints=replace(block.joints, position=position, velocity=velocity))


@pytest.mark.parametrize('joint', [0, 1, 2])
def test_one_joint_that_stands_still_is_named_with_the_time(gimbals, joint):
    block, table = gimbals
    count = len(block.joints.position)
    with refused(InputError, 'frozen', table.joint_names[joint], ' s to '):
        calibrate(frozen(block, joint=joint, start=count // 3, stop=3 * count // 4), table)


def test_a_gyroscope_that_repeats_one_reading_on_a_shaft_without_rests_is_named(shaft):
    """Nothing rests, so nothing else tells a frozen reading from a quiet one."""
    rate = shaft[0].imu.rate_s.copy()
    moving = np.flatnonzero(np.abs(rate[:, 0]) > 1.0)
    start = moving[len(moving) // 2]
    rate[start:start + 1000] = rate[start]
    with refused(InputError, 'frozen', 'gyroscope', ' s to '):
        calibrate(replace(shaft[0], imu=replace(shaft[0].imu, rate_s=rate)), shaft[1])


def test_a_wrong_gain_is_no_frozen_joint(gimbals):
    assert calibrate(replace(gimbals[0], imu=replace(gimbals[0].imu, rate_s=1.1 * gimbals[0].imu.rate_s)), gimbals[1]).calibration


def test_diagnose_refuses_the_same(gimbals):
    with refused(InputError, 'on_table', '0 %'):
        diagnose(still(gimbals[0]), gimbals[1])


@pytest.mark.parametrize(('gain', 'noise', 'fails'), [(1.0, 0.1, False), (0.7, 0.1, False), (1e-5, 1e-3, True), (1e-5, 1.0, True), (1.0, 2.0, True)])
def test_gain_and_coherence_decide(gain, noise, fails):
    rng = np.random.default_rng(1)
    told = rng.normal(size=(5000, 3))
    felt = gain * told + noise * rng.normal(size=(5000, 3))
    found = same_motion((felt.T @ told, told.T @ told, felt.T @ felt), [], None)
    assert (found is not None) == fails


@pytest.mark.real_data
def test_the_imu_on_the_bench_is_refused(recordings):
    folder = recordings / 'shaft_yaw_medium'
    with refused(InputError, 'on_table', '0 %'):
        calibrate(folder, folder / 'table.yaml', imu_topic='/imu_fixed/data_raw')


def test_a_live_session_tells_the_same_causes(gimbals):
    block, table = gimbals
    session = LiveCalibration(table)
    session.push(joints(block, ('middle', 'outer', 'inner')))
    with refused(InputError, 'on_table', 'outer', 'middle'):
        session.solve(pending=True)
