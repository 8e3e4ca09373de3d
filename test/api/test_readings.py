"""
Readings in other units than SI, from the recording to the corrected topic.

Situations of drivers in g, of register counts and of rates in other units, with own numbers.
"""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from refusal import refused

from imu_calibration.api.calibrate import calibrate_recordings, check_recording
from imu_calibration.api.compensate import compensate_recording
from imu_calibration.cli.main import main
from imu_calibration.core.errors import InputError
from imu_calibration.core.readings import RawReadings, parse_axes, unit_of
from imu_calibration.core.samples import ImuSamples, SampleBlock
from imu_calibration.document.calibration_text import calibration_from_text, calibration_to_text
from imu_calibration.effects.base import Role
from msg_adapters.bag import open_recording
from msg_adapters.write import write_session

from worlds.hand_sessions import GRAVITY, simulate, unpack

G, DEG = 9.80665, np.pi / 180
SIZES = {
    'g': G,
    'mg': 1e-3 * G,
    'counts:4096/g': G / 4096,
    'deg/s': DEG,
    'urad/s': 1e-6,
    'counts:65.5/(deg/s)': DEG / 65.5,
    'counts:32.8/dps': DEG / 32.8,
    'm/s^2': 1.0,
    'rad/s': 1.0,
}
"""Unit -> its size in SI, written a second time."""
PAIRS = (
    ('g', 'counts:32.8/dps'),
    ('mg', 'deg/s'),
    ('m/s^2', 'urad/s'),
    ('counts:4096/g', 'counts:65.5/(deg/s)'),
)


def session(seed=3):
    """Return (samples in SI, ranges at rest, truth) of a session by hand of 20 poses."""
    return simulate(seed, n_poses=20, still=3.0, force_sd=0.004, rate_sd=4e-4)


def in_units(imu, force_unit, rate_unit):
    """Return the samples as a driver with these units publishes them."""
    return ImuSamples(
        imu.stamp_ns, imu.force_s / SIZES[force_unit], imu.rate_s / SIZES[rate_unit], imu.frame_id
    )


@pytest.fixture(scope='module')
def truth():
    return session()


@pytest.fixture(scope='module')
def in_g(truth):
    """A calibration of readings in g and deg/s."""
    raw = in_units(truth[0], 'g', 'deg/s')
    units = {'accelerometer_unit': 'g', 'gyroscope_unit': 'deg/s'}
    return calibrate_recordings(
        SampleBlock(raw), gravity=GRAVITY, model_as_asked=True, **units
    ).calibration


@pytest.fixture(scope='module')
def in_si(truth):
    """A calibration of readings in SI."""
    return calibrate_recordings(
        SampleBlock(truth[0]), gravity=GRAVITY, model_as_asked=True
    ).calibration


def lengths_at_rest(imu, ranges):
    """Return the length of the mean force of each pose, m/s^2."""
    return np.array([np.linalg.norm(imu.force_s[part].mean(axis=0)) for part in ranges])


def max_z(calibration, truth):
    """Return the largest error of biases and matrices in units of its sd."""
    bias_f, matrix_f, bias_w, matrix_w = unpack(truth)
    errors = []
    for sensor, bias, matrix in (
        ('accelerometer', bias_f, matrix_f),
        ('gyroscope', bias_w, matrix_w),
    ):
        for effect, true in (('bias', bias), ('matrix', matrix)):
            part = calibration.model.slices[sensor, effect]
            off = calibration.values[part] - true.ravel()
            errors.append(np.abs(off / np.maximum(calibration.sd[part], 1e-12)))
    return float(np.max(np.concatenate(errors)))


