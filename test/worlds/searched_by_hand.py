"""A calibration by hand with the search of effects, from poses and turns."""

import numpy as np

from imu_calibration.calibration.hand_recording import HandRecording
from imu_calibration.calibration.hand_workflow import solve_hand_by_evidence
from imu_calibration.calibration.pose_observations import PoseObservations
from imu_calibration.core.samples import ImuSamples
from imu_calibration.references.gravity.hand_parameters import HandOptions

from worlds.hand_sessions import GRAVITY

NO_SAMPLES = HandRecording(ImuSamples(np.zeros(0, np.int64), *np.zeros((2, 0, 3))), None, {})
"""The search needs the means only."""


def searched(data, options=HandOptions(GRAVITY)):
    """Return the solution with the effects that poses and turns support."""
    return solve_hand_by_evidence(PoseObservations(data, NO_SAMPLES, options.gravity), options)
