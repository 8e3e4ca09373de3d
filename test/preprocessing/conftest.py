"""A recording by hand without a fault, and its calibration."""

import pytest

from worlds.calibrated_by_hand import calibrated
from worlds.physics_hand import hold_and_turn


@pytest.fixture(scope='session')
def clean():
    """Readings of eighteen poses by hand at 90 Hz, 80 s."""
    return hold_and_turn(11, n_poses=18, rate_hz=90.0, pose_sd=0.0, drift_sd=0.0)[0]


@pytest.fixture(scope='session')
def usual(clean):
    """Its calibration."""
    return calibrated(clean)
