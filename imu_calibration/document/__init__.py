"""
The calibration document.

In: parameters with their covariance, the proof on held-out windows. Out: a `Calibration`, its text,
decision, verdict and comparison, files, and formats of other programs. Read `calibration` first,
then `verdict`.
"""
