"""
compensator_node with a target frame and no pose.

Waits for /tf_static, says what it waits for, then corrects as with the pose in parameters.

Over DDS with a real tf2_msgs: the installed one, or where no wheel has it one made from its
definition. Where that cannot be made either (no compiler, no headers), another type holds the place
of the subscription, and the node is handed the messages.
"""

import importlib.util
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from rclpy.parameter import Parameter
from scipy.spatial.transform import Rotation
from std_msgs.msg import String

from imu_calibration.core.samples import ImuSamples
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.nodes.compensator_node import CompensatorNode
from imu_calibration.nodes.inputs import latched_qos
from imu_calibration.nodes.robot_stand import TF_STATIC
from msg_adapters.write import encode_imu

from ros.message_package import make_package, why_not
from ros.one_process import OneProcess
from worlds.compensation_cases import random_calibration

pytestmark = [pytest.mark.live, pytest.mark.usefixtures('executor_only')]
OK, WARN, ERROR = range(3)
STATUS = 'compensator_node: compensation'
XYZ, RPY = [0.3, -0.1, 0.05], [0.2, -0.4, 1.1]
MESSAGES = [
    row.tobytes()
    for row in encode_imu(
        ImuSamples(
            10**18 + 5_000_000 * np.arange(50),
            np.tile([2.0, 4.0, 8.8], (50, 1)),
            np.full((50, 3), 0.1),
            'imu_link',
        )
    )
]


@pytest.fixture(scope='module')
def made_messages(tmp_path_factory):
    """Whether messages on /tf_static are real ones; they can be imported afterwards."""
    if importlib.util.find_spec('tf2_msgs') is None:
        if why_not():
            return False
        folder = tmp_path_factory.mktemp('messages')
        make_package(
            folder,
            'tf2_msgs',
            {'TFMessage': 'geometry_msgs/TransformStamped[] transforms\n'},
            ('geometry_msgs', 'std_msgs', 'builtin_interfaces'),
        )
        sys.path.append(str(folder))
    return True


class Bench(OneProcess):
    """Nodes in this process, and a broadcaster of static transforms."""

    def __init__(self, monkeypatch, is_real):
        super().__init__(monkeypatch)
        self.is_real, self._publisher, self._held = is_real, None, {}

    def broadcast(self, *steps):
        """
        Publish (parent, child, xyz, quaternion) steps beside those before, latched.

        As tf2's StaticTransformBroadcaster does.
        """
        self._held |= {one.child_frame_id: one for one in map(stamped, steps)}
        if not self.is_real:
            for node in self.nodes:
                if node._frames._subscription is not None:
                    node._frames.take(SimpleNamespace(transforms=list(self._held.values())))
            return
        from tf2_msgs.msg import TFMessage

        if self._publisher is None:
            self._publisher = self.node.create_publisher(TFMessage, TF_STATIC, latched_qos())
        self._publisher.publish(TFMessage(transforms=list(self._held.values())))


@pytest.fixture
def bench(monkeypatch, made_messages):
    """A Bench."""
    if not made_messages:
        for name in ('tf2_msgs', 'tf2_msgs.msg'):
            monkeypatch.setitem(sys.modules, name, ModuleType(name))
        sys.modules['tf2_msgs.msg'].TFMessage = String
    with Bench(monkeypatch, made_messages) as made:
        yield made


@pytest.fixture
def place(tmp_path):
    """A file with a calibration of imu_link."""
    path = tmp_path / 'good.yaml'
    path.write_text(calibration_to_text(random_calibration(1)))
    return str(path)


def stamped(step):
    """A TransformStamped of a (parent, child, xyz, quaternion) step."""
    parent, child, xyz, quaternion = step
    one = TransformStamped(child_frame_id=child)
    one.header.frame_id = parent
    for name, value in zip('xyz', xyz, strict=True):
        setattr(one.transform.translation, name, float(value))
    for name, value in zip('xyzw', quaternion, strict=True):
        setattr(one.transform.rotation, name, float(value))
    return one


