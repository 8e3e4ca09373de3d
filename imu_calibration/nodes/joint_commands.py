"""
Interfaces to command a controller: its topic, or its action where control_msgs is installed.

The topic has no feedback: the result of a trajectory shows only in the joint states. The action
returns the reason of a refusal.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from action_msgs.msg import GoalStatus, GoalStatusArray
from rclpy.node import Node
from rclpy.qos import qos_profile_action_status_default
from trajectory_msgs.msg import JointTrajectory

from imu_calibration.core.errors import InputError
from imu_calibration.kinematics.motion_limits import TrajectoryPoints
from imu_calibration.nodes.inputs import node_of, output_qos
from imu_calibration.nodes.lifecycle import guarded
from msg_adapters.joint_state import encode_trajectory

COMMANDS = ('topic', 'action', 'auto')
"""
How trajectories are sent; 'auto': by the action where control_msgs is installed and a server is
there.
"""
COMMAND_DEPTH = 10
RESULTS = {
    -1: 'the goal is invalid',
    -2: 'the joints are not those of the controller',
    -3: 'the stamp is old',
    -4: 'a joint left the path',
    -5: 'a joint did not reach the end',
}
"""Descriptions of the error codes of FollowJointTrajectory."""


class TopicCommand:
    """Sends trajectories to the topic `joint_trajectory`."""

    def __init__(self, node: Node):
        self._publisher = node.create_publisher(
            JointTrajectory, 'joint_trajectory', output_qos(COMMAND_DEPTH)
        )
        self.topic_name = self._publisher.topic_name
        self.name = self.topic_name
        """Interface by which the node moves the joints, readable."""
        self.action_name = f'{self.topic_name.rpartition("/")[0]}/follow_joint_trajectory'
        """Action of the same controller, by the convention of ros2_control."""
        self.goals: set[bytes] = set()
        """Goals of this node; none."""
        # Loads the message types, so that no stop waits for them.
        encode_trajectory(TrajectoryPoints.stop(()))

    @property
    def is_heard(self) -> bool:
        """Whether a controller is connected."""
        return self._publisher.get_subscription_count() > 0

    def send(self, points: TrajectoryPoints) -> None:
        """Send a trajectory."""
        self._publisher.publish(encode_trajectory(points))

    def stop(self, joint_names: tuple[str, ...]) -> None:
        """Send the trajectory without points: the controller stops."""
        self.send(TrajectoryPoints.stop(joint_names))


class ActionCommand:
    """
    Sends trajectories as goals of FollowJointTrajectory.

    A stop cancels the goal, and is sent to the topic as well.

    Parameters
    ----------
    node : Node
    action_type : type
        ``control_msgs.action.FollowJointTrajectory``.
    client : object
        An ``rclpy.action.ActionClient`` of it.
    refused : callable
        Called with one line when a goal is refused or ends otherwise than by success or a stop.

    """

    def __init__(
        self, node: Node, action_type: Any, client: Any, *, refused: Callable[[str], None]
    ):
        self._topic = TopicCommand(node)
        self._action = action_type
        self._client = client
        self._refused = refused
        self._goal_handle: Any = None
        """Handle of the accepted goal that is executed; None without one."""
        self._n_commands = 0
        """Number of goals and stops; a response to an earlier one is obsolete."""
        self.action_name = 'follow_joint_trajectory'
        self.name = self.action_name
        """Interface by which the node moves the joints, readable."""
        self.topic_name = self._topic.name
        self.goals: set[bytes] = set()
        """Identifiers of the goals of this node."""

    @property
    def is_heard(self) -> bool:
        """Whether the server is there."""
        return bool(self._client.server_is_ready())

    def send(self, points: TrajectoryPoints) -> None:
        """Send a trajectory as a goal."""
        from rclpy.serialization import deserialize_message

        self._n_commands += 1
        number = self._n_commands
        goal = self._action.Goal(
            trajectory=deserialize_message(encode_trajectory(points), JointTrajectory)
        )
        self._client.send_goal_async(goal).add_done_callback(
            self._guarded(lambda future: self._on_goal_response(number, future.result()))
        )

    def stop(self, joint_names: tuple[str, ...]) -> None:
        """
        Cancel the goal, and send the trajectory without points.

        The first to arrive stops the joints.
        """
        self._n_commands += 1  # the result of the goal is not reported any more
        handle = self._goal_handle
        self._goal_handle = None
        self._topic.stop(joint_names)
        if handle is not None:
            handle.cancel_goal_async()

    def _on_goal_response(self, number: int, handle: Any) -> None:
        """Process the server's response to the goal of command `number`."""
        self.goals.add(bytes(handle.goal_id.uuid))
        if number != self._n_commands:  # stopped before the server's response
            if handle.accepted:
                handle.cancel_goal_async()
            return
        if not handle.accepted:
            self._refused('it refused the goal')
            return
        self._goal_handle = handle
        handle.get_result_async().add_done_callback(
            self._guarded(lambda future: self._on_result(number, future.result().result))
        )

    def _guarded(self, callback: Callable[[Any], None]) -> Callable[[Any], None]:
        """
        Return a callback of a future whose exceptions count as a refusal.

        In an executor they would end the node.
        """
        return guarded(callback, lambda error: self._refused(f'{type(error).__name__}: {error}'))

    def _on_result(self, number: int, result: Any) -> None:
        """Report the result of the goal of command `number` unless it is a success."""
        if number != self._n_commands:
            return
        self._goal_handle = None
        if result.error_code != 0:
            text = getattr(result, 'error_string', '')
            self._refused(
                RESULTS.get(result.error_code, f'error code {result.error_code}')
                + (f' ({text})' if text else '')
            )


