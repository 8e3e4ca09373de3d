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


@pytest.fixture(scope='module')
def surface():
    """(path, function, its arguments) of every public function."""
    return [(path, *function) for path in modules() for function in public_functions(path)]


def found_where(is_wrong, surface):
    """Return 'file: function (line)' of the public functions whose arguments are wrong."""
    return [
        f'{path.relative_to(ROOT)}: {entry.name} (line {entry.lineno})'
        for path, entry, arguments in surface
        if is_wrong(path, entry, arguments)
    ]


def test_every_public_function_says_its_types(surface):
    def is_untyped(path, entry, arguments):
        every = arguments + entry.args.kwonlyargs
        if any(argument.annotation is None for argument in every):
            return True
        return entry.returns is None and (entry.name != '__init__' or not every)

    assert found_where(is_untyped, surface) == []


def test_what_comes_after_the_third_argument_is_named(surface):
    def takes_more_than_three(path, entry, arguments):
        counted = [argument for argument in arguments if argument.arg not in XYZ]
        return path.name not in POSITIONAL and len(counted) > 3

    assert found_where(takes_more_than_three, surface) == []
