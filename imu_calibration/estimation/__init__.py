"""
Rows become a solution.

In: rows of any reference (`accumulated_rows`, or a `RowSet` with nuisances) and a sensor model.
Out: parameters with their covariance, the noise, the observable effects. Read `solver` first,
`row_estimate` for other references than a table; the noise is described in `noise_model` and found
in `noise_search`. No window, no pose and no table is known here.
"""
