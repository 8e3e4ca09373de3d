"""Accelerometer and gyroscope on two Imu topics, each with zeros for the other sensor."""

import json

import numpy as np
import pytest
from refusal import refused

from imu_calibration.api.calibrate import calibrate_recordings
from imu_calibration.api.choices import calibration_options
from imu_calibration.api.compensate import compensate_recording
from imu_calibration.api.inspect import imu_topics_of, inspect_recording, split_topics
from imu_calibration.api.recordings import Topics
from imu_calibration.cli.main import main
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples
from imu_calibration.references.gravity.gravity_reference import GravityReference
from msg_adapters.bag import open_recording
from msg_adapters.bag_writer import BagWriter
from msg_adapters.definitions import standard_definition
from msg_adapters.imu import IMU_TYPE
from msg_adapters.layout import Packed
from msg_adapters.write import encode_imu

from worlds.small_hand import ACCELEROMETER, GRAVITY, GYROSCOPE, hand_motion


def written(path, accel, gyro):
    """Write a bag with one Imu topic for each sensor."""
    with BagWriter(path, 'mcap') as writer:
        for name, imu in (('/accel', accel), ('/gyro', gyro)):
            topic = writer.add_topic(name, standard_definition(IMU_TYPE))
            packed = Packed.of_rows(encode_imu(imu))
            writer.write(np.full(len(imu), topic), imu.stamp_ns, packed)
    return path


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
    return written(path, accel, gyro)


@pytest.fixture(scope='module')
def calibration(bag):
    return calibrate_recordings(
        bag, imu_topic='/accel', gyroscope_topic='/gyro', gravity=GRAVITY, model_as_asked=True
    ).calibration


def test_both_sensors_are_calibrated(calibration):
    found = calibration
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


def test_each_of_several_pairs_is_proposed(tmp_path):
    """Two cameras: the words of the names tell which topics belong together."""
    rng = np.random.default_rng(84)
    stamps = 10**18 + 5_000_000 * np.arange(800)
    nothing = np.full((800, 3), np.nan)
    with BagWriter(tmp_path / 'bag', 'mcap') as writer:
        for name in ('/cam1/accel', '/cam1/gyro', '/cam2/accel', '/cam2/gyro', '/cam3/gyro'):
            force, rate = rng.normal([0, 0, 9.8], 0.01, (800, 3)), nothing
            if name.endswith('gyro'):
                force, rate = nothing, rng.normal(0, 1e-3, (800, 3))
            packed = Packed.of_rows(encode_imu(ImuSamples(stamps, force, rate, 'imu_link')))
            topic = writer.add_topic(name, standard_definition(IMU_TYPE))
            writer.write(np.full(800, topic), stamps, packed)
    each = imu_topics_of(tmp_path / 'bag', Topics())
    looks = inspect_recording(
        tmp_path / 'bag', each, GravityReference(), options=calibration_options({})
    )
    pairs = [(pair.imu, pair.gyroscope) for pair in split_topics(looks)]
    assert pairs == [('/cam1/accel', '/cam1/gyro'), ('/cam2/accel', '/cam2/gyro')]
    noted = []
    for look in looks:
        if any(finding.check == 'split' for finding in look.findings):
            noted.append(look.recording.imu_topic)
    assert sorted(noted) == ['/cam1/accel', '/cam1/gyro', '/cam2/accel', '/cam2/gyro']


@pytest.mark.parametrize('faster', ['/gyro', '/accel'])
def test_the_corrected_topic_has_both_sensors(bag, calibration, tmp_path, faster):
    """
    True readings at the stamps of the slower topic, in the frame of the accelerometer.

    Of the first second at rest; the bounds are ten times the noise of a mean of 80 readings.
    """
    topics = {'imu_topic': '/accel', 'gyroscope_topic': '/gyro'}
    if faster == '/accel':
        bag = exchanged(bag, tmp_path / 'exchanged')
    found = compensate_recording(bag, calibration, output=tmp_path / 'corrected', **topics)
    assert found.exit_code == 0 and not found.warnings
    with open_recording(tmp_path / 'corrected', '/imu/data_corrected', want_joints=False) as made:
        corrected = ImuSamples.concatenate([block.imu for block in made.blocks()])
    assert corrected.frame_id == 'accel'
    in_memory = compensate_recording(bag, calibration, **topics).imu
    np.testing.assert_array_equal(corrected.stamp_ns, in_memory.stamp_ns)
    np.testing.assert_allclose(corrected.force_s, in_memory.force_s, rtol=1e-12)
    np.testing.assert_allclose(corrected.rate_s, in_memory.rate_s, rtol=1e-9, atol=1e-12)
    still = corrected.stamp_ns < corrected.stamp_ns[0] + 10**9
    length = np.linalg.norm(corrected.force_s[still].mean(axis=0))
    assert length == pytest.approx(GRAVITY, rel=1e-3)
    assert np.abs(corrected.rate_s[still].mean(axis=0)).max() < 1e-3


def exchanged(bag, path):
    """Write a bag whose accelerometer is faster: 160 Hz, interpolated; its gyroscope has 80 Hz."""
    parts = {}
    for name in ('/accel', '/gyro'):
        with open_recording(bag, name, want_joints=False) as recording:
            parts[name] = ImuSamples.concatenate([block.imu for block in recording.blocks()])
    accel, gyro = parts['/accel'], parts['/gyro']
    force = np.empty((len(gyro), 3))
    for axis in range(3):
        force[:, axis] = np.interp(gyro.stamp_ns, accel.stamp_ns, accel.force_s[:, axis])
    accel = ImuSamples(gyro.stamp_ns, force, np.zeros_like(force), 'accel')
    gyro = gyro.select(slice(None, None, 2))
    return written(path, accel, gyro)
