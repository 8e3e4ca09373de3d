"""
Bags for the benchmarks, and the cost of a command on them.

Each bag is a simulated session, repeated until the bag is long enough.
"""

import subprocess
import sys
import time
from math import ceil
from pathlib import Path

import numpy as np

from imu_calibration.api.resources import config_file
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.table import Table
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.session import SimulationOptions, random_values, simulate_session
from msg_adapters.write import write_session

PIECE_MINUTES = 10.0
PAUSE_NS = 2_000_000_000
"""
Hole between the repetitions, so that the jump of the joints back to the start lies in no window.
"""
ITERATED_SECONDS = 0.25
"""Processor time over which a bare iteration is averaged."""
RUNNER = """
import os, subprocess, sys
child = subprocess.Popen(sys.argv[1:], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
_, status, usage = os.wait4(child.pid, 0)
print(usage.ru_utime + usage.ru_stime, usage.ru_maxrss, os.waitstatus_to_exitcode(status))
"""
"""
Runs a command from a small process: the peak memory of a child begins with that of its parent.
"""


def bench_table():
    """Return the three-axis Table that the sessions run on."""
    import yaml

    return Table.from_mapping(
        yaml.safe_load(config_file('table_simulated.yaml').read_text(encoding='utf-8'))
    )


def long_session(minutes, imu_rate=1000.0, joint_rate=200.0):
    """
    Return (ImuSamples, JointSamples) of a session of `minutes`.

    One session of `PIECE_MINUTES` is simulated; it is repeated with pauses, or cut, to the length.
    """
    table = bench_table()
    profile = make_profile('calibration', 0, table, duration=60.0 * PIECE_MINUTES)
    model = SensorModel(
        accelerometer=('bias', 'matrix', 'accel_size_effect'), joint_names=table.joint_names
    )
    imu, joints, _ = simulate_session(
        model,
        random_values(model),
        table,
        profile=profile,
        options=SimulationOptions(imu_rate, joint_rate),
        seed=0,
    )
    span = int(imu.stamp_ns[-1] - imu.stamp_ns[0]) + PAUSE_NS
    repeats = range(ceil(60e9 * minutes / span))
    end = imu.stamp_ns[0] + int(60e9 * minutes)
    return tuple(
        _until(type(samples).concatenate(_shifted(samples, k * span) for k in repeats), end)
        for samples in (imu, joints)
    )


def hand_session(still=22.0):
    """
    Return (ImuSamples, None) by hand at 200 Hz: ten minutes with poses of 22 s.

    25 poses of `still` s, random turns of 2 s between them.
    """
    from worlds.hand_sessions import simulate as simulate_by_hand

    return simulate_by_hand(0, 25, period=0.005, still=still, duration=2.0)[0], None


def iterate(bag):
    """Return the processor time of rosbags for all raw messages of a bag, s."""
    from rosbags.highlevel import AnyReader

    start, count = time.process_time(), 0
    while (spent := time.process_time() - start) < ITERATED_SECONDS:
        with AnyReader([bag]) as reader:
            for _ in reader.messages():
                pass
        count += 1
    return spent / count


def run_verb(command, codes=(0, 3, 4)):
    """
    Return (processor seconds, peak memory in MB) of a command in a process of its own.

    RuntimeError unless it ends with one of `codes`.
    """
    found = subprocess.run(
        [sys.executable, '-c', RUNNER, *command],
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
        check=True,
    )
    seconds, kilobytes, code = found.stdout.split()
    if int(code) not in codes:
        raise RuntimeError(
            f'the command must end with one of {codes}, it ended with {code}; run it by hand:'
            f' {" ".join(command)}'
        )
    return float(seconds), float(kilobytes) / 1024


def write_bench_bag(path, minutes=None, storage='sqlite3', with_joints=True, session=None):
    """
    Write a bench bag and return its path; `session` (from `long_session`) saves making it again.
    """
    imu, joints = session or long_session(minutes)
    write_session(path, imu, joints if with_joints else None, storage=storage)
    return path


def _shifted(samples, shift_ns):
    fields = vars(samples) | {'stamp_ns': samples.stamp_ns + np.int64(shift_ns)}
    return type(samples)(**fields)


def _until(samples, end_ns):
    return samples.select(samples.stamp_ns < end_ns)
