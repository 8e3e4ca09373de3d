"""
A node's process: parameters from settings, help, first line, callbacks and timers.

Exit code 0 after SIGINT and SIGTERM, else 1.
"""

import ast
import importlib
import inspect
import json
import signal
import sys
import textwrap
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from imu_calibration.core.errors import ImuCalibrationError, InputError, shortened
from imu_calibration.core.settings import Setting, describe, override

UNKNOWN_PARAMETER = 'is unknown and ignored'
"""What is logged of a parameter that the node does not have."""
NOT_OURS = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')
"""Beginnings of the parameters that rclpy itself has."""


TYPE_NAMES = {
    bool: 'true or false',
    int: 'a whole number',
    float: 'a number with a decimal point',
    str: 'a text',
    tuple: 'a list of numbers with decimal points',
}
_GROUPS = '_imu_calibration_groups'
"""Attribute of a node that holds its groups."""


def declare_parameters(
    node: Node,
    group: type,
    take: Callable[[Any], None] | None = None,
    *,
    hints: dict[str, str] | None = None,
) -> Any:
    """
    Declare the fields of the settings `group` as parameters of a node; return their given values.

    Tuples become arrays. From then on requests to change a parameter are handled: a setting
    declared `live` changes, of any other setting the request is rejected with the reason.

    Parameters
    ----------
    node : Node
    group : type
        Settings class; one with live settings needs `take`.
    take : callable, optional
        Called with the new settings before they are in force; an ImuCalibrationError rejects them.
    hints : mapping, optional
        As for `errors.with_hint`.

    Raises
    ------
    InputError
        When a value has the wrong type or lies out of bounds.

    """
    values = {}
    for item in describe(group):
        try:
            value = node.declare_parameter(
                item.name,
                list(item.default) if isinstance(item.default, tuple) else item.default,
                parameter_descriptor(item),
            ).value
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            kind = TYPE_NAMES[type(item.default)]
            raise InputError(
                f"parameter '{item.name}' must be {kind}{range_text(item.bounds)}: {error}"
            ) from error
        values[item.name] = _from_ros(item, value)
    settings = override(group(), values)
    _add_group(node, _Group(settings, take, hints or {}))
    return settings


def parameter_descriptor(item: Setting) -> ParameterDescriptor:
    """
    Return the descriptor of one setting.

    Type, meaning, unit, range, symptom of a wrong value, reason why it is fixed.
    """
    text = f'{item.text} [{item.unit}]' if item.unit else item.text
    descriptor = ParameterDescriptor(name=item.name, description=text, read_only=item.path)
    notes = []
    if item.symptom:
        notes.append(f'When wrong: {item.symptom}.')
    if not item.live:
        notes.append(f'Fixed while the node runs: {item.fixed}.')
    descriptor.additional_constraints = ' '.join(notes)
    if isinstance(item.default, bool) or item.bounds == (None, None):
        return descriptor
    if isinstance(item.default, int):
        low, high = _limits(item.bounds, 2**63 - 1)
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    elif isinstance(item.default, float):
        low, high = _limits(item.bounds, sys.float_info.max)
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=float(low), to_value=float(high))
        ]
    return descriptor


@dataclass
class _Group:
    """A group of settings that are parameters of a node."""

    settings: Any
    """Present settings, an instance of the settings class."""
    take: Callable[[Any], None] | None
    """As of `declare_parameters`."""
    hints: dict[str, str]
    """As for `errors.with_hint`."""


def _add_group(node: Node, group: _Group) -> None:
    """
    Handle requests to change the parameters of a group: one callback per node, for all its groups.
    """
    groups = getattr(node, _GROUPS, None)
    if groups is None:
        groups = []
        setattr(node, _GROUPS, groups)
        node.add_on_set_parameters_callback(partial(_set_parameters, groups))
    groups.append(group)


