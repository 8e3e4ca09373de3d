"""From start to end of a node's process: help, first line, callbacks and timers; exit code 0 after SIGINT and SIGTERM, 1 with one line."""

import inspect
import signal
import sys
import textwrap
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import rclpy
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from imu_calibration.core.errors import ImuCalibrationError, shortened
from imu_calibration.core.settings import describe
from imu_calibration.nodes.parameters import meaning, settings_of, unknown_parameters, value_text

HELP_WIDTH = 118


def help_text(node_class: Callable[[], Any]) -> str:
    """Return the help of a node, from the docstring of its module and the settings that it declares."""
    module = sys.modules[node_class.__module__]
    name = Path(inspect.getfile(module)).stem
    lines = [f'usage: ros2 run imu_calibration {name} --ros-args [-p NAME:=VALUE ...] [-r FROM:=TO ...] [--params-file FILE]', '',
             inspect.getdoc(module) or '', '', 'parameters:']
    for group in settings_of(name):
        for item in describe(group):
            lines.append(f'  {item.name}: {value_text(item.default)}')
            lines += textwrap.wrap(meaning(item), HELP_WIDTH, initial_indent='      ', subsequent_indent='      ')
    return '\n'.join(lines)


def every(node: Node, seconds: float, callback: Callable[[], Any]) -> Any:
    """Call a function of a node every so many seconds of the steady clock; return the timer."""
    return node.create_timer(seconds, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


SIGNALS = (signal.SIGINT, signal.SIGTERM)
HEARD = 0.1
"""Seconds within which the interpreter has heard of a signal; rclpy hears first, and ends the context."""
LOOK_AGAIN = 0.5
"""Interval at which an idle node checks whether its end was requested, s."""


def run_node(make_node: Callable[[], Any], arguments: Sequence[str] | None = None, *, spin: Callable[[Any], None] | None = None,
             hints: dict[str, str] | None = None) -> int:
    """
    Run one node until a signal ends the process, and return the exit code.

    Parameters
    ----------
    make_node : callable
        Returns the node; its class gives the text of ``--help``. A method `close` of the node is called before it is destroyed, and
        its result is printed; a method `halt` is called at the first signal, while the context is still valid and messages
        can be sent; an attribute `failed` is true when the node ended because it could not continue, and has reported it.
    arguments : list of str, optional
        Command line without the program's name; default ``sys.argv[1:]``.
    spin : callable, optional
        Called with the node, returns or raises ExternalShutdownException when the context ends; default ``rclpy.spin``.
    hints : dict, optional
        As for `errors.with_hint`.

    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    own = remove_ros_args(['', *arguments])[1:]
    if '-h' in own or '--help' in own:
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)   # the reader of a pipe may close it
        print(help_text(make_node))
        return 0
    if own:
        print(f"error: arguments of the node follow --ros-args, got '{shortened(own[0])}' before it; write --ros-args -p NAME:=VALUE, "
              'and see --help', file=sys.stderr)
        return 1
    # rclpy's handlers, installed by init, end the wait and call these; without them Python would also raise KeyboardInterrupt in mid-write.
    asked_to_end, node, halts = [], None, hasattr(make_node, 'halt')

    def asked(number, _):
        asked_to_end.append(number)
        if halts and node is not None:
            node.halt()
        if halts:
            rclpy.try_shutdown()
    for number in SIGNALS:
        signal.signal(number, asked)
    report = sys.unraisablehook   # incomplete objects of rclpy at the end of the context are not reported either
    sys.unraisablehook = lambda unraisable: None if asked_to_end else report(unraisable)
    # A node with a final message needs the context until it is sent.
    rclpy.init(args=arguments, **({'signal_handler_options': SignalHandlerOptions.NO} if halts else {}))
    try:
        if asked_to_end:   # before rclpy's handlers were installed
            return 0
        node = make_node()
        for line in unknown_parameters(node):
            node.get_logger().warning(line)
        # At a signal rclpy wakes the executor before it ends the context: an executor that checks the context in between waits again.
        every(node, LOOK_AGAIN, lambda: None)
        if not asked_to_end:   # an executor cannot be made any more
            (spin or rclpy.spin)(node)
    except (ExternalShutdownException, KeyboardInterrupt):
        pass
    except ImuCalibrationError as error:
        return _failed(error.with_hint(hints or {}))
    except Exception as error:
        # A context that ends while something is being made or published fails in many ways; none of them is news.
        time.sleep(HEARD)
        if not asked_to_end:
            return _failed(f'the node cannot continue: {shortened(f"{type(error).__name__}: {error}", 300)}')
    finally:
        _end(node)
    return int(getattr(node, 'failed', False))


def _failed(line: str) -> int:
    print(f'error: {line}', file=sys.stderr, flush=True)
    return 1


def _end(node: Any) -> None:
    _ignore_signals()   # `ros2 launch` sends every signal twice, and the second must not interrupt saving
    if node is not None:
        last_words = node.close() if hasattr(node, 'close') else ''
        if last_words:   # a logger would also publish, and complain that it cannot any more
            print(f'[{node.get_name()}]: {last_words}', file=sys.stderr, flush=True)
        node.destroy_node()
    rclpy.try_shutdown()
    _ignore_signals()   # rclpy has restored the earlier handlers


def _ignore_signals() -> None:
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def guarded(callback: Callable[..., Any], failed: Callable[[Exception], Any]) -> Callable[..., None]:
    """Return `callback` with its exceptions passed to `failed`."""
    def call(*arguments: Any) -> None:
        try:
            callback(*arguments)
        except Exception as error:
            failed(error)
    return call


def announce(node: Node, inputs: Sequence[str], outputs: Sequence[str], *, note: str = '') -> None:
    """Log the full names of topics, given as relative names, and a note."""
    read, published = (', '.join(map(node.resolve_topic_name, names)) or 'nothing' for names in (inputs, outputs))
    node.get_logger().info(f'reads {read}; publishes {published}' + (f'; {note}' if note else ''))
