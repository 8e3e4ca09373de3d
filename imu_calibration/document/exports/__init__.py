"""
Export of a calibration to the formats of other programs.

Each target is one record with its own formula.

In: a calibration, its noise, a motion. Out: files for estimators and autopilots with the loss of
each; calibrations from such files. Read `target` first, then one of `targets`.
"""
