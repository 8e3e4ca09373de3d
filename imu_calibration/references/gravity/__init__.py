"""
Multi-position calibration without a table.

In: samples of an IMU held still in many attitudes and turned between them. Out: a
`HandCalibration`, and the effects that its equations support. Read `hand_calibration` first.
"""
