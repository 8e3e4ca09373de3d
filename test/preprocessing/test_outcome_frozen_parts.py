"""Parts of a recording that are no readings are left out by every verb, with a note."""

from dataclasses import replace

import numpy as np
import pytest
from refusal import refused

from imu_calibration.allan.identify import figures_of, identify_noise
from imu_calibration.api.compensate import compensate_recording
from imu_calibration.calibration.check import check_errors
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples, SampleBlock
from imu_calibration.document.outcome import exit_code, shortcomings
from imu_calibration.effects.sensor_model import BASE, SensorModel
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.checks import Preflight
from imu_calibration.preprocessing.sample_recording import read_recording
from imu_calibration.preprocessing.stream_cleaning import BlockCleaner
from imu_calibration.references.gravity.pose_readings import errors_by_hand
from imu_calibration.references.turntable.collector import GatherStep

from worlds.calibrated_by_hand import OPTIONS, calibrated
from worlds.hand_sessions import GRAVITY
from worlds.noise_worlds import identifying
from worlds.physics import make_session
from worlds.physics_hand import hold_and_turn


def seconds_of(imu):
    return (imu.stamp_ns - imu.stamp_ns[0]) * 1e-9


def without_output(imu, start, stop, value=None, sensors=('force_s', 'rate_s')):
    """Return the samples with zeros (`value` 0) or the first reading from start to stop, s."""
    time = seconds_of(imu)
    dead = (time >= start) & (time < stop)
    columns = {}
    for name in sensors:
        readings = getattr(imu, name).copy()
        readings[dead] = readings[np.argmax(dead)] if value is None else value
        columns[name] = readings
    return replace(imu, **columns)


FAULTS = {
    'zeros at the start': (0.0, 5.3, 0.0),
    'zeros at the end': (68.0, 1e9, 0.0),
    'zeros for a third': (22.0, 49.0, 0.0),
    'one reading held': (31.0, 44.0, None),
    'accelerometer zero': (27.0, 41.0, 0.0, ('force_s',)),
    'gyroscope held': (27.0, 41.0, None, ('rate_s',)),
}


@pytest.mark.parametrize('name', FAULTS)
def test_by_hand_the_live_part_is_calibrated(clean, usual, name):
    """Tracebacks, '1 in 1 intervals at rest', or a prior that was called unproven."""
    found = calibrated(without_output(clean, *FAULTS[name]))
    assert not found.calibration.status_by_name.keys() - usual.calibration.status_by_name.keys()
    error = (found.calibration.values - usual.calibration.values) / np.maximum(
        found.calibration.sd, 1e-9
    )
    assert np.abs(error).max() < 4
    assert 'held' not in set(found.calibration.status)
    spans = [finding for finding in found.gathered.findings if finding.check == 'frozen']
    assert len(spans) == 1 and spans[0].samples > 90 * 4
    # the share is above 1 %
    assert exit_code(found.calibration) == 3
    assert any(str(spans[0].samples) in line for line in shortcomings(found.calibration))


def test_a_short_part_is_a_note():
    longer = hold_and_turn(12, n_poses=44, rate_hz=90.0, pose_sd=0.0, drift_sd=0.0)[0]
    found = calibrated(without_output(longer, 61.0, 62.6))
    assert [f.check for f in found.gathered.findings if f.samples] == ['frozen']
    assert exit_code(found.calibration) == 0


def test_a_recording_without_any_reading_is_refused(clean):
    dead = replace(clean, force_s=0 * clean.force_s, rate_s=0 * clean.rate_s)
    with refused(InputError, 'frozen', len(clean)):
        calibrated(dead)


def test_check_and_compensate_note_the_part(clean, usual):
    bad = without_output(clean, 20.0, 36.0)
    checked, good = (
        check_errors(
            errors_by_hand([SampleBlock(samples)], usual.calibration, OPTIONS),
            usual.calibration,
        )
        for samples in (bad, clean)
    )
    assert (checked.exit_code, good.exit_code) == (3, 0)
    assert checked.proof['accelerometer'].after < 2 * good.proof['accelerometer'].after
    corrected = compensate_recording(bad, usual.calibration)
    assert corrected.exit_code == 3 and corrected.frozen == pytest.approx(16 * 90, rel=0.05)
    unharmed = compensate_recording(clean, usual.calibration)
    assert unharmed.frozen == 0 and len(corrected.warnings) == len(unharmed.warnings) + 1


def test_noise_is_that_of_the_readings():
    rng = np.random.default_rng(4)
    n, rate = 80 * 600, 80.0
    stamp_ns = 10**18 + np.round(np.arange(n) * 1e9 / rate).astype(np.int64)
    force = np.array([0.1, -0.2, GRAVITY]) + rng.normal(0, 0.01, (n, 3))
    imu = ImuSamples(stamp_ns, force, rng.normal(0, 0.001, (n, 3)), 'imu')
    dead = without_output(imu, 200.0, 420.0, 0.0)
    with identifying(0, 3):
        result = identify_noise([SampleBlock(dead)])
    figures = figures_of(result)
    for sensor, sd in (('accelerometer', 0.01), ('gyroscope', 0.001)):
        assert figures.sensor(sensor)[0].white == pytest.approx(sd / np.sqrt(rate), rel=0.01)
    assert result.record.left_out['frozen_output'] == pytest.approx(220.0, abs=1.0)
    assert figures.recording['dropped']['imu frozen output'] > 0.3 * n


def test_ranges_are_left_out_whatever_the_blocks(clean):
    bad = without_output(clean, 31.0, 44.0)
    preflight = Preflight(GRAVITY)
    whole = read_recording([SampleBlock(bad)], preflight=preflight).imu
    pieces = [SampleBlock(bad.select(slice(a, a + 37))) for a in range(0, len(bad), 37)]
    cleaner = BlockCleaner(without=preflight.without_readings)
    cut = [imu for cleaned in cleaner.all_of(pieces) for _, imu in cleaned.imu]
    assert np.array_equal(np.concatenate([imu.stamp_ns for imu in cut]), whole.stamp_ns)
    time = (whole.stamp_ns - bad.stamp_ns[0]) * 1e-9
    assert not ((time >= 31.0) & (time < 44.0)).any() and len(whole) > 0.8 * len(bad)


def test_on_a_table_no_window_has_frozen_readings():
    """The recording was refused: the gyroscope repeated one reading while the joints turned."""
    session = make_session(5, profile='quick', noise='realistic', grade='industrial')
    table = Table.from_mapping(session.table)
    bad = without_output(session.imu, 43.0, 56.5)
    blocks = [SampleBlock(bad, session.joints, session.temperature)]
    windows = []
    step = GatherStep(table, SensorModel(BASE, BASE))
    gathered = step.read(blocks, 0, Preflight(GRAVITY), windows=windows)
    used = [window for window in windows if window.kind != 'unused']
    start, stop = bad.stamp_ns[0] + np.array([43.0, 56.5]) * 1e9
    stamps = np.concatenate([window.stamp_ns for window in used])
    assert not ((stamps >= start) & (stamps < stop)).any()
    assert [f.check for f in gathered.findings if f.samples] == ['frozen']
    assert gathered.counts['static'] == sum(len(w.time) for w in used if w.kind == 'static')