@pytest.mark.parametrize(('force_unit', 'rate_unit'), PAIRS)
def test_units_travel_from_the_recording_to_the_corrected_readings(truth, force_unit, rate_unit):
    imu, ranges, values = truth
    raw = in_units(imu, force_unit, rate_unit)
    units = {'accelerometer_unit': force_unit, 'gyroscope_unit': rate_unit}
    found = calibrate_recordings(
        SampleBlock(raw), gravity=GRAVITY, model_as_asked=True, **units
    ).calibration
    assert max_z(found, values) < 5.0
    assert found.readings.accelerometer.scale == pytest.approx(1 / SIZES[force_unit], rel=1e-12)
    assert found.readings.gyroscope.scale == pytest.approx(1 / SIZES[rate_unit], rel=1e-12)
    read_again = calibration_from_text(calibration_to_text(found))
    assert read_again.readings == found.readings
    corrected = compensate_recording(SampleBlock(raw), read_again).imu
    np.testing.assert_allclose(lengths_at_rest(corrected, ranges), GRAVITY, rtol=1e-3)
    bias_w, matrix_w = unpack(values)[2:]
    true_rate = np.linalg.solve(matrix_w, (imu.rate_s - bias_w).T).T
    # The estimates differ from the truth by a few sd of 2e-4 (matrix) and 5e-5 rad/s (bias).
    assert np.nanmax(np.abs(corrected.rate_s - true_rate)) < 5e-3
    np.testing.assert_allclose(
        read_again.compensate(raw).force_s, corrected.force_s, rtol=1e-12, equal_nan=True
    )


def test_the_bag_of_compensate_holds_si_with_covariances_in_si(tmp_path, truth, in_g):
    imu, ranges, _ = truth
    write_session(tmp_path / 'raw', in_units(imu, 'g', 'deg/s'))
    (tmp_path / 'calibration.yaml').write_text(calibration_to_text(in_g))
    arguments = ['--calibration', str(tmp_path / 'calibration.yaml'), '--output']
    code = main(['compensate', str(tmp_path / 'raw'), *arguments, str(tmp_path / 'out')])
    assert code == 0
    with open_recording(tmp_path / 'out', '/imu/data_corrected', want_joints=False) as recording:
        blocks = [block.imu for block in recording.blocks() if block.imu is not None]
    corrected = ImuSamples.concatenate(blocks)
    np.testing.assert_allclose(lengths_at_rest(corrected, ranges), GRAVITY, rtol=1e-3)
    variance = in_g.readings.accelerometer.convert_covariance(np.eye(3) * 4e-6)
    np.testing.assert_allclose(variance, np.eye(3) * 4e-6 * G**2, rtol=1e-12)


def test_a_recording_in_another_unit_is_refused_with_the_option_that_states_it(
    tmp_path, truth, in_g, capsys
):
    """SI readings and a calibration in g: biases would be taken from 96 m/s^2."""
    imu, ranges, _ = truth
    write_session(tmp_path / 'si', imu)
    (tmp_path / 'calibration.yaml').write_text(calibration_to_text(in_g))
    command = ['compensate', str(tmp_path / 'si'), '--output', str(tmp_path / 'out')]
    command += ['--calibration', str(tmp_path / 'calibration.yaml')]
    assert main(command) == 1
    assert '(--accelerometer-unit m/s^2)' in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()
    with refused(InputError, 'force_unit') as caught:
        check_recording(SampleBlock(imu), in_g, gravity=GRAVITY)
    assert (caught.value.key, caught.value.value) == ('accelerometer_unit', 'm/s^2')
    stated = compensate_recording(
        SampleBlock(imu), in_g, accelerometer_unit='m/s^2', gyroscope_unit='rad/s'
    )
    np.testing.assert_allclose(lengths_at_rest(stated.imu, ranges), GRAVITY, rtol=1e-3)


def test_compensate_refuses_readings_without_gravity(tmp_path, truth, in_g):
    """A driver that subtracts gravity: the calibration is that of the readings with it."""
    imu = truth[0]
    motion = np.random.default_rng(7).normal(0.0, 0.03, imu.force_s.shape)
    write_session(tmp_path / 'free', replace(imu, force_s=motion))
    units = {'accelerometer_unit': 'm/s^2', 'gyroscope_unit': 'rad/s'}
    for output in (None, tmp_path / 'out'):
        with refused(InputError, 'without_gravity'):
            compensate_recording(tmp_path / 'free', in_g, output=output, **units)
    assert not (tmp_path / 'out').exists()


def test_rates_at_another_scale_than_the_calibrated_one_are_a_caution_or_refused(truth, in_g):
    raw = in_units(truth[0], 'g', 'deg/s')
    assert compensate_recording(raw, in_g).exit_code == 0
    half = compensate_recording(replace(raw, rate_s=0.5 * raw.rate_s), in_g)
    assert (len(half.cautions), half.exit_code) == (1, 3)
    values = in_g.values.copy()
    values[in_g.model.part('gyroscope', Role.LINEAR)] *= 0.48
    with refused(InputError, 'corrected_scale') as caught:  # 2 / 0.48 times the truth
        compensate_recording(replace(raw, rate_s=2.0 * raw.rate_s), replace(in_g, values=values))
    assert caught.value.key == 'gyroscope_unit'


