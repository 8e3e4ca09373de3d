"""ROS parameters made from the settings that the package declares once."""

import math
import sys

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException

from imu_calibration.errors import InputError
from imu_calibration.settings import describe, override


def declare_parameters(node, group, changeable=()):
    """
    Declare every field of the settings `group` as a parameter of `node` and return the settings with the values it was given.

    Parameters
    ----------
    node : rclpy.node.Node
    group : dataclass class
        Fields declared with `settings.setting`; tuples become arrays.
    changeable : collection of str
        Parameters that may be set while the node runs; the others are read-only.

    Raises
    ------
    InputError
        When a value has the wrong type or lies out of bounds.

    """
    values = {}
    for name, default, unit, text, bounds, symptom in describe(group):
        descriptor = parameter_descriptor(name, default, unit, text, bounds, symptom, name not in changeable)
        try:
            value = node.declare_parameter(name, _to_ros(default), descriptor).value
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            raise InputError(f"parameter '{name}' must be {_type_name(default)}{_range_text(bounds)}: {error}") from error
        values[name] = tuple(value) if isinstance(default, tuple) else value
    return override(group(), values)


def parameter_descriptor(name, default, unit, text, bounds, symptom, read_only=True):
    """Return the ParameterDescriptor of one setting: type, meaning, unit, range, and what a wrong value looks like."""
    descriptor = ParameterDescriptor(name=name, description=f'{text} [{unit}]' if unit else text, read_only=read_only)
    descriptor.additional_constraints = f'When wrong: {symptom}' if symptom else ''
    if isinstance(default, bool) or bounds == (None, None):
        return descriptor
    if isinstance(default, int):
        low, high = _limits(bounds, 2**63 - 1)
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    elif isinstance(default, float):
        low, high = _limits(bounds, sys.float_info.max)
        descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
    return descriptor


def _limits(bounds, largest):
    low, high = bounds
    return -largest if low is None else low, largest if high is None else high


def _to_ros(default):
    return list(default) if isinstance(default, tuple) else default


def _type_name(default):
    return {bool: 'true or false', int: 'a whole number', float: 'a number with a decimal point', str: 'a text',
            tuple: 'a list of numbers with decimal points'}[type(default)]


def _range_text(bounds):
    low, high = (math.inf * sign if bound is None else bound for bound, sign in zip(bounds, (-1, 1)))
    return '' if bounds == (None, None) else f' in [{low:g}, {high:g}]'
