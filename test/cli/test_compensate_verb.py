"""``imu_calibration compensate``: from a bag of a known sensor to a bag of true readings."""

from dataclasses import replace
from shutil import rmtree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_copying import raw_messages

from imu_calibration.api.compensate import compensate_recording as compensate_samples
from imu_calibration.cli.main import main
from imu_calibration.compensation.covariance import Uncertainty
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples, TemperatureSamples
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.effects.forward_equations import sensor_output
from imu_calibration.kinematics.rotations import Reference, lever_matrix
from imu_calibration.kinematics.signal_history import ThermalBranch
from msg_adapters.bag import open_recording
from msg_adapters.imu import FIELDS
from msg_adapters.write import write_session
from validation.imu_messages import parse_imu

from worlds.compensation_cases import FURTHER, random_calibration

PERIOD_NS = 2_000_000
N = 3000
EFFECTS = {
    'usual': (('accel_size_effect',), ()),
    'all': (FURTHER['accelerometer'], FURTHER['gyroscope']),
}


def true_motion():
    """
    Return the readings of a smooth motion that starts and ends at rest.

    They are (stamps, force, rate, alpha, temperature).
    """
    time = PERIOD_NS * 1e-9 * np.arange(N)
    phase, w = np.array([0.0, 1.0, 2.0]), np.array([2.0, 1.5, 3.0])
    rate = np.sin(np.outer(time, w) + phase)
    alpha = w * np.cos(np.outer(time, w) + phase)
    force = 9.8 * np.stack([np.sin(0.5 * time), np.zeros(N), np.cos(0.5 * time)], axis=1)
    return 10**18 + PERIOD_NS * np.arange(N), force, rate, alpha, np.linspace(20.0, 35.0, N)


def write_case(folder, effects):
    """
    Write a bag of what a sensor with these effects reads, and its calibration.

    Return the calibration.
    """
    calibration = random_calibration(7, *EFFECTS[effects], sd=1e-5)
    stamps, force, rate, alpha, temperature = true_motion()
    branch = np.interp(
        stamps - stamps[0], stamps[::100] - stamps[0], ThermalBranch().of(temperature[::100])
    )
    ref = Reference(
        np.zeros(N),
        np.broadcast_to(np.eye(3), (N, 3, 3)),
        force,
        rate,
        alpha,
        9.8,
        temperature,
        branch,
    )
    readings = [
        sensor_output(calibration.model, sensor, calibration.values, ref=ref)
        for sensor in ('accelerometer', 'gyroscope')
    ]
    thermometer = TemperatureSamples(stamps[::100], temperature[::100])
    write_session(
        folder / 'bag', ImuSamples(stamps, *readings, 'imu_link'), temperature=thermometer
    )
    folder.joinpath('calibration.yaml').write_text(calibration_to_text(calibration))
    return calibration


def compensate(folder, *more, bag='bag'):
    return main(
        [
            'compensate',
            f'{folder}/{bag}',
            '--calibration',
            f'{folder}/calibration.yaml',
            '--output',
            f'{folder}/out',
            *more,
        ]
    )


@pytest.mark.parametrize('effects', EFFECTS)
def test_the_corrected_topic_holds_the_true_readings(tmp_path, effects, capsys):
    calibration = write_case(tmp_path, effects)
    assert compensate(tmp_path) == 0
    assert '/imu/data_corrected (3000 samples)' in capsys.readouterr().out
    stamps, force, rate, _, temperature = true_motion()
    with open_recording(tmp_path / 'out', '/imu/data_corrected', want_joints=False) as recording:
        imu = ImuSamples.concatenate(
            [block.imu for block in recording.blocks() if block.imu is not None]
        )
    np.testing.assert_array_equal(imu.stamp_ns, stamps)
    # Temperature between its stamps is linear in the bag as in the truth; only the delay of the
    # derivative, 20 ms at most, and g-sensitivity that sees it are left: 9 rad/s^3 x 0.02 s x 0.035
    # m.
    late = 9.0 * 0.02 * 0.035
    assert np.abs(imu.force_s - force)[100:-100].max() < late
    assert np.abs(imu.rate_s - rate)[100:-100].max() < (
        1e-3 * late * 10 if effects == 'all' else 1e-12
    )
    message = parse_imu(raw_messages(tmp_path / 'out', '/imu/data_corrected')[0][1])
    cov = np.array(message.doubles[FIELDS['rate_cov']]).reshape(3, 3)
    # a block of readings has the covariance of its last one
    dt = float(temperature[-1]) - calibration.model.temperature_ref_c
    expected = (
        Uncertainty(calibration)
        .at(force[-1], rate[-1], warming=dt)
        .covariances(*Uncertainty(calibration).noise)[1]
    )
    # Was unknown, so it is the calibration's noise.
    assert np.diag(cov) == pytest.approx(np.diag(expected), rel=0.05)


def test_readings_at_another_point_and_frame_of_the_body(tmp_path):
    write_case(tmp_path, 'usual')
    pose = '--target-xyz', '0.2', '-0.1', '0.3', '--target-rpy', '0.1', '0.2', '-1.5'
    assert compensate(tmp_path, '--target-frame', 'base_link', *pose) == 0
    _, force, rate, alpha, _ = true_motion()
    mat_ts = Rotation.from_euler('xyz', [0.1, 0.2, -1.5]).as_matrix()
    rate_t, alpha_t = rate @ mat_ts.T, alpha @ mat_ts.T
    expected = force @ mat_ts.T - lever_matrix(rate_t, alpha_t) @ np.array([0.2, -0.1, 0.3])
    parsed = [parse_imu(data) for _, data in raw_messages(tmp_path / 'out', '/imu/data_corrected')]
    assert {message.frame_id for message in parsed} == {'base_link'}
    got = np.array([message.doubles for message in parsed])[100:-100]
    # The window of the derivative is up to 40 ms long at an arm of 0.37 m: 9 rad/s^3 x 0.02 s x 0.4
    # m.
    assert np.abs(got[:, FIELDS['force_s']] - expected[100:-100]).max() < 9.0 * 0.021 * 0.4
    np.testing.assert_allclose(got[:, FIELDS['rate_s']], rate_t[100:-100], atol=1e-12)
    without_arm = np.abs(got[:, FIELDS['force_s']] - (force @ mat_ts.T)[100:-100]).max()
    assert without_arm > 0.5


