"""
Windows of a table become a solution.

In: accumulated rows of windows and a sensor model. Out: a `Solution` with its noise. Read `solver`
first, then `weighted_system`; the noise is found in `session_noise`.
"""
