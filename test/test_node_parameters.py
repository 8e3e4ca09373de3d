"""
The parameter files in config/ are the declarations of the nodes, with their defaults.

Run as a program, this writes the files anew: ``.venv/bin/python test/test_node_parameters.py``.
"""

import ast
import difflib
import importlib
import json
import textwrap
from pathlib import Path

import pytest
import yaml

from imu_calibration.settings import describe

ROOT = Path(__file__).resolve().parents[1]
NODES = ('calibration_node', 'compensator_node', 'simulator_node', 'bag_player_node')


def settings_of(node):
    """Settings classes that the module of `node` declares as parameters."""
    name = f'imu_calibration.nodes.{node}'
    tree = ast.parse(ROOT.joinpath(*name.split('.')).with_suffix('.py').read_text())
    calls = [call for call in ast.walk(tree) if isinstance(call, ast.Call) and getattr(call.func, 'id', '') == 'declare_parameters']
    module = importlib.import_module(name)
    return [getattr(module, call.args[1].id) for call in sorted(calls, key=lambda call: call.lineno)]


def rendered(node):
    """Text of the parameter file of `node`."""
    lines = [f'# Parameters of {node} with their defaults: meaning [unit], range, and what you see when it is wrong.', '/**:', '  ros__parameters:']
    for group in settings_of(node):
        for name, default, unit, text, bounds, symptom in describe(group):
            words = text + (f' [{unit}]' if unit not in ('', '1') else '') + range_text(bounds) + (f'. When wrong: {symptom}' if symptom else '')
            lines += textwrap.wrap(words, 120, initial_indent='    # ', subsequent_indent='    # ')
            lines.append(f'    {name}: {value_text(default)}')
    return '\n'.join(lines) + '\n'


def range_text(bounds):
    """Say which values are allowed."""
    low, high = (bound if bound is None or isinstance(bound, int) else f'{bound:g}' for bound in bounds)
    if high is not None:
        return f', {low} to {high}' if low is not None else f', at most {high}'
    return f', at least {low}' if low is not None else ''


def value_text(value):
    """Write `value` so that YAML reads the same type back."""
    if isinstance(value, tuple):
        return '[' + ', '.join(map(value_text, value)) + ']'
    text = json.dumps(value)
    return text.replace('e', '.0e') if isinstance(value, float) and 'e' in text and '.' not in text else text


@pytest.mark.parametrize('node', NODES)
def test_parameter_file_is_the_declaration(node):
    written, declared = (ROOT / 'config' / f'{node}.yaml').read_text(), rendered(node)
    difference = '\n'.join(difflib.unified_diff(written.splitlines(), declared.splitlines(), 'written', 'declared', lineterm=''))
    assert not difference, f'run python {Path(__file__).name}\n{difference}'


@pytest.mark.parametrize('node', NODES)
def test_yaml_gives_the_defaults_back(node):
    values = yaml.safe_load(rendered(node))['/**']['ros__parameters']
    defaults = {name: default for group in settings_of(node) for name, default, *_ in describe(group)}
    assert {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()} == defaults
    assert [type(value) for value in values.values()] == [list if isinstance(value, tuple) else type(value) for value in defaults.values()]


@pytest.mark.parametrize('value', [1e-5, 1.5e-7, 0.1, 20.0, 1e22, True, 3, '', 'a: b', (0.0, 1e-9)])
def test_values_keep_their_type(value):
    read = yaml.safe_load(value_text(value))
    assert (tuple(read) if isinstance(value, tuple) else read) == value and isinstance(read, (type(value), list))


if __name__ == '__main__':
    for each in NODES:
        (ROOT / 'config' / f'{each}.yaml').write_text(rendered(each))
