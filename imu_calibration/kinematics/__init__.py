"""
Motion of the reference, and strapdown integration of measured motion.

In: a table and readings of its joints. Out: attitude, rate, angular acceleration and specific force
at the IMU's stamps. Read `chain` first; joints become curves in `joint_curve`.
"""
