"""
The use case: from recordings to a judged calibration document.

In: blocks of samples, a table, options. Out: a `CalibrationResult`, live sessions, fleets,
diagnoses. Read `calibrate` first, then `table_calibration` and `hand_workflow`.
"""
