"""Physical constants and units of people, each named once; multiply to come to SI, divide to leave it."""

import math

STANDARD_GRAVITY = 9.80665
"""m/s^2: the g of people's units, never the gravity of a place."""
MILLI_G = 1e-3 * STANDARD_GRAVITY
MICRO_G = 1e-6 * STANDARD_GRAVITY
DEG = math.pi / 180
DEG_H = DEG / 3600
ARCMIN = DEG / 60
