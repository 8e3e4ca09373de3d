"""
Nodes inside the test's own process, in a DDS domain of their own.

Seconds less than as processes, and what they say can be heard.
"""

import time

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from ros.live_station import PATIENCE, STAY_LOCAL, free_domain


class Ear:
    """Stands for the logger of a node."""

    def __init__(self, lines):
        self._lines = lines

    def info(self, line, **_):
        """Hear a line."""
        self._lines.append(('info', line))

    def warning(self, line, **_):
        """Hear a line."""
        self._lines.append(('warning', line))

    def error(self, line, **_):
        """Hear a line."""
        self._lines.append(('error', line))


class OneProcess:
    """
    Nodes, and a node of the test that talks to them.

    Parameters
    ----------
    monkeypatch : pytest.MonkeyPatch

    """

    def __init__(self, monkeypatch):
        for name, value in STAY_LOCAL.items():
            monkeypatch.setenv(name, value)
        domain_id, self._lock = free_domain()
        self.context, self.said, self.status, self.nodes = Context(), [], {}, []
        rclpy.init(context=self.context, domain_id=domain_id)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.node = rclpy.create_node('tester', context=self.context)
        self.executor.add_node(self.node)
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._hear, 100)
        self._monkeypatch = monkeypatch

    def _hear(self, array):
        self.status |= {status.name: status for status in array.status}

    def start(self, make, parameters=None, **options):
        """Return a node of a class with those parameters; what it says goes to `said`."""
        overrides = [Parameter(name, value=value) for name, value in (parameters or {}).items()]
        with self._monkeypatch.context() as patch:
            patch.setattr(make, 'get_logger', lambda node: Ear(self.said))
            node = make(
                context=self.context,
                parameter_overrides=overrides,
                use_global_arguments=False,
                **options,
            )
        node.get_logger = lambda: Ear(self.said)
        self.executor.add_node(node)
        self.nodes.append(node)
        return node

    def until(self, condition, what):
        """Spin until a condition holds."""
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, (
                f'waited in vain for {what}; said: {self.said}; status: {self.lines()}'
            )
            self.executor.spin_once(timeout_sec=0.02)

    def lines(self):
        """Return the latest (level, message) by name of status."""
        return {name: (status.level[0], status.message) for name, status in self.status.items()}

    def figure(self, name, key):
        """Return a value of a status, '' when it is not there."""
        return (
            next((pair.value for pair in self.status[name].values if pair.key == key), '')
            if name in self.status
            else ''
        )

    def heard(self, *values, level=None):
        """Return how many lines hold all of these names, numbers and keys; sentences may change."""
        return sum(
            all(str(value) in line for value in values)
            for kind, line in self.said
            if level in (None, kind)
        )

    def shows(self, name, *values, level=None):
        """
        Return whether the latest status has this level and holds all of these items.

        The items are names, numbers and keys.
        """
        shown, line = self.lines().get(name, (None, ''))
        return (
            shown is not None
            and level in (None, shown)
            and all(str(value) in line for value in values)
        )

    def call(self, name, kind=Trigger, until=None, **fields):
        """
        Call a service with these fields of its request and return its answer.

        `until` waits in place of the method.
        """
        client, until = self.node.create_client(kind, name), until or self.until
        until(client.service_is_ready, name)
        future = client.call_async(kind.Request(**fields))
        until(future.done, f'the answer of {name}')
        self.node.destroy_client(client)
        return future.result()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for node in self.nodes:
            if hasattr(node, 'close'):
                node.close()
        self.executor.shutdown(timeout_sec=1.0)
        for node in (*self.nodes, self.node):
            node.destroy_node()
        self.context.try_shutdown()
        self._lock.close()
