"""
Selection of the effects that a recording supports, and analysis of the residual.

The effects are proven on held-out windows.

In: windows, a table and a sensor model. Out: an `Investigation`: the effects named, with their
evidence, the extended model, and for the unexplained excess its regimes and a proposed formula.
Read `investigation` first, then `unexplained`.
"""