@pytest.mark.parametrize('rate_unit', ['deg/s', 'counts:65.5/(deg/s)'])
def test_compensate_refuses_rates_in_another_unit(tmp_path, truth, in_si, rate_unit):
    """The whole recording is needed for it: no turn lies at its beginning."""
    imu, _, _ = truth
    raw = in_units(imu, 'm/s^2', rate_unit)
    with pytest.raises(InputError) as caught:
        compensate_recording(SampleBlock(raw), in_si)
    assert (caught.value.code, caught.value.key) == ('rate_unit', 'gyroscope_unit')
    write_session(tmp_path / 'raw', raw)
    (tmp_path / 'calibration.yaml').write_text(calibration_to_text(in_si))
    command = ['compensate', str(tmp_path / 'raw'), '--output', str(tmp_path / 'out')]
    command += ['--calibration', str(tmp_path / 'calibration.yaml')]
    assert main(command) == 1
    assert not (tmp_path / 'out').exists()
    assert main([*command, '--gyroscope-unit', rate_unit]) == 0


def test_check_reads_the_unit_from_the_calibration(in_g):
    later, _, _ = session(seed=3)
    found = check_recording(SampleBlock(in_units(later, 'g', 'deg/s')), in_g, gravity=GRAVITY)
    assert found.helps


@pytest.mark.parametrize(
    ('force_unit', 'rate_unit', 'key'),
    [
        ('g', 'rad/s', 'accelerometer_unit'),
        ('mg', 'rad/s', 'accelerometer_unit'),
        ('m/s^2', 'deg/s', 'gyroscope_unit'),
        ('m/s^2', 'urad/s', 'gyroscope_unit'),
    ],
)
def test_the_proposed_unit_is_that_of_the_readings(truth, force_unit, rate_unit, key):
    raw = in_units(truth[0], force_unit, rate_unit)
    with pytest.raises(InputError) as caught:
        calibrate_recordings(SampleBlock(raw), gravity=GRAVITY)
    proposed = {'accelerometer_unit': force_unit, 'gyroscope_unit': rate_unit}[key]
    assert (caught.value.key, caught.value.value) == (key, proposed)


def test_a_wrongly_stated_unit_is_refused_with_the_right_one(truth):
    raw = in_units(truth[0], 'mg', 'rad/s')
    with pytest.raises(InputError) as caught:
        calibrate_recordings(SampleBlock(raw), gravity=GRAVITY, accelerometer_unit='g')
    assert caught.value.value == 'mg'
    with pytest.raises(InputError) as caught:
        calibrate_recordings(SampleBlock(truth[0]), gravity=GRAVITY, gyroscope_unit='deg/s')
    assert (caught.value.key, caught.value.value) == ('gyroscope_unit', 'rad/s')


def test_counts_of_a_text_log_are_stated_for_calibrate_and_compensate(tmp_path, truth):
    """A log whose header names no unit and whose numbers are counts."""
    imu, ranges, values = truth
    raw = in_units(imu, 'counts:4096/g', 'counts:65.5/(deg/s)')
    rows = np.column_stack([(imu.stamp_ns - imu.stamp_ns[0]) * 1e-9, raw.force_s, raw.rate_s])
    log = tmp_path / 'log.csv'
    np.savetxt(log, rows, '%.4f', ',', header='time (s),ax,ay,az,gx,gy,gz', comments='')
    units = {'accelerometer_unit': 'counts:4096/g', 'gyroscope_unit': 'counts:65.5/(deg/s)'}
    found = calibrate_recordings(log, gravity=GRAVITY, model_as_asked=True, **units).calibration
    assert max_z(found, values) < 5.0
    corrected = compensate_recording(log, found).imu
    np.testing.assert_allclose(lengths_at_rest(corrected, ranges), GRAVITY, rtol=1e-3)
    columns = ['time=time (s):s', 'force=ax,ay,az:counts:4096/g', 'rate=gx,gy,gz:counts:65.5/dps']
    output = tmp_path / 'converted'
    assert main(['convert', str(log), '--columns', *columns, '--output', str(output)]) == 0
    with open_recording(output, want_joints=False) as recording:
        blocks = [block.imu for block in recording.blocks() if block.imu is not None]
    converted = ImuSamples.concatenate(blocks)
    np.testing.assert_allclose(converted.force_s, imu.force_s, atol=1e-4 * G / 4096)
    np.testing.assert_allclose(converted.rate_s, imu.rate_s, atol=1e-4 * DEG / 65.5)


