"""
Driving joints through motions, safely.

In: motions from a planner and measured joint states. Out: trajectories to send, times of measurement, and stops with their reason.
Read `driver` first.
"""
