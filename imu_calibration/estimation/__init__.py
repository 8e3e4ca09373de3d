"""
What estimates of any reference have in common.

In: a sensor model, rows or normal matrices. Out: a `Solution` with its covariance terms, the noise
model. Read `solution` first, then `noise_model`. The solvers are those of
the references: `references.turntable.estimation` and `references.rows`. No window, no pose and no
table is known here.
"""
