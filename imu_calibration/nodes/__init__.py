"""
ROS 2 nodes: they read parameters, call the core and publish; no arithmetic lives here.

In: topics, services, parameters. Out: topics, diagnostics, files.
Read `calibration_node` and `compensator_node` first.
"""

import os

from imu_calibration.nodes.early_end import end_quietly_while_importing, require_rclpy

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')   # as the command line does, before numpy is imported
end_quietly_while_importing()
require_rclpy()
