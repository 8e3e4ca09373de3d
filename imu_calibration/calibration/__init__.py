"""
The use case: from recordings to a judged calibration document.

In: blocks of samples, a table, options. Out: a `CalibrationResult`, live sessions, fleets,
diagnoses. Read `table_calibration` first, then `hand_workflow`.
"""
