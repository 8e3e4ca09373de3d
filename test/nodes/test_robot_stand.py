"""
Nodes on an arm.

Its description from a file or from robot_description, its link from the messages, its up from a
file or /tf_static.
"""

import threading

import numpy as np
import pytest
import yaml
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from refusal import refused
from sensor_msgs.msg import Imu
from std_msgs.msg import String

from imu_calibration.core.errors import ImuCalibrationError
from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.document import files
from imu_calibration.kinematics.urdf import StaticTransforms, table_from_urdf
from imu_calibration.nodes import planner_node, robot_stand
from imu_calibration.nodes.calibration_node import CalibrationNode
from imu_calibration.nodes.inputs import latched_qos
from imu_calibration.nodes.planner_node import PlannerNode
from imu_calibration.nodes.robot_stand import RobotSettings, chain_of
from imu_calibration.planning.planning_problem import noise_of_grade
from imu_calibration.simulation.sensor_noise import GRADES

from ros.one_process import OneProcess
from worlds.arms import SIX_AXES

pytestmark = pytest.mark.live
LINK = 'imu_link'


@pytest.fixture(scope='module')
def bench():
    """Nodes in this process."""
    with pytest.MonkeyPatch.context() as patch, OneProcess(patch) as made:
        yield made


@pytest.fixture(scope='module')
def site(tmp_path_factory):
    """Where the arm stands."""
    path = tmp_path_factory.mktemp('site') / 'site.yaml'
    path.write_text(yaml.safe_dump({'gravity': 9.81, 'up': [0.0, 1.0, 0.0]}))
    return str(path)


def same(table, other):
    """Assert that two chains are one."""
    assert table.joint_names == other.joint_names and table.up == pytest.approx(other.up)
    assert [(joint.name, joint.xyz, joint.limits) for joint in table.joints] == [
        (joint.name, joint.xyz, joint.limits) for joint in other.joints
    ]
    assert table.mount_xyz == other.mount_xyz and table.gravity_value == other.gravity_value


class Talking:
    """Publishes messages of an IMU in a thread while a node is being made."""

    def __init__(self, bench):
        self._publisher = bench.node.create_publisher(Imu, 'imu/data_raw', qos_profile_sensor_data)
        self._end, self._thread = (
            threading.Event(),
            threading.Thread(target=self._talk, daemon=True),
        )

    def _talk(self):
        message = Imu()
        message.header.frame_id = LINK
        while not self._end.wait(0.02):
            self._publisher.publish(message)

    def __enter__(self):
        self._thread.start()

    def __exit__(self, *_):
        self._end.set()
        self._thread.join()


def test_the_description_and_the_link_come_from_topics(bench, site):
    publisher = bench.node.create_publisher(String, 'robot_description', latched_qos())
    hostile = (
        '<robot name="x"><joint name="j" type="fixed">'
        + '<origin>' * 5000
        + '</origin>' * 5000
        + '</joint></robot>'
    )
    publisher.publish(String(data=hostile))
    threading.Timer(1.5, lambda: publisher.publish(String(data=SIX_AXES))).start()
    with Talking(bench):
        calibrates, moves = (
            bench.start(node, {'urdf_file': 'topic', 'table_file': site})
            for node in (CalibrationNode, PlannerNode)
        )
    expected = table_from_urdf(SIX_AXES, LINK, files.read_mapping(site, 'site'))
    same(calibrates.worker.live.table, expected)
    same(moves._table, expected)
    assert bench.heard(level='warning') == 1  # the hostile one
    assert bench.heard('robot_description', 'pan, lift, elbow', level='info') == 1


