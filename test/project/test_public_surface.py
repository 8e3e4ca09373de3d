"""
Everything public says its types, and what comes after the third argument is named by whoever calls.
"""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
XYZ = {'x', 'y', 'z', 'wx', 'wy', 'wz', 'fx', 'fy', 'fz'}
"""Components of one vector, as what is called for every sample takes them."""
POSITIONAL = ('settings.py',)
"""
Where some functions take more than three arguments by their place: settings are declared like rows
of a table.
"""


def modules():
    """Path of every module."""
    return [
        path
        for folder in ('imu_calibration', 'msg_adapters')
        for path in sorted((ROOT / folder).rglob('*.py'))
    ]


def public_functions(path):
    """
    Yield (function, its arguments without self) of the public functions.

    They are the functions, methods and constructors that other code may call.
    """
    for node in ast.parse(path.read_text()).body:
        inside = (
            node.body
            if isinstance(node, ast.ClassDef) and not node.name.startswith('_')
            else [node]
        )
        for entry in inside:
            if isinstance(entry, ast.FunctionDef) and (
                not entry.name.startswith('_')
                or entry.name in ('__init__', '__call__')
                and entry is not node
            ):
                bound = entry is not node and not any(
                    getattr(mark, 'id', '') == 'staticmethod' for mark in entry.decorator_list
                )
                yield entry, [*entry.args.posonlyargs, *entry.args.args][bound:]


@pytest.mark.parametrize('path', modules(), ids=lambda path: path.stem)
def test_it_says_its_types(path):
    found = [
        f'{entry.name} (line {entry.lineno})'
        for entry, arguments in public_functions(path)
        if any(argument.annotation is None for argument in arguments + entry.args.kwonlyargs)
        or entry.returns is None
        and (entry.name != '__init__' or not arguments + entry.args.kwonlyargs)
    ]
    assert not found, f'annotate {", ".join(found)}'


@pytest.mark.parametrize(
    'path', [path for path in modules() if path.name not in POSITIONAL], ids=lambda path: path.stem
)
def test_what_comes_after_the_third_argument_is_named(path):
    found = [
        f'{entry.name} (line {entry.lineno})'
        for entry, arguments in public_functions(path)
        if len([argument for argument in arguments if argument.arg not in XYZ]) > 3
    ]
    assert not found, f'put a * behind the third argument of {", ".join(found)}'
