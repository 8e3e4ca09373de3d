"""
Estimates and choice of effects for references of few rows: gravity, or a topic of poses.

In: a `RowSet` with its nuisances. Out: a `RowEstimate`, its model error, and the effects that the
rows support. Read `row_estimate` first, then `row_search`. A table has too many rows to store, and
its reference accumulates them.
"""
