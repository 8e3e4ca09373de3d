"""
Nodes as processes that are forked from one that has imported most of them: a second less each.

Parameters, signals, exit codes and output are those of a process of its own, which is needed where
the import of a node, or the end of the interpreter after its main function, is tested.
"""

import contextlib
import importlib
import multiprocessing
import os
import signal
import subprocess
import sys

from without_search import candidates_in_scripts

from examples.processes import NodeProcesses, node_command

CANDIDATES = 'IMU_CALIBRATION_TEST_CANDIDATES'
"""Environment variable of a node: the candidates of its search for effects on a table."""
PRELOADED = (
    'imu_calibration.references.turntable.live_diagnosis',
    'imu_calibration.calibration.live',
    'imu_calibration.references.gravity.live_poses',
    'imu_calibration.compensation.health',
    'imu_calibration.compensation.stream',
    'imu_calibration.compensation.unit_gate',
    'imu_calibration.planning.campaign',
    'imu_calibration.planning.driver',
    'imu_calibration.planning.planner',
    'imu_calibration.simulation.profiles',
    'imu_calibration.simulation.session',
    'imu_calibration.api.choices',
    'imu_calibration.api.recordings',
    'msg_adapters.bag',
    'msg_adapters.live',
    # What nodes import later, where they need it first.
    'scipy.interpolate',
    'scipy.optimize',
    'scipy.stats',
    # What rclpy imports.
    'diagnostic_msgs.msg',
    'rcl_interfaces.msg',
    'rcl_interfaces.srv',
    'rosidl_generator_py',
    'sensor_msgs.msg',
    'std_msgs.msg',
    'std_srvs.srv',
    'trajectory_msgs.msg',
    'visualization_msgs.msg',
    'yaml',
)
"""
What nodes import, except rclpy: its libraries give all processes that are forked afterwards the
same identity in DDS.
"""


def _server():
    """Return the context whose processes are forked from one that has imported `PRELOADED`."""
    context = multiprocessing.get_context('forkserver')
    context.set_forkserver_preload(list(PRELOADED))
    return context


def _run(command, folder, environment, output):
    """Run a node in the forked process, which ends with its exit code."""
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    if output:
        opened = os.open(output, os.O_WRONLY | os.O_APPEND)
        for number in (1, 2):
            os.dup2(opened, number)
    _, _, module, *arguments = command
    sys.argv = [module, *arguments]
    candidates = environment.get(CANDIDATES)
    with candidates_in_scripts(candidates) if candidates else contextlib.nullcontext():
        sys.exit(importlib.import_module(module).main())


class ForkedNode:
    """A forked process with the methods of `subprocess.Popen` that tests use."""

    def __init__(self, command, environment, output):
        self.args = command
        self._process = _server().Process(
            target=_run, args=(command, os.getcwd(), environment, output)
        )
        self._process.start()
        self.pid = self._process.pid

    @property
    def returncode(self):
        """The exit code, minus the number of a signal, None while it runs."""
        return self._process.exitcode

    def poll(self):
        """Return the exit code, None while it runs."""
        return self.returncode

    def wait(self, timeout=None):
        """Return the exit code once it has ended."""
        self._process.join(timeout)
        if self.returncode is None:
            raise subprocess.TimeoutExpired(self.args, timeout)
        return self.returncode

    def send_signal(self, number):
        """Send a signal unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self):
        """End it at once."""
        self.send_signal(signal.SIGKILL)


class ForkedNodes(NodeProcesses):
    """Forked processes of one DDS domain."""

    def start(self, name, parameters=None, output=None, candidates='', **options):
        """
        Start a node and return its ForkedNode.

        Parameters
        ----------
        name : str
        parameters : dict, optional
        output : file, optional
            For its output.
        candidates : str
            Effects of the catalogue that its search on a table tests; '': all of them.
        **options
            As for `node_command`.

        """
        command = node_command(name, parameters, **options)
        environment = self.environment | ({CANDIDATES: candidates} if candidates else {})
        process = ForkedNode(command, environment, output.name if output else None)
        self.running.append(process)
        return process
