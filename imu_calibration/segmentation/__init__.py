"""
Segmentation of a stream into windows.

In: blocks of samples and a table. Out: static windows, constant-rate spins, dynamic stretches.
Read `window_finder` first; static poses are found in `static_detector`.
"""
