"""
The use case: from recordings to a judged calibration document.

In: blocks of samples, a table, options. Out: a `CalibrationResult`, documents, comparisons, live sessions, fleets.
Read `calibrate` first.
"""
