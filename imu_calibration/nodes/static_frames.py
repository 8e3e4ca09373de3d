"""/tf_static, for the pose of the IMU in another frame."""

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from imu_calibration.core.errors import InputError
from imu_calibration.kinematics.urdf import StaticTransforms
from msg_adapters.stamps import clean_name

TOPIC = '/tf_static'
DEPTH = 100
"""Publishers of static transforms whose last message is wanted."""


class StaticFrames:
    """
    The static transforms that are published; listens from the first question on.

    Parameters
    ----------
    node : Node
    changed : callable
        Called after the reception of transforms.

    """

    def __init__(self, node: Node, changed: Callable[[], None]):
        self._node, self._changed, self._subscription = node, changed, None
        self.transforms, self.n_unusable = StaticTransforms(), 0

    def pose(self, target: str, source: str) -> Any:
        """Return the pose of a frame in another one (see `StaticTransforms.pose`), None while it is not known."""
        self._listen()
        return self.transforms.pose(target, source)

    def waits_for(self, target: str, source: str) -> str:
        """Return a readable description of the awaited transform."""
        return f"the transform from '{target}' to '{source}' on {TOPIC}: {self.transforms.why_not(target, source)}" + \
            (f'; {self.n_unusable} received transforms are unusable (not finite)' if self.n_unusable else '')

    def take(self, message: Any) -> None:
        """Process a tf2_msgs/TFMessage."""
        for stamped in message.transforms:
            place, turn = stamped.transform.translation, stamped.transform.rotation
            usable = self.transforms.add(*(clean_name(name).lstrip('/') for name in (stamped.header.frame_id, stamped.child_frame_id)),
                                         xyz=(place.x, place.y, place.z),
                                         quaternion=(turn.x, turn.y, turn.z, turn.w))
            self.n_unusable += not usable
        self._changed()

    def _listen(self):
        if self._subscription is None:
            try:
                from tf2_msgs.msg import TFMessage
            except ImportError as error:
                raise InputError(f'{TOPIC} needs the messages of the package tf2_msgs, which is not installed; '
                                 'install ros-jazzy-tf2-msgs, or give target_xyz and target_rpy', code='package_missing') from error
            qos = QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self._subscription = self._node.create_subscription(TFMessage, TOPIC, self.take, qos)
