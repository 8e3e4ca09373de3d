"""
Where the IMU truly was.

In: a table and readings of its joints. Out: attitude, rate, angular acceleration and specific force at the IMU's stamps.
Read `kinematics` first; joints become curves in `joint_curve`.
"""
