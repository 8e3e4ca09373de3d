"""
Which effects the evidence of a recording asks for, proven on windows held out.

In: windows, a table and a sensor model. Out: an `Investigation`: the effects named, with their evidence, and the extended model.
Read `investigation` first; a diagnosis is the story told about it.
"""