def _set_parameters(groups: list[_Group], parameters: list) -> SetParametersResult:
    """Change the parameters of a request, group by group; reject it at the first error."""
    new_settings = [group.settings for group in groups]
    hints = {}
    try:
        for parameter in parameters:
            _replace_setting(new_settings, parameter)
        for group, settings in zip(groups, new_settings, strict=True):
            if settings is not group.settings:
                hints = group.hints
                if group.take is not None:
                    group.take(settings)
                group.settings = settings
    except ImuCalibrationError as error:
        return SetParametersResult(successful=False, reason=error.with_hint(hints))
    # The requester receives a response, and the node continues unchanged.
    except Exception as error:
        return SetParametersResult(successful=False, reason=f'{type(error).__name__}: {error}')
    return SetParametersResult(successful=True)


def _replace_setting(all_settings: list, parameter: Any) -> None:
    """
    Replace the settings in a list that have a parameter by ones with its new value.

    Raises an InputError where the setting is not live.
    """
    for k, settings in enumerate(all_settings):
        item = next((item for item in describe(settings) if item.name == parameter.name), None)
        if item is None:
            continue
        value = _from_ros(item, parameter.value)
        if value == getattr(settings, item.name):
            return
        if not item.live:
            raise InputError(
                f"parameter '{item.name}' cannot be changed while the node runs: {item.fixed};"
                f' start the node with -p {item.name}:={parameter.value}'
            )
        all_settings[k] = override(settings, {item.name: value})


def unknown_parameters(node: Node) -> list[str]:
    """Return a line for each given parameter that `node` does not have: ROS ignores it silently."""
    given = getattr(node, '_parameter_overrides', {})
    lines = []
    for name in sorted(given):
        if node.has_parameter(name) or name.startswith(NOT_OURS):
            continue
        remedy = f"see 'ros2 param list {node.get_fully_qualified_name()}'"
        similar = get_close_matches(name, node.get_parameters_by_prefix(''), 1)
        if similar:
            remedy = f"did you mean '{similar[0]}'?"
        lines.append(f"parameter '{name}' {UNKNOWN_PARAMETER}; {remedy}")
    return lines


def _limits(bounds: tuple, largest: float) -> tuple:
    """Return (low, high) of the bounds of a setting, the largest number where one is None."""
    low, high = bounds
    return -largest if low is None else low, largest if high is None else high


def _from_ros(item: Setting, value: Any) -> Any:
    """Return the value of a parameter as that of a setting: arrays become tuples."""
    return tuple(value) if isinstance(item.default, tuple) else value


_ARM = {
    'allow_xacro': "parameter 'allow_xacro'",
    'urdf': "parameter 'urdf_file'",
    'imu_link': "parameter 'imu_link'",
}
HINTS = {
    'calibration_node': {
        'frame_id': "parameter 'frame_id'",
        'gravity': "parameter 'gravity'",
        'table': "parameter 'table_file'",
        **_ARM,
        'imu_topic': 'remap imu/data_raw',
        'joint_topic': 'remap joint_states',
        'temperature_topic': 'remap imu/temperature',
        'inspect': "record a bag and run 'imu_calibration inspect BAG' to {}",
        'diagnose': (
            "call ~/diagnose, by hand record a bag and run 'imu_calibration diagnose BAG', to {}"
        ),
    },
    'compensator_node': {
        'anyway': "parameter 'anyway'",
        'calibration': "parameter 'calibration_file'",
        'imu_topic': 'remap imu/data_raw',
        'target_frame': "parameter 'target_frame'",
        'temperature_topic': 'remap imu/temperature',
    },
    'planner_node': {
        **_ARM,
        'table': "parameter 'table_file'",
        'joint_topic': 'remap joint_states',
    },
    'simulator_node': {
        **_ARM,
        'calibration': "parameter 'calibration_file'",
        'table': "parameter 'table_file'",
    },
}
"""
Node -> {key of `errors.ERROR_KEYS`: its name in the node}; a node without an entry receives no such
error.
"""


