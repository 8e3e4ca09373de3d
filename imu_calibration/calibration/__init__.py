"""
From observations of a reference to a judged calibration document.

In: a `ModelSource` and options. Out: a `CalibrationResult`, or a diagnosis. Read `calibrate` first,
then `result` and `reference`: the protocols that each reference of `references` implements.
"""
