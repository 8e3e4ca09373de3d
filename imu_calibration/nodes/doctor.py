"""
``ros2 doctor``.

The Imu topics of the running system, their type, quality of service, stamps, units, frames and
covariances.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSCompatibility, qos_check_compatible
from ros2cli.node.direct import DirectNode
from ros2doctor.api import DoctorCheck, DoctorReport, Report, Result
from ros2doctor.api.format import doctor_error, doctor_warn
from sensor_msgs.msg import Imu

from imu_calibration.nodes.inputs import BatchInput
from imu_calibration.preprocessing.checks import Preflight
from imu_calibration.preprocessing.recording_evidence import (
    GOOD,
    REFUSE,
    WARNING,
    CheckFinding,
    check_messages,
)
from imu_calibration.preprocessing.stream_cleaning import BlockCleaner
from msg_adapters.imu_stream import ImuHeads
from msg_adapters.live import LiveGatherer

TYPE = 'sensor_msgs/msg/Imu'
LISTEN_SECONDS = 3.0
"""
Seconds of recording, up to `RETRIES` times as many if fewer than `ENOUGH_MESSAGES` messages were
received.
"""
DISCOVERY = 2.0
"""
Seconds in which the nodes of the system are found, up to `RETRIES` times where no Imu topic was.
"""
RETRIES = 3
ENOUGH_MESSAGES = 100
"""Messages that suffice to check a topic."""
IMU_TOPIC_ENDINGS = ('imu/data', 'imu/data_raw', 'imu/data_corrected')
"""Endings of topics that carry Imu messages by convention (REP 145)."""
NOT_MEASURED = ('/imu/residual',)
"""Endings of Imu topics without measurements."""


@dataclass(frozen=True)
class StreamFindings:
    """Properties of one topic."""

    topic: str
    """Full name."""
    source: str
    """Its publishers and how reliable they are."""
    findings: tuple[CheckFinding, ...]
    """Findings of the checks of a recording."""


def look(node: Node, spin_once: Any) -> list[StreamFindings]:
    """
    Record every Imu topic for some seconds and return the findings of each, in order of name.

    Parameters
    ----------
    node : Node
        Subscribes for that time.
    spin_once : callable
        Spins the node once; called with the node and ``timeout_sec=``.

    """
    for _ in range(RETRIES):
        _spin(node, spin_once, DISCOVERY)
        topics = _imu_topics(node)
        if topics:
            break
    streams = [_Stream(node, name) for name in topics]
    _spin(node, spin_once, 0.2)
    for stream in streams:
        stream.match_offered_qos()
    for _ in range(RETRIES):
        _spin(node, spin_once, LISTEN_SECONDS)
        if all(stream.count >= ENOUGH_MESSAGES for stream in streams):
            break
    return [stream.findings() for stream in streams]


def _imu_topics(node: Node) -> list[str]:
    """Return the published topics with Imu messages, or with names of Imu topics."""
    topics = []
    for name, types in sorted(node.get_topic_names_and_types()):
        # A name by convention with another type is a fault to report.
        may_be_imu = TYPE in types or name.endswith(IMU_TOPIC_ENDINGS)
        if may_be_imu and not name.endswith(NOT_MEASURED) and node.count_publishers(name):
            topics.append(name)
    return topics


def _spin(node: Node, spin_once: Any, seconds: float) -> None:
    """Spin a node for some seconds."""
    end = time.monotonic() + seconds
    while True:
        remaining = end - time.monotonic()
        if remaining <= 0:
            break
        spin_once(node, timeout_sec=remaining)


class _Stream:
    """One subscribed topic, with the messages that were received."""

    def __init__(self, node: Node, topic: str):
        self.node = node
        self.topic = topic
        self._begin()
        self.by_wall_clock = not node.count_publishers('/clock')
        """Whether stamps can be compared with the time of reception: not in simulated time."""
        self.input = BatchInput(node, Imu, topic, add=self._add)

    def _begin(self) -> None:
        """Begin a new recording."""
        self.heads = ImuHeads()
        """Frames, covariances and delays of the messages."""
        self.gatherer = LiveGatherer()
        """Samples of the messages."""
        self.count = 0
        """Number of messages."""

    def match_offered_qos(self) -> None:
        """
        Subscribe with the QoS of the publishers.

        Start again, because messages queued for the first subscription are received twice.
        """
        self.input.look()
        self._begin()

    def _add(self, data: bytes, sent_ns: int) -> None:
        """Record a message."""
        self.heads.add(data, time.time_ns() if self.by_wall_clock else 0)
        self.gatherer.add_imu(data, sent_ns)
        self.count += 1

    def findings(self) -> StreamFindings:
        """Return the findings of the recorded messages, publishers and subscribers."""
        self.input.look()
        preflight = Preflight(strict=False)
        for _ in BlockCleaner(watchers=[preflight]).all_of([self.gatherer.flush()]):
            pass  # the preflight reads the blocks on the way
        findings = (
            *self._publisher_faults(),
            *self._subscriber_findings(),
            *check_messages(self.heads.evidence()),
            *preflight.findings,
        )
        return StreamFindings(self.topic, self.input.source(), findings)

    def _publisher_faults(self) -> Iterator[CheckFinding]:
        """Yield faults of the publishers: another type, several of them, no messages."""
        for other in self.input.others:
            yield CheckFinding(
                'type',
                REFUSE,
                f'a topic must have one type, {other.node_name} publishes {other.topic_type} here'
                f' instead of {TYPE}; rename its topic',
            )
        names = sorted(self.input.names())
        if len(names) > 1:
            yield CheckFinding(
                'publishers',
                WARNING,
                f'one node must publish a topic, {len(names)} do ({", ".join(names)}): their '
                'messages mix; stop all but one, or rename their topics',
            )
        if names and not self.heads.evidence().frame_ids:
            yield CheckFinding(
                'silence',
                WARNING,
                f'messages are required, none came in {RETRIES * LISTEN_SECONDS:g} s; check the'
                ' driver',
            )

    def _subscriber_findings(self) -> Iterator[CheckFinding]:
        """
        Yield a refusal for each subscriber that a publisher cannot serve because of its QoS.

        If all are served, yield whether the messages are published reliably.
        """
        n_unserved = 0
        for listener in self.node.get_subscriptions_info_by_topic(self.topic):
            for publisher in self.input.publishers:
                compatibility, why = qos_check_compatible(
                    publisher.qos_profile, listener.qos_profile
                )
                if compatibility == QoSCompatibility.ERROR:
                    n_unserved += 1
                    yield CheckFinding(
                        'qos',
                        REFUSE,
                        f'a subscriber must request at most the offered QoS, {listener.node_name}'
                        f' receives nothing from {publisher.node_name}:'
                        f' {why.partition(": ")[2].rstrip(";") or why}',
                    )
        if self.input.publishers and not n_unserved:
            reliable = (
                'reliable'
                if self.input.reliable
                else 'best effort: messages lost by the network are not repeated'
            )
            yield CheckFinding('qos', GOOD, f'published {reliable}')


CATEGORY = 'imu'


@cache
def _streams() -> list[StreamFindings]:
    """Return the findings, computed once for check and report."""
    with DirectNode(None) as direct:
        return look(direct.node, rclpy.spin_once)


class ImuCheck(DoctorCheck):
    """Check that Imu messages follow the conventions of sensor_msgs."""

    def category(self) -> str:
        """Return the name that links the check and its report."""
        return CATEGORY

    def check(self) -> Result:
        """Return the faults of each topic."""
        result = Result()
        kinds: dict[str, tuple[Callable, Callable]] = {
            REFUSE: (doctor_error, result.add_error),
            WARNING: (doctor_warn, result.add_warning),
        }
        for stream in _streams():
            for finding in stream.findings:
                if finding.severity in kinds:
                    print_line, count = kinds[finding.severity]
                    print_line(f'{stream.topic}: {finding.check.replace("_", " ")}: {finding.text}')
                    count()
        return result


class ImuReport(DoctorReport):
    """Report the properties of every Imu topic."""

    def category(self) -> str:
        """Return the name that links the check and its report."""
        return CATEGORY

    def report(self) -> Report:
        """Return a line for each finding."""
        report = Report('IMU STREAMS')
        for stream in _streams():
            report.add_to_report('topic', stream.source)
            for finding in stream.findings:
                report.add_to_report(
                    finding.check.replace('_', ' '), f'{finding.severity}: {finding.text}'
                )
        if not report.items:
            report.add_to_report('topic', 'none of type sensor_msgs/msg/Imu has a publisher')
        return report
