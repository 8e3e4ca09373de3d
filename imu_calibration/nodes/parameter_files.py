"""
Parameter files of the nodes, written from the settings that the nodes declare: ``make config``.

A setting is declared once, in the settings of its node, with default, unit, meaning, bounds and symptom of a wrong value. Names of
the inputs of a session (table, calibration, bag) are comments in the file: a default set there would override
an earlier argument of the command line.
"""

import ast
import importlib
import json
import textwrap
from pathlib import Path

from imu_calibration.core.settings import Setting, describe

NODES = ('calibration_node', 'compensator_node', 'simulator_node', 'bag_player_node', 'planner_node')


def main(folder: Path = Path(__file__).resolve().parents[2] / 'config') -> None:
    """Write one file for each node, and print which have changed."""
    for node in NODES:
        path = folder / f'{node}.yaml'
        text = rendered(node)
        if not path.exists() or path.read_text() != text:
            path.write_text(text)
            print(f'written: {path}')


def settings_of(node: str) -> list[type]:
    """Return the settings classes that the module of `node` declares as parameters."""
    tree = ast.parse(Path(__file__).with_name(f'{node}.py').read_text())
    calls = [call for call in ast.walk(tree) if isinstance(call, ast.Call) and getattr(call.func, 'id', '') == 'declare_parameters']
    module = importlib.import_module(f'imu_calibration.nodes.{node}')
    return [getattr(module, ast.unparse(call.args[1])) for call in sorted(calls, key=lambda call: call.lineno)]


def rendered(node: str) -> str:
    """Return the text of the parameter file of `node`."""
    lines = [f'# Parameters of {node} with their defaults: meaning [unit], range, and symptoms of a wrong value.', '/**:',
             '  ros__parameters:']
    for group in settings_of(node):
        for item in describe(group):
            words = meaning(item) + (f'. When wrong: {item.symptom}' if item.symptom else '')
            lines += textwrap.wrap(words, 120, initial_indent='    # ', subsequent_indent='    # ')
            lines.append(f'    {"# " if item.session else ""}{item.name}: {value_text(item.default)}')
    return '\n'.join(lines) + '\n'


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


if __name__ == '__main__':
    main()