def test_an_arm_from_a_file_stands_as_static_transforms_say_and_the_noise_is_that_of_a_file(
    bench, tmp_path, monkeypatch
):
    (tmp_path / 'arm.urdf').write_text(SIX_AXES)
    transforms = StaticTransforms()
    transforms.add('map', 'base_link', xyz=(0, 0, 1), quaternion=(np.sin(0.3), 0, 0, np.cos(0.3)))
    asked = []

    class Frames:
        """Knows the transforms from the second question on."""

        def __init__(self, node, changed):
            pass

        def pose(self, target, source):
            asked.append((target, source))
            return transforms.pose(target, source) if len(asked) > 1 else None

    monkeypatch.setattr(robot_stand, 'StaticFrames', Frames)
    robot = RobotSettings(str(tmp_path / 'arm.urdf'), 'tool', 'map')
    table = chain_of(bench.node, robot, 'none')
    assert (
        table.up == pytest.approx((0.0, np.sin(0.6), np.cos(0.6)))
        and asked == [('base_link', 'map')] * 2
    )
    noise = noise_of_grade(GRADES['tactical'].noise, 100.0)
    monkeypatch.setattr(planner_node.files, 'read_noise', lambda path: (path, 'figures'))
    monkeypatch.setattr(
        planner_node,
        'expected_noise',
        lambda figures, grade, rate: (
            noise if figures == (tmp_path / 'noise.yaml', 'figures') else None
        ),
    )
    node = bench.start(
        PlannerNode,
        {
            'urdf_file': str(tmp_path / 'arm.urdf'),
            'imu_link': 'tool',
            'table_file': 'none',
            'noise_file': str(tmp_path / 'noise.yaml'),
        },
    )
    found = node._make_campaign().planner.problem.noise  # with the joints' own
    assert all(found[sensor].white_variance is noise[sensor].white_variance for sensor in noise)


@pytest.mark.parametrize(
    'given, gravity, sd',
    [({}, STANDARD_GRAVITY, 0.02), ({'gravity': 9.79}, 9.79, 0.0), ({'latitude': 0.0}, 9.78, 1e-3)],
)
def test_the_stated_gravity_holds_for_an_arm_whose_site_states_none(
    bench, tmp_path, given, gravity, sd
):
    (tmp_path / 'arm.urdf').write_text(SIX_AXES)
    robot = {'urdf_file': str(tmp_path / 'arm.urdf'), 'imu_link': 'tool'}
    node = bench.start(CalibrationNode, {**robot, 'table_file': 'none', **given})
    table = node.worker.live.table
    assert table.gravity_value == pytest.approx(gravity, abs=5e-4)  # 9.78033 on the equator
    assert table.gravity_sd_value == pytest.approx(sd, rel=0.03)
    # the reference of the gathered motion cannot change
    answer = node.set_parameters_atomically([Parameter('gravity', value=9.83)])
    assert not answer.successful and 'gravity' in answer.reason
    assert node.set_parameters_atomically([Parameter('hand_samples', value=5000)]).successful


def test_a_table_has_the_measured_gravity_and_no_other_latitude(bench, tmp_path):
    (tmp_path / 'table.yaml').write_text(
        yaml.safe_dump({'joints': [{'name': 'a', 'axis': [0, 0, 1]}], 'latitude': 48.0})
    )
    settings = {'table_file': str(tmp_path / 'table.yaml')}
    with refused(ImuCalibrationError, 'gravity_twice', 9.80891, 9.78033):
        bench.start(CalibrationNode, {**settings, 'latitude': 0.0})
    node = bench.start(CalibrationNode, {**settings, 'gravity': 9.79})
    assert (node.worker.live.table.gravity_value, node.worker.live.table.latitude) == (9.79, 48.0)


def test_what_cannot_be_used_is_refused_by_name(bench, tmp_path):
    (tmp_path / 'arm.urdf').write_text(SIX_AXES)
    with refused(ImuCalibrationError, 'link_unknown', 'nowhere'):
        chain_of(bench.node, RobotSettings(str(tmp_path / 'arm.urdf'), 'nowhere'), '')
    assert chain_of(bench.node, RobotSettings(), 'none') is None
    with refused(ImuCalibrationError, 'table_missing', 'table_file', 'urdf_file'):
        bench.start(PlannerNode, {})  # it moves joints: no table is assumed
