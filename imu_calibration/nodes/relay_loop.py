"""
From a subscription to a publisher as serialized bytes, without the executor in between.

The wait set and the handles are internals of rclpy; `available` returns whether they exist. All
other callbacks of the node run in a second thread with the public executor.
"""

import sys
import threading
from collections.abc import Callable
from typing import Any, Protocol

from rclpy.callback_groups import CallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription

try:
    from rclpy.impl.implementation_singleton import rclpy_implementation as _inner
    from rclpy.signals import SignalHandlerGuardCondition
except ImportError:
    _inner = None

MAX_MESSAGES_IN_ROW = 256
"""Largest number of messages read in a row before the context is checked."""
WAIT_NS = 100_000_000
"""Longest wait, ns, after which a replaced subscription is noticed; a signal ends it at once."""
SWITCH_INTERVAL = 5e-4
"""The message thread gets the interpreter back from the other thread within this time, s."""


class OutsideExecutor(CallbackGroup):
    """Callbacks that the executor never runs: their subscription is read by `relay`."""

    def can_execute(self, _entity: Any) -> bool:
        """Return False: never by the executor."""
        return False

    def beginning_execution(self, _entity: Any) -> bool:
        """Return False: never by the executor."""
        return False

    def ending_execution(self, _entity: Any) -> None:
        """Do nothing."""


def available() -> bool:
    """Return whether this rclpy has the inner classes and methods that `relay` uses."""
    methods_of_classes = {
        'WaitSet': ('wait', 'clear_entities', 'add_subscription', 'add_guard_condition'),
        'Subscription': ('take_message',),
        'Publisher': ('publish_raw',),
    }
    for class_name, methods in methods_of_classes.items():
        inner_class = getattr(_inner, class_name, None)
        if not all(hasattr(inner_class, method) for method in methods):
            return False
    return True


class Subscribed(Protocol):
    """A source of messages, such as `inputs.MatchedInput`."""

    subscription: Subscription


def relay(
    node: Node, source: Subscribed, publisher: Publisher, *, convert: Callable[[bytes, dict], Any]
) -> None:
    """
    Publish the result of `convert` for each message until the context ends.

    Parameters
    ----------
    node : rclpy.node.Node
        Its other callbacks run in a second thread.
    source : Subscribed
        In a callback group `OutsideExecutor`; its subscription may change.
    publisher : rclpy.publisher.Publisher
    convert : callable
        (Serialized message, message information of the middleware) -> serialized message, or None
        for no publication.

    """
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    failures: list[BaseException] = []
    thread = threading.Thread(
        target=_spin, args=(executor, failures, node.context), name='callbacks', daemon=True
    )
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL)
    thread.start()
    try:
        _drain(node.context, source, publisher, convert)
    finally:
        sys.setswitchinterval(before)
        executor.shutdown(timeout_sec=2.0)
        thread.join(timeout=2.0)
    if failures:
        raise failures[0]


def _spin(executor: Any, failures: list[BaseException], context: Any) -> None:
    """Run the other callbacks; an exception is stored and ends the context."""
    try:
        executor.spin()
    except ExternalShutdownException:
        pass
    except BaseException as error:
        failures.append(error)
        context.try_shutdown()


def _drain(context: Any, source: Subscribed, publisher: Publisher, convert: Callable) -> None:
    """Relay messages until the context ends; a signal ends the wait by the guard condition."""
    guard = SignalHandlerGuardCondition(context)
    try:
        with publisher.handle, guard.handle, context.handle:
            wait_set = _inner.WaitSet(1, 1, 0, 0, 0, 0, context.handle)
            publish = getattr(publisher.handle, 'publish_raw', publisher.publish)
            while context.ok():
                try:
                    _drain_one(context, source, wait_set, guard, publish, convert)
                except InvalidHandle:  # another subscription has just replaced it
                    continue
    finally:
        guard.destroy()


def _drain_one(
    context: Any,
    source: Subscribed,
    wait_set: Any,
    guard: Any,
    publish: Callable[[bytes], None],
    convert: Callable[[bytes, dict], Any],
) -> None:
    """Relay the messages of one subscription, until the source has another one."""
    subscription = source.subscription
    with subscription.handle:
        take = subscription.handle.take_message
        message_type = subscription.msg_type
        while context.ok() and source.subscription is subscription:
            wait_set.clear_entities()
            wait_set.add_subscription(subscription.handle)
            wait_set.add_guard_condition(guard.handle)
            wait_set.wait(WAIT_NS)
            for _ in range(MAX_MESSAGES_IN_ROW):
                taken = take(message_type, True)
                if taken is None:
                    break
                converted = convert(taken[0], taken[1])
                if converted is not None:
                    publish(converted)
