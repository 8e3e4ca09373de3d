"""
Estimates and choice of effects for references of few rows: gravity, or a topic of poses.

In: `Rows` with nuisances. Out: a `RowEstimate`, its model error, and the effects that the rows
support. Read `row_estimate` first, then `row_search`. The steps of an estimate, the evidence and
the order of tests are those of any reference (`estimation`, `selection`).
"""
