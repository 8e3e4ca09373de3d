"""The tree builds as a ROS 2 workspace, and every executable starts from it."""

import os
import signal
import subprocess
import time
import uuid
from pathlib import Path

import pytest

from ros.workspace import plain_environment

ROOT = Path(__file__).resolve().parents[2]
NODES = (
    'calibration_node',
    'compensator_node',
    'simulator_node',
    'bag_player_node',
    'planner_node',
)
EXECUTABLES = ('imu_calibration', *NODES)

TABLE = 'table_file:={config}/table_simulated.yaml'
PARAMETERS = {'calibration_node': [TABLE], 'simulator_node': [TABLE], 'compensator_node': []}

LOCAL = {'ROS_DOMAIN_ID': str(1 + os.getpid() % 100), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}

pytestmark = [pytest.mark.slow, pytest.mark.live]


@pytest.fixture(scope='module')
def workspace(built):
    """A workspace with this tree built in it."""
    return built


@pytest.fixture(scope='module')
def graph():
    """A node that looks at the graph of this host, in a domain of its own."""
    import rclpy

    with pytest.MonkeyPatch.context() as patch:
        for key, value in LOCAL.items():
            patch.setenv(key, value)
        context = rclpy.Context()
        rclpy.init(context=context)
        node = rclpy.create_node('watcher', context=context)
        yield node
        node.destroy_node()
        context.try_shutdown()


def sourced(workspace, *command, **options):
    """Run `command` in a shell that has sourced the workspace, away from the checkout."""
    script = f'. {workspace}/install/setup.bash && exec "$@"'
    return subprocess.run(
        ['bash', '-c', script, 'bash', *map(str, command)],
        cwd=workspace,
        env=plain_environment(),
        capture_output=True,
        text=True,
        timeout=120,
        **options,
    )


def prefix(workspace):
    """Where the package was installed."""
    return workspace / 'install' / 'imu_calibration'


@pytest.mark.parametrize('name', EXECUTABLES)
def test_executables_lie_where_ros2_run_and_the_shell_look(workspace, name):
    assert os.access(prefix(workspace) / 'lib' / 'imu_calibration' / name, os.X_OK)
    found = sourced(workspace, 'bash', '-c', f'type -p {name}')
    assert found.stdout.strip() == str(prefix(workspace) / 'bin' / name)


def test_the_ament_index_finds_the_package_with_its_files(workspace):
    script = (
        'from ament_index_python.packages import get_package_share_directory as share;'
        ' print(share("imu_calibration"))'
    )
    done = sourced(workspace, 'python', '-c', script)
    assert done.returncode == 0, done.stderr
    share = Path(done.stdout.strip())
    assert share == prefix(workspace) / 'share' / 'imu_calibration'
    for folder, pattern in (('config', '*.*'), ('launch', '*.launch.py')):
        source = sorted(path.name for path in (ROOT / folder).glob(pattern))
        assert (
            source
            and sorted(path.name for path in (share / folder).iterdir() if path.is_file()) == source
        )
    assert (share / 'package.xml').is_file()


def test_the_code_and_its_files_come_from_the_workspace(workspace):
    script = (
        'import imu_calibration, msg_adapters; from imu_calibration.api.resources import'
        ' config_file; print(imu_calibration.__file__, msg_adapters.__file__,'
        ' config_file("tolerances.yaml"))'
    )
    done = sourced(workspace, 'python', '-c', script)
    assert done.returncode == 0, done.stderr
    assert all(name.startswith(str(prefix(workspace))) for name in done.stdout.split())


@pytest.mark.parametrize('folder', ['bin', 'lib/imu_calibration'])
def test_the_command_line_starts(workspace, folder):
    done = sourced(workspace, prefix(workspace) / folder / 'imu_calibration', '--help')
    assert done.returncode == 0, done.stderr
    for verb in ('inspect', 'calibrate', 'compensate', 'simulate', 'compare'):
        assert verb in done.stdout


@pytest.mark.parametrize('name', PARAMETERS)
def test_a_node_joins_the_graph_and_ends_on_sigint(workspace, graph, name):
    namespace = f'build_{uuid.uuid4().hex}'
    config = prefix(workspace) / 'share' / 'imu_calibration' / 'config'
    parameters = [word for text in PARAMETERS[name] for word in ('-p', text.format(config=config))]
    command = [
        prefix(workspace) / 'lib' / 'imu_calibration' / name,
        '--ros-args',
        '-r',
        f'__ns:=/{namespace}',
        *parameters,
    ]
    with subprocess.Popen(
        [
            'bash',
            '-c',
            f'. {workspace}/install/setup.bash && exec "$@"',
            'bash',
            *map(str, command),
        ],
        cwd=workspace,
        env=plain_environment() | LOCAL,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            until = time.monotonic() + 60.0
            while f'/{namespace}/{name}/get_type_description' not in dict(
                graph.get_service_names_and_types()
            ):
                assert process.poll() is None, process.stderr.read()
                assert time.monotonic() < until, f'{name} did not join the graph'
                time.sleep(0.1)
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=30)
        finally:
            process.kill()
    assert process.returncode == 0, errors


def test_a_player_without_a_bag_refuses_in_one_line(workspace):
    done = sourced(workspace, prefix(workspace) / 'lib' / 'imu_calibration' / 'bag_player_node')
    assert done.returncode == 1
    assert 'bag' in done.stderr and 'Traceback' not in done.stderr