def settings_of(node: str) -> list[type]:
    """
    Return the settings classes that the module of `node` declares as parameters, in this order.

    They are the second arguments of `declare_parameters` in its source: no node is made.
    """
    tree = ast.parse(Path(__file__).with_name(f'{node}.py').read_text())
    calls = []
    for call in ast.walk(tree):
        if isinstance(call, ast.Call) and getattr(call.func, 'id', '') == 'declare_parameters':
            calls.append(call)
    module = importlib.import_module(f'imu_calibration.nodes.{node}')
    return [
        getattr(module, ast.unparse(call.args[1]))
        for call in sorted(calls, key=lambda call: call.lineno)
    ]


def meaning(item: Setting) -> str:
    """Return the meaning of a setting, with unit and range."""
    unit = f' [{item.unit}]' if item.unit not in ('', '1') else ''
    return item.text + unit + range_text(item.bounds)


def range_text(bounds: tuple) -> str:
    """Return the allowed values of a setting as a continuation of a text; '' without bounds."""
    low, high = (f'{bound:g}' if isinstance(bound, float) else bound for bound in bounds)
    if low is not None and high is not None:
        return f', {low} to {high}'
    if low is not None:
        return f', at least {low}'
    return f', at most {high}' if high is not None else ''


def value_text(value: object) -> str:
    """Return `value` so that YAML reads the same type back."""
    if isinstance(value, tuple):
        return '[' + ', '.join(map(value_text, value)) + ']'
    text = json.dumps(value)
    # YAML reads 1e-06 as a text, and 1.0e-06 as a number.
    if isinstance(value, float) and 'e' in text and '.' not in text:
        return text.replace('e', '.0e')
    return text


HELP_WIDTH = 118


def help_text(node_class: Callable[[], Any]) -> str:
    """
    Return the help of a node, from the docstring of its module and the settings that it declares.
    """
    module = sys.modules[node_class.__module__]
    name = Path(inspect.getfile(module)).stem
    lines = [
        (
            f'usage: ros2 run imu_calibration {name} --ros-args [-p NAME:=VALUE ...] [-r FROM:=TO'
            ' ...] [--params-file FILE]'
        ),
        '',
        inspect.getdoc(module) or '',
        '',
        'parameters:',
    ]
    for group in settings_of(name):
        for item in describe(group):
            lines.append(f'  {item.name}: {value_text(item.default)}')
            lines += textwrap.wrap(
                meaning(item), HELP_WIDTH, initial_indent='      ', subsequent_indent='      '
            )
    return '\n'.join(lines)


