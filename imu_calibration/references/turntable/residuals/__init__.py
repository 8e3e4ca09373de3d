"""
Analysis of the residual of windows on a table, beyond the catalogue of effects.

In: an `Investigation`. Out: regimes, spectrum, a proposed formula, an onset. Read
`residual_analysis` first.
"""
