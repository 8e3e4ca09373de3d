"""Text of ``--help``: purpose of a node, its topics and services, and every parameter with its default and meaning."""

import inspect
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

from imu_calibration.nodes.parameter_files import meaning, settings_of, value_text
from imu_calibration.settings import describe

WIDTH = 118


def help_text(node_class: Callable[[], Any]) -> str:
    """Return the help of a node, from the docstring of its module and the settings that it declares."""
    module = sys.modules[node_class.__module__]
    name = Path(inspect.getfile(module)).stem
    lines = [f'usage: ros2 run imu_calibration {name} --ros-args [-p NAME:=VALUE ...] [-r FROM:=TO ...] [--params-file FILE]', '',
             inspect.getdoc(module) or '', '', 'parameters:']
    for group in settings_of(name):
        for item in describe(group):
            lines.append(f'  {item.name}: {value_text(item.default)}')
            lines += textwrap.wrap(meaning(item), WIDTH, initial_indent='      ', subsequent_indent='      ')
    return '\n'.join(lines)
