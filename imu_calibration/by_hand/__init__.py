"""
Multi-position calibration without a table.

In: samples of an IMU held still in many attitudes and turned between them. Out: a `HandCalibration`, its document, relative arms.
Read `calibrate` first.
"""
