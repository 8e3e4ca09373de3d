"""
Publishing serialized messages at their times.

In real time, faster, or as fast as subscribers receive them.
"""

import threading
import time
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
import rclpy
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from msg_adapters.storage import read_ahead

CLOCK_RATE = 100.0
"""Messages on /clock per second, where a node publishes them."""
SHORTEST_SLEEP = 0.001
"""Seconds; messages that are due by then are published together."""
PLAYBACK_DEPTH = 20_000
"""Messages that wait for a slow reliable subscriber: some seconds of a fast stream."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Messages of a stretch of time, in order."""

    time: np.ndarray
    """Times at which the messages are due, s since the start, not falling, shape (n,)."""
    publisher: list
    """Publisher of each message."""
    messages: list
    """Serialized messages (bytes or memoryviews)."""
    until: float
    """End of the stretch, s."""


@dataclass(frozen=True)
class Pace:
    """Rate of publication."""

    factor: float = 1.0
    """Seconds of messages per second; 0: as fast as possible."""
    clock_rate: float = 0.0
    """/clock messages per second; 0: none."""
    subscribers: int = 0
    """Subscribers of each awaited topic to wait for before the start."""


class Playback(threading.Thread):
    """
    Publishes batches in a thread of its own; another thread makes them ahead.

    Parameters
    ----------
    node : rclpy.node.Node
    publishers : list of Publisher
    batches : generator of Batch
    pace : Pace
    clock_start_ns : int
        Time on /clock at the start.
    awaited : list of Publisher
        Publishers whose subscribers are waited for.
    ended : str
        Line that is logged at the end, with ``{}`` for the number of messages.
    ends_node : bool
        Whether the node ends after the last message; after an error it always ends.

    """

    def __init__(
        self,
        node: Node,
        publishers: Sequence,
        batches: Generator[Batch, None, None],
        *,
        pace: Pace,
        ended: str,
        clock_start_ns: int = 0,
        awaited: Sequence = (),
        ends_node: bool = True,
    ):
        super().__init__(name='playback', daemon=True)
        self._node = node
        self._publishers = publishers
        self._batches = batches
        self._pace = pace
        self._awaited = awaited
        self._end_text = ended
        self._ends_node = ends_node
        self._clock_start_ns = clock_start_ns
        self._clock_due = 0.0
        """Time of the next message on /clock, s since the start."""
        self._clock = None
        if pace.clock_rate:
            self._clock = node.create_publisher(Clock, '/clock', QoSProfile(depth=10))
        self._ending = threading.Event()
        """Set to stop publishing."""
        self._n_published = 0
        """Number of published messages."""
        self._is_over = False
        """Whether the playback ended by itself, after all messages or by an error."""
        self.failed = False
        """Whether an error ended it."""

    def end(self) -> str:
        """Stop as soon as possible; return the outcome, '' when all messages were published."""
        self._ending.set()
        if self.is_alive():
            self.join(5.0)
        return '' if self._is_over else f'stopped after {self._n_published} messages'

    def run(self) -> None:
        """Publish all messages."""
        error: BaseException | None = None
        try:
            self._play()
        except BaseException as raised:
            error = raised
        if self._ending.is_set():
            return
        self._is_over = True
        self.failed = error is not None and rclpy.ok()
        if self.failed:
            self._node.get_logger().error(f'stopped publishing: {type(error).__name__}: {error}')
        elif error is None:
            self._node.get_logger().info(self._end_text.format(self._n_published))
        if error is not None or self._ends_node:
            rclpy.try_shutdown()

    def _play(self) -> None:
        """Publish all batches, and wait until they are received."""
        start = None
        with closing(read_ahead(self._batches)) as batches:
            for batch in batches:
                if start is None:
                    self._wait_for_subscribers()
                    start = time.monotonic()
                self._publish(batch, start)
                if self._ending.is_set():
                    return
        self._settle()

    def _wait_for_subscribers(self) -> None:
        """Wait until each awaited topic has the requested number of subscribers."""
        while any(
            publisher.get_subscription_count() < self._pace.subscribers
            for publisher in self._awaited
        ):
            if self._ending.wait(0.05):
                return
        if self._awaited and self._pace.subscribers:
            self._ending.wait(0.3)  # the other side may find us a little later than we find it

    def _publish(self, batch: Batch, start: float) -> None:
        """Publish the messages of a batch when they are due; `start` on the steady clock, s."""
        n_done = 0
        while n_done < len(batch.messages) and not self._ending.is_set():
            now = float(batch.time[-1])  # as fast as possible: all are due
            if self._pace.factor:
                now = (time.monotonic() - start) * self._pace.factor
            n_due = int(np.searchsorted(batch.time, now, side='right'))
            self._publish_clock(now)
            for publisher, message in zip(
                batch.publisher[n_done:n_due], batch.messages[n_done:n_due], strict=True
            ):
                publisher.publish(bytes(message))
            self._n_published += n_due - n_done
            n_done = n_due
            if self._pace.factor and n_done < len(batch.messages):
                wait = (batch.time[n_done] - now) / self._pace.factor
                time.sleep(min(max(wait, SHORTEST_SLEEP), 0.05))

    def _publish_clock(self, now: float) -> None:
        """Publish /clock when it is due; `now` in s since the start."""
        if self._clock is None or now < self._clock_due:
            return
        self._clock_due = now + max(self._pace.factor, 1e-3) / self._pace.clock_rate
        stamp_ns = self._clock_start_ns + int(round(now * 1e9))
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(stamp_ns, 10**9)
        self._clock.publish(message)

    def _settle(self) -> None:
        """
        Wait until reliable subscribers have received all messages.

        Acknowledgements arrive with heartbeats, every three seconds.
        """
        for publisher in self._publishers:
            publisher.wait_for_all_acked(Duration(seconds=10.0))
        self._ending.wait(0.5)
