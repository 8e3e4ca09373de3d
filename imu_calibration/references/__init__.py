"""
References: sources of the true motion, and the equations of their parameters.

In: recordings of an IMU on a turntable, or of one that was held still in many attitudes. Out: a
`ModelSource` and its `Observations` for `calibration`. Read `turntable.table_reference` and
`gravity.gravity_reference` first; `rows` has what references of few rows have in common.
"""
