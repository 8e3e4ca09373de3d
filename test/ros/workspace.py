"""
This tree built as a ROS 2 workspace, and shells in it.

With the `ros2` command line where its wheels are.
"""

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
VARIABLE = 'IMU_CALIBRATION_ROS2'
NOT_SOURCE = shutil.ignore_patterns(
    '.git',
    '.venv*',
    '.hypothesis',
    '.pytest_cache',
    '__pycache__',
    '*.egg-info',
    'build',
    'install',
    'log',
    'demo',
    'out',
)
NEEDED = (
    'argcomplete',
    'packaging',
    'psutil',
    'lark',
    'catkin_pkg',
)
"""What ros2cli imports beside rclpy."""
COMPONENTS = """
class _Absent:
    class Request: pass
    class Response: pass
class LoadNode(_Absent): pass
class UnloadNode(_Absent): pass
class ListNodes(_Absent): pass
"""
"""Three service types that launch_ros imports and nothing here calls; they have no wheel."""


def build(folder):
    """Build this tree in the workspace `folder`."""
    shutil.copytree(ROOT, folder / 'src' / 'imu_calibration', ignore=NOT_SOURCE)
    done = subprocess.run(
        [sys.executable, '-m', 'colcon', 'build'],
        cwd=folder,
        env=plain_environment(),
        capture_output=True,
        text=True,
        timeout=300,
    )
    logs = '\n'.join(
        path.read_text() for path in sorted(folder.glob('log/latest_build/*/std*.log'))
    )
    assert done.returncode == 0, done.stdout + done.stderr + logs


def plain_environment():
    """The environment of a shell outside the checkout, with this interpreter first on PATH."""
    environment = {
        k: v for k, v in os.environ.items() if not k.startswith(('PYTEST', 'COLCON', 'PYTHONPATH'))
    }
    environment['PATH'] = os.pathsep.join([str(Path(sys.executable).parent), os.environ['PATH']])
    if 'ROS_DISTRO' in os.environ and 'PYTHONPATH' in os.environ:
        environment['PYTHONPATH'] = os.environ['PYTHONPATH']
    return environment


def sourced(folder, script):
    """The command that runs a line of shell in the sourced workspace."""
    return ['bash', '-c', f'. {folder}/install/setup.bash && {script}']


def with_ros2(folder):
    """
    The environment of `plain_environment` with the real `ros2`.

    That of a sourced ROS, else from the wheels that `IMU_CALIBRATION_ROS2` names.

    Parameters
    ----------
    folder : Path
        Where the wheels are installed to, unless it has them.

    """
    if shutil.which('ros2'):
        return plain_environment()
    wheels = sorted(
        Path(os.environ.get(VARIABLE, ROOT.parents[0] / 'shared' / 'ros2')).glob('*.whl')
    )
    if not any(wheel.name.startswith('ros2cli-') for wheel in wheels):
        pytest.skip(f'no ros2 command and no wheels of ros2cli; set {VARIABLE} to their folder')
    install = [
        sys.executable,
        '-m',
        'pip',
        '--disable-pip-version-check',
        '--no-input',
        'install',
        '--quiet',
        '--target',
        str(folder),
    ]
    if any(folder.iterdir()):
        return _with_packages_of(folder)
    needed = [name for name in NEEDED if importlib.util.find_spec(name.replace('-', '_')) is None]
    done = subprocess.run(
        [*install, '--no-compile', '--no-deps', *map(str, wheels), *needed],
        capture_output=True,
        text=True,
        timeout=300,
    )
    if done.returncode:
        pytest.skip(f'ros2cli cannot be installed here: {done.stderr.strip().splitlines()[-1]}')
    (folder / 'composition_interfaces' / 'srv').mkdir(parents=True)
    (folder / 'composition_interfaces' / '__init__.py').touch()
    (folder / 'composition_interfaces' / 'srv' / '__init__.py').write_text(COMPONENTS)
    return _with_packages_of(folder)


def _with_packages_of(folder):
    environment = plain_environment()
    environment['PATH'] = os.pathsep.join([str(folder / 'bin'), environment['PATH']])
    environment['PYTHONPATH'] = os.pathsep.join(
        filter(None, [str(folder), environment.get('PYTHONPATH', '')])
    )
    return environment | {'AMENT_PREFIX_PATH': sys.prefix}
