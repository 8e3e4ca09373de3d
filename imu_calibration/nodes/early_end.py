"""A node that is asked to end while its modules are still being imported: it ends at once, without a traceback."""

import os
import signal
import sys

NAMES = ('calibration_node', 'compensator_node', 'simulator_node', 'bag_player_node', 'planner_node')
"""Executables of this package; the nodes of other packages that import it keep their own interrupt."""


def end_quietly_while_importing() -> None:
    """Let SIGINT end the process with exit code 0 until `lifecycle.run_node` takes over; does nothing in other programs."""
    if is_node_process():
        # Nothing is open yet; an exception would go through whatever is being imported.
        signal.signal(signal.SIGINT, lambda number, frame: os._exit(0))


def is_node_process() -> bool:
    """Return whether this process was started to run one of the nodes, by its executable or by ``python -m``."""
    if sys.argv[:1] == ['-m']:
        return any(argument.startswith('imu_calibration.nodes.') for argument in sys.orig_argv)
    return bool(sys.argv) and os.path.basename(sys.argv[0]) in NAMES
