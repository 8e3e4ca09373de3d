"""Faults that text logs are refused for, in bags: every verb refuses or names them."""

from dataclasses import replace

import numpy as np
import pytest
from refusal import refused

from imu_calibration.api.calibrate import calibrate_recordings
from imu_calibration.api.compensate import compensate_recording
from imu_calibration.api.inspect import inspect_recording
from imu_calibration.api.noise import identify_recording
from imu_calibration.api.recordings import Topics
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.references.gravity.gravity_reference import GravityReference
from msg_adapters.write import write_session

from worlds.compensation_cases import random_calibration
from worlds.small_hand import ACCELEROMETER, GRAVITY, GYROSCOPE, hand_motion

HZ = 80.0
START_NS = 1_731_900_000_123_456_789


def readings(seed, **options):
    """Return samples in SI of a session by hand."""
    motion, generator = hand_motion(seed=seed, hz=HZ, **options), np.random.default_rng(seed)
    stamps = START_NS + np.round(motion.time * 1e9).astype(np.int64)
    force = ACCELEROMETER.read(motion.force, generator)
    return ImuSamples(stamps, force, GYROSCOPE.read(motion.rate, generator), 'imu_link')


@pytest.fixture(scope='module')
def session():
    return readings(10282, n_poses=9)


@pytest.fixture
def calibration(tmp_path):
    found = random_calibration(5, (), (), sd=1e-5)
    (tmp_path / 'calibration.yaml').write_text(calibration_to_text(found))
    return found


def equal(imu):
    return replace(imu, stamp_ns=np.full_like(imu.stamp_ns, START_NS))


def five_digits(imu):
    """1.7319e+09: the stamps advance once in 28 hours."""
    return replace(imu, stamp_ns=imu.stamp_ns // 10**14 * 10**14)


def whole_seconds(imu):
    return replace(imu, stamp_ns=imu.stamp_ns // 10**9 * 10**9)


def increments(imu):
    return replace(imu, force_s=imu.force_s / HZ, rate_s=imu.rate_s / HZ)


@pytest.mark.parametrize(
    ('fault', 'storage', 'code', 'value'),
    [
        (equal, 'mcap', 'stamps_equal', None),
        (five_digits, 'sqlite3', 'stamps_equal', None),
        (whole_seconds, 'mcap', 'stamps_equal', None),
        (increments, 'sqlite3', 'increments', HZ),
    ],
)
def test_each_verb_refuses_with_the_key(
    fault, storage, code, value, session, calibration, tmp_path
):
    bag = tmp_path / 'bag'
    write_session(bag, fault(session), storage=storage)
    (look,) = inspect_recording(bag, [Topics()], GravityReference(), options=CalibrationOptions())
    assert look.refused
    refusals = [finding.check for finding in look.findings if finding.severity == 'refuse']
    assert refusals[0] == code
    for verb in (
        lambda: calibrate_recordings(bag, gravity=GRAVITY),
        lambda: identify_recording(bag),
        lambda: compensate_recording(bag, calibration),
        lambda: compensate_recording(bag, calibration, output=tmp_path / 'corrected'),
    ):
        with refused(InputError, code) as caught:
            verb()
        assert value is None or float(caught.value.value) == pytest.approx(value, rel=1e-3)
    assert not (tmp_path / 'corrected').exists()


def test_a_dead_band_is_named(tmp_path):
    imu = readings(10283, n_poses=14)
    rate = imu.rate_s - GYROSCOPE.bias  # the chip estimates its own bias
    rate = np.where(np.abs(rate) < 0.01, 0.0, rate)
    write_session(tmp_path / 'bag', replace(imu, rate_s=rate), storage='mcap')
    (look,) = inspect_recording(
        tmp_path / 'bag', [Topics()], GravityReference(), options=CalibrationOptions()
    )
    assert 'dead_band' in [finding.check for finding in look.findings]
    found = calibrate_recordings(tmp_path / 'bag', gravity=GRAVITY)
    assert found.exit_code == 3
    z = found.calibration.values[:3] - ACCELEROMETER.bias
    assert np.abs(z / found.calibration.sd[:3]).max() < 4.0
    # The accelerometer is corrected, and a rate within the band remains 0.
    corrected = compensate_recording(tmp_path / 'bag', found.calibration)
    assert not corrected.refused and corrected.imu is not None
    still = np.all(rate == 0.0, axis=1)
    length = np.linalg.norm(corrected.imu.force_s[still], axis=1).mean()
    assert length == pytest.approx(GRAVITY, rel=1e-3)
    assert not corrected.imu.rate_s[still].any()


def test_a_dead_band_at_rest_leaves_the_noise_of_the_accelerometer(tmp_path):
    generator, n = np.random.default_rng(10461), 4000
    stamps = START_NS + np.arange(n) * 10_000_000
    force = np.array([0.3, -0.2, 9.79]) + 0.015 * generator.standard_normal((n, 3))
    write_session(tmp_path / 'bag', ImuSamples(stamps, force, np.zeros((n, 3)), 'imu_link'))
    found = identify_recording(tmp_path / 'bag')
    assert found.figures.sensors == ('accelerometer',)
    assert list(found.figures.recording['unusable']) == ['gyroscope']
    # 4000 readings determine the density to 1.1 %.
    for axis in found.figures.accelerometer:
        assert axis.white == pytest.approx(0.015 / np.sqrt(100.0), rel=0.06)


def test_wrapped_rates_are_named(calibration, tmp_path):
    """Turns at up to 3.6 rad/s in a range of 2.2 rad/s."""
    imu = readings(10284, n_poses=14)
    end = 2.2
    wrapped = np.abs(imu.rate_s) > end
    rate = np.where(wrapped, imu.rate_s - 2 * end * np.sign(imu.rate_s), imu.rate_s)
    n_wrapped = int(np.count_nonzero(wrapped.any(axis=1)))
    assert n_wrapped
    write_session(tmp_path / 'bag', replace(imu, rate_s=rate), storage='sqlite3')
    corrected = compensate_recording(tmp_path / 'bag', calibration)
    assert corrected.wrapped >= n_wrapped
    assert corrected.exit_code == 3
    assert any(str(corrected.wrapped) in line for line in corrected.warnings)
    (look,) = inspect_recording(
        tmp_path / 'bag', [Topics()], GravityReference(), options=CalibrationOptions()
    )
    assert look.streams['imu'].dropped['wrapped'] == corrected.wrapped
    # Readings within the range are not named.
    assert compensate_recording(imu, calibration).wrapped == 0
