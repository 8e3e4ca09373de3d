"""
Is this IMU on this table? What does not tell the motion of the joints is refused, with the cause.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
from refusal import refused

from imu_calibration.api.calibrate import calibrate_recordings
from imu_calibration.api.diagnose import diagnose
from imu_calibration.core.errors import InputError
from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.frozen_joints import standing_still
from imu_calibration.preprocessing.joint_checks import _rate_findings
from imu_calibration.preprocessing.on_table import (
    ProductSums,
    _candidates,
    a_period_late,
    same_motion,
    signs_or_delay,
)
from imu_calibration.preprocessing.window import Window, WindowKind
from imu_calibration.references.turntable.live_windows import LiveCalibration

from worlds.misfit_worlds import make_pair


@pytest.fixture(scope='module')
def gimbals():
    pair = make_pair(None, 1, imu_rate=50.0, joint_rate=50.0)
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
    return replace(
        block, imu=replace(block.imu, force_s=force, rate_s=rng.normal(0.0, 1e-3, force.shape))
    )


def joints(block, names=None, sign=1.0):
    known = block.joints
    return replace(
        block,
        joints=replace(
            known,
            position=sign * known.position,
            velocity=sign * known.velocity,
            names=names or known.names,
        ),
    )


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        (still, ()),
        (lambda block: joints(block, ('middle', 'outer', 'inner')), ('outer', 'middle')),
        (lambda block: joints(block, sign=-1.0), ('outer', 'inner')),
        (lambda block: later(block, 9.0), ('9.0 s',)),
    ],
    ids=(
        'another IMU',
        'exchanged joints',
        'wrong signs',
        'apart by many seconds',
    ),
)
def test_an_imu_that_does_not_move_as_the_joints_say_is_refused_with_the_cause(
    gimbals, change, words
):
    block, table = gimbals
    with refused(InputError, 'on_table') as caught:
        calibrate_recordings(change(block), table)
    assert all(word in str(caught.value) for word in words) and '\n' not in str(caught.value)
    # No joint and no delay explains it.
    assert ('--imu-topic' in caught.value.with_hint({'imu_topic': '--imu-topic'})) == (not words)


@pytest.mark.parametrize(
    ('seconds', 'delay', 'side'),
    [(0.5, '0.5 s', 'behind'), (-0.5, '0.5 s', 'ahead'), (2.0, '2.0 s', 'behind')],
)
def test_streams_that_are_apart_in_time_are_told_from_a_wrong_imu(shaft, seconds, delay, side):
    with refused(InputError, 'on_table', delay, side):
        calibrate_recordings(later(shaft[0], seconds), shaft[1])


def test_the_delay_between_the_streams_of_three_joints_is_named(gimbals):
    table, time = gimbals[1], np.arange(1000) * 0.04
    zero = np.zeros((len(time), 3))

    def turning(time):
        phase = np.outer(time, [0.62, 0.86, 1.14])
        position = np.sin(phase) + np.sin(0.37 * phase)
        return JointMotion(time, position, np.gradient(position, 0.04, axis=0), zero, zero)

    told = turning(time)
    rate = reference_motion(table, told).rate_s
    for delay, words in ((2.0, ' 2.0 s behind '), (-2.0, ' 2.0 s ahead ')):
        felt = reference_motion(table, turning(time - delay))
        window = Window(
            WindowKind.DYNAMIC, (1e9 * time).astype(np.int64), time, felt.force_s, felt.rate_s, told
        )
        sums = ProductSums(felt.rate_s.T @ rate, rate.T @ rate, felt.rate_s.T @ felt.rate_s)
        assert words in same_motion(sums, [window], table).text


def test_one_joint_the_other_way_round_is_told_from_a_wrong_imu(shaft):
    with refused(InputError, 'on_table', 'shaft turns the other way round', 'measured x is minus'):
        calibrate_recordings(joints(shaft[0], sign=-1.0), shaft[1])


def sweeps(table, measured_rate, joint_rate):
    """Return a window of 60 s on a shaft from the rates of both streams, functions of the time."""
    time = np.arange(6000) * 0.01
    zero = np.zeros((len(time), 1))
    motion = JointMotion(
        time, np.cumsum(joint_rate(time))[:, None] * 0.01, joint_rate(time)[:, None], zero, zero
    )
    measured = reference_motion(table, replace(motion, rate=measured_rate(time)[:, None])).rate_s
    return Window(
        WindowKind.DYNAMIC,
        (1e9 * time).astype(np.int64),
        time,
        np.zeros_like(measured),
        measured,
        motion,
    )


PERIOD = 1.105


def ripple(time):
    """Sweeps with the ripple of a stepper motor, one period after the other."""
    phase = 2.0 * np.pi * time / PERIOD
    return np.sin(phase) + 0.45 * np.sin(28.0 * phase)


def alternating(sign):
    """
    Sweeps of which every other one differs, by `sign`, in addition to a ripple that one stream has.
    """

    def rate(time):
        phase = 2.0 * np.pi * time / PERIOD
        return (
            np.sin(phase)
            + 0.2 * sign * np.sin(1.5 * phase)
            + (0.3 * np.sin(19.3 * phase) if sign > 0 else 0.0)
        )

    return rate


@pytest.mark.parametrize(
    ('measured', 'joint'),
    [(lambda time: ripple(time - 0.005), ripple), (alternating(1.0), alternating(-1.0))],
    ids=('a lag of half a sampling period', 'both neighbours equally good'),
)
def test_a_period_of_fast_sweeps_is_not_reported_as_a_delay(shaft, measured, joint):
    """
    Periods of 1.105 s at 100 Hz.

    Without the delays between samples, or with those of one sign only, the stamps seem 1.1 s ahead.
    """
    table = shaft[1]
    assert a_period_late([sweeps(table, measured, joint)], table) is None


@pytest.mark.parametrize('delay', [-1.1, -0.14, 0.14, 1.1])
def test_a_real_delay_of_fast_sweeps_is_reported(shaft, delay):
    """Their size varies slowly, so that one period of delay is no repetition."""
    table = shaft[1]

    def rate(time):
        return (1.0 + 0.5 * np.sin(0.77 * time)) * ripple(time)

    found = a_period_late([sweeps(table, lambda time: rate(time - delay), rate)], table)
    assert (
        found is not None
        and f' {abs(delay):.1f} s ' in found.text
        and ('behind' if delay > 0 else 'ahead') in found.text
    )


@pytest.mark.parametrize('swing', [0.0, 0.6])
@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_half_a_period_of_delay_is_told_from_a_wrong_sign_as_far_as_sweeps_differ(
    shaft, sign, swing
):
    """
    Sweeps of 2 s to and fro.

    One second of delay and a wrong sign are one thing when all are alike, and told apart when every
    other one is larger.
    """
    table, time = shaft[1], np.arange(6000) * 0.01
    position = np.stack(
        [(1.0 + swing * np.sin(0.77 * t)) * np.sin(np.pi * t) for t in (time, time - 1.0)]
    )
    rates = [np.gradient(each, 0.01) for each in position]
    zero = np.zeros((len(time), 1))
    motion = JointMotion(time, position[0][:, None], rates[0][:, None], zero, zero)
    felt = reference_motion(
        table, replace(motion, rate=sign * rates[1 if sign > 0 else 0][:, None])
    ).rate_s
    window = Window(
        WindowKind.DYNAMIC, (1e9 * time).astype(np.int64), time, np.zeros_like(felt), felt, motion
    )
    assert a_period_late([window], table) is None, (
        'opposite rates are not a clock that is late by a whole period'
    )
    found = signs_or_delay([window], table)
    if swing and sign < 0:
        assert found is None
    else:
        assert found.sure == (swing > 0) and ' 1.0 s' in found.words


@pytest.mark.parametrize(
    ('signs', 'corrected'),
    [
        ((-1, 1, 1), ['outer']),
        ((1, -1, 1), ['middle']),
        ((1, 1, -1), ['inner']),
        ((-1, 1, -1), ['outer', 'inner']),
    ],
)
def test_the_joints_with_a_reversed_sign_are_named_and_no_mount_or_standstill_is(
    gimbals, signs, corrected
):
    """
    Signs of outer and inner together are a sensor turned about y for the gyroscope.

    Gravity separates them.
    """
    with refused(InputError, 'on_table') as caught:
        calibrate_recordings(joints(gimbals[0], sign=np.array(signs)), gimbals[1])
    assert [
        name for name in gimbals[1].joint_names if re.search(rf'\b{name}\b', str(caught.value))
    ] == corrected


def test_a_reversed_joint_is_no_standstill_of_a_parallel_one(gimbals):
    """
    With middle at 80 degrees, inner is nearly parallel to outer, and it rests.

    Its standstill would explain the rates too.
    """
    table, time = gimbals[1], np.arange(6000) * 0.01
    motion = JointMotion(
        time, np.zeros((6000, 3)), np.zeros((6000, 3)), np.zeros((6000, 3)), np.zeros((6000, 3))
    )
    motion.position[:, 0], motion.rate[:, 0] = np.sin(time), np.cos(time)
    motion.position[:, 1] = np.radians(-80.0)
    reference = reference_motion(table, motion)
    reversed_outer = replace(
        motion, position=motion.position * [-1, 1, 1], rate=motion.rate * [-1, 1, 1]
    )
    window = Window(
        WindowKind.DYNAMIC,
        (1e9 * time).astype(np.int64),
        time,
        reference.force_s,
        reference.rate_s,
        reversed_outer,
    )
    assert standing_still([window], table).check == 'frozen', 'a standstill of inner explains it'
    told = reference_motion(table, reversed_outer).rate_s
    (finding,) = _rate_findings(
        ProductSums(
            reference.rate_s.T @ told, told.T @ told, reference.rate_s.T @ reference.rate_s
        ),
        [window],
        table,
    )
    assert finding.check == 'on_table' and 'outer' in finding.text and 'middle' not in finding.text


@pytest.mark.parametrize('lag', [0.05, -0.05])
def test_a_late_clock_is_no_standstill(gimbals, lag):
    """
    While outer and inner turn, a lag turns the rate of outer about the axis of middle, which rests.

    A middle that turns unseen is a standstill.
    """
    table, time = gimbals[1], np.arange(1000) * 0.01

    def motion(time, outer, middle=0.0):
        rate = np.stack(
            [outer * np.sin(time), middle * np.cos(2 * time), np.full(1000, 3.0)], axis=1
        )
        position = np.stack(
            [-outer * np.cos(time), middle * np.sin(2 * time) / 2, 3.0 * time], axis=1
        )
        return JointMotion(time, position, rate, np.zeros((1000, 3)), np.zeros((1000, 3)))

    def checked(outer, middle):
        felt = reference_motion(table, motion(time - lag, outer, middle))
        return standing_still(
            [
                Window(
                    WindowKind.DYNAMIC,
                    (1e9 * time).astype(np.int64),
                    time,
                    felt.force_s,
                    felt.rate_s,
                    motion(time, outer),
                )
            ],
            table,
        )

    assert checked(1.5, 0.0) is None
    assert checked(0.0, 0.5).check == 'frozen'


@pytest.mark.parametrize(
    ('order', 'signs', 'words'),
    [
        ([1, 0, 2], [1, 1, -1], "measured x is the reference's y"),
        ([0, 1, 2], [-1, -1, 1], "measured y is minus the reference's y"),
    ],
)
def test_imu_axes_exchanged_in_a_part_of_the_recording_are_reported_with_the_time(
    gimbals, order, signs, words
):
    block, table = gimbals
    force, rate = block.imu.force_s.copy(), block.imu.rate_s.copy()
    part = slice(2 * len(rate) // 5, 4 * len(rate) // 5)
    force[part], rate[part] = force[part][:, order] * signs, rate[part][:, order] * signs
    with refused(InputError, 'on_table', words, ' s to ', 'the driver of the IMU') as caught:
        calibrate_recordings(
            replace(block, imu=replace(block.imu, force_s=force, rate_s=rate)), table
        )
    duration = (block.imu.stamp_ns[-1] - block.imu.stamp_ns[0]) * 1e-9
    start, stop = (
        float(each) for each in re.search(r'from (\d+) s to (\d+) s', str(caught.value)).groups()
    )
    assert abs(start - 0.4 * duration) < 15.0 and abs(stop - 0.8 * duration) < 15.0


def test_each_sign_and_each_exchange_of_two_joints_is_tested_on_an_arm():
    candidates = _candidates(6)
    assert len(candidates) == 1 + 6 + 15 and ([0, 4, 2, 3, 1, 5], [1.0] * 6) in candidates
    assert len(_candidates(3)) == 48


def frozen(block, *, joint, start, stop):
    position, velocity = block.joints.position.copy(), block.joints.velocity.copy()
    position[start:stop, joint], velocity[start:stop, joint] = position[start, joint], 0.0
    return replace(block, joints=replace(block.joints, position=position, velocity=velocity))


def test_one_joint_that_stands_still_is_named_with_the_time(gimbals):
    block, table = gimbals
    count, joint = len(block.joints.position), 2
    with refused(InputError, 'frozen', table.joint_names[joint], ' s to '):
        calibrate_recordings(
            frozen(block, joint=joint, start=count // 3, stop=3 * count // 4), table
        )


def test_a_gyroscope_that_repeats_one_reading_on_a_shaft_is_left_out(shaft):
    rate = shaft[0].imu.rate_s.copy()
    moving = np.flatnonzero(np.abs(rate[:, 0]) > 1.0)
    start = moving[len(moving) // 2]
    rate[start : start + 1000] = rate[start]
    found = calibrate_recordings(
        replace(shaft[0], imu=replace(shaft[0].imu, rate_s=rate)), shaft[1], model_as_asked=True
    )
    (frozen,) = [each for each in found.result.gathered.findings if each.samples]
    assert frozen.check == 'frozen' and frozen.samples == pytest.approx(1000, abs=50)
    assert found.exit_code == 3 and found.calibration.decisions['gyroscope'] == 'helps'
    whole = calibrate_recordings(*shaft, model_as_asked=True).calibration
    away = found.calibration.values - whole.values
    assert (np.abs(away) <= 2 * found.calibration.sd).all()


def test_a_wrong_gain_is_no_frozen_joint(gimbals):
    assert calibrate_recordings(
        replace(gimbals[0], imu=replace(gimbals[0].imu, rate_s=1.1 * gimbals[0].imu.rate_s)),
        gimbals[1],
        model_as_asked=True,
    ).calibration


def test_diagnose_refuses_the_same(shaft):
    with refused(InputError, 'on_table', '0 %'):
        diagnose(still(shaft[0]), shaft[1])


@pytest.mark.parametrize(
    ('gain', 'noise', 'fails'),
    [(1.0, 0.1, False), (0.7, 0.1, False), (1e-5, 1e-3, True), (1e-5, 1.0, True), (1.0, 2.0, True)],
)
def test_gain_and_coherence_decide(gain, noise, fails):
    rng = np.random.default_rng(1)
    told = rng.normal(size=(5000, 3))
    felt = gain * told + noise * rng.normal(size=(5000, 3))
    found = same_motion(ProductSums(felt.T @ told, told.T @ told, felt.T @ felt), [], None)
    assert (found is not None) == fails


@pytest.mark.real_data
def test_the_imu_on_the_bench_is_refused(recordings):
    folder = recordings / 'shaft_yaw_medium'
    with refused(InputError, 'on_table', '0 %'):
        calibrate_recordings(folder, folder / 'table.yaml', imu_topic='/imu_fixed/data_raw')


def test_a_live_session_tells_the_same_causes(gimbals):
    block, table = gimbals
    session = LiveCalibration(table)
    session.push(joints(block, ('middle', 'outer', 'inner')))
    with refused(InputError, 'on_table', 'outer', 'middle'):
        session.solve(pending=True)


def test_a_coarse_gyroscope_may_repeat_the_reading_of_a_constant_rate_and_no_other(gimbals):
    """
    With steps of 0.02 rad/s a constant rate is one reading.

    The same reading while the rate changes, or at another rate, is a standstill.
    """
    table, time = gimbals[1], np.arange(4000) * 0.01
    rate = np.zeros((4000, 3))
    rate[:, 0] = np.where(time < 20, 1.0, np.sin(time))
    motion = JointMotion(
        time, np.cumsum(rate, axis=0) * 0.01, rate, np.zeros((4000, 3)), np.zeros((4000, 3))
    )
    reference = reference_motion(table, motion)

    def checked(changed):
        readings = 0.02 * np.round(changed / 0.02)
        return standing_still(
            [
                Window(
                    WindowKind.DYNAMIC,
                    (1e9 * time).astype(np.int64),
                    time,
                    reference.force_s,
                    readings,
                    motion,
                )
            ],
            table,
        )

    assert checked(1.02 * reference.rate_s) is None
    moving, constant = reference.rate_s.copy(), reference.rate_s.copy()
    moving[2000:2110] = moving[2000]
    constant[500:1500] = 0.0
    assert checked(moving).check == checked(constant).check == 'frozen'
