"""Joints whose states are frozen or jump while the table moves on are named, with the time."""

import re
from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.core.samples import SampleBlock
from imu_calibration.preprocessing.joint_checks import _rate_findings, against_joints
from imu_calibration.preprocessing.on_table import ProductSums
from imu_calibration.references.turntable.collector import Collector, GatherStep

from worlds.live_sessions import TABLE, make_session

SECONDS = 4.0
RATE = 50.0


@pytest.fixture(scope='module')
def recording():
    """IMU, joints and model of a session in which joints move alone and together."""
    imu, joints, _, model = make_session(21, RATE)
    return imu, joints, model


def found(imu, joints, model):
    collector = Collector(GatherStep(TABLE, model))
    collector.push(SampleBlock(imu, joints))
    return against_joints(collector.finish(), model, TABLE)


def frozen(joints, joint, start, seconds=SECONDS):
    """Hold the state of a joint for some seconds; then it jumps to where the joint is."""
    held = slice(start, start + int(seconds * RATE))
    position, velocity = joints.position.copy(), joints.velocity.copy()
    position[held, joint], velocity[held, joint] = position[start, joint], 0.0
    return replace(joints, position=position, velocity=velocity)


def times(text):
    """Return the times in a message, s."""
    return [float(value) for value in re.findall(r'([\d.]+) s\b', text)]


@pytest.mark.parametrize(
    ('joint', 'seconds', 'named'),
    [(1, 58.7, 'middle'), (2, 76.2, 'inner'), (0, 33.0, 'outer'), (0, 53.0, 'outer or inner')],
    ids=('middle beside others', 'inner beside others', 'while all rest', 'parallel to another'),
)
def test_a_frozen_joint_is_named_with_the_time(recording, joint, seconds, named):
    """
    The joints before a frozen one turn about axes that its state no longer gives.

    At rest by the joints, the IMU turns.
    """
    imu, joints, model = recording
    start = round(seconds * RATE)
    (finding,) = found(imu, frozen(joints, joint, start), model)
    assert finding.check == 'frozen' and f', {named} is' in finding.text
    assert seconds - 3.0 < min(times(finding.text))
    assert max(times(finding.text)) < seconds + SECONDS + 3.0


def test_a_period_of_a_repeated_motion_is_no_better_cause():
    """Joints that turn to and fro in 10 s: later by that, most of a frozen time is explained."""
    imu, joints, _, model = make_session(11, RATE, profile='tumbling')
    (finding,) = found(imu, frozen(joints, 1, round(9.5 * RATE), seconds=9.0), model)
    assert finding.check == 'frozen' and 'middle' in finding.text


def test_a_zero_that_changes_is_a_jump(recording):
    imu, joints, model = recording
    position = joints.position.copy()
    moving = round(59.7 * RATE)
    position[moving:, 1] += 1.0
    (finding,) = found(imu, replace(joints, position=position), model)
    assert finding.check == 'joint_jump' and 'middle' in finding.text
    assert times(finding.text)[0] == pytest.approx(moving / RATE, abs=0.3)


def test_no_kept_samples_are_no_fault():
    """One window may be longer than all samples that are kept."""
    rates = np.eye(3)
    assert _rate_findings(ProductSums(rates, rates, rates), [], TABLE) == []


@pytest.mark.parametrize('joint', [1, 2])
def test_a_wrong_gear_ratio_is_no_frozen_joint(recording, joint):
    """Rests of other joints are explained by a motion of theirs too, the other times are not."""
    imu, joints, model = recording
    position, velocity = joints.position.copy(), joints.velocity.copy()
    position[:, joint] *= 0.7
    velocity[:, joint] *= 0.7
    changed = replace(joints, position=position, velocity=velocity)
    assert 'frozen' not in {finding.check for finding in found(imu, changed, model)}


@pytest.mark.parametrize('lag', [0.03, 0.3])
def test_a_late_stream_is_no_frozen_joint(recording, lag):
    imu, joints, model = recording
    late = replace(imu, stamp_ns=imu.stamp_ns + int(lag * 1e9))
    assert 'frozen' not in {finding.check for finding in found(late, joints, model)}
    # A frozen joint in a stream that is little late is still found.
    if lag == 0.03:
        (finding,) = found(late, frozen(joints, 1, round(58.7 * RATE)), model)
        assert finding.check == 'frozen' and 'middle' in finding.text
