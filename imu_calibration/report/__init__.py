"""
HTML reports.

In: a `CalibrationResult` or a `Diagnosis`. Out: one self-contained HTML page each.
Read `calibration_sections` first.
"""
