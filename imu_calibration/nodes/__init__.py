"""ROS 2 nodes: they read parameters, call the core and publish; no arithmetic lives here."""

from imu_calibration.nodes.early_end import end_quietly_while_importing

end_quietly_while_importing()
