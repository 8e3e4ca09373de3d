"""Bags for the benchmarks: a simulated session, repeated until the bag is long enough."""

from math import ceil

import numpy as np

from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.table import Table
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.session import SimulationOptions, random_values, simulate
from imu_calibration.use_cases.resources import config_file
from msg_adapters.write import write_session

PIECE_MINUTES = 10.0
PAUSE_NS = 2_000_000_000
"""Hole between the repetitions, so that the jump of the joints back to the start lies in no window."""


def bench_table():
    """Return the three-axis Table that the sessions run on."""
    import yaml
    return Table.from_mapping(yaml.safe_load(config_file('table_simulated.yaml').read_text(encoding='utf-8')))


def long_session(minutes, imu_rate=1000.0, joint_rate=200.0):
    """
    Return (ImuSamples, JointSamples) of a session of `minutes`.

    One session of `PIECE_MINUTES` is simulated; it is repeated with pauses, or cut, to the length.
    """
    table = bench_table()
    profile = make_profile('calibration', 0, table, duration=60.0 * PIECE_MINUTES)
    model = SensorModel(accelerometer=('bias', 'matrix', 'accel_size_effect'), joint_names=table.joint_names)
    imu, joints, _ = simulate(model, random_values(model), table, profile=profile, options=SimulationOptions(imu_rate, joint_rate), seed=0)
    span = int(imu.stamp_ns[-1] - imu.stamp_ns[0]) + PAUSE_NS
    repeats = range(ceil(60e9 * minutes / span))
    end = imu.stamp_ns[0] + int(60e9 * minutes)
    return tuple(_until(type(samples).concatenate(_shifted(samples, k * span) for k in repeats), end) for samples in (imu, joints))


def write_bench_bag(path, minutes, storage='sqlite3', with_joints=True, session=None):
    """Write a bench bag and return its path; `session` (from `long_session`) saves making it again."""
    imu, joints = session or long_session(minutes)
    write_session(path, imu, joints if with_joints else None, storage=storage)
    return path


def _shifted(samples, shift_ns):
    fields = vars(samples) | {'stamp_ns': samples.stamp_ns + np.int64(shift_ns)}
    return type(samples)(**fields)


def _until(samples, end_ns):
    return samples.select(samples.stamp_ns < end_ns)
