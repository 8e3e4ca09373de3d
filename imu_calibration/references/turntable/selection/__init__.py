"""
Choice of the effects that windows on a table support, tested on held-out windows.

In: windows, a table and a sensor model. Out: an `Investigation`. Read `investigation` first, then
`reduced_recording` and `window_evidence`.
"""
