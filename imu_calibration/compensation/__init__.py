"""
The model inverted.

In: raw samples and a calibration. Out: corrected samples with their covariance, for a recording or
sample by sample. Read `compensate` first.
"""
