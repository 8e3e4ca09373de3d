"""The other end of the topics: what a test needs to talk to nodes that run as processes."""

import os
import time
from collections import defaultdict

from examples.processes import local_environment

PATIENCE = 240.0
"""Seconds after which a wait fails; a busy machine needs some of them."""


class Harness:
    """A node in this process, in a DDS domain of its own on this host."""

    def __init__(self, domain_id):
        os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = local_environment(domain_id)[
            'ROS_AUTOMATIC_DISCOVERY_RANGE'
        ]
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.executors import SingleThreadedExecutor

        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain_id)
        self.node = rclpy.create_node('harness', context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self.received, self.statuses, self._publishers = defaultdict(list), {}, {}
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 100)

    def _on_diagnostics(self, array):
        for status in array.status:
            self.statuses[status.name.partition(':')[0]] = status

    def publisher(self, message_type, topic, qos):
        """Return a publisher, the same one for the same topic."""
        if topic not in self._publishers:
            self._publishers[topic] = self.node.create_publisher(message_type, topic, qos)
        return self._publishers[topic]

    def listen(self, message_type, topic, qos):
        """Keep serialized messages of a topic in ``received[topic]``."""
        self.node.create_subscription(
            message_type, topic, self.received[topic].append, qos, raw=True
        )

    def spin(self, seconds):
        """Take messages for so long."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def wait(self, condition, seconds=PATIENCE, what='condition'):
        """Take messages until `condition()` holds."""
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, (
                f'{what} did not come within {seconds} s; diagnostics: {self.lines()}'
            )
            self._executor.spin_once(timeout_sec=0.05)

    def lines(self):
        """Return the latest message of each node's diagnostics."""
        return {name: status.message for name, status in self.statuses.items()}

    def values(self, node):
        """Return the latest details of a node's diagnostics."""
        return (
            {pair.key: pair.value for pair in self.statuses[node].values}
            if node in self.statuses
            else {}
        )

    def connected(self, topic, subscribers=1):
        """Return whether our publisher of `topic` has found its subscribers."""
        return self._publishers[topic].get_subscription_count() >= subscribers

    def call(self, service_type, name, seconds=PATIENCE):
        """Call a service without arguments and return its response."""
        client = self.node.create_client(service_type, name)
        self.wait(client.service_is_ready, seconds, f'service {name}')
        future = client.call_async(service_type.Request())
        self.wait(future.done, seconds, f'response of {name}')
        self.node.destroy_client(client)
        return future.result()

    def close(self):
        """End this side."""
        self._executor.shutdown(timeout_sec=1.0)
        self.node.destroy_node()
        self.context.try_shutdown()
