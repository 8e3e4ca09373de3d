"""Other programs that may drive the same joints: publishers on the trajectory topic, active goals of the trajectory action."""

from typing import Any

from action_msgs.msg import GoalStatus, GoalStatusArray
from rclpy.node import Node
from rclpy.qos import qos_profile_action_status_default

from imu_calibration.nodes.inputs import node_of
from imu_calibration.nodes.joint_commands import ActionCommand, TopicCommand

_ACTIVE = (GoalStatus.STATUS_ACCEPTED, GoalStatus.STATUS_EXECUTING, GoalStatus.STATUS_CANCELING)


class OtherDrivers:
    """
    Finds other publishers and action clients that command the joints.

    Parameters
    ----------
    node : Node
    command : TopicCommand or ActionCommand
        Command of the node itself, whose publisher and goals do not count.

    """

    def __init__(self, node: Node, command: TopicCommand | ActionCommand):
        self._node, self._command = node, command
        self._active: set[bytes] = set()
        self._status = node.create_subscription(GoalStatusArray, f'{command.action_name}/_action/status', self._take,
                                                qos_profile_action_status_default)

    def _take(self, message: Any) -> None:
        self._active = {bytes(each.goal_info.goal_id.uuid) for each in message.status_list if each.status in _ACTIVE}

    def found(self) -> str:
        """Return a line that names the other driver, '' for none."""
        topic, own = self._command.topic_name, self._node.get_fully_qualified_name()
        names = sorted(map(node_of, self._node.get_publishers_info_by_topic(topic)))
        if own in names:
            names.remove(own)
        if names:
            return (f'{topic} must have no other publisher, there is {", ".join(names)}; stop it (after a crash its name remains for half '
                    'a minute)')
        # The last status of a controller that has ended is not valid any more.
        if self._active - self._command.goals and self._node.count_publishers(self._status.topic_name):
            return (f'{self._command.action_name} must have no active goal, another client has one; wait until it has ended, or cancel it')
        return ''
