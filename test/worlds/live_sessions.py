"""
Short sessions for the tests of the nodes.

Enough motion for an answer in a few seconds of processing.
"""

import numpy as np

from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core import documents
from imu_calibration.core.samples import SampleBlock
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.table import Table
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.session import SimulationOptions, random_values, simulate_session

from ros.live_station import TABLE as TABLE_FILE
from worlds.calibrated import calibrated_on_table

TABLE = Table.from_mapping(documents.from_text(TABLE_FILE.read_text()))
TOLERANCES = documents.from_text((TABLE_FILE.parent / 'tolerances.yaml').read_text())
OPTIONS = CalibrationOptions(tolerances=TOLERANCES)


def make_session(seed=1, rate=100.0, joint_rate=None, seconds=None, profile='quick'):
    """Return (imu, joints, true values, model) of a simulated session, or of its first seconds."""
    model = SensorModel(
        accelerometer=('bias', 'matrix', 'accel_size_effect'), joint_names=TABLE.joint_names
    )
    values = random_values(model, 'industrial', seed)
    imu, joints, _ = simulate_session(
        model,
        values,
        TABLE,
        profile=make_profile(profile, 1, TABLE),
        options=SimulationOptions(rate, joint_rate or rate),
        seed=seed,
    )
    if seconds is not None:
        end = imu.stamp_ns[0] + int(seconds * 1e9)
        imu, joints = imu.select(imu.stamp_ns < end), joints.select(joints.stamp_ns < end)
    return imu, joints, values, model


def offline(*sessions):
    """Return the offline answer for (imu, joints) as they were sent."""
    return calibrated_on_table([[SampleBlock(*s)] for s in sessions], TABLE, OPTIONS).calibration


def assert_same(live, expected, share=1e-6):
    """Assert that a live calibration is the offline one, to a share of the standard deviations."""
    assert live.param_names == expected.param_names and live.status == expected.status
    assert np.max(np.abs(live.values - expected.values) / expected.sd) < share


def errors_in_sd(calibration, model, values):
    """
    Return the errors of the IMU's own parameters in standard deviations (true values of `model`).
    """
    found = []
    for effect in model.effects:
        if (effect.sensor, effect.name) in calibration.model.slices:
            part = calibration.model.slices[effect.sensor, effect.name]
            found.append(
                (calibration.values[part] - values[model.slices[effect.sensor, effect.name]])
                / calibration.sd[part]
            )
    return np.concatenate(found)
