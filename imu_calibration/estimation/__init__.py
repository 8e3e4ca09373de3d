"""
Windows become a solution.

In: windows and a sensor model. Out: parameters with their covariance, the noise, the observable
effects. Read `solver` first, `row_estimate` for other references than a table; the noise is
described in `noise_model` and found in `noise_search`.
"""
