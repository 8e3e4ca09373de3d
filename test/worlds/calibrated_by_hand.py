"""Calibration of readings by hand with the requested model, without a search for effects."""

from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.samples import SampleBlock

from worlds.calibrated import calibrated_by_hand
from worlds.hand_sessions import GRAVITY

OPTIONS = CalibrationOptions(gravity=GRAVITY, as_asked=True)


def calibrated(imu):
    """Return the result for ImuSamples of one recording."""
    return calibrated_by_hand([[SampleBlock(imu)]], OPTIONS)
