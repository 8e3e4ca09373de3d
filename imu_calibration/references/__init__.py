"""
References: sources of the true motion, and the equations of their parameters.

In: windows of a turntable, or samples of an IMU that was held still in many attitudes. Out:
gathered data, models, solutions. Read `turntable.session_data` and `gravity.hand_calibration`
first; `rows` has what references of few rows have in common.
"""
