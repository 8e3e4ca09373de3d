"""A turn of the IMU against its stated mount is named; axes of a sensor that are off are not."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

from imu_calibration.effects.base import SENSORS
from imu_calibration.kinematics.joint import Joint
from imu_calibration.kinematics.rotations import nearest_rotation, rotation, rotation_vector
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.recording_evidence import NOTE, WARNING
from imu_calibration.references.turntable.mount_check import common_turn_deg, mount_findings


def table(mount_rpy_deg=(0.0, 0.0, 0.0)):
    joints = [Joint('p', (0, 0, 1)), Joint('q', (1, 0, 0)), Joint('r', (0, 1, 0))]
    return Table(joints, gravity=9.8, mount_rpy_deg=mount_rpy_deg)


def solution(accelerometer, gyroscope, sd=1e-5):
    """Two estimated matrices."""
    parts = {'accelerometer': slice(0, 9), 'gyroscope': slice(9, 18)}
    assert set(parts) == set(SENSORS)
    return SimpleNamespace(
        model=SimpleNamespace(part=lambda sensor, _role: parts[sensor]),
        values=np.concatenate([accelerometer.ravel(), gyroscope.ravel()]),
        held=np.zeros(18, bool),
        covariance=sd**2 * np.eye(18),
    )


def off_axes(seed):
    """Return scale factors and axes of one sensor that are off by half a percent."""
    return np.eye(3) + np.random.default_rng(seed).normal(0.0, 0.005, (3, 3))


def of_turn(vector_deg):
    turn = rotation(np.radians(vector_deg))
    return solution(off_axes(1) @ turn, off_axes(2) @ turn)


@pytest.mark.parametrize('degrees', [-3.0, 12.0, 24.0])
def test_a_zero_of_the_last_joint_is_named_with_the_mount_that_fits(degrees):
    # Readings in a sensor frame that is turned by v: the mount turns by -v, its inverse.
    (finding,) = mount_findings(of_turn((0.0, degrees, 0.0)), table())
    roll, pitch, yaw = (float(x) for x in re.search(r'\[(.*)\]', finding.text)[1].split(','))
    assert abs(pitch + degrees) < 0.6 and max(abs(roll), abs(yaw)) < 0.6
    assert 'zero of r' in finding.text and finding.key == 'table'
    assert finding.severity == WARNING


def test_a_turn_about_another_axis_is_no_zero():
    stated = (0.0, 0.0, 15.0)
    (finding,) = mount_findings(of_turn((0.0, 0.0, 15.0)), table(stated))
    shown = [float(x) for x in re.search(r'\[(.*)\]', finding.text)[1].split(',')]
    assert np.abs(shown).max() < 0.6 and 'zero of' not in finding.text


def test_a_small_turn_is_a_note_with_its_size():
    """Axes that are off by 0.05 deg do not hide a turn by 0.5 deg."""
    rng = np.random.default_rng(8104)
    turn = rotation(np.radians([0.0, -0.5, 0.0]))
    triads = [(np.eye(3) + rng.normal(0.0, 1e-3, (3, 3))) @ turn for _ in SENSORS]
    (finding,) = mount_findings(solution(*triads), table())
    assert finding.severity == NOTE and finding.check == 'mount'
    assert float(re.search(r'([\d.]+) deg', finding.text)[1]) == pytest.approx(0.5, abs=0.1)
    assert common_turn_deg(solution(*triads)) == pytest.approx([0, -0.5, 0], abs=0.1)


def test_usual_units_are_seldom_turned():
    """Axes that are off by 0.2 to 1 deg at random: few notes, and hardly a warning."""
    rng = np.random.default_rng(8105)
    found = []
    for _ in range(300):
        size = np.radians(rng.uniform(0.2, 1.0))
        triads = [np.eye(3) + rng.normal(0.0, size, (3, 3)) for _ in SENSORS]
        found += [finding.severity for finding in mount_findings(solution(*triads), table())]
    # two tests at 2.5 %, which are not independent
    assert found.count(NOTE) <= 24 and found.count(WARNING) <= 3


def test_a_zero_of_half_a_degree_is_noted_among_usual_axes():
    """Axes that are off by 0.2 deg: the angles between the axes show how far they usually are."""
    rng = np.random.default_rng(9111)
    turn = rotation(np.radians([0.0, 0.5, 0.0]))
    severities = []
    for _ in range(100):
        triads = [(np.eye(3) + rng.normal(0.0, np.radians(0.2), (3, 3))) @ turn for _ in SENSORS]
        found = mount_findings(solution(*triads), table())
        severities += [finding.severity for finding in found]
    assert severities.count(NOTE) >= 88 and WARNING not in severities


def test_a_turn_within_the_noise_of_the_matrices_is_no_note():
    turn = rotation(np.radians([0.0, 0.5, 0.0]))
    assert len(mount_findings(solution(turn, turn), table())) == 1
    assert mount_findings(solution(turn, turn, sd=np.radians(0.5)), table()) == ()


def test_axes_of_the_sensors_that_are_off_are_no_turn():
    triads = [off_axes(3), off_axes(4)]
    common = nearest_rotation(np.sum([nearest_rotation(triad) for triad in triads], axis=0))
    assert mount_findings(solution(*[triad @ common.T for triad in triads]), table()) == ()
    turned, opposite = rotation(np.array([0.05, 0, 0])), rotation(np.array([-0.03, 0, 0]))
    assert mount_findings(solution(turned, opposite), table()) == ()
    # The mean of these two turns is 2.6 deg.
    turned, opposite = rotation(np.array([0.1, 0, 0])), rotation(np.array([-0.01, 0, 0]))
    assert mount_findings(solution(turned, opposite), table()) == ()


def test_the_vector_of_a_rotation():
    for vector in ([0.0, 0.0, 0.0], [1e-9, 0.0, 0.0], [0.4, -1.2, 2.0]):
        assert np.allclose(rotation_vector(rotation(np.array(vector))), vector, atol=1e-15)
