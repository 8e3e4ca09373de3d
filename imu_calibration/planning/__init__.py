"""
Which motion next: what a table, an arm or a hand should do so that every parameter comes within its tolerance.

In: a chain of joints with its limits, a model with tolerances, the noise of the IMU, what is known already. Out: motions with joint
trajectories, the standard deviations that they promise, and a lower bound on the time of any such plan. Read `planner.py` first.
"""
