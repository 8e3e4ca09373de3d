"""
Imports run one way.

Nodes and cli, then msg_adapters, then the core, which needs numpy and scipy only.
"""

import ast
import os
import re
import subprocess
import sys
from functools import lru_cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FRONT_DOOR = ROOT / 'imu_calibration/__init__.py'
"""
Imports the names for notebooks when they are asked for; test_notebook sees to it that it imports
nothing by itself.
"""
EDGE = {'cli', 'nodes', 'api', '__main__'}
ROS = {
    'rclpy',
    'ros2cli',
    'ros2doctor',
    'rosbags',
    'ament_index_python',
    'launch',
    'launch_ros',
    'rosgraph_msgs',
    'std_srvs',
}
LATE = {'yaml', 'matplotlib', 'jinja2', 'tqdm', 'urdf_parser_py', 'xacro'}
LATE_OF_SCIPY = ('scipy.ndimage', 'scipy.optimize', 'scipy.signal', 'scipy.sparse', 'scipy.stats')
NOT_IN_CALIBRATE = ('allan', 'planning')
"""They would take half of the time in which a command or a node starts."""

BLOCKED_IMPORTS = """
import importlib, sys

class OnlyNumpyAndScipy:
    def find_spec(self, name, path=None, target=None):
        head = name.partition('.')[0]
        allowed = {'numpy', 'scipy', 'imu_calibration', *sys.stdlib_module_names}
        if head not in allowed and not head.startswith('_sysconfigdata'):
            raise ModuleNotFoundError(f'{name} may not be imported here', name=name)

sys.meta_path.insert(0, OnlyNumpyAndScipy())
for name in sys.argv[1:]:
    try:
        importlib.import_module(name)
    except ImportError as error:
        print(f'{name}: {error}')
"""


def module_name(path):
    """Dotted name of the module in `path`."""
    parts = path.relative_to(ROOT).with_suffix('').parts
    return '.'.join(parts[:-1] if parts[-1] == '__init__' else parts)


def modules(package):
    """Every module file of `package`."""
    return sorted((ROOT / package).rglob('*.py'))


def core_modules():
    """Modules of imu_calibration below the command line, the nodes and the installed files."""
    return [
        path
        for path in modules('imu_calibration')
        if path.relative_to(ROOT).with_suffix('').parts[1] not in EDGE
    ]


@lru_cache(maxsize=None)
def parsed(path):
    """The syntax tree of a file."""
    return ast.parse(path.read_text())


@lru_cache(maxsize=None)
def imports(path, top_level_only=False):
    """Absolute names of what `path` imports, at any depth or at import time only."""
    tree = parsed(path)
    package = module_name(path).split('.')
    if path.name != '__init__.py':
        package = package[:-1]
    found = set()
    for node in _at_import_time(tree) if top_level_only else ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            name = '.'.join([*base, *([node.module] if node.module else [])])
            found |= {name, *(f'{name}.{alias.name}' for alias in node.names)}
    return found


def _at_import_time(node):
    for child in ast.iter_child_nodes(node):
        is_for_types = isinstance(child, ast.If) and ast.unparse(child.test) == 'TYPE_CHECKING'
        is_later = isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
        if not is_for_types and not is_later:
            yield child
            yield from _at_import_time(child)


def heads(names):
    """First parts of dotted names."""
    return {name.partition('.')[0] for name in names}


def ros_packages(names):
    """Those of `names` that belong to ROS or read its bags."""
    return {name for name in heads(names) if name in ROS or name.endswith('_msgs')}


def inside(names, *packages):
    """Those of `names` that lie in one of `packages`."""
    return {
        name
        for name in names
        if any(name == package or name.startswith(f'{package}.') for package in packages)
    }


@pytest.mark.live
def test_the_core_imports_with_numpy_and_scipy_alone_and_without_a_screen():
    environment = {
        k: v for k, v in os.environ.items() if k not in ('DISPLAY', 'WAYLAND_DISPLAY', 'PYTHONPATH')
    }
    command = [sys.executable, '-c', BLOCKED_IMPORTS, *map(module_name, core_modules())]
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120
    )
    assert (done.returncode, done.stdout) == (0, ''), done.stdout + done.stderr


def test_the_core_knows_nothing_of_ros_or_of_the_layers_above():
    above = ('msg_adapters', *(f'imu_calibration.{name}' for name in EDGE))
    for path in core_modules():
        if path != FRONT_DOOR:
            assert not ros_packages(imports(path)), path
            assert not inside(imports(path), *above), path


def test_heavy_libraries_are_imported_where_they_are_used():
    for path in core_modules():
        names = imports(path, top_level_only=True)
        assert not heads(names) & LATE and not inside(names, *LATE_OF_SCIPY), path
        assert (
            not inside(imports(path), 'scipy.signal', 'scipy.stats')
            or module_name(path).split('.')[1] in NOT_IN_CALIBRATE
        ), path


def test_the_compensator_starts_without_scipy():
    """Its import took a quarter of the start of that node, which corrects by numpy alone."""
    waiting = [ROOT / 'imu_calibration' / 'nodes' / 'compensator_node.py']
    seen = set(waiting)
    while waiting:
        path = waiting.pop()
        names = imports(path, top_level_only=True)
        assert 'scipy' not in heads(names), path
        files = {ROOT / (name.replace('.', '/') + '.py') for name in names}
        found = {file for file in files - seen if file.is_file()}
        waiting += found
        seen |= found
    assert ROOT / 'imu_calibration' / 'document' / 'comparison.py' in seen