def make_command(
    node: Node, how: str, refused: Callable[[str], None]
) -> TopicCommand | ActionCommand:
    """
    Return the interface to command joints that `how` (one of `COMMANDS`) selects.

    Raises
    ------
    InputError
        When it requires an action without control_msgs.

    """
    if how == 'topic':
        return TopicCommand(node)
    try:
        from control_msgs.action import FollowJointTrajectory
    except ImportError:
        if how == 'action':
            raise InputError(
                "parameter 'command' is action, and control_msgs is not installed: install"
                ' ros-jazzy-control-msgs, or use topic',
                code='package_missing',
            ) from None
        return TopicCommand(node)
    from rclpy.action import ActionClient

    client = ActionClient(node, FollowJointTrajectory, 'follow_joint_trajectory')
    if how == 'auto' and not client.wait_for_server(timeout_sec=1.0):
        client.destroy()
        return TopicCommand(node)
    return ActionCommand(node, FollowJointTrajectory, client, refused=refused)


_ACTIVE = (GoalStatus.STATUS_ACCEPTED, GoalStatus.STATUS_EXECUTING, GoalStatus.STATUS_CANCELING)


class OtherCommanders:
    """
    Finds other publishers and action clients that command the joints.

    Parameters
    ----------
    node : Node
    command : TopicCommand or ActionCommand
        Command of the node itself, whose publisher and goals do not count.

    """

    def __init__(self, node: Node, command: TopicCommand | ActionCommand):
        self._node = node
        self._command = command
        self._active_goals: set[bytes] = set()
        """Goals of all clients that the controller had accepted at its last status."""
        self._status_subscription = node.create_subscription(
            GoalStatusArray,
            f'{command.action_name}/_action/status',
            self._take,
            qos_profile_action_status_default,
        )

    def _take(self, message: Any) -> None:
        """Record the active goals of a GoalStatusArray."""
        self._active_goals = {
            bytes(goal.goal_info.goal_id.uuid)
            for goal in message.status_list
            if goal.status in _ACTIVE
        }

    def obstacle(self) -> str:
        """
        Return the refusal that names another node that commands the joints, '' for none.

        It publishes to the topic of commands, or has a goal at the controller.
        """
        topic = self._command.topic_name
        publishers = sorted(map(node_of, self._node.get_publishers_info_by_topic(topic)))
        own_name = self._node.get_fully_qualified_name()
        if own_name in publishers:
            publishers.remove(own_name)  # once: a second node may have the same name
        if publishers:
            return (
                f'{topic} must have no other publisher, there is {", ".join(publishers)}; stop it'
                ' (after a crash its name remains for half a minute)'
            )
        # The last status of a controller that has ended is not valid any more.
        if self._active_goals - self._command.goals and self._node.count_publishers(
            self._status_subscription.topic_name
        ):
            return (
                f'{self._command.action_name} must have no active goal, another client has one;'
                ' wait until it has ended, or cancel it'
            )
        return ''
