"""
The model inverted.

In: raw samples and a calibration. Out: corrected samples with their covariance, in whole recordings or one by one.
Read `compensate` first.
"""
