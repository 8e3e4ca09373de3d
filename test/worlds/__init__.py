"""
Data for tests, made by physics that does not know the estimator's columns.

In: an effect to hide, a seed. Out: sessions, recordings, and what is true of them.
Read `physics` first; `validation/hide_and_seek.py` runs the whole protocol.
"""
