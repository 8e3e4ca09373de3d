"""
What the model gets wrong, and why.

In: windows and a sensor model. Out: a `Diagnosis`: findings, the extended model, the gain on held-out windows.
Read `diagnose` first.
"""
