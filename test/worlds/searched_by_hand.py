"""A calibration by hand with the search of effects, from poses and turns."""

import numpy as np

from imu_calibration.calibration.by_evidence import solve_by_evidence
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.samples import ImuSamples
from imu_calibration.preprocessing.sample_recording import SampleRecording
from imu_calibration.references.gravity.hand_workflow import PoseRecording
from imu_calibration.references.gravity.pose_observations import PoseObservations

from worlds.hand_sessions import GRAVITY

NO_SAMPLES = SampleRecording(ImuSamples(np.zeros(0, np.int64), *np.zeros((2, 0, 3))), None, {})
"""The search needs the means only."""


def searched(data, options=CalibrationOptions(gravity=GRAVITY)):
    """Return the solution with the effects that poses and turns support."""
    observations = PoseObservations(data, NO_SAMPLES, options.gravity)
    return solve_by_evidence(PoseRecording(observations), options)
