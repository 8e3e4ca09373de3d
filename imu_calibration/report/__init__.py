"""
Pages that people look at.

In: a `CalibrationResult` or a `Diagnosis`. Out: one self-contained HTML page each.
Read `calibration_page` first.
"""
