"""
Diagnosis of the model errors of a recording by hand.

In: poses, turns and a calibration by hand. Out: the same `Diagnosis` as on a table.
Read `by_hand.inquiry` first, then `diagnose`.
"""
