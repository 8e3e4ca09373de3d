"""
What estimates of any reference have in common.

In: a sensor model and `Rows`. Out: a `Solution` with its covariance terms, the noise model. Read
`rows` first, then `estimate` and `solution`. How values are found is in the references:
`references.turntable.estimation` and `references.rows`. No window, no pose and no table is known
here.
"""