def every(node: Node, seconds: float, callback: Callable[[], Any]) -> Any:
    """Call a function of a node every so many seconds of the steady clock; return the timer."""
    return node.create_timer(seconds, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


SIGNALS = (signal.SIGINT, signal.SIGTERM)
SIGNAL_SECONDS = 0.1
"""
Seconds within which Python's handler of a signal is called; rclpy's is first, and ends the context.
"""
LOOK_AGAIN = 0.5
"""Interval at which an idle node checks whether its end was requested, s."""


def run_node(
    make_node: Callable[[], Any],
    arguments: Sequence[str] | None = None,
    *,
    spin: Callable[[Any], None] | None = None,
    hints: dict[str, str] | None = None,
) -> int:
    """
    Run one node until a signal ends the process, and return the exit code.

    Parameters
    ----------
    make_node : callable
        Returns the node; its class gives the text of ``--help``. A method `close` of the node is
        called before it is destroyed, and its result is printed; a method `halt` is called at the
        first signal, while the context is still valid and messages can be sent; an attribute
        `failed` is true when the node ended because it could not continue, and has reported it.
    arguments : list of str, optional
        Command line without the program's name; default ``sys.argv[1:]``.
    spin : callable, optional
        Called with the node, returns or raises ExternalShutdownException when the context ends;
        default ``rclpy.spin``.
    hints : dict, optional
        As for `errors.with_hint`.

    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    not_of_ros = remove_ros_args(['', *arguments])[1:]
    if not_of_ros:
        return _print_help_or_refusal(make_node, not_of_ros)

    # Signals. rclpy's handlers, installed by init, end the wait and call these; without them Python
    # would also raise KeyboardInterrupt in mid-write. A node with a final message (`halt`) needs
    # the context until it is sent: rclpy installs no handlers, and `on_signal` ends the context.
    received_signals: list[int] = []
    node = None
    halts = hasattr(make_node, 'halt')

    def on_signal(number, _):
        received_signals.append(number)
        if halts and node is not None:
            node.halt()
        if halts:
            rclpy.try_shutdown()

    for number in SIGNALS:
        signal.signal(number, on_signal)
    # Incomplete objects of rclpy at the end of the context are not reported either.
    report = sys.unraisablehook
    sys.unraisablehook = lambda unraisable: None if received_signals else report(unraisable)

    init_options = {}
    if halts:
        init_options['signal_handler_options'] = SignalHandlerOptions.NO
    rclpy.init(args=arguments, **init_options)
    try:
        if received_signals:  # before rclpy's handlers were installed
            return 0
        node = make_node()
        for line in unknown_parameters(node):
            node.get_logger().warning(line)
        # At a signal rclpy wakes the executor before it ends the context: an executor that checks
        # the context in between waits again.
        every(node, LOOK_AGAIN, lambda: None)
        if not received_signals:  # an executor cannot be made any more
            (spin or rclpy.spin)(node)
    except (ExternalShutdownException, KeyboardInterrupt):
        pass
    except ImuCalibrationError as error:
        return _failed(error.with_hint(hints or {}))
    except Exception as error:
        # A context that ends while something is being made or published fails in many ways; none of
        # them is news.
        time.sleep(SIGNAL_SECONDS)
        if not received_signals:
            return _failed(
                f'the node cannot continue: {shortened(f"{type(error).__name__}: {error}", 300)}'
            )
    finally:
        _end(node)
    return int(getattr(node, 'failed', False))


def _print_help_or_refusal(make_node: Callable[[], Any], not_of_ros: Sequence[str]) -> int:
    """Process arguments that are not of ROS: --help, or a mistake; return the exit code."""
    if '-h' in not_of_ros or '--help' in not_of_ros:
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # the reader of a pipe may close it
        print(help_text(make_node))
        return 0
    return _failed(
        'arguments of the node follow --ros-args, got'
        f" '{shortened(not_of_ros[0])}' before it; write --ros-args -p NAME:=VALUE, and see --help"
    )


def _failed(line: str) -> int:
    """Print an error; return the exit code."""
    print(f'error: {line}', file=sys.stderr, flush=True)
    return 1


def _end(node: Any) -> None:
    """Close and destroy a node, print the outcome, and end the context."""
    # `ros2 launch` sends every signal twice, and the second must not interrupt saving.
    _ignore_signals()
    if node is not None:
        outcome = node.close() if hasattr(node, 'close') else ''
        if outcome:  # a logger would also publish, and complain that it cannot any more
            print(f'[{node.get_name()}]: {outcome}', file=sys.stderr, flush=True)
        node.destroy_node()
    rclpy.try_shutdown()
    _ignore_signals()  # rclpy has restored the earlier handlers


def _ignore_signals() -> None:
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def guarded(
    callback: Callable[..., Any], failed: Callable[[Exception], Any]
) -> Callable[..., None]:
    """Return `callback` with its exceptions passed to `failed`."""

    def call(*arguments: Any) -> None:
        try:
            callback(*arguments)
        except Exception as error:
            failed(error)

    return call


def announce(node: Node, inputs: Sequence[str], outputs: Sequence[str], *, note: str = '') -> None:
    """Log the full names of topics, given as relative names, and a note."""
    read = ', '.join(map(node.resolve_topic_name, inputs)) or 'nothing'
    published = ', '.join(map(node.resolve_topic_name, outputs)) or 'nothing'
    node.get_logger().info(f'reads {read}; publishes {published}' + (f'; {note}' if note else ''))
