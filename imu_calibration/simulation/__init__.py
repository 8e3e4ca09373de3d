"""
The model run.

In: a table, a profile of motions, a sensor model, a grade of noise. Out: the samples that a session
would give. Read `session` first.
"""
