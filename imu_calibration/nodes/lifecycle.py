"""From start to end of a node's process: exit code 0 after SIGINT and SIGTERM, one line and 1 when it cannot run."""

import signal
import sys

import rclpy
from rclpy.executors import ExternalShutdownException

from imu_calibration.errors import ImuCalibrationError


def run_node(make_node, arguments=None, spin=None, hints=None):
    """
    Run one node until the process is asked to end, and return the exit code.

    Parameters
    ----------
    make_node : callable
        Returns the node; an `ImuCalibrationError` becomes one line on standard error and exit code 1. A method `close` of the
        node is called before it is destroyed.
    arguments : list of str, optional
        Command line; default ``sys.argv``.
    spin : callable, optional
        Called with the node, returns or raises ExternalShutdownException when the context ends; default ``rclpy.spin``.
    hints : dict, optional
        As for `errors.with_hint`.

    """
    # rclpy's handler, installed by init, ends the wait; without this line Python would also raise KeyboardInterrupt in mid-write.
    early = []
    signal.signal(signal.SIGINT, lambda number, frame: early.append(number))
    rclpy.init(args=arguments)
    node = None
    try:
        if early:   # before rclpy could take note of it
            return 0
        node = make_node()
        (spin or rclpy.spin)(node)
    except (ExternalShutdownException, KeyboardInterrupt):
        pass
    except ImuCalibrationError as error:
        print(f'error: {error.told(hints or {})}', file=sys.stderr, flush=True)
        return 1
    except Exception:
        # A context that ends while something is being made or published fails in many ways; none of them is news.
        if rclpy.ok():
            raise
    finally:
        _end(node)
    return 0


def _end(node):
    if node is not None:
        if hasattr(node, 'close'):
            node.close()
        node.destroy_node()
    rclpy.try_shutdown()