def test_a_gyroscope_that_is_absent_does_not_spoil_the_accelerometer(tmp_path):
    calibration = write_case(tmp_path, 'usual')
    stamps, force, _, _, _ = true_motion()
    readings = force @ calibration.value('accelerometer', 'matrix').T + calibration.value(
        'accelerometer', 'bias'
    )
    absent = np.diag([-1.0, 0.0, 0.0])
    write_session(
        tmp_path / 'half',
        ImuSamples(stamps, readings, np.full((N, 3), np.nan), 'imu_link'),
        rate_cov=absent,
    )
    assert compensate(tmp_path, bag='half') == 0
    parsed = [parse_imu(data) for _, data in raw_messages(tmp_path / 'out', '/imu/data_corrected')]
    got = np.array([message.doubles for message in parsed])
    np.testing.assert_allclose(got[:, FIELDS['force_s']], force, atol=1e-12)
    # The absent sensor is copied as it was recorded.
    assert np.all(got[:, FIELDS['rate_s']] == 0.0)
    assert np.all(got[:, FIELDS['rate_cov']] == absent.ravel())


def test_saturated_readings_are_marked_in_the_bag(tmp_path):
    calibration = write_case(tmp_path, 'usual')
    limited = replace(
        calibration,
        model=calibration.model.with_effect('gyroscope', 'gyro_saturation'),
        values=np.append(calibration.values, 0.9),
        covariance=np.pad(calibration.covariance, (0, 1)),
        status=calibration.status + ('determined',),
    )
    tmp_path.joinpath('calibration.yaml').write_text(calibration_to_text(limited))
    assert compensate(tmp_path) == 0
    pairs = zip(
        raw_messages(tmp_path / 'bag', '/imu/data_raw'),
        raw_messages(tmp_path / 'out', '/imu/data_corrected'),
        strict=True,
    )
    for (_, raw), (_, corrected) in pairs:
        saturated = np.abs(parse_imu(raw).doubles[FIELDS['rate_s']]).max() >= 0.9 * (1 - 1e-6)
        assert (
            parse_imu(corrected).doubles[FIELDS['rate_cov']][0] == pytest.approx(0.81, rel=1e-5)
        ) == saturated


def test_stamps_move_only_when_asked(tmp_path):
    calibration = write_case(tmp_path, 'usual')
    late = replace(
        calibration,
        model=calibration.model.with_effect('reference', 'time_offset'),
        values=np.append(calibration.values, 3e-3),
        covariance=np.pad(calibration.covariance, (0, 1)),
        status=calibration.status + ('determined',),
    )
    tmp_path.joinpath('calibration.yaml').write_text(calibration_to_text(late))
    stamps = true_motion()[0]
    for more, shift in (((), 0), (('--correct-stamps',), 3_000_000)):
        assert compensate(tmp_path, *more) == 0
        got = [
            parse_imu(data).stamp_ns
            for _, data in raw_messages(tmp_path / 'out', '/imu/data_corrected')
        ]
        assert got == (stamps - shift).tolist()
        rmtree(tmp_path / 'out')


@pytest.mark.parametrize(
    ('more', 'words'),
    [
        (('--imu-topic', '/imu/data_corrected'), '/imu/data_corrected'),
        (('--target-xyz', '1', '0', '0'), 'needs the name of that frame'),
    ],
)
def test_what_cannot_be_done_is_refused_in_one_line(tmp_path, capsys, more, words):
    write_case(tmp_path, 'usual')
    if '--imu-topic' in more:
        compensate(tmp_path)
        (tmp_path / 'out').rename(tmp_path / 'twice')
        code = compensate(tmp_path, *more, '--corrected-topic', '/again', bag='twice')
    else:
        code = compensate(tmp_path, *more)
    error = capsys.readouterr().err
    assert code == 1 and words in error and error.count('\n') == 1
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize(
    'per_si, code',
    [
        (1 / 9.80665, 'force_unit'),
        (1e3 / 9.80665, 'force_unit'),
        (2048 / 9.80665, 'force_unit'),
        (0.01, 'without_gravity'),
    ],
)
def test_readings_in_another_unit_are_refused_before_anything_is_written(
    tmp_path, per_si, code, capsys
):
    """Readings in g, mg, counts or without gravity: biases in m/s^2 do not belong to them."""
    write_case(tmp_path, 'usual')
    with open_recording(tmp_path / 'bag', '/imu/data_raw', want_joints=False) as recording:
        imu = ImuSamples.concatenate(
            [block.imu for block in recording.blocks() if block.imu is not None]
        )
    other = replace(imu, force_s=imu.force_s * per_si)
    write_session(tmp_path / 'other', other)
    assert compensate(tmp_path, bag='other') == 1
    assert 'm/s^2' in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()
    with pytest.raises(InputError) as error:
        compensate_samples(other, tmp_path / 'calibration.yaml')
    assert error.value.code == code
