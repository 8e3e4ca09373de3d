"""Readings that are increments over one sample, as navigation files have them."""

from dataclasses import replace

import numpy as np
import pytest
from refusal import refused

from imu_calibration.api.calibrate import calibrate_recordings, check_recording
from imu_calibration.api.compensate import compensate_recording
from imu_calibration.api.inspect import imu_topics_of
from imu_calibration.api.recordings import Topics
from imu_calibration.compensation.unit_gate import UnitGate
from imu_calibration.core.errors import InputError
from imu_calibration.core.readings import RawReadings, SensorUnit, combined, unit_of
from imu_calibration.core.samples import ImuSamples, SampleBlock
from imu_calibration.document.calibration_text import calibration_from_text, calibration_to_text
from msg_adapters.csv_log import LogOptions

from worlds.hand_sessions import GRAVITY, simulate, unpack

G, DEG = 9.80665, np.pi / 180


@pytest.fixture(scope='module')
def session():
    """Return (samples in SI, ranges at rest, truth, samples per second)."""
    imu, ranges, values = simulate(5, n_poses=16, still=2.5, force_sd=0.004, rate_sd=4e-4)
    return imu, ranges, values, 1e9 / float(np.median(np.diff(imu.stamp_ns)))


def parameters(found, sensor, effect):
    return found.values[found.model.slices[sensor, effect]]


def increments_of(imu, per_second):
    """Return the samples as angle and velocity over one sample."""
    return replace(imu, force_s=imu.force_s / per_second, rate_s=imu.rate_s / per_second)


def test_increments_are_detected_stated_stored_and_applied(session):
    imu, ranges, values, per_second = session
    raw = SampleBlock(increments_of(imu, per_second))
    with pytest.raises(InputError) as caught:
        calibrate_recordings(raw, gravity=GRAVITY)
    assert (caught.value.code, caught.value.key) == ('increments', 'increments')
    assert float(caught.value.value) == pytest.approx(per_second, rel=1e-3)

    found = calibrate_recordings(
        raw, gravity=GRAVITY, increments=per_second, model_as_asked=True
    ).calibration
    bias_f, _, _, matrix_w = unpack(values)
    np.testing.assert_allclose(parameters(found, 'accelerometer', 'bias'), bias_f, atol=5e-3)
    np.testing.assert_allclose(
        parameters(found, 'gyroscope', 'matrix'), matrix_w.ravel(), atol=2e-3
    )
    stored = calibration_from_text(calibration_to_text(found))
    assert stored.readings == found.readings
    assert stored.readings.gyroscope.scale == pytest.approx(1 / per_second, rel=1e-9)

    corrected = compensate_recording(raw, stored).imu
    lengths = [np.linalg.norm(np.nanmean(corrected.force_s[part], axis=0)) for part in ranges]
    np.testing.assert_allclose(lengths, GRAVITY, rtol=1e-3)
    assert check_recording(raw, stored, gravity=GRAVITY).helps
    with refused(InputError, 'force_unit'):  # readings in SI
        compensate_recording(SampleBlock(imu), stored)


def test_increments_of_another_rate_are_refused(session):
    imu, _, _, per_second = session
    raw = SampleBlock(increments_of(imu, per_second))
    found = calibrate_recordings(raw, gravity=GRAVITY, increments=per_second).calibration
    half = ImuSamples(imu.stamp_ns[::2], raw.imu.force_s[::2], raw.imu.rate_s[::2], imu.frame_id)
    with pytest.raises(InputError) as caught:
        compensate_recording(half, found)
    assert caught.value.code == 'increments_rate'
    assert float(caught.value.value) == pytest.approx(per_second / 2, rel=1e-3)
    with refused(InputError, 'increments_rate'):
        calibrate_recordings(raw, gravity=GRAVITY, increments=2 * per_second)


def test_units_of_increments_are_read_from_their_text():
    in_g = unit_of('accelerometer', 'increments:250*g')
    assert in_g.scale == pytest.approx(1 / (250 * G), rel=1e-12)
    counts = unit_of('gyroscope', 'increments:100*counts:65.5/dps')
    assert counts.convert(np.array([65.5])) == pytest.approx([100 * DEG], rel=1e-12)
    of_file = RawReadings.from_mapping(
        {'accelerometer': {'unit': 'counts', 'scale': 400.0, 'offset': 12.0}}
    )
    stated = combined(of_file, increments=50.0).accelerometer
    assert stated == SensorUnit('increments:50*counts', 8.0, 12.0)
    read_again = RawReadings.from_mapping({'accelerometer': stated.to_mapping()})
    assert read_again.accelerometer == stated
    again = combined(combined(of_file, increments=50.0), increments=100.0).accelerometer
    assert again == SensorUnit('increments:100*counts', 4.0, 12.0)


@pytest.mark.parametrize('per_second', [0.0, -100.0, np.nan, np.inf, 1e6])
def test_samples_per_second_must_be_possible(per_second):
    with refused(InputError, 'increments_rate'):
        combined(RawReadings(), increments=per_second)


@pytest.mark.parametrize(
    'header',
    [
        'time,dtheta_x,dtheta_y,dtheta_z,dvel_x,dvel_y,dvel_z',
        'time,delta_angle_x,delta_angle_y,delta_angle_z,delta_v_x,delta_v_y,delta_v_z',
    ],
)
def test_a_log_of_increments_names_the_option(tmp_path, session, header):
    imu, _, values, per_second = session
    raw = increments_of(imu, per_second)
    rows = np.column_stack([(imu.stamp_ns - imu.stamp_ns[0]) * 1e-9, raw.rate_s, raw.force_s])
    log = tmp_path / 'log.csv'
    np.savetxt(log, rows, '%.12g', ',', header=header, comments='')
    with pytest.raises(InputError) as caught:
        calibrate_recordings(log, gravity=GRAVITY)
    assert (caught.value.code, caught.value.key) == ('increments', 'increments')
    assert len(imu_topics_of(log, Topics(log=LogOptions(raw=('force', 'rate'))))) == 1
    found = calibrate_recordings(
        log, gravity=GRAVITY, increments=per_second, model_as_asked=True
    ).calibration
    np.testing.assert_allclose(
        parameters(found, 'accelerometer', 'bias'), unpack(values)[0], atol=5e-3
    )


def test_the_node_names_increments():
    gate = UnitGate(RawReadings())
    passed = [gate.passes(10**9 + k * 5_000_000, (0.0, 0.003, GRAVITY / 200)) for k in range(300)]
    assert not any(passed)
    assert gate.error is not None and gate.error.code == 'increments'
    assert float(gate.error.value) == pytest.approx(200.0, rel=0.01)


@pytest.mark.parametrize(
    ('per_second', 'opens'), [(200.0, True), (100.0, False)], ids=['as stated', 'at half the rate']
)
def test_the_node_compares_the_rate_of_increments_of_either_sensor(per_second, opens):
    """Angles over 5 ms that arrive at 100 Hz would be rates of twice their value."""
    gate = UnitGate(combined(RawReadings(), gyroscope_unit='increments:200*rad/s'))
    stamps = 10**9 + np.arange(400) * round(1e9 / per_second)
    passed = [gate.passes(int(stamp), (0.0, 0.003, GRAVITY)) for stamp in stamps]
    assert not any(passed[: int(0.9 * per_second)]) and passed[-1] == opens
    assert (gate.error is None) == opens
    if not opens:
        assert (gate.error.code, float(gate.error.value)) == ('increments_rate', 100.0)
