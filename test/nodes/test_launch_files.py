"""
Launch files: every argument that is used is declared, every parameter exists.

`launch` itself is replaced, it is not on PyPI.
"""

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest
import yaml

from imu_calibration.core.settings import describe
from imu_calibration.nodes.lifecycle import settings_of

ROOT = Path(__file__).resolve().parents[2]


class Recorded:
    """Stands for any class of launch: keeps what it was made with."""

    made = []

    def __init__(self, *args, **kwargs):
        self.args, self.kwargs = args, kwargs
        Recorded.made.append(self)

    def perform(self, context):
        """Return the value of a LaunchConfiguration, '' without one."""
        return context.get(self.args[0], '')


def stand_in(name):
    """A class of its own for each name."""
    return type(name, (Recorded,), {})


@pytest.fixture
def launch(monkeypatch):
    """Stand-ins for the modules of launch."""
    names = {
        'launch': ['LaunchDescription'],
        'launch.actions': ['DeclareLaunchArgument', 'OpaqueFunction'],
        'launch.conditions': ['IfCondition'],
        'launch.substitutions': [
            'LaunchConfiguration',
            'PathJoinSubstitution',
            'PythonExpression',
        ],
        'launch_ros': [],
        'launch_ros.actions': ['Node'],
        'launch_ros.parameter_descriptions': ['ParameterFile', 'ParameterValue'],
        'launch_ros.substitutions': ['FindPackageShare'],
    }
    for module, classes in names.items():
        made = ModuleType(module)
        for name in classes:
            setattr(made, name, stand_in(name))
        monkeypatch.setitem(sys.modules, module, made)
    # It imports its classes of launch anew: the stand-ins here, and not them in a later test.
    name = 'imu_calibration.nodes.launch_arguments'
    monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, name)
    Recorded.made = []


