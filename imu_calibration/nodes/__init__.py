"""
ROS 2 nodes: they read parameters, call the core and publish; no arithmetic lives here.

In: topics, services, parameters. Out: topics, diagnostics, files.
Read `calibration_node` and `compensator_node` first.
"""

import os
import signal
import sys
from importlib.util import find_spec

NODE_NAMES = (
    'calibration_node',
    'compensator_node',
    'simulator_node',
    'bag_player_node',
    'planner_node',
)
"""
Executables of this package; the nodes of other packages that import it keep their own interrupt.
"""


def end_quietly_while_importing() -> None:
    """
    Let SIGINT end the process with exit code 0 until `lifecycle.run_node` handles it.

    No effect in other programs.
    """
    if is_node_process():
        # No file is open yet; an exception would pass through the module under import.
        signal.signal(signal.SIGINT, lambda number, frame: os._exit(0))


def require_rclpy() -> None:
    """
    End a node's process with one line and exit code 1 where ROS is not installed.

    No effect in other programs.
    """
    if is_node_process() and find_spec('rclpy') is None:
        print(
            'a node needs ROS 2 (rclpy), it is not installed; source a ROS 2 Jazzy workspace, or'
            ' use the command line imu_calibration, which needs no ROS',
            file=sys.stderr,
        )
        raise SystemExit(1)


def is_node_process() -> bool:
    """
    Return whether this process was started to run one of the nodes.

    By its executable or by ``python -m``.
    """
    if sys.argv[:1] == ['-m']:
        return any(argument.startswith('imu_calibration.nodes.') for argument in sys.orig_argv)
    return bool(sys.argv) and os.path.basename(sys.argv[0]) in NODE_NAMES


# As the command line does, before numpy is imported.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
end_quietly_while_importing()
require_rclpy()
