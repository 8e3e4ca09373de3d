"""A limit that outputs pile up at is told from a coarse output that repeats all its values."""

from types import SimpleNamespace

import numpy as np
import pytest

from imu_calibration.core.documents import from_text
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window
from imu_calibration.preprocessing.window_finder import MotionGatherer
from imu_calibration.references.turntable.selection import investigation, saturation
from imu_calibration.references.turntable.selection.saturation import (
    find_saturation,
    may_be_clipped,
    without_clipped,
)
from msg_adapters.bag import open_recording

from worlds.misfit_worlds import make_pair

STEP = 0.0981


def windows_of(force, count=10):
    """Return moving windows with some specific force, shape (n, 3)."""
    size = len(force) // count
    zero = np.zeros((size, 1))
    return [
        Window(
            'dynamic',
            np.arange(size) * 10**7,
            np.arange(size) * 0.01,
            force[k * size : (k + 1) * size],
            np.zeros((size, 3)),
            JointMotion(np.arange(size) * 0.01, zero, zero, zero, zero),
        )
        for k in range(count)
    ]


def upright(noise, step=STEP):
    force = np.array([0.0, 0.0, 9.81]) + np.random.default_rng(0).normal(0.0, noise, (48_000, 3))
    return np.round(force / step) * step


def test_gravity_on_the_highest_steps_of_a_coarse_output_is_no_limit():
    assert not may_be_clipped(windows_of(upright(0.03)), 'accelerometer')


@pytest.mark.parametrize('step', [1e-6, STEP])
def test_a_limit_is_seen_in_fine_and_in_coarse_outputs(step):
    swing = 12.0 * np.sin(np.arange(48_000) * 0.02)[:, None] * np.array([0.1, 0.2, 1.0])
    force = np.clip(np.round(swing / step) * step, -100 * STEP, 100 * STEP)
    assert may_be_clipped(windows_of(force), 'accelerometer')


@pytest.mark.parametrize('where', ['where the force is large', 'at rest'])
def test_a_limit_is_where_the_motion_passes_it(where):
    """
    An output that sticks at its largest value while nothing happens is no limit.

    This holds though the model expects more elsewhere.
    """
    expected = 12.0 * np.sin(np.arange(8000) * 0.02)[:, None] * np.array([0.0, 0.0, 1.0])
    force = expected + np.random.default_rng(1).normal(0, 0.01, expected.shape)
    if where == 'at rest':
        force *= 0.8
        force[np.abs(expected[:, 2]) < 0.1, 2] = 10.0
    else:
        force = np.clip(force, -10.0, 10.0)
    windows = windows_of(force)
    predicted = [{'accelerometer': part} for part in np.split(expected, 10)]
    found = find_saturation(windows, predicted, np.full(3, 0.01), sensor='accelerometer')
    assert found is None if where == 'at rest' else found.level == 10.0


def test_samples_at_a_limit_and_those_predicted_near_it_are_left_out():
    """The first twenty of a hundred are at the limit, the next twenty might be, and no more go."""
    expected, force = np.zeros((100, 3)), np.zeros((100, 3))
    force[:20, 2], expected[20:40, 2], force[20:40, 2] = 10.0, 9.97, 9.9
    kept = without_clipped(
        windows_of(force, 1),
        [{'accelerometer': expected}],
        {'accelerometer': 10.0},
        noise_sd={'accelerometer': np.full(3, 0.01), 'gyroscope': np.full(3, 0.01)},
    )
    assert [list(window.stamp_ns // 10**7) for window in kept] == [list(range(40, 100))]


@pytest.mark.real_data
def test_a_coarse_accelerometer_on_a_vertical_shaft_has_no_limit(recordings):
    folder = recordings / 'shaft_yaw_slow_later'
    table = Table.from_mapping(from_text((folder / 'table.yaml').read_text()))
    gatherer, windows = MotionGatherer(table), []
    with open_recording(folder) as recording:
        for block in recording.blocks(table.joint_names):
            windows += gatherer.push(block)
    windows += gatherer.finish()
    model = SensorModel(joint_names=table.joint_names)
    used, _, limits = saturation.without_clipping(windows, table, model)
    assert len(used) == len(windows) >= 8 and not limits


def test_locked_windows_show_no_limit(monkeypatch):
    windows, seen = windows_of(np.random.default_rng(0).normal(0.0, 1.0, (1200, 3)), 12), []
    monkeypatch.setattr(
        saturation,
        '_limits',
        lambda some, table, model: seen.extend(map(id, some)),
    )
    _, locked, _ = saturation.without_clipping(windows, None, None)
    assert locked.sum() == 3 and seen == [
        id(window) for window, out in zip(windows, locked) if not out
    ]


def test_a_limit_that_one_window_alone_shows_is_seen(monkeypatch):
    """The eleventh window of twelve would be locked."""
    force, seen = np.random.default_rng(0).normal(0.0, 1.0, (1200, 3)), []
    force[1020:1040, 2] = 9.0
    windows, limit = windows_of(force, 12), SimpleNamespace(sensor='accelerometer', level=9.0)
    found = saturation._Limits([limit], {}, np.zeros(0))
    monkeypatch.setattr(
        saturation,
        '_limits',
        lambda some, table, model: (seen.extend(map(id, some)), found)[1],
    )
    monkeypatch.setattr(saturation, 'predictions', lambda *given, **named: None)
    monkeypatch.setattr(saturation, 'without_clipped', lambda some, *given, **named: some)
    _, locked, _ = saturation.without_clipping(windows, None, None)
    assert id(windows[10]) in seen and locked.sum() == 2


def test_what_is_always_at_its_limit_does_not_empty_the_recording(monkeypatch):
    pair = make_pair(None, 1, table='shaft', profile='sweeps', imu_rate=50.0, joint_rate=50.0)
    table = Table.from_mapping(pair.table)
    gatherer = MotionGatherer(table)
    windows = gatherer.push(pair.first.block) + gatherer.finish()
    monkeypatch.setattr(saturation, 'may_be_clipped', lambda windows, sensor: True)
    monkeypatch.setattr(saturation, 'without_clipped', lambda *given, **known: [])
    found = investigation.investigate(windows, table, SensorModel(joint_names=table.joint_names))
    assert (
        found.used == [window for window in windows if window.kind != 'unused'] and not found.limits
    )
