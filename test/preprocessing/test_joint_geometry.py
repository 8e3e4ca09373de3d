"""Wrong zeros, axes and clocks of a table are named; a joint that is frozen is still frozen."""

import re
from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.rotations import rotation
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.frozen_joints import standing_still
from imu_calibration.preprocessing.joint_geometry import description_error, with_axis
from imu_calibration.preprocessing.window import Window

from worlds.tables import joints_about

PERIOD, SECONDS = 0.04, 240.0
TABLE = Table.from_mapping(
    {
        'joints': joints_about('zxy', ('a', 'b', 'c')),
        'gravity': 9.81,
    }
)


def motion_of_steps(seed):
    """Return joints that turn one or two at a time, with smooth random rates."""
    rng, time = np.random.default_rng(seed), np.arange(0, SECONDS, PERIOD)
    rate = np.zeros((len(time), 3))
    for start in range(0, int(SECONDS), 6):
        inside = (time >= start) & (time < start + 6)
        shape = np.sin(np.pi * (time[inside] - start) / 6) ** 2
        for joint in rng.choice(3, rng.integers(1, 3), replace=False):
            rate[inside, joint] = rng.uniform(-1.2, 1.2) * shape
    acceleration = np.gradient(rate, PERIOD, axis=0)
    return JointMotion(
        time, PERIOD * np.cumsum(rate, axis=0), rate, acceleration, np.zeros_like(rate)
    )


def window_of(true_table, motion, stated_motion, seed=3):
    """Return a window: readings of an IMU on the true table, and the joints as stated."""
    rng = np.random.default_rng([seed, 1])
    reference = reference_motion(true_table, motion)
    matrix = np.eye(3) + rng.normal(0, 0.01, (3, 3))
    rate = reference.rate_s @ matrix.T + 0.004 + rng.normal(0, 5e-4, (len(motion), 3))
    force = reference.force_s @ matrix.T + 0.1 + rng.normal(0, 0.01, (len(motion), 3))
    stamps = (1e9 * stated_motion.time).astype(np.int64)
    return Window('dynamic', stamps, stated_motion.time, force, rate, stated_motion)


@pytest.mark.parametrize('degrees', [-17.0, 32.0])
def test_a_zero_that_is_off_is_named_with_its_value(degrees):
    motion = motion_of_steps(11)
    position = motion.position + np.radians([0.0, degrees, 0.0])
    finding = standing_still([window_of(TABLE, motion, replace(motion, position=position))], TABLE)
    assert finding.check == 'on_table' and finding.key == 'table'
    shown = float(re.search(r'b reads (-?[\d.]+) deg', finding.text)[1])
    assert abs(shown - degrees) < 0.1  # the noise of 0.03 deg/s leaves less than 0.01 deg


@pytest.mark.parametrize('joint', [0, 1, 2])
def test_a_wrong_axis_is_named(joint):
    motion = motion_of_steps(12)
    stated = with_axis(TABLE, joint, np.roll(TABLE.joints[joint].axis, 1))
    finding = description_error([window_of(TABLE, motion, motion)], stated)
    axis = ', '.join(f'{value:.0f}' for value in TABLE.joints[joint].axis)
    assert finding.check == 'on_table'
    assert f'{TABLE.joint_names[joint]} is [{axis}]' in finding.text


def test_a_clock_that_is_off_by_many_seconds_is_named_with_its_value():
    motion = motion_of_steps(13)
    n_late = round(41.0 / PERIOD)
    measured = motion.select(slice(0, len(motion) - n_late))
    stated = motion.select(slice(n_late, None))
    finding = standing_still([window_of(TABLE, measured, stated)], TABLE)
    assert finding.check == 'on_table' and '41.0 s' in finding.text


def test_a_joint_that_is_frozen_for_a_time_is_no_error_of_the_description():
    motion = motion_of_steps(14)
    start = int(np.argmax(np.abs(motion.rate[:, 1]) > 0.1))
    part = slice(start, start + 100)
    position, rate = motion.position.copy(), motion.rate.copy()
    position[part, 1] = position[start, 1]
    rate[part, 1] = 0.0
    stated = replace(motion, position=position, rate=rate)
    assert description_error([window_of(TABLE, motion, stated)], TABLE) is None
    assert description_error([window_of(TABLE, motion, motion)], TABLE) is None


@pytest.mark.parametrize('degrees', [13.0, 35.0])
def test_an_axis_between_coordinate_axes_is_named(degrees):
    motion = motion_of_steps(16)
    oblique = rotation(np.radians(degrees) * np.array([0.0, 0.6, 0.8]))
    true_table = with_axis(TABLE, 1, oblique @ TABLE.joints[1].axis)
    finding = standing_still([window_of(true_table, motion, motion)], TABLE)
    assert finding.check == 'on_table' and finding.key == 'table'
    shown = np.array(
        [float(value) for value in re.search(r'b is \[(.*)\]', finding.text)[1].split(',')]
    )
    # Rates do not show the axis about which the IMU was mounted: 0.6 deg of the forces' errors.
    assert np.abs(shown - true_table.joints[1].axis).max() < 0.01


def test_two_errors_of_the_description_are_no_frozen_joint():
    motion = motion_of_steps(17)
    stated = replace(motion, position=motion.position + np.radians([0.0, 14.0, 0.0]))
    true_table = with_axis(TABLE, 2, (0.0, np.cos(0.3), np.sin(0.3)))
    finding = standing_still([window_of(true_table, motion, stated)], TABLE)
    assert finding.check == 'on_table' and finding.key == 'table'


@pytest.mark.parametrize('degrees', [6.0, -28.0])
def test_a_turned_imu_is_no_frozen_joint(degrees):
    """The zero of the last joint has the same effect as the mount of the IMU."""
    motion = motion_of_steps(15)
    position = motion.position + np.radians([0.0, 0.0, degrees])
    window = window_of(TABLE, motion, replace(motion, position=position))
    assert standing_still([window], TABLE) is None


def test_a_late_imu_does_not_hide_a_wrong_zero():
    motion = motion_of_steps(18)
    n_late = 1
    stated = motion.select(slice(n_late, None))
    position = stated.position + np.radians([0.0, 9.0, 0.0])
    window = window_of(TABLE, motion.select(slice(0, -n_late)), replace(stated, position=position))
    shown = re.search(r'b reads (-?[\d.]+) deg', description_error([window], TABLE).text)[1]
    assert abs(float(shown) - 9.0) < 0.2


def test_a_saturated_gyroscope_is_no_frozen_joint():
    """What a clipped axis lacks lies along the axis of a joint that rests, in a tilted attitude."""
    motion = motion_of_steps(19)
    motion = replace(motion, position=motion.position + [0.0, 0.7, 0.4])
    whole = window_of(TABLE, motion, motion)
    limit = 0.6
    windows = []
    for start in range(0, len(motion), 300):
        part = slice(start, start + 300)
        clipped = np.clip(whole.rate_s[part], -limit, limit)
        windows.append(
            replace(
                whole,
                stamp_ns=whole.stamp_ns[part],
                time=whole.time[part],
                force_s=whole.force_s[part],
                rate_s=clipped,
                motion=motion.select(part),
            )
        )
    assert standing_still(windows, TABLE) is None
