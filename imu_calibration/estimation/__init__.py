"""
Windows become a solution.

In: windows and a sensor model. Out: parameters with their covariance, the noise, what is observable.
Read `solver` first; the noise is described in `noise_model` and judged by `restricted_likelihood`.
"""
