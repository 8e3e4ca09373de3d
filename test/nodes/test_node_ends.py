"""A node that is interrupted while it is still starting ends quietly, with exit code 0."""

import importlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from refusal import refused

from imu_calibration.core.settings import describe
from imu_calibration.nodes import is_node_process
from imu_calibration.nodes.lifecycle import settings_of

from ros.live_station import TABLE

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.live
# Short sleeps: the handler of a signal that arrives just before a sleep runs after it.
SLOW_IMPORT = """
import pathlib, time
pathlib.Path({mark!r}).touch()
for _ in range(600):
    time.sleep(0.1)
"""
EARLY = """
import os, signal, sys
import rclpy
from imu_calibration.nodes.lifecycle import run_node
init = rclpy.init
def interrupted(args=None):
    os.kill(os.getpid(), signal.SIGINT)
    init(args=args)
rclpy.init = interrupted
def spin(node):
    raise SystemExit('it did not end')
sys.exit(run_node(lambda: rclpy.create_node('early'), [], spin=spin))
"""


UNWOKEN = """
import os, sys, threading, time
import rclpy
from imu_calibration.nodes.lifecycle import run_node
def end():
    time.sleep(1.0)
    print('alive for 1 s', flush=True)
    context = rclpy.get_default_context().handle
    with context:
        context.shutdown()
    time.sleep(20.0)
    os._exit(3)
def make():
    node = rclpy.create_node('idle')
    threading.Thread(target=end, daemon=True).start()
    return node
sys.exit(run_node(make, []))
"""


def environment(*folders):
    """The environment of a process that imports from here."""
    path = os.pathsep.join([*map(str, folders), str(ROOT), os.environ.get('PYTHONPATH', '')])
    return {**os.environ, 'PYTHONPATH': path, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}


