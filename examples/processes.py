"""
Nodes as processes of their own, without `ros2 run`.

For demonstrations, measurements and tests on one host.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
END_TIMEOUT = 30.0
"""Longest time for a node to end, s."""


def local_environment(domain_id: int) -> dict[str, str]:
    """Return an environment in which DDS is limited to this host and a separate domain."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get('PYTHONPATH', '')]))
    return {
        **os.environ,
        'ROS_DOMAIN_ID': str(domain_id),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'PYTHONPATH': path,
        'OMP_NUM_THREADS': '1',
        'OPENBLAS_NUM_THREADS': '1',
    }


def node_command(
    name: str,
    parameters: Mapping | None = None,
    *,
    remappings: Mapping | None = None,
    namespace: str = '',
    node_name: str | None = None,
    parameter_file: Any = None,
) -> list[str]:
    """
    Return the command that runs a node of this package.

    Parameters
    ----------
    name : str
        Executable, such as 'calibration_node'.
    parameters, remappings : dict, optional
        Name -> value, name -> new name.
    namespace, node_name : str, optional
    parameter_file : path-like, optional

    """
    command = [sys.executable, '-m', f'imu_calibration.nodes.{name}', '--ros-args']
    if parameter_file:
        command += ['--params-file', str(parameter_file)]
    for key, value in (parameters or {}).items():
        command += ['-p', f'{key}:={_text(value)}']
    renamed = dict(remappings or {})
    renamed |= {'__ns': namespace} if namespace else {}
    renamed |= {'__node': node_name} if node_name else {}
    for old, new in renamed.items():
        command += ['-r', f'{old}:={new}']
    return command


def _text(value):
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (str, Path)):
        return f"'{value}'"
    return repr(value)


class NodeProcesses:
    """Processes of one DDS domain; as a context manager it ends all of them."""

    def __init__(self, domain_id: int):
        self.environment, self.running = local_environment(domain_id), []

    def start(
        self, name: str, parameters: Mapping | None = None, output: Any = None, **options: Any
    ) -> subprocess.Popen:
        """
        Start a node (see `node_command`) and return its Popen; `output` is a file for its output.
        """
        process = subprocess.Popen(
            node_command(name, parameters, **options),
            env=self.environment,
            stdout=output,
            stderr=output,
            stdin=subprocess.DEVNULL,
        )
        self.running.append(process)
        return process

    def end(
        self, process: subprocess.Popen, number: int = signal.SIGINT, timeout: float = END_TIMEOUT
    ) -> int:
        """Send a signal and return the exit code; kill a process that does not end in time."""
        if process.poll() is None:
            process.send_signal(number)
        try:
            process.wait(timeout)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        self.running = [other for other in self.running if other is not process]
        return process.returncode

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        for process in self.running:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        deadline = time.monotonic() + END_TIMEOUT
        for process in list(self.running):
            self.end(process, timeout=max(0.1, deadline - time.monotonic()))
