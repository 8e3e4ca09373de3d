"""
Inputs: subscriptions that connect to any publisher.

They lose no message of a reliable publisher, and report faults of their topic.
"""

import time
from collections.abc import Callable
from difflib import get_close_matches
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from imu_calibration.nodes.lifecycle import every

QUEUE_DEPTH = 1000
"""Messages that wait at most: a pause of 160 ms at 6 kHz, of 5 s at 200 Hz."""


def input_qos(reliable: bool = False, depth: int = QUEUE_DEPTH) -> QoSProfile:
    """
    Return the profile of an input (`inputs.MatchedInput`).

    With `reliable` lost messages are repeated; without it any publisher can connect.
    """
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
    )


def output_qos(depth: int = QUEUE_DEPTH) -> QoSProfile:
    """
    Return the profile of an output: the default of rclpy is reliable, so that all can subscribe.
    """
    return QoSProfile(depth=depth)


def latched_qos(depth: int = 1) -> QoSProfile:
    """
    Return the profile of the calibration document: a late subscriber receives the last messages.
    """
    return QoSProfile(depth=depth, durability=DurabilityPolicy.TRANSIENT_LOCAL)


PUBLISHER_CHECK_SECONDS = 0.25
"""Seconds between two checks of the publishers of the inputs."""
SEVERAL_AFTER = 3.0
"""Seconds after which several publishers of one topic are reported."""
DEAD_AFTER = 30.0
"""
The same when they have one name: for so long discovery may still list a killed node in addition to
its replacement.
"""
NAP = 0.004
"""
Seconds a callback sleeps after it has read all messages: at 2 kHz the executor then wakes once for
eight messages.
"""
NOT_RAW = ('_corrected', '/residual', '/truth')
"""Suffixes of topics that this package publishes, which are not suggested as replacements."""
MAX_NAMED_TOPICS = 3
"""Other topics that are named at most."""


def node_of(endpoint: Any) -> str:
    """Return the full name of the node of a TopicEndpointInfo."""
    return f'{endpoint.node_namespace.rstrip("/")}/{endpoint.node_name}'


