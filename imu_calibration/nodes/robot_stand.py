"""The table or robot description of a node, and static frames."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import Imu
from std_msgs.msg import String

from imu_calibration.core.errors import InputError
from imu_calibration.core.settings import flag_setting, path_setting, text_setting
from imu_calibration.document import files
from imu_calibration.kinematics.table import Table
from imu_calibration.kinematics.urdf import StaticTransforms, root_of, table_from_urdf
from imu_calibration.nodes.diagnostics import LOG_WARN, say
from imu_calibration.nodes.inputs import latched_qos
from msg_adapters.layout import clean_name

if TYPE_CHECKING:
    from imu_calibration.calibration.reference import MotionReference

TF_STATIC = '/tf_static'
TRANSFORM_DEPTH = 100
"""Publishers of static transforms whose last message is wanted."""


class StaticFrames:
    """
    The static transforms that are published, received from the first call of `pose` on.

    Parameters
    ----------
    node : Node
    changed : callable
        Called after the reception of transforms.

    """

    def __init__(self, node: Node, changed: Callable[[], None]):
        self._node = node
        self._changed = changed
        self._subscription: Any = None
        """Subscription of the transforms; None before the first call of `pose`."""
        self.transforms = StaticTransforms()
        """The received transforms."""
        self.n_unusable = 0
        """Number of received transforms that are not finite."""

    def pose(self, target: str, source: str) -> Any:
        """
        Return the pose of a frame in another one (see `StaticTransforms.pose`).

        None while it is not known.
        """
        self._listen()
        return self.transforms.pose(target, source)

    def waits_for(self, target: str, source: str) -> str:
        """Return a readable description of the awaited transform."""
        text = (
            f"the transform from '{target}' to '{source}' on {TF_STATIC}:"
            f' {self.transforms.why_not(target, source)}'
        )
        if self.n_unusable:
            text += f'; {self.n_unusable} received transforms are unusable (not finite)'
        return text

    def take(self, message: Any) -> None:
        """Process a tf2_msgs/TFMessage."""
        for stamped in message.transforms:
            place = stamped.transform.translation
            turn = stamped.transform.rotation
            is_usable = self.transforms.add(
                clean_name(stamped.header.frame_id).lstrip('/'),
                clean_name(stamped.child_frame_id).lstrip('/'),
                xyz=(place.x, place.y, place.z),
                quaternion=(turn.x, turn.y, turn.z, turn.w),
            )
            if not is_usable:
                self.n_unusable += 1
        self._changed()

    def _listen(self) -> None:
        """Subscribe to the transforms at the first call."""
        if self._subscription is None:
            try:
                from tf2_msgs.msg import TFMessage
            except ImportError as error:
                raise InputError(
                    f'{TF_STATIC} needs the messages of the package tf2_msgs, which is not'
                    ' installed; install ros-jazzy-tf2-msgs, or give target_xyz and target_rpy',
                    code='package_missing',
                ) from error
            self._subscription = self._node.create_subscription(
                TFMessage, TF_STATIC, self.take, latched_qos(TRANSFORM_DEPTH)
            )


URDF_FROM_TOPIC = 'topic'
"""Value of `urdf_file` that selects the topic robot_description."""
NO_TABLE = ('', 'none')
"""Values of `table_file` that mean: none. Launch arguments cannot be empty."""
WAIT_SECONDS = 0.1
"""Longest wait for a callback, s."""
WAIT_LOG_SECONDS = 5.0
"""Interval at which the awaited message is logged, s."""
Received = TypeVar('Received')


@dataclass(frozen=True)
class RobotSettings:
    """The arm that carries the IMU."""

    urdf_file: str = path_setting(
        'description (.urdf, or .xacro with allow_xacro) of the arm that carries the IMU, path;'
        f' {URDF_FROM_TOPIC}: the topic robot_description; empty: table_file only. With an arm,'
        ' table_file describes the site: up, gravity, latitude, limits of joints by name',
        'the node waits for the missing input',
        fixed='all motion gathered so far is of that arm',
    )
    imu_link: str = text_setting(
        'link of the arm that carries the IMU; empty: the frame_id of its messages',
        'another place and attitude of the sensor',
        session=True,
        fixed='all motion gathered so far is of that link',
    )
    world_frame: str = text_setting(
        'frame whose z axis points up and that /tf_static ties to the root of the arm; '
        'empty: up of table_file, '
        "otherwise the root's z axis",
        'a tilted base shows as accelerometer bias',
        session=True,
        fixed='all motion gathered so far is for this attitude of the arm',
    )
    allow_xacro: bool = flag_setting(
        'expand a .xacro file, which is a program: its expressions can execute any Python code',
        'the node refuses a .xacro file',
    )


def chain_of(
    node: Node,
    robot: RobotSettings,
    table_file: str,
    *,
    frame_id: str = '',
    gravity: float | None = None,
    gravity_sd: float = 0.0,
) -> Table | None:
    """
    Return the chain of joints that a node's parameters describe, None for neither table nor arm.

    Waits for the required topics while the node runs: their publishers may be started later.

    Parameters
    ----------
    node : Node
        Not spun by anybody yet.
    robot : RobotSettings
    table_file : str
    frame_id : str
        Frame of the IMU's messages; '': that of the first one received.
    gravity, gravity_sd : float, optional
        Local gravity and its standard deviation, m/s^2, as for `Table.at`.

    Raises
    ------
    InputError
        When a file cannot be used, the description is none, or the link is not on it.

    """
    table_path = _path_of(table_file)
    if not robot.urdf_file:
        if table_path is None:
            return None
        return files.read_table(table_path, gravity=gravity, gravity_sd=gravity_sd)

    # An arm; the table file describes its site.
    site = {} if table_path is None else files.read_mapping(table_path, 'table description')
    if robot.urdf_file == URDF_FROM_TOPIC:
        text = _description_from_topic(node)
    else:
        text = files.read_robot_description(files.user_path(robot.urdf_file), robot.allow_xacro)
    link = robot.imu_link or frame_id
    if not link:
        message = _first_message(node, Imu, 'imu/data_raw', qos_profile_sensor_data)
        link = clean_name(message.header.frame_id)
    if robot.world_frame:
        site['up'] = _up_from_frame(node, robot.world_frame, root_of(text))
    return table_from_urdf(text, link, site, gravity=gravity, gravity_sd=gravity_sd)


def live_reference(
    node: Node, robot: RobotSettings, table_file: str, **known: Any
) -> 'MotionReference':
    """Return the reference that a node's parameters describe; arguments as for `chain_of`."""
    # Here, because simulator_node does not need it.
    from imu_calibration.api.references import reference_of

    return reference_of(chain_of(node, robot, table_file, **known))


