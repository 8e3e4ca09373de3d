"""
Launch files: every argument that is used is declared, every parameter exists.

`launch` itself is replaced, it is not on PyPI.
"""

import importlib.util
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


def stand_in(name):
    """A class of its own for each name."""
    return type(name, (Recorded,), {})


@pytest.fixture
def launch(monkeypatch):
    """Stand-ins for the modules of launch."""
    names = {
        'launch': ['LaunchDescription'],
        'launch.actions': ['DeclareLaunchArgument'],
        'launch.conditions': ['IfCondition'],
        'launch.substitutions': ['LaunchConfiguration', 'PathJoinSubstitution'],
        'launch_ros': [],
        'launch_ros.actions': ['Node'],
        'launch_ros.parameter_descriptions': ['ParameterValue'],
        'launch_ros.substitutions': ['FindPackageShare'],
    }
    for module, classes in names.items():
        made = ModuleType(module)
        for name in classes:
            setattr(made, name, stand_in(name))
        monkeypatch.setitem(sys.modules, module, made)
    Recorded.made = []


@pytest.mark.parametrize(
    'path', sorted((ROOT / 'launch').glob('*.launch.py')), ids=lambda path: path.name
)
def test_arguments_are_declared_and_parameters_exist(path, launch):
    spec = importlib.util.spec_from_file_location('launch_file', path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.generate_launch_description()
    of_kind = {
        kind: [r for r in Recorded.made if type(r).__name__ == kind]
        for kind in ('DeclareLaunchArgument', 'LaunchConfiguration', 'Node')
    }
    declared = [r.args[0] for r in of_kind['DeclareLaunchArgument']]
    assert sorted(declared) == sorted({r.args[0] for r in of_kind['LaunchConfiguration']})
    tables = [
        r.kwargs['default_value'].args[0][1]
        for r in of_kind['DeclareLaunchArgument']
        if r.args[0] == 'table'
    ]
    assert tables in (
        [],
        ['table_simulated.yaml' if path.name == 'demo.launch.py' else 'table_template.yaml'],
    )  # the template is refused
    for node in of_kind['Node']:
        name = node.kwargs['executable']
        if node.kwargs['package'] != 'imu_calibration':
            continue
        known = {item.name for group in settings_of(name) for item in describe(group)}
        given = {
            key for group in node.kwargs['parameters'] if isinstance(group, dict) for key in group
        }
        assert given <= known | {'use_sim_time'}, name


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