POSE = ('base_link', 'imu_link', XYZ, Rotation.from_euler('xyz', RPY).as_quat())


def corrected(node):
    """What the node makes of the messages."""
    return [node.convert(message, {'source_timestamp': 1}) for message in MESSAGES]


def test_it_waits_and_says_for_what(bench, place):
    node = bench.start(CompensatorNode, {'calibration_file': place, 'target_frame': 'base_link'})
    bench.until(lambda: STATUS in bench.status, 'diagnostics')
    assert bench.shows(STATUS, "'base_link'", "'imu_link'", TF_STATIC, level=WARN)
    bench.broadcast(('map', 'odom', [0, 0, 0], [0, 0, 0, 1]))
    bench.until(
        lambda: bench.shows(STATUS, "'base_link'", "'imu_link'", 'map, odom'), 'what came instead'
    )
    assert node.adopted is None and corrected(node) == [None] * len(MESSAGES)
    assert bench.heard(
        "'imu_link'", 'map, odom', level='info'
    ) == 1 and node.get_subscriptions_info_by_topic(TF_STATIC)


def test_with_the_transform_it_corrects_as_with_the_pose_in_parameters(bench, place):
    """It was published before the node started, as the description of a robot is."""
    if bench.is_real:
        bench.broadcast(POSE)
    node = bench.start(CompensatorNode, {'calibration_file': place, 'target_frame': 'base_link'})
    if not bench.is_real:
        bench.broadcast(POSE)
    bench.until(lambda: node.adopted is not None, 'the transform')
    told = bench.start(
        CompensatorNode,
        {
            'calibration_file': place,
            'target_frame': 'base_link',
            'target_xyz': XYZ,
            'target_rpy': RPY,
        },
    )
    assert not node.awaited
    np.testing.assert_allclose(
        node.compensation.transfer.mat_ts, told.compensation.transfer.mat_ts, atol=1e-12
    )
    np.testing.assert_allclose(node.compensation.transfer.arm_t, XYZ)
    assert [made[:60] for made in corrected(node)] == [
        made[:60] for made in corrected(told)
    ] and b'base_link' in corrected(node)[0]


def test_a_transform_that_moves_is_followed_and_one_that_is_repeated_changes_nothing(bench, place):
    node = bench.start(CompensatorNode, {'calibration_file': place, 'target_frame': 'base_link'})
    bench.broadcast(POSE)
    bench.until(lambda: node.adopted is not None, 'the transform')
    before = node.compensation
    bench.broadcast(POSE, ('base_link', 'laser', [1, 0, 0], [0, 0, 0, 1]))
    bench.until(lambda: node._frames.pose('base_link', 'laser') is not None, 'the other one')
    assert node.compensation is before
    warned = bench.heard("'base_link'", level='warning')
    bench.broadcast((*POSE[:2], [0.5, 0.0, 0.0], POSE[3]))
    bench.until(lambda: node.compensation is not before, 'the new place')
    np.testing.assert_allclose(node.compensation.transfer.arm_t, [0.5, 0.0, 0.0])
    assert bench.heard("'base_link'", level='warning') == warned + 1


def test_a_pose_in_parameters_ends_the_waiting(bench, place):
    node = bench.start(CompensatorNode, {'calibration_file': place, 'target_frame': 'base_link'})
    assert (
        node.awaited
        and node.set_parameters_atomically([Parameter('target_xyz', value=XYZ)]).successful
    )
    assert node.adopted is not None and not node.awaited


def test_without_tf2_msgs_one_sentence_names_it(bench, place, monkeypatch):
    monkeypatch.setitem(sys.modules, 'tf2_msgs.msg', None)
    node = bench.start(CompensatorNode, {'calibration_file': place, 'target_frame': 'base_link'})
    assert node.refusal == 'package_missing' and 'tf2' in node.problem and node.adopted is None
