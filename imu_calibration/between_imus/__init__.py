"""
Position of one IMU relative to another on the same rigid body.

In: recordings of two IMUs that move together. Out: their relative arm with its covariance.
Read `arm` first.
"""
