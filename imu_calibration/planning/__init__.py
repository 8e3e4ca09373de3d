"""
Motion planning: motions of a table, an arm or a hand after which every parameter is within its tolerance.

In: a chain of joints with its limits, a model with tolerances, the noise of the IMU, prior information. Out: motions with joint
trajectories, the standard deviations that they promise, and a lower bound on the time of any such plan. Read `planner.py` first.
"""
