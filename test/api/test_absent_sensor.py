"""An accelerometer without a gyroscope, or the reverse: calibrated, checked, compensated."""

import numpy as np
import pytest
from refusal import refused

from imu_calibration.api.calibrate import calibrate_recordings, check_recording
from imu_calibration.api.compensate import compensate_recording
from imu_calibration.calibration.live import LiveByHandSettings, LiveSettings
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples, SampleBlock
from imu_calibration.document.calibration_text import calibration_from_text, calibration_to_text
from imu_calibration.document.trust import usable
from imu_calibration.preprocessing.absent_sensor import MIN_ABSENT_SAMPLES, SensorPresence
from imu_calibration.references.gravity.live_poses import LiveByHand

from worlds.candidates import FEW
from worlds.small_hand import ACCELEROMETER, GRAVITY, GYROSCOPE, hand_motion


def readings(seed, n_poses=14):
    """Return (time, force, rate) as read."""
    motion, generator = hand_motion(seed=seed, n_poses=n_poses), np.random.default_rng(seed)
    force = ACCELEROMETER.read(motion.force, generator)
    rate = GYROSCOPE.read(motion.rate, generator)
    return motion.time, force, rate


def block(time, force, rate):
    stamps = 10**18 + np.round(time * 1e9).astype(np.int64)
    return SampleBlock(ImuSamples(stamps, force, rate, 'imu_link'))


def without(values):
    return np.full_like(values, np.nan)


@pytest.fixture(scope='module')
def accelerometer_only():
    time, force, rate = readings(31)
    return calibrate_recordings(
        [block(time, force, without(rate))], gravity=GRAVITY, candidates=FEW
    )


def test_an_accelerometer_alone_is_calibrated(accelerometer_only):
    found = accelerometer_only.calibration
    assert found.absent == ('gyroscope',)
    assert accelerometer_only.exit_code == 0
    assert found.decisions == {'accelerometer': 'helps'}
    assert len(found.requested) == 9
    assert set(found.requested.values()) == {'determined'}
    names = [name for name in found.param_names if name in found.requested]
    true = np.concatenate([ACCELEROMETER.bias, ACCELEROMETER.matrix[np.tril_indices(3)]])
    places = [found.param_names.index(name) for name in names]
    z = (found.values[places] - true) / found.sd[places]
    assert np.sqrt(np.mean(z**2)) < 2.0  # 9 values: chi-square beyond 36 has a chance of 4e-5
    # The absent sensor is nominal, and no line of the table shows it.
    assert np.array_equal(found.of('gyroscope', found.model.effects[0].role), np.zeros(3))
    assert 'gyroscope.' not in str(found)


def test_the_document_keeps_what_is_absent(accelerometer_only):
    read = calibration_from_text(calibration_to_text(accelerometer_only.calibration))
    assert read.absent == ('gyroscope',)
    assert read.decisions == accelerometer_only.calibration.decisions


def test_it_is_checked_and_applied_to_one_sensor(accelerometer_only):
    time, force, rate = readings(32)
    calibration = accelerometer_only.calibration
    found = check_recording(block(time, force, without(rate)), calibration, gravity=GRAVITY)
    assert list(found.proof) == ['accelerometer']
    assert found.exit_code == 0
    corrected = compensate_recording(block(time, force, without(rate)), calibration)
    assert corrected.exit_code == 0
    assert np.isnan(corrected.imu.rate_s).all()
    still = np.linalg.norm(rate - GYROSCOPE.bias, axis=1) < 0.02
    length = np.linalg.norm(corrected.imu.force_s[still], axis=1)
    assert abs(np.median(length) - GRAVITY) < 3e-3


def test_readings_of_the_absent_sensor_pass_with_a_reason(accelerometer_only):
    time, force, rate = readings(33)
    corrected = compensate_recording(block(time, force, rate), accelerometer_only.calibration)
    assert list(corrected.refused) == ['gyroscope']
    assert corrected.exit_code == 3
    assert np.allclose(corrected.imu.rate_s, rate, rtol=0, atol=1e-12)


