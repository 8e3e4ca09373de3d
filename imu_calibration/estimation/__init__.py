"""
Rows become a solution.

In: rows (`accumulated_rows`) and a sensor model. Out: parameters with their covariance, the noise,
the observable effects. Read `solver` first, `references.rows` for other references than a table;
the noise is described in `noise_model` and found in `noise_search`. No window, no pose and no table
is known here.
"""