def test_the_nominal_file_takes_flat_keys_and_those_of_the_document(tmp_path, truth):
    imu, _, _ = truth
    raw = ImuSamples(
        imu.stamp_ns, imu.force_s * 415.0 + 32768.0, imu.rate_s * 4770.0 + 32000.0, 'imu_link'
    )
    flat = {
        'accelerometer_offset': 32768,
        'accelerometer_scale': 415,
        'gyroscope_offset': 32000,
        'gyroscope_scale': 4770,
    }
    nested = {
        'accelerometer': {'unit': 'counts', 'scale': 415, 'offset': [32768] * 3},
        'gyroscope': {'unit': 'counts:4770/(rad/s)', 'offset': 32000},
    }
    found = []
    for name, content in (('flat', flat), ('nested', nested)):
        path = tmp_path / f'{name}.yaml'
        path.write_text(yaml.safe_dump(content))
        found.append(
            calibrate_recordings(
                SampleBlock(raw), gravity=GRAVITY, nominal=path, model_as_asked=True
            ).calibration
        )
    np.testing.assert_allclose(found[0].values, found[1].values, rtol=1e-9)
    path = tmp_path / 'nested.yaml'
    with refused(InputError, 'unit_twice', 'mg'):
        calibrate_recordings(SampleBlock(raw), nominal=path, accelerometer_unit='mg')


@pytest.mark.parametrize(
    ('mapping', 'code'),
    [
        ({'accelerometer': {'unit': 'furlong'}}, 'unit_unknown'),
        ({'accelerometer': {'unit': 'counts'}}, 'scale_missing'),
        ({'accelerometer': {'unit': 'g', 'scale': 0.2}}, 'unit_scale'),
        ({'accelerometer': {'unit': 'g', 'scale': 0}}, 'reading_number'),
        ({'gyroscope': {'scale': float('nan')}}, 'reading_number'),
        ({'gyroscope': {'offset': [1, 2]}}, 'reading_number'),
        ({'gyroscope': [1, 2]}, 'not_a_mapping'),
        ({'gyroscope': {'factor': 2}}, 'key_unknown'),
        ({'magnetometer': {}}, 'key_unknown'),
        ({'axes': 'x,y'}, 'axes_unknown'),
        ({'axes': 'x,x,z'}, 'axes_unknown'),
        ({'axes': [1]}, 'axes_unknown'),
        ({'axes': 'x,y,-z'}, 'axes_left_handed'),
    ],
)
def test_a_description_that_cannot_be_used_is_refused(in_g, mapping, code):
    with refused(InputError, code):
        RawReadings.from_mapping(mapping)
    document = yaml.safe_load(calibration_to_text(in_g))
    document['readings'] = mapping
    with refused(InputError, code):
        calibration_from_text(yaml.safe_dump(document))


@pytest.mark.parametrize('text', ['counts:0/g', 'counts:-4/g', 'counts:4/deg', 'counts:x/g', ''])
def test_a_unit_that_does_not_exist_is_refused(text):
    with refused(InputError, 'unit_unknown') as caught:
        unit_of('accelerometer', text)
    assert caught.value.key == 'accelerometer_unit'


def test_a_calibration_without_readings_is_si_in_axes_of_the_source(in_g):
    document = yaml.safe_load(calibration_to_text(in_g))
    del document['readings']
    found = calibration_from_text(yaml.safe_dump(document))
    assert found.readings == RawReadings() and found.readings.is_si
    assert 'readings' not in yaml.safe_load(calibration_to_text(found))


def test_axes_name_the_directions_forward_left_and_up():
    frd = RawReadings(axes='frd').mat_flu_source()
    np.testing.assert_array_equal(frd, np.diag([1.0, -1.0, -1.0]))
    np.testing.assert_array_equal(RawReadings(axes='x,-y,-z').mat_flu_source(), frd)
    turned = RawReadings(axes=parse_axes(' -X, +y,-z')).mat_flu_source()
    np.testing.assert_array_equal(turned, np.diag([-1.0, 1.0, -1.0]))
    assert RawReadings().mat_flu_source() is None
