"""
What the model gets wrong, and why: the story told about what `selection` found.

In: windows and a sensor model. Out: a `Diagnosis`: findings in words, the extended model, the gain on held-out windows, what is
unexplained. Read `diagnose` first.
"""
