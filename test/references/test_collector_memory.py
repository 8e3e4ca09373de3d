"""Memory stays bounded however long the stream: a session that is repeated end to end."""

import tracemalloc

import numpy as np
import pytest
import yaml

from imu_calibration.api.resources import config_file
from imu_calibration.core.samples import SampleBlock
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable import accumulator as least_squares
from imu_calibration.references.turntable import collector as gathering
from imu_calibration.references.turntable.collector import GatherStep
from imu_calibration.references.turntable.estimation.solver import solve
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.session import SimulationOptions, random_values, simulate_session

TABLE = Table.from_mapping(
    yaml.safe_load(config_file('table_simulated.yaml').read_text(encoding='utf-8'))
)
MODEL = SensorModel(
    accelerometer=('bias', 'matrix', 'accel_size_effect'), joint_names=tuple(TABLE.joint_names)
)
PAUSE_NS = 2_000_000_000
"""Between the repetitions, so that the jump of the joints back to the start lies in no window."""
BLOCK = 4096
ALLOWED_GROWTH = 1 << 20
"""
Peaks depend on where blocks and windows end, by less than this, bytes; a sample that stayed would
cost 56 times as many bytes as samples.
"""


@pytest.fixture(scope='module')
def piece():
    """Return the IMU and the joints of a short session at 100 Hz."""
    profile = make_profile('quick', 4, TABLE)
    return simulate_session(
        MODEL,
        random_values(MODEL, 'industrial', 4),
        TABLE,
        profile=profile,
        options=SimulationOptions(100.0, 50.0),
        seed=4,
    )[:2]


def stream(imu, joints, repetitions):
    """Yield blocks of a session repeated end to end."""
    span = int(imu.stamp_ns[-1] - imu.stamp_ns[0]) + PAUSE_NS
    for k in range(repetitions):
        for start in range(0, len(imu), BLOCK):
            part = slice(start, start + BLOCK)
            begin, end = imu.stamp_ns[part][[0, -1]]
            near = slice(*np.searchsorted(joints.stamp_ns, [begin if start else 0, end + 1]))
            yield SampleBlock(
                *(
                    type(s)(**{**vars(s), 'stamp_ns': s.stamp_ns + k * span})
                    for s in (imu.select(part), joints.select(near))
                )
            )


def peak(imu, joints, repetitions):
    """Return (what was gathered, peak of allocated memory in bytes)."""
    tracemalloc.start()
    try:
        gathered = GatherStep(TABLE, MODEL).gather(stream(imu, joints, repetitions), 0)
        return gathered, tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.long
def test_peak_memory_does_not_grow_with_the_stream(piece, monkeypatch):
    """
    Three times the length takes no more memory, once all that is kept on purpose is full.

    Nothing of the data is lost by it.
    """
    for module, name, value in (
        (gathering, 'KEPT_POSES', 20),
        (gathering, 'KEPT_SAMPLES', 2000),
        (least_squares, 'MAX_MEAN_ROWS', 64),
        (least_squares, 'MAX_ACCUMULATOR_BLOCKS', 4),
        (least_squares, 'LEAST_ROWS', 4),
    ):
        monkeypatch.setattr(module, name, value)
    imu, joints = piece
    short, short_peak = peak(imu, joints, 1)
    long, long_peak = peak(imu, joints, 3)
    assert long_peak < short_peak + ALLOWED_GROWTH
    assert len(long.accumulator.rows) <= 64
    used = [sum(found.accumulator.samples.values()) for found in (short, long)]
    assert abs(used[1] - 3 * used[0]) < 0.02 * used[1]
    once, thrice = (solve(found.accumulator, MODEL) for found in (short, long))
    assert np.max(np.abs(thrice.values - once.values) / once.sd) < 2.0, (
        'the same samples again say the same'
    )


def test_what_is_kept_by_default_is_small(piece):
    """A session of the usual length needs a small part of the 500 MB that a recording may take."""
    imu, joints = piece
    assert peak(imu, joints, 1)[1] < 50e6
