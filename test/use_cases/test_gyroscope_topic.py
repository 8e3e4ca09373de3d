"""Accelerometer and gyroscope on two Imu topics, each with zeros for the other sensor."""

import json

import numpy as np
import pytest
from refusal import refused

from imu_calibration.cli.main import main
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples
from imu_calibration.use_cases.calibrate import calibrate_recordings
from msg_adapters.bag_writer import BagWriter
from msg_adapters.definitions import standard_definition
from msg_adapters.imu import IMU_TYPE
from msg_adapters.layout import Packed
from msg_adapters.write import encode_imu

from worlds.small_hand import ACCELEROMETER, GRAVITY, GYROSCOPE, hand_motion


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """The force at 80 Hz on /accel, the rate at 160 Hz on /gyro."""
    motion, generator = hand_motion(hz=160.0, n_poses=14, seed=81), np.random.default_rng(81)
    stamps = 10**18 + np.round(motion.time * 1e9).astype(np.int64)
    nothing = np.zeros_like(motion.force)
    accel = ImuSamples(stamps, ACCELEROMETER.read(motion.force, generator), nothing, 'accel')
    accel = accel.select(slice(None, None, 2))
    gyro = ImuSamples(stamps, nothing, GYROSCOPE.read(motion.rate, generator), 'gyro')
    path = tmp_path_factory.mktemp('split') / 'bag'
    with BagWriter(path, 'mcap') as writer:
        for name, imu in (('/accel', accel), ('/gyro', gyro)):
            topic = writer.add_topic(name, standard_definition(IMU_TYPE))
            packed = Packed.of_rows(encode_imu(imu))
            writer.write(np.full(len(imu), topic), imu.stamp_ns, packed)
    return path


def test_both_sensors_are_calibrated(bag):
    result = calibrate_recordings(bag, imu_topic='/accel', gyroscope_topic='/gyro', gravity=GRAVITY)
    found = result.calibration
    assert found.decisions == {'accelerometer': 'helps', 'gyroscope': 'helps'}
    # x of the body is the x axis of the accelerometer in both matrices
    matrix = GYROSCOPE.matrix
    for name, true in (('bias', GYROSCOPE.bias), ('matrix', matrix)):
        error = found.value('gyroscope', name) - true
        part = found.model.slices['gyroscope', name]
        assert np.sqrt(np.mean((error.ravel() / found.sd[part]) ** 2)) < 2.0
    assert found.provenance['options']['gyroscope_topic'] == '/gyro'


def test_a_topic_that_is_missing_is_named(bag):
    with refused(InputError, 'topic_unknown', '/gyr'):
        calibrate_recordings(bag, imu_topic='/accel', gyroscope_topic='/gyr', gravity=GRAVITY)


def test_one_topic_alone_is_one_sensor(bag):
    found = calibrate_recordings(bag, imu_topic='/accel', gravity=GRAVITY)
    assert list(found.calibration.decisions) == ['accelerometer']
    assert found.exit_code == 3


def two_topics(path, of_accel, of_gyro):
    """Write two Imu topics, /accel and /gyro, of a resting IMU."""
    rng = np.random.default_rng(83)
    stamps = 10**18 + 5_000_000 * np.arange(800)
    force, rate = rng.normal([0, 0, 9.8], 0.01, (800, 3)), rng.normal(0, 1e-3, (800, 3))
    with BagWriter(path, 'mcap') as writer:
        for name, (has_force, has_rate), nothing in (
            ('/accel', of_accel, np.nan),
            ('/gyro', of_gyro, 0.0),
        ):
            imu = ImuSamples(
                stamps,
                force if has_force else np.full_like(force, nothing),
                rate if has_rate else np.full_like(rate, nothing),
                'imu_link',
            )
            topic = writer.add_topic(name, standard_definition(IMU_TYPE))
            writer.write(np.full(len(imu), topic), imu.stamp_ns, Packed.of_rows(encode_imu(imu)))
    return str(path)


@pytest.mark.parametrize(
    ('of_accel', 'of_gyro', 'split'),
    [
        ((True, False), (False, True), True),
        ((True, True), (False, True), False),
        ((True, False), (True, False), False),
        ((True, True), (True, True), False),
    ],
)
def test_inspect_proposes_to_read_the_topics_of_two_sensors_together(
    of_accel, of_gyro, split, tmp_path, capsys
):
    bag = two_topics(tmp_path / 'bag', of_accel, of_gyro)
    main(['inspect', bag])
    assert ('--imu-topic /accel --gyroscope-topic /gyro' in capsys.readouterr().out) == split
    main(['inspect', bag, '--json'])
    looks = json.loads(capsys.readouterr().out)['result']['imu']
    checks = [[finding['check'] for finding in look['findings']] for look in looks]
    assert ['split' in each for each in checks] == [split, split]


def test_nothing_is_proposed_where_both_topics_are_read(tmp_path, capsys):
    bag = two_topics(tmp_path / 'bag', (True, False), (False, True))
    main(['inspect', bag, '--imu-topic', '/accel', '--gyroscope-topic', '/gyro'])
    assert 'one sensor per topic' not in capsys.readouterr().out
