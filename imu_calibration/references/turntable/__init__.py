"""
Reference by a turntable or an arm.

In: recordings with joints. Out: a calibration, its proof, a diagnosis. Read `table_reference`
first, then `table_calibration`: windows become statistics (`window_statistics`) and rows
(`accumulator`); `estimation` solves them, `selection` chooses effects, `residuals` analyses the
unexplained.
"""