def test_adapters_know_no_node_and_no_command_line():
    for path in modules('msg_adapters'):
        assert 'rclpy' not in heads(imports(path, top_level_only=True)), path
        assert not inside(imports(path), 'imu_calibration.cli', 'imu_calibration.nodes'), path


ORDER = (
    ('core',),
    ('kinematics',),
    ('effects',),
    ('preprocessing',),
    ('estimation', 'simulation', 'compensation'),
    ('selection', 'allan'),
    ('document',),
    ('calibration',),
    ('references',),
    ('between_imus',),
    ('planning',),
    ('report',),
    ('api',),
    ('cli', 'nodes'),
)
"""Packages from the ground up: each may import what stands in an earlier row."""
ENTRIES = (FRONT_DOOR, FRONT_DOOR.with_name('__main__.py'))
"""Modules of no package; both import late or the command line only."""


def test_each_package_imports_only_what_stands_below_it():
    height = {name: row for row, names in enumerate(ORDER) for name in names}
    for path in modules('imu_calibration'):
        if path in ENTRIES:
            continue
        own = path.relative_to(ROOT / 'imu_calibration').with_suffix('').parts[0]
        imported = {
            name.split('.')[1] for name in inside(imports(path), 'imu_calibration') if '.' in name
        }
        above = {name for name in imported & set(height) - {own} if height[name] >= height[own]}
        assert above == set(), path


def test_estimation_knows_no_window_no_pose_and_no_table():
    of_data = ('preprocessing', 'references', 'kinematics.table', 'kinematics.joint')
    for path in modules('imu_calibration/estimation'):
        assert not inside(imports(path), *(f'imu_calibration.{name}' for name in of_data)), path


def test_every_package_has_its_place_in_the_order():
    found = {
        path.relative_to(ROOT / 'imu_calibration').with_suffix('').parts[0]
        for path in modules('imu_calibration')
    } - {'__init__', '__main__'}
    assert found == {name for names in ORDER for name in names}


def test_the_page_of_contents_goes_from_the_ground_up():
    height = {name: row for row, names in enumerate(ORDER) for name in names}
    text = ast.get_docstring(ast.parse(FRONT_DOOR.read_text()))
    listed = [
        name
        for line in text.partition('Contents')[2].splitlines()
        for name in re.findall(r'^`(\w+)`', line)
    ]
    assert len(listed) > 15 and listed == sorted(listed, key=height.get)


def test_every_package_says_what_comes_in_what_goes_out_and_what_to_read_first():
    for folder in (ROOT / 'imu_calibration').iterdir():
        if folder.is_dir() and any(folder.glob('*.py')):
            text = ast.get_docstring(ast.parse((folder / '__init__.py').read_text())) or ''
            text = ' '.join(text.split())
            assert 'In: ' in text and 'Out: ' in text and 'Read `' in text, folder.name


def test_a_public_name_means_one_thing():
    entries = {'main', 'run', 'add_arguments'}  # of each node and verb
    homes = {}
    for path in [*modules('imu_calibration'), *modules('msg_adapters')]:
        for node in parsed(path).body:
            named = isinstance(node, (ast.ClassDef, ast.FunctionDef))
            if named and not node.name.startswith('_') and node.name not in entries:
                homes.setdefault(node.name, []).append(module_name(path))
    assert {name: found for name, found in homes.items() if len(found) > 1} == {}


def weigher():
    """Return the module tools/weigh.py."""
    sys.path.insert(0, str(ROOT / 'tools'))
    try:
        import weigh
    finally:
        sys.path.pop(0)
    return weigh


def test_no_modules_import_each_other(tmp_path):
    weigh = weigher()
    assert (
        weigh.cycles(weigh.imports(ROOT, [*modules('imu_calibration'), *modules('msg_adapters')]))
        == []
    )
    for name, other in (('first', 'second'), ('second', 'first'), ('third', 'first')):
        (tmp_path / f'{name}.py').write_text(f'def function():\n    from {other} import function\n')
    assert [
        sorted(found)
        for found in weigh.cycles(weigh.imports(tmp_path, list(tmp_path.glob('*.py'))))
    ] == [['first', 'second']]


def test_the_start_of_a_program_is_the_last_statement_of_its_module():
    """A function below it is missing while the program runs."""
    starts = {
        path: [
            isinstance(node, ast.If) and '__main__' in ast.unparse(node.test)
            for node in parsed(path).body
        ]
        for path in modules('imu_calibration')
    }
    guarded = {path: of_nodes for path, of_nodes in starts.items() if any(of_nodes)}
    assert len(guarded) >= 5
    assert [path.name for path, of_nodes in guarded.items() if not of_nodes[-1]] == []


def test_modules_of_all_layers_were_found():
    names = set(map(module_name, [*modules('imu_calibration'), *modules('msg_adapters')]))
    assert {
        'imu_calibration.core.samples',
        'imu_calibration.cli',
        'imu_calibration.nodes',
        'msg_adapters',
    } <= names


def test_a_module_binds_each_constant_once():
    """
    Two constants of one name.

    As after a join of two files, leave the first one's users with the second one's value.
    """
    for path in modules('imu_calibration') + modules('msg_adapters'):
        bound = [
            target.id
            for node in parsed(path).body
            if isinstance(node, (ast.Assign, ast.AnnAssign))
            for target in (node.targets if isinstance(node, ast.Assign) else [node.target])
            if isinstance(target, ast.Name)
        ]
        assert sorted(set(bound)) == sorted(bound), path
