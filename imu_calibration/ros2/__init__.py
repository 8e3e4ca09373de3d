"""
Extensions of the `ros2` command line: ``ros2 imu VERB`` and a check for ``ros2 doctor``.

In: entry points, topics. Out: the verbs of `imu_calibration.cli`, findings of `imu_calibration.preflight`.
Read `command` first.
"""
