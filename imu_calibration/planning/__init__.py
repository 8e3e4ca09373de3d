"""
Motions of a table, an arm or a hand for a calibration, and their safe execution.

After the motions every parameter is within its tolerance.

In: a chain of joints with its limits, a model with tolerances, the noise of the IMU, prior
information. Out: motions with joint trajectories, the standard deviations that they promise, a
lower bound on the time of any such plan; trajectories to send, and stops with their reason. Read
`planner` first, then `driver`.
"""
