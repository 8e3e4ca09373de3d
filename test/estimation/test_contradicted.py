"""
Windows that do not belong to the rest count for nothing, clean sessions keep all.

Such a window is one pose that was leaned on, or a bump in motion.
"""

from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.document.verdict import _left_out
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import WindowKind
from imu_calibration.references.turntable.accumulator import Accumulator
from imu_calibration.references.turntable.collector import from_bytes, to_bytes
from imu_calibration.references.turntable.estimation.solver import solve
from imu_calibration.references.turntable.session_data import SessionData
from imu_calibration.references.turntable.window_statistics import reduce_windows

from worlds.misfit_coverage import clean
from worlds.physics import TABLES

TABLE = Table.from_mapping(TABLES['three_axis'])
MODEL = SensorModel(joint_names=tuple(TABLE.joint_names))
LEAN, BUMP = np.array([0.04, -0.03, 0.01]), 8.0
"""Of a table that somebody leans on, 5 mrad, and of a blow, m/s^2."""


@pytest.fixture(scope='module')
def session():
    """A clean session of realistic noise, calibrated."""
    return clean(501)


def accumulated(windows):
    """Return the Accumulator of windows."""
    total = Accumulator()
    for row in reduce_windows(windows, MODEL, TABLE):
        total.add(row)
    return total


def numbers(windows, kind):
    """Return the numbers of the windows of a kind."""
    return [number for number, window in enumerate(windows) if window.kind == kind]


def leaned(windows, numbers):
    """Return the windows, some of them read while somebody leaned on the table."""
    return [
        replace(window, force_s=window.force_s + LEAN) if number in numbers else window
        for number, window in enumerate(windows)
    ]


def struck(windows, number):
    """Return the windows with a blow on the IMU in one of them, ringing down in half a second."""
    window = windows[number]
    since = window.time - window.time[len(window) // 2]
    ringing = np.where(
        since >= 0, np.exp(-np.maximum(since, 0) / 0.2) * np.sin(2 * np.pi * 4 * since), 0.0
    )
    return [
        *windows[:number],
        replace(window, force_s=window.force_s + np.outer(ringing, [BUMP, 0, -BUMP])),
        *windows[number + 1 :],
    ]


def bias_error(solution, truth):
    """Return the rms error of the accelerometer's biases, m/s^2."""
    return np.sqrt(
        np.mean(
            (
                solution.values[solution.model.slices['accelerometer', 'bias']]
                - truth['accelerometer'].bias
            )
            ** 2
        )
    )


def test_clean_sessions_keep_all_windows(session):
    assert not any(noise.left_out for noise in session.solution.noise.values())


@pytest.mark.parametrize(
    'spoil',
    [
        lambda windows: leaned(windows, numbers(windows, WindowKind.STATIC)[5:6]),
        lambda windows: leaned(windows, numbers(windows, WindowKind.STATIC)[4:9:4]),
        lambda windows: struck(
            windows, max(numbers(windows, WindowKind.DYNAMIC), key=lambda at: len(windows[at]))
        ),
    ],
    ids=('one pose', 'two poses', 'a blow in motion'),
)
def test_what_others_contradict_costs_nothing(session, spoil):
    """
    Biases stay as good and as certain as without it.

    The fit that believes all windows is ten times as uncertain of poses.
    """
    clean, spoilt = (
        solve(accumulated(session.windows), MODEL),
        solve(accumulated(spoil(session.windows)), MODEL),
    )
    part = MODEL.slices['accelerometer', 'bias']
    assert len(spoilt.noise['accelerometer'].left_out) >= 1
    assert not spoilt.noise['gyroscope'].left_out
    assert bias_error(spoilt, session.truth) < bias_error(clean, session.truth) + 1.5e-4
    assert np.all(spoilt.sd[part] < 1.2 * clean.sd[part])


def test_what_is_frequent_is_how_the_recording_is(session):
    """A quarter of all poses read otherwise are no outliers: they widen the standard deviations."""
    some = numbers(session.windows, WindowKind.STATIC)[::4]
    found, part = (
        solve(accumulated(leaned(session.windows, some)), MODEL),
        MODEL.slices['accelerometer', 'bias'],
    )
    assert len(found.noise['accelerometer'].left_out) < len(some) / 2
    assert np.all(found.sd[part] > 3 * session.solution.sd[part])


def test_a_session_that_goes_on_leaves_out_the_same(session):
    """Nothing but the accumulator is needed: live, after a restart, with any number of windows."""
    total = accumulated(leaned(session.windows, numbers(session.windows, WindowKind.STATIC)[5:6]))
    again = from_bytes(to_bytes(SessionData(accumulator=total), MODEL))[0].accumulator
    first, second = solve(total, MODEL), solve(again, MODEL)
    assert first.noise['accelerometer'].left_out == second.noise['accelerometer'].left_out
    np.testing.assert_array_equal(first.values, second.values)


def test_the_verdict_says_what_was_left_out(session):
    calibration = type('Statistics', (), {'statistics': {'accelerometer': {'left_out_s': [81.2]}}})
    (note,) = _left_out(calibration)
    assert 'accelerometer' in note.what and '81 s' in note.what
