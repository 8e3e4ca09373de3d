"""
The noise of an IMU, identified from a recording at rest.

In: blocks of samples (and temperatures). Out: Allan curves, the figures of each axis with intervals
and statuses, noise.yaml. Read `identify` first, then `moment_fit`.
"""
