"""
Selection of the effects that a recording supports, proven on held-out windows.

In: windows, a table and a sensor model. Out: an `Investigation`: the effects named, with their evidence, and the extended model.
Read `investigation` first; a diagnosis is its description.
"""
