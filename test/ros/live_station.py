"""
What the tests over DDS share.

A domain of their own, nodes as processes, and a node that watches them.
"""

import fcntl
import os
import tempfile
import time
from pathlib import Path

import numpy as np

from msg_adapters.live import LiveGatherer

from ros.forked_nodes import ForkedNodes

ROOT = Path(__file__).resolve().parents[2]
TABLE = ROOT / 'config' / 'table_simulated.yaml'
PATIENCE = 240.0
"""Seconds after which a test gives up; a busy machine needs some of them."""
STAY_LOCAL = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}


def free_domain():
    """Return (domain id, lock): no other test of this host has it while the lock is open."""
    for number in range(100):
        domain_id = 1 + (os.getpid() + number) % 100
        lock = open(Path(tempfile.gettempdir(), f'imu_calibration_test_domain_{domain_id}'), 'w')
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return domain_id, lock
        except OSError:
            lock.close()
    raise RuntimeError('no free ROS_DOMAIN_ID')


class Station:
    """
    Nodes of one DDS domain and a node of the test's own among them.

    Parameters
    ----------
    output : path-like, optional
        File for what the nodes print.
    processes : type
        NodeProcesses or a class with its methods.

    """

    def __init__(self, output=None, processes=ForkedNodes):
        import rclpy
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor

        os.environ |= STAY_LOCAL
        domain_id, self._lock = free_domain()
        self.processes = processes(domain_id)
        self.output = open(output, 'wb') if output else None
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain_id)
        self.node = rclpy.create_node('station', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.status, self.history, self.subscriptions = {}, [], []

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self.processes.__exit__(*exception)
        self.executor.shutdown(timeout_sec=2.0)
        self.node.destroy_node()
        self.context.try_shutdown()
        if self.output:
            self.output.close()
        self._lock.close()

    def start(self, name, parameters=None, **options):
        """Start a node as a process."""
        return self.processes.start(name, parameters, output=self.output, **options)

    def calibration_node(self, folder, **parameters):
        """
        Start calibration_node with a place to save in `folder`.

        `parameters` may also hold namespace, remappings and candidates, as for `start`.
        """
        options = {
            key: parameters.pop(key)
            for key in ('namespace', 'remappings', 'candidates')
            if key in parameters
        }
        fixed = {
            'table_file': TABLE,
            'save_file': Path(folder) / 'calibration.yaml',
            # A test that needs a solution or a diagnosis asks for it.
            'solve_share': 0.02,
            'diagnosis_period': 0.0,
        }
        return self.start('calibration_node', fixed | parameters, **options)

    def play(self, bag, rate, subscribers=1, **parameters):
        """Start bag_player_node."""
        options = {
            key: parameters.pop(key) for key in ('namespace', 'remappings') if key in parameters
        }
        fixed = {'bag': bag, 'rate': float(rate), 'wait_for_subscribers': subscribers}
        return self.start('bag_player_node', fixed | parameters, **options)

    def publisher(self, message_type, topic, reliable=True, depth=1000):
        """Return a publisher of the station's node."""
        from rclpy.qos import QoSProfile, ReliabilityPolicy

        reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        return self.node.create_publisher(
            message_type, topic, QoSProfile(depth=depth, reliability=reliability)
        )

    def watch_imu(self, topic):
        """Gather the Imu messages of a topic; returns the LiveGatherer."""
        from sensor_msgs.msg import Imu

        from imu_calibration.nodes.inputs import BatchInput

        gatherer = LiveGatherer()
        self.subscriptions.append(
            BatchInput(self.node, Imu, topic, add=gatherer.add_imu, depth=20_000)
        )
        return gatherer

    def watch_documents(self, topic='imu/calibration'):
        """Return the list that calibration documents of a topic go to."""
        from std_msgs.msg import String

        from imu_calibration.nodes.inputs import latched_qos

        documents = []
        note = self.node.create_subscription(
            String, topic, lambda message: documents.append(message.data), latched_qos()
        )
        self.subscriptions.append(note)
        return documents

    def watch_diagnostics(self):
        """
        Keep the last status by name in `status`, and the new ones in `history`.

        `history` holds every (name, level, message) that was new.
        """
        from diagnostic_msgs.msg import DiagnosticArray

        def note(message):
            for status in message.status:
                known = self.status.get(status.name)
                if known is None or (known.level, known.message) != (status.level, status.message):
                    self.history.append((status.name, status.level[0], status.message))
                self.status[status.name] = status

        self.subscriptions.append(
            self.node.create_subscription(DiagnosticArray, '/diagnostics', note, 100)
        )

    def figure(self, key, name='calibration_node: calibration'):
        """Return a figure of a diagnostic status as int; 0 while it is not there."""
        status = self.status.get(name)
        return (
            next((int(float(value.value)) for value in status.values if value.key == key), 0)
            if status
            else 0
        )

    def until(self, condition, what, patience=PATIENCE):
        """
        Spin until a condition holds; fail with `what` when it does not in time or a node has died.
        """
        deadline = time.monotonic() + patience
        while not condition():
            for process in self.processes.running:
                assert process.poll() in (None, 0), (
                    f'a node ended with {process.returncode} while waiting for {what}:'
                    f' {process.args[2]}'
                )
            known = {name: status.message for name, status in self.status.items()}
            assert time.monotonic() < deadline, (
                f'waited in vain for {what}; last diagnostics: {known}'
            )
            self.executor.spin_once(timeout_sec=0.05)

    def spin_for(self, seconds):
        """Spin for a while."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.05)

    def call(self, service, kind=None, again=PATIENCE / 3, **fields):
        """
        Call a service (Trigger unless `kind` is given) and return its response.

        An answer may be lost before both sides are connected; the call is repeated every `again`
        seconds.
        """
        from std_srvs.srv import Trigger

        kind = kind or Trigger
        client = self.node.create_client(kind, service)
        try:
            self.until(client.service_is_ready, f'service {service}')
            asked, began = [], time.monotonic()

            def answered():
                if time.monotonic() - began >= len(asked) * again:
                    asked.append(client.call_async(kind.Request(**fields)))
                return any(future.done() for future in asked)

            self.until(answered, f'the answer of {service}')
            return next(future for future in asked if future.done()).result()
        finally:
            self.node.destroy_client(client)


class Publisher:
    """Publishes samples of one IMU and its joints from the station, faster than they were taken."""

    def __init__(
        self, station, imu_topic='imu/data_raw', joint_topic='joint_states', reliable=True
    ):
        from sensor_msgs.msg import Imu, JointState

        self.station = station
        self.imu, self.joints = (
            station.publisher(kind, topic, reliable, 20_000)
            for kind, topic in ((Imu, imu_topic), (JointState, joint_topic))
        )

    def wait(self, subscribers=1, ended=()):
        """
        Wait until both topics have so many subscribers besides those that have ended.

        A killed node remains among the subscribers until its lease of 20 s is over, so that a node
        which follows it may miss the first messages.
        """

        def are_matched():
            for publisher in (self.imu, self.joints):
                known = self._subscriptions(publisher)
                if len(known.difference(ended)) < subscribers:
                    return False
                if publisher.get_subscription_count() < len(known):
                    return False
            return True

        self.station.until(are_matched, 'subscribers')
        self.station.spin_for(0.3)

    def subscriptions(self):
        """Return the identifiers of all subscriptions of both topics."""
        return self._subscriptions(self.imu) | self._subscriptions(self.joints)

    def _subscriptions(self, publisher):
        found = self.station.node.get_subscriptions_info_by_topic(publisher.topic_name)
        return {bytes(each.endpoint_gid) for each in found}

    def send(self, imu, joints, per_second=4000):
        """
        Publish ImuSamples and JointSamples merged by their place in the recording.

        About so many per second are published.
        """
        from msg_adapters.layout import Packed
        from msg_adapters.write import encode_imu, encode_joints

        queue = []
        for publisher, samples, encode in (
            (self.imu, imu, encode_imu),
            (self.joints, joints, encode_joints),
        ):
            messages = Packed.of_rows(encode(samples)).views() if len(samples) else []
            queue += [(k / len(messages), publisher, message) for k, message in enumerate(messages)]
        queue.sort(key=lambda entry: entry[0])
        step = max(per_second // 50, 1)
        for start in range(0, len(queue), step):
            for _, publisher, message in queue[start : start + step]:
                publisher.publish(bytes(message))
            self.station.spin_for(0.02)


def taken(gatherer):
    """Return the ImuSamples that were gathered, in the order of their stamps, each once."""
    samples = gatherer.flush().imu
    return samples.select(np.unique(samples.stamp_ns, return_index=True)[1])
