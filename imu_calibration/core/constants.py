"""Physical constants and customary units, each named once; multiply to convert to SI, divide to convert from SI."""

import math

STANDARD_GRAVITY = 9.80665
"""m/s^2: the g of people's units, never the gravity of a place."""
STANDARD_GRAVITY_SD = 0.02
"""Standard deviation of an unknown local gravity, m/s^2."""
MILLI_G = 1e-3 * STANDARD_GRAVITY
MICRO_G = 1e-6 * STANDARD_GRAVITY
HOTTEST_C = 200.0
"""No IMU works above this temperature; a larger reading is in kelvin, degrees C."""
DEG = math.pi / 180
DEG_H = DEG / 3600
ARCMIN = DEG / 60