class MatchedInput:
    """
    A subscription as reliable as the publishers of its topic.

    It requests reliability, so that no message of a reliable publisher is lost, until a best-effort
    publisher appears: that publisher would never connect. When the last best-effort publisher has
    disappeared it requests reliability again.

    Parameters
    ----------
    node : Node
    message_type : type
    topic : str
        Relative name, as in a remapping.
    callback : callable
        Called with each message, and with the middleware's message information if it has two
        parameters.
    depth : int
        Messages that may wait.
    group : CallbackGroup, optional
    single : bool
        Whether several publishers at once are a fault.
    raw : bool
        Whether messages are passed serialized.
    latched : bool
        Whether the last message that was sent before is wanted too; its publisher is then reliable.

    """

    def __init__(
        self,
        node: Node,
        message_type: type,
        topic: str,
        *,
        callback: Callable[..., None],
        depth: int = QUEUE_DEPTH,
        group: CallbackGroup | None = None,
        single: bool = True,
        raw: bool = True,
        latched: bool = False,
    ):
        self.node = node
        self.message_type = message_type
        self.topic = topic
        self.single = single
        self._callback = callback
        self._depth = depth
        self._group = group
        self._raw = raw
        self._latched = latched
        self.type_name = '{}/msg/{}'.format(
            message_type.__module__.partition('.')[0], message_type.__name__
        )
        self._several_since: float | None = None
        """Time since which several publishers send, s of the steady clock; None: at most one."""
        self.publishers: list[Any] = []
        """Publishers of the topic (TopicEndpointInfo) at the last `look`."""
        self.others: list[Any] = []
        """Publishers of another type on the topic."""
        self.reliable = True
        """Whether the subscription requests reliability."""
        self.subscription = self._subscribe()

    @property
    def topic_name(self) -> str:
        """Full name of the topic."""
        return self.subscription.topic_name

    def _subscribe(self) -> Subscription:
        """Return a new subscription with the present reliability."""
        # With its default callbacks rclpy warns of every publisher that offers less than requested,
        # before we request less.
        silent = SubscriptionEventCallbacks(use_default_callbacks=False)
        qos = latched_qos() if self._latched else input_qos(self.reliable, self._depth)
        return self.node.create_subscription(
            self.message_type,
            self.topic,
            self._callback,
            qos,
            callback_group=self._group,
            event_callbacks=silent,
            raw=self._raw,
        )

    def look(self) -> None:
        """Record the publishers, and subscribe again when they require another reliability."""
        was_mixed = self.mixed
        self.publishers = []
        self.others = []
        for publisher in self.node.get_publishers_info_by_topic(self.topic_name):
            if publisher.topic_type == self.type_name:
                self.publishers.append(publisher)
            else:
                self.others.append(publisher)
        reliable = self._latched or all(
            publisher.qos_profile.reliability != ReliabilityPolicy.BEST_EFFORT
            for publisher in self.publishers
        )
        # A new subscription to a latched topic receives the last message of the publisher that
        # remains.
        needs_last_message = self._latched and was_mixed and not self.mixed
        if reliable != self.reliable or needs_last_message:
            old_subscription = self.subscription
            self.reliable = reliable
            self.subscription = self._subscribe()
            self.node.destroy_subscription(old_subscription)
        if not self.mixed:
            self._several_since = None
        elif self._several_since is None:
            self._several_since = time.monotonic()

    @property
    def mixed(self) -> bool:
        """Whether several publishers sent on the topic at the last `look`."""
        return len(self.publishers) > 1

    def names(self) -> list[str]:
        """Return the full names of the nodes that publish."""
        return [node_of(publisher) for publisher in self.publishers]

    def faults(self) -> list[str]:
        """Return the faults of the topic, a line each."""
        if not self.single or self._several_since is None:
            return []
        names = self.names()
        patience = DEAD_AFTER if len(set(names)) == 1 else SEVERAL_AFTER
        if time.monotonic() - self._several_since < patience:
            return []
        return [
            f'{len(names)} publishers on {self.topic_name} ({", ".join(sorted(names))}): their'
            f' messages mix; stop all but one, or remap {self.topic}'
        ]

    def source(self) -> str:
        """Return the source of the messages, readable."""
        return (
            f'{self.topic_name} from {", ".join(sorted(set(self.names()))) or "an unknown node"}, '
            + ('reliable' if self.reliable else 'best effort')
        )

    def silence(self, unusable: str = '') -> str:
        """
        Return the likely reason of a silent topic, and a similar topic.

        `unusable` describes received messages that were dropped.
        """
        if unusable:
            return f'no message on {self.topic_name} is usable: {unusable}'
        what = f'no messages on {self.topic_name} ({self.type_name})'
        if self.publishers:
            return (
                f'{what}: {", ".join(sorted(set(self.names())))} is a publisher but does not send'
            )
        if self.others:
            return (
                f'{what}: {self.others[0].node_name} publishes {self.others[0].topic_type} there;'
                f' remap {self.topic} to another topic'
            )
        return f'{what}: {self._elsewhere()}'

    def _elsewhere(self) -> str:
        """Return a text that names other topics of the type, the most similar name first."""
        topics = sorted(
            name
            for name in self._topics_of_sources()
            if name != self.topic_name and not name.endswith(NOT_RAW)
        )
        if not topics:
            return 'no other node publishes that type; see that the driver runs'
        nearest, *further = get_close_matches(self.topic_name, topics, MAX_NAMED_TOPICS, 0.0)
        further_text = f' (or {", ".join(further)})' if further else ''
        return f'there is {nearest}{further_text}; listen to it with -r {self.topic}:={nearest}'

    def _topics_of_sources(self) -> set[str]:
        """
        Return the topics of the type from nodes that are neither this one nor a compensator.

        By node: a search by topic applies the remappings of this node to the name of the topic.
        """
        sources: set[str] = set()
        for name, space in self.node.get_node_names_and_namespaces():
            full_name = f'{space.rstrip("/")}/{name}'
            if full_name == self.node.get_fully_qualified_name():
                continue
            try:
                services = self.node.get_service_names_and_types_by_node(name, space)
                topics = self.node.get_publisher_names_and_types_by_node(name, space)
            except NodeNameNonExistentError:
                continue
            # A node that reloads a calibration is a compensator.
            if any(service == f'{full_name}/reload' for service, _ in services):
                continue
            for topic, types in topics:
                if self.type_name in types:
                    sources.add(topic)
        return sources


class BatchInput(MatchedInput):
    """
    An input whose callback passes on all waiting messages at once.

    This is efficient for thousands of messages per second: the public executor calls it for the
    first message, and the following ones are read through the subscription's handle. Where rclpy
    has no such handle every message has its own call, which is slower with the same result.

    Parameters
    ----------
    add : callable
        Called with each serialized message (bytes) and its time of sending, ns.

    """

    def __init__(
        self,
        node: Node,
        message_type: type,
        topic: str,
        *,
        add: Callable[[bytes, int], None],
        **options: Any,
    ):
        self._add = add
        super().__init__(node, message_type, topic, callback=self._arrived, **options)

    def _arrived(self, message: bytes, information: dict) -> None:
        """Pass on a message and the ones that wait after it."""
        self._add(message, sent_ns(information))
        if self.drain():
            time.sleep(NAP)

    def drain(self) -> bool:
        """Pass on all waiting messages; return whether the handle allows it."""
        take = getattr(getattr(self.subscription, 'handle', None), 'take_message', None)
        if take is None:
            return False
        while True:
            taken = take(self.message_type, True)
            if taken is None:
                return True
            message, information = taken
            self._add(message, sent_ns(information))


def sent_ns(information: dict) -> int:
    """Return the time of sending of a message, ns, or of reception if the middleware has none."""
    return information['source_timestamp'] or information['received_timestamp']


def watch_inputs(node: Node, inputs: list[MatchedInput]) -> None:
    """Check the publishers of the inputs periodically, by the steady clock."""

    def look() -> None:
        for source in inputs:
            source.look()

    every(node, PUBLISHER_CHECK_SECONDS, look)
