"""Parameters of a node from its settings."""

import ast
import importlib
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node

from imu_calibration.core.errors import ImuCalibrationError, InputError
from imu_calibration.core.settings import Setting, describe, override

UNKNOWN_PARAMETER = 'is unknown and ignored'
"""What is logged of a parameter that the node does not have."""
NOT_OURS = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')
"""Beginnings of the parameters that rclpy itself has."""


TYPE_NAMES = {bool: 'true or false', int: 'a whole number', float: 'a number with a decimal point', str: 'a text',
              tuple: 'a list of numbers with decimal points'}
_GROUPS = '_imu_calibration_groups'
"""Attribute of a node that holds its groups."""


def declare_parameters(node: Node, group: type, take: Callable[[Any], None] | None = None, *,
                       hints: dict[str, str] | None = None) -> Any:
    """
    Declare every field of the settings `group` as a parameter of `node` and return the settings with the given values.

    Tuples become arrays. From then on requests to change a parameter are handled: a setting declared `live` changes, of any other setting
    the request is rejected with the reason.

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
            value = node.declare_parameter(item.name, list(item.default) if isinstance(item.default, tuple) else item.default,
                                           parameter_descriptor(item)).value
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            kind = TYPE_NAMES[type(item.default)]
            raise InputError(f"parameter '{item.name}' must be {kind}{range_text(item.bounds)}: {error}") from error
        values[item.name] = _from_ros(item, value)
    settings = override(group(), values)
    _watch(node, _Group(settings, take, hints or {}))
    return settings


def parameter_descriptor(item: Setting) -> ParameterDescriptor:
    """Return the descriptor of one setting: type, meaning, unit, range, symptom of a wrong value, reason why it is fixed."""
    text = f'{item.text} [{item.unit}]' if item.unit else item.text
    descriptor = ParameterDescriptor(name=item.name, description=text, read_only=item.path)
    notes = [f'When wrong: {item.symptom}.'] * bool(item.symptom) + [f'Fixed while the node runs: {item.fixed}.'] * (not item.live)
    descriptor.additional_constraints = ' '.join(notes)
    if isinstance(item.default, bool) or item.bounds == (None, None):
        return descriptor
    if isinstance(item.default, int):
        low, high = _limits(item.bounds, 2**63 - 1)
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    elif isinstance(item.default, float):
        low, high = _limits(item.bounds, sys.float_info.max)
        descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
    return descriptor


@dataclass
class _Group:
    """A group of settings that are parameters of a node."""

    settings: Any
    take: Callable[[Any], None] | None
    hints: dict[str, str]


def _watch(node: Node, group: _Group) -> None:
    """Handle requests to change the parameters of a group: one callback per node, for all its groups."""
    groups = getattr(node, _GROUPS, None)
    if groups is None:
        groups = []
        setattr(node, _GROUPS, groups)
        node.add_on_set_parameters_callback(partial(_set, groups))
    groups.append(group)


def _set(groups: list[_Group], parameters: list) -> SetParametersResult:
    new, hints = [group.settings for group in groups], {}
    try:
        for parameter in parameters:
            _change(new, parameter)
        for group, settings in zip(groups, new, strict=True):
            if settings is not group.settings:
                hints = group.hints
                if group.take is not None:
                    group.take(settings)
                group.settings = settings
    except ImuCalibrationError as error:
        return SetParametersResult(successful=False, reason=error.with_hint(hints))
    except Exception as error:   # the requester receives a response, and the node continues unchanged
        return SetParametersResult(successful=False, reason=f'{type(error).__name__}: {error}')
    return SetParametersResult(successful=True)


def _change(groups: list, parameter: Any) -> None:
    for place, group in enumerate(groups):
        item = next((item for item in describe(group) if item.name == parameter.name), None)
        if item is None:
            continue
        value = _from_ros(item, parameter.value)
        if value == getattr(group, item.name):
            return
        if not item.live:
            raise InputError(f"parameter '{item.name}' cannot be changed while the node runs: {item.fixed}; start the node with "
                             f'-p {item.name}:={parameter.value}')
        groups[place] = override(group, {item.name: value})


def unknown_parameters(node: Node) -> list[str]:
    """Return a line for each given parameter that `node` does not have: ROS ignores it silently."""
    given = getattr(node, '_parameter_overrides', {})
    lines = []
    for name in sorted(given):
        if node.has_parameter(name) or name.startswith(NOT_OURS):
            continue
        near = get_close_matches(name, node.get_parameters_by_prefix(''), 1)
        lines.append(f"parameter '{name}' {UNKNOWN_PARAMETER}" + (f"; did you mean '{near[0]}'?" if near else
                                                                     f"; see 'ros2 param list {node.get_fully_qualified_name()}'"))
    return lines


def _limits(bounds: tuple, largest: float) -> tuple:
    low, high = bounds
    return -largest if low is None else low, largest if high is None else high


def _from_ros(item: Setting, value: Any) -> Any:
    return tuple(value) if isinstance(item.default, tuple) else value


_ARM = {'allow_xacro': "parameter 'allow_xacro'", 'urdf': "parameter 'urdf_file'", 'imu_link': "parameter 'imu_link'"}
HINTS = {
    'calibration_node': {'frame_id': "parameter 'frame_id'", 'gravity': "parameter 'gravity'", 'table': "parameter 'table_file'",
                         **_ARM, 'imu_topic': 'remap imu/data_raw', 'joint_topic': 'remap joint_states',
                         'temperature_topic': 'remap imu/temperature',
                         'inspect': "record a bag and run 'imu_calibration inspect BAG' to {}",
                         'diagnose': "call ~/diagnose, by hand record a bag and run 'imu_calibration diagnose BAG', to {}"},
    'compensator_node': {'anyway': "parameter 'anyway'", 'calibration': "parameter 'calibration_file'", 'imu_topic': 'remap imu/data_raw',
                         'target_frame': "parameter 'target_frame'", 'temperature_topic': 'remap imu/temperature'},
    'planner_node': {**_ARM, 'table': "parameter 'table_file'", 'joint_topic': 'remap joint_states'},
    'simulator_node': {**_ARM, 'calibration': "parameter 'calibration_file'", 'table': "parameter 'table_file'"},
}
"""Node -> {key of `errors.ERROR_KEYS`: its name in the node}; a node without an entry receives no such error."""


def settings_of(node: str) -> list[type]:
    """Return the settings classes that the module of `node` declares as parameters."""
    tree = ast.parse(Path(__file__).with_name(f'{node}.py').read_text())
    calls = [call for call in ast.walk(tree) if isinstance(call, ast.Call) and getattr(call.func, 'id', '') == 'declare_parameters']
    module = importlib.import_module(f'imu_calibration.nodes.{node}')
    return [getattr(module, ast.unparse(call.args[1])) for call in sorted(calls, key=lambda call: call.lineno)]


def meaning(item: Setting) -> str:
    """Return the meaning of a setting, with unit and range."""
    return item.text + (f' [{item.unit}]' if item.unit not in ('', '1') else '') + range_text(item.bounds)


def range_text(bounds: tuple) -> str:
    """Return which values are allowed."""
    low, high = (bound if bound is None or isinstance(bound, int) else f'{bound:g}' for bound in bounds)
    if high is not None:
        return f', {low} to {high}' if low is not None else f', at most {high}'
    return f', at least {low}' if low is not None else ''


def value_text(value: object) -> str:
    """Return `value` so that YAML reads the same type back."""
    if isinstance(value, tuple):
        return '[' + ', '.join(map(value_text, value)) + ']'
    text = json.dumps(value)
    return text.replace('e', '.0e') if isinstance(value, float) and 'e' in text and '.' not in text else text
