"""
The catalogue of effects and the sensor model made of them.

In: names of effects, a reference motion. Out: columns, coefficients, predicted outputs.
Read `base` first, then `sensor_effects`.
"""