def described(path, context):
    """Record the classes made by a launch file with the launch arguments of `context`."""
    spec = importlib.util.spec_from_file_location('launch_file', path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.generate_launch_description()
    for made in [r for r in Recorded.made if type(r).__name__ == 'OpaqueFunction']:
        made.kwargs['function'](context)
    return module


def test_the_pages_start_launch_files_with_arguments_that_they_declare(launch):
    pages = ''.join((ROOT / name).read_text() for name in ('README.md', 'docs/ros.md'))
    commands = re.findall(
        r'^ros2 launch imu_calibration (\S+)(.*)', pages.replace('\\\n', ' '), re.MULTILINE
    )
    assert len(commands) >= 5
    for name, words in commands:
        Recorded.made = []
        described(ROOT / 'launch' / name, {})
        declared = [r.args[0] for r in Recorded.made if type(r).__name__ == 'DeclareLaunchArgument']
        given = re.findall(r'(\S+):=', words.split('  #')[0])
        assert given and set(given) <= set(declared), (name, given)


@pytest.mark.parametrize(
    'path', sorted((ROOT / 'launch').glob('*.launch.py')), ids=lambda path: path.name
)
def test_arguments_are_declared_and_parameters_exist(path, launch):
    module = described(path, {})
    # a second pass with a value for each optional argument
    Recorded.made = []
    described(path, dict.fromkeys(getattr(module, 'OPTIONAL_PARAMETERS', {}), '1'))
    of_kind = {
        kind: [r for r in Recorded.made if type(r).__name__ == kind]
        for kind in ('DeclareLaunchArgument', 'LaunchConfiguration', 'Node')
    }
    declared = [r.args[0] for r in of_kind['DeclareLaunchArgument']]
    used = {r.args[0] for r in of_kind['LaunchConfiguration']}
    if path.name == 'compensate.launch.py':
        used |= {'frame_prefix'}  # in config/robot_localization_ekf.yaml
    assert sorted(declared) == sorted(used)
    tables = [
        r.kwargs['default_value'].args[0][1]
        for r in of_kind['DeclareLaunchArgument']
        if r.args[0] == 'table'
    ]
    expected = 'table_template.yaml'  # the template is refused
    if path.name == 'demo.launch.py':
        expected = 'table_simulated.yaml'
    assert set(tables) <= {expected}
    for node in of_kind['Node']:
        name = node.kwargs['executable']
        if node.kwargs['package'] != 'imu_calibration':
            continue
        known = {item.name for group in settings_of(name) for item in describe(group)}
        given = {
            key for group in node.kwargs['parameters'] if isinstance(group, dict) for key in group
        }
        assert given <= known | {'use_sim_time'}, name


@pytest.mark.parametrize('verb', ['calibrate', 'compensate', 'drive'])
def test_an_argument_that_is_not_given_keeps_the_parameter_of_the_file(verb, launch):
    given = {'gravity': '9.81', 'noise_file': 'noise.yaml', 'latitude': '48', 'anyway': 'true'}
    expected = {'gravity', 'latitude', 'noise_file'} | (
        {'anyway'} if verb == 'compensate' else set()
    )
    parameters = []
    for context in ({}, given):
        Recorded.made = []
        described(ROOT / f'launch/{verb}.launch.py', context)
        nodes = [
            r
            for r in Recorded.made
            if type(r).__name__ == 'Node' and r.kwargs['package'] == 'imu_calibration'
        ]
        assert all(type(r.kwargs['respawn']).__name__ == 'LaunchConfiguration' for r in nodes)
        groups = [each for each in nodes[0].kwargs['parameters'] if isinstance(each, dict)]
        parameters.append(set().union(*groups))
    assert parameters[0] <= {'table_file', 'use_sim_time', 'urdf_file', 'imu_link'}
    assert parameters[1] - parameters[0] == expected


def test_the_frames_of_the_filter_have_the_prefix_of_the_namespace(launch):
    text = (ROOT / 'config/robot_localization_ekf.yaml').read_text()
    [found] = yaml.safe_load(text.replace('$(var frame_prefix)', 'left/')).values()
    parameters = found['ros__parameters']
    frames = {parameters[name] for name in ('odom_frame', 'base_link_frame', 'world_frame')}
    assert frames == {'left/odom', 'left/base_link'}
    described(ROOT / 'launch/compensate.launch.py', {})
    (file,) = [r for r in Recorded.made if type(r).__name__ == 'ParameterFile']
    assert file.kwargs == {'allow_substs': True}
    (prefix,) = [
        r.kwargs['default_value']
        for r in Recorded.made
        if type(r).__name__ == 'DeclareLaunchArgument' and r.args[0] == 'frame_prefix'
    ]
    before, namespace, after = prefix.args[0]
    assert namespace.args == ('namespace',)
    prefixes = [eval(before + name + after) for name in ('', 'left', '/left')]
    assert prefixes == ['', 'left/', 'left/']


def test_the_filter_of_robot_localization_takes_what_the_compensator_publishes():
    """
    Its parameters are those that its ekf_node documents.

    Fifteen flags for each input, the topic that the launch file remaps.
    """
    [(node, found)] = yaml.safe_load(
        (ROOT / 'config/robot_localization_ekf.yaml').read_text()
    ).items()
    parameters, name = found['ros__parameters'], node.removeprefix('/**/')
    assert (
        node == '/**/ekf_filter_node'  # in any namespace
        and parameters['imu0'] == 'imu/data'
        and f"name='{name}'" in (ROOT / 'launch/compensate.launch.py').read_text()
    )
    assert len(parameters['imu0_config']) == len(parameters['odom0_config']) == 15
    yaw_rate, forward = 11, 12  # of x y z, roll pitch yaw, velocities, rates, accelerations
    assert [k for k, used in enumerate(parameters['imu0_config']) if used] == [yaw_rate, forward]
    assert parameters['imu0_remove_gravitational_acceleration'] and parameters['two_d_mode']