def stand_path(robot: RobotSettings, table_file: str) -> Path | None:
    """Return the path of the arm's description, or else of the table's; None without either."""
    return _path_of(robot.urdf_file or table_file)


def _path_of(file: str) -> Path | None:
    """Return the path that a parameter names, None for none."""
    return None if file in NO_TABLE else files.user_path(file)


def joint_topics(robot: RobotSettings, table_file: str) -> list[str]:
    """Return the topics of the joints, none without a table or an arm."""
    return ['joint_states'] if stand_path(robot, table_file) else []


def words_of(robot: RobotSettings, table_file: str) -> str:
    """Return a description of the result of `chain_of`."""
    if not robot.urdf_file:
        return f'the table {files.user_path(table_file)}'
    if robot.urdf_file == URDF_FROM_TOPIC:
        return 'the arm of the topic robot_description'
    return f'the arm {files.user_path(robot.urdf_file)}'


def _description_from_topic(node: Node) -> str:
    """Return the text of the first usable robot description on the topic."""

    def is_robot(message: Any) -> bool:
        try:
            return bool(root_of(message.data))
        except InputError as error:  # any participant can publish on the topic
            say(node.get_logger(), LOG_WARN, f'a robot description was ignored: {error}')
            return False

    return _first_message(node, String, 'robot_description', latched_qos(), is_robot).data


def _up_from_frame(node: Node, world: str, root: str) -> list[float]:
    """Return the z axis of the frame `world` in the root frame of the robot."""
    frames = StaticFrames(node, lambda: None)
    _, mat_rw = _waited_for(
        node, lambda: frames.pose(root, world), lambda: frames.waits_for(root, world)
    )
    return (mat_rw @ np.array([0.0, 0.0, 1.0])).tolist()


def _first_message(
    node: Node,
    kind: type,
    topic: str,
    qos: QoSProfile,
    usable: Callable[[Any], bool] = lambda message: True,
) -> Any:
    """Return the first usable message of a topic."""
    usable_messages: list[Any] = []

    def add(message: Any) -> None:
        if usable(message):
            usable_messages.append(message)

    subscription = node.create_subscription(kind, topic, add, qos)
    try:
        return _waited_for(
            node,
            lambda: usable_messages[0] if usable_messages else None,
            lambda: (
                f'a message on {node.resolve_topic_name(topic)}'
                f' ({kind.__module__.split(".")[0]}/{kind.__name__})'
            ),
        )
    finally:
        node.destroy_subscription(subscription)


def _waited_for(
    node: Node, received: Callable[[], Received | None], describe: Callable[[], str]
) -> Received:
    """
    Spin a node until `received` returns an object that is not None, and return it.

    Meanwhile the description of the object is logged, the first time after one second. Raises an
    ExternalShutdownException when the context ends before.
    """
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    logged_at = time.monotonic() - WAIT_LOG_SECONDS + 1.0
    try:
        while True:
            awaited = received()
            if awaited is not None:
                return awaited
            executor.spin_once(timeout_sec=WAIT_SECONDS)
            if time.monotonic() - logged_at > WAIT_LOG_SECONDS:
                node.get_logger().info(f'waits for {describe()}')
                logged_at = time.monotonic()
    finally:
        executor.remove_node(node)
        executor.shutdown()
