"""Optional arguments of the launch files."""

from collections.abc import Mapping
from typing import Any

from launch.substitutions import LaunchConfiguration
from launch_ros.parameter_descriptions import ParameterValue


def given_parameters(
    context: Any, optional: Mapping[str, tuple[str, type]]
) -> dict[str, ParameterValue]:
    """
    Return the parameters of a node that launch arguments set.

    A parameter without an argument keeps its value in the parameter file.

    Parameters
    ----------
    context : LaunchContext
    optional : mapping
        Launch argument, empty by default -> parameter that it sets, and the type of its value.

    """
    parameters = {}
    for argument, (name, kind) in optional.items():
        value = LaunchConfiguration(argument)
        if value.perform(context):
            parameters[name] = ParameterValue(value, value_type=kind)
    return parameters
