"""
ROS 2 nodes: they read parameters, call the core and publish; no arithmetic lives here.

In: topics, services, parameters. Out: topics, diagnostics, files.
Read `calibration_node` and `compensator_node` first.
"""

from imu_calibration.nodes.early_end import end_quietly_while_importing, require_rclpy

end_quietly_while_importing()
require_rclpy()