@pytest.mark.parametrize(
    'node',
    ['calibration_node', 'compensator_node', 'simulator_node', 'bag_player_node', 'planner_node'],
)
def test_interrupted_while_importing(node, tmp_path):
    mark = tmp_path / 'importing'
    (tmp_path / 'rclpy').mkdir()
    (tmp_path / 'rclpy' / '__init__.py').write_text(SLOW_IMPORT.format(mark=str(mark)))
    process = subprocess.Popen(
        [sys.executable, '-m', f'imu_calibration.nodes.{node}'],
        env=environment(tmp_path),
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 60
    while not mark.exists():
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    out, error = process.communicate(timeout=20)
    assert (process.returncode, out, error) == (0, '', '')


ENDS = """
import sys
import rclpy
from types import SimpleNamespace
from imu_calibration.nodes.lifecycle import run_node
def spin(node):
    {what}
sys.exit(run_node(lambda: rclpy.create_node('ends'), [], spin=spin))
"""


@pytest.mark.parametrize(
    ('what', 'code', 'words'),
    (
        (
            "raise ValueError('nobody foresaw this')",
            1,
            'error: the node cannot continue: ValueError: nobody foresaw this\n',
        ),
        (
            (
                "raise __import__('imu_calibration.core.errors', fromlist=['x']).InputError('a bag"
                " must be there; name one')"
            ),
            1,
            'error: a bag must be there; name one\n',
        ),
        ('node.failed = True', 1, ''),
        ('pass', 0, ''),
    ),
    ids=('unforeseen', 'refused', 'failed', 'done'),
)
def test_a_node_that_cannot_go_on_says_so_and_ends_with_another_code(what, code, words):
    pytest.importorskip('rclpy')
    done = subprocess.run(
        [sys.executable, '-c', ENDS.format(what=what)],
        env=environment(),
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (done.returncode, done.stderr) == (code, words)


@pytest.mark.parametrize('node', ('calibration_node', 'compensator_node'))
def test_help_says_what_a_node_does_and_lists_every_parameter(node, capsys):
    pytest.importorskip('rclpy')
    module = importlib.import_module(f'imu_calibration.nodes.{node}')
    assert module.main(['--help']) == 0
    text = capsys.readouterr().out
    assert (
        text.startswith(f'usage: ros2 run imu_calibration {node} --ros-args')
        and '/diagnostics' in text
    )
    assert all(
        f'\n  {item.name}: ' in text for group in settings_of(node) for item in describe(group)
    )
    assert (
        module.main(['--calibration', 'a.yaml']) == 1
        and "'--calibration'" in capsys.readouterr().err
    )


def test_interrupted_while_ros_starts():
    pytest.importorskip('rclpy')
    done = subprocess.run(
        [sys.executable, '-c', EARLY], env=environment(), capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stderr) == (0, '')


def test_a_node_without_work_ends_although_nothing_wakes_it():
    """
    The second half of the things that rclpy does at a signal.

    It runs after an executor that had woken in the first half waits again.
    """
    pytest.importorskip('rclpy')
    done = subprocess.run(
        [sys.executable, '-c', UNWOKEN],
        env=environment(),
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, 'alive for 1 s\n', '')


def test_other_programs_keep_their_interrupt(monkeypatch):
    handler = (
        'import signal, sys; before = signal.getsignal(signal.SIGINT); import'
        ' imu_calibration.nodes; '
    )
    done = subprocess.run(
        [sys.executable, '-c', handler + 'sys.exit(signal.getsignal(signal.SIGINT) is not before)'],
        env=environment(),
        timeout=60,
    )
    assert done.returncode == 0 and not is_node_process()
    monkeypatch.setattr(
        sys, 'argv', ['/opt/ros/lib/imu_calibration/calibration_node', '--ros-args']
    )
    assert is_node_process()
    monkeypatch.setattr(sys, 'argv', ['/home/me/ws/install/mine/lib/mine/my_node'])
    assert not is_node_process()


PUBLISHES = '''
import sys
import rclpy
from imu_calibration.nodes.compensator_node import CompensatorNode
from imu_calibration.nodes.planner_node import PlannerNode
from imu_calibration.nodes.lifecycle import run_node

def spin(node):
    """A signal ends the context while a callback runs."""
    rclpy.try_shutdown()
    node._guarded(broken)()
    statuses = node.diagnostics if isinstance(node, CompensatorNode) else node._diagnostics
    statuses.publish_now()

def broken():
    raise rclpy.handle.InvalidHandle('Failed to publish')
kind = CompensatorNode if sys.argv[1] == 'compensator' else PlannerNode
sys.exit(run_node(kind, sys.argv[2:], spin=spin))
'''


@pytest.mark.parametrize('name', ['compensator', 'planner'])
def test_what_cannot_be_published_at_the_end_is_not_printed(name):
    parameters = ['--ros-args', '-p', f'table_file:={TABLE}'] if name == 'planner' else []
    done = subprocess.run(
        [sys.executable, '-c', PUBLISHES, name, *parameters],
        env=environment(),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert 'Failed to publish' not in done.stderr + done.stdout and 'Error' not in done.stderr


def test_a_node_without_ros_ends_with_one_line(monkeypatch, capsys):
    from imu_calibration import nodes

    nodes.require_rclpy()  # this process is no node
    monkeypatch.setattr(nodes, 'is_node_process', lambda: True)
    monkeypatch.setattr(nodes, 'find_spec', lambda name: None)
    with pytest.raises(SystemExit) as ended:
        nodes.require_rclpy()
    assert ended.value.code == 1 and capsys.readouterr().err.count('\n') == 1


@pytest.mark.parametrize('module', ['urdf_parser_py.urdf', 'xacro'])
def test_a_robot_description_without_its_packages_is_refused_with_the_extra(
    monkeypatch, tmp_path, module
):
    from imu_calibration.core.errors import InputError
    from imu_calibration.document import files
    from imu_calibration.kinematics.urdf import table_from_urdf

    monkeypatch.setitem(sys.modules, module, None)
    path = tmp_path / ('arm.xacro' if module == 'xacro' else 'arm.urdf')
    path.write_text('<robot name="a"><link name="base"/></robot>')
    with refused(InputError, 'package_missing', 'imu_calibration[arm]'):
        table_from_urdf(
            files.read_robot_description(path, allow_xacro=True), 'base', {'gravity': 9.8}
        )


@pytest.mark.live
def test_nodes_limit_the_threads_of_numpy_before_it_is_imported():
    code = (
        "import os, sys, imu_calibration.nodes; print('numpy' in sys.modules,"
        " os.environ['OPENBLAS_NUM_THREADS'])"
    )
    given = {name: value for name, value in os.environ.items() if name != 'OPENBLAS_NUM_THREADS'}
    done = subprocess.run(
        [sys.executable, '-c', code],
        cwd=ROOT,
        env=given,
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert done.stdout.split() == ['False', '1']
