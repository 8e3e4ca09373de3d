"""
Diagnosis of model errors and their causes: a description of the result of `selection`.

In: windows and a sensor model. Out: a `Diagnosis`: findings as sentences, the extended model, the
gain on held-out windows, the unexplained residual. Read `findings` first.
"""