def test_a_gyroscope_alone_has_its_bias():
    time, force, rate = readings(34)
    result = calibrate_recordings(
        [block(time, without(force), rate)], gravity=GRAVITY, candidates=FEW
    )
    found = result.calibration
    assert found.absent == ('accelerometer',)
    assert list(found.decisions) == ['gyroscope']
    places = [found.param_names.index(f'gyroscope.bias.{axis}') for axis in 'xyz']
    assert [found.status[place] for place in places] == ['determined'] * 3
    z = (found.values[places] - GYROSCOPE.bias) / found.sd[places]
    assert np.abs(z).max() < 4.0
    assert result.exit_code == 3  # without gravity no turn determines its matrix
    corrected = compensate_recording(block(time, without(force), rate), found)
    still = np.linalg.norm(rate - GYROSCOPE.bias, axis=1) < 0.02
    assert np.abs(corrected.imu.rate_s[still].mean(axis=0)).max() < 2e-4
    with refused(InputError, 'absent'):
        check_recording(block(time, force, without(rate)), found, gravity=GRAVITY)


def live_session(saved=None):
    return LiveByHand(
        CalibrationOptions(),
        LiveSettings(),
        LiveByHandSettings(gravity=GRAVITY),
        saved=saved,
        clock=lambda: 0.0,
    )


@pytest.mark.parametrize(
    ('sensor', 'other_reading'),
    [('accelerometer', np.nan), ('accelerometer', 0.0), ('gyroscope', np.nan)],
)
def test_live_one_sensor_gives_the_calibration_of_the_recording(sensor, other_reading):
    time, force, rate = readings(10280)
    if sensor == 'accelerometer':
        rate = np.full_like(rate, other_reading)
    else:
        force = np.full_like(force, other_reading)
    imu = block(time, force, rate).imu
    expected = calibrate_recordings([SampleBlock(imu)], gravity=GRAVITY).calibration
    live = live_session()
    for start in range(0, len(imu), 400):
        live.push(SampleBlock(imu.select(slice(start, start + 400))))
        live.coverage()
    found = live.solve(pending=True).calibration
    assert (found.absent, found.decisions) == (expected.absent, expected.decisions)
    np.testing.assert_array_equal(found.values, expected.values)
    assert not any(live.counts.values())
    assert {group.sensor for group in live.groups()} == {sensor}
    # The samples that another run continues with have no readings of the absent sensor either.
    again = live_session(live.saved()).solve().calibration
    np.testing.assert_array_equal(again.values, expected.values)
    # With consent a gyroscope alone is corrected by its bias.
    assert sensor not in usable(found, anyway=True, live=True).refused


def test_a_live_stream_without_any_change_is_refused():
    time, force, rate = readings(10281, n_poses=2)
    live = live_session()
    live.push(block(time, np.tile(force[0], (len(time), 1)), without(rate)))
    with refused(InputError, 'frozen', len(time)):
        live.solve(pending=True)


def test_presence_does_not_depend_on_the_pieces():
    stamps = np.arange(3 * MIN_ABSENT_SAMPLES)
    force = np.ones((len(stamps), 3))
    rate = without(force)
    late = MIN_ABSENT_SAMPLES + 500
    rate[late:] = 0.1
    for size in (len(stamps), 700):
        presence, count = SensorPresence(), 0
        for start in range(0, len(stamps), size):
            part = slice(start, start + size)
            passed = presence.push(ImuSamples(stamps[part], force[part], rate[part]))
            count += len(passed)
            assert np.isfinite(passed.rate_s).all()
        assert presence.finish() is None
        assert (presence.absent, presence.n_late) == (('gyroscope',), len(stamps) - late)
        assert count == len(stamps)


def test_a_sensor_that_starts_soon_is_present():
    stamps = np.arange(2 * MIN_ABSENT_SAMPLES)
    rate = np.full((len(stamps), 3), np.nan)
    rate[MIN_ABSENT_SAMPLES // 2 :] = 0.0
    presence = SensorPresence()
    for start in range(0, len(stamps), 300):
        part = slice(start, start + 300)
        presence.push(ImuSamples(stamps[part], np.ones((len(stamps[part]), 3)), rate[part]))
    assert (presence.absent, presence.n_late) == ((), 0)


def test_a_gyroscope_that_measures_nothing_does_not_refuse_the_accelerometer():
    time, force, rate = readings(35)
    result = calibrate_recordings([block(time, force, np.zeros_like(rate))], gravity=GRAVITY)
    assert list(result.calibration.decisions) == ['accelerometer']
    assert result.calibration.decisions['accelerometer'] == 'helps'
    assert list(result.calibration.statistics['unusable_sensors']) == ['gyroscope']
    assert result.exit_code == 3  # it is there, and not corrected


def test_an_accelerometer_that_reads_zero_is_no_traceback():
    time, force, rate = readings(36)
    with refused(InputError, 'frozen'):
        calibrate_recordings(
            [block(time, np.zeros_like(force), np.zeros_like(rate))], gravity=GRAVITY
        )
