"""
Serialized message in, corrected serialized message out.

The same as the catalogue's compensation, and the rules of the message.
"""

import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from imu_calibration.compensation.compensate import Transfer
from imu_calibration.compensation.covariance import Uncertainty
from imu_calibration.compensation.stream import CompensationStream
from imu_calibration.core.samples import ImuSamples, TemperatureSamples
from imu_calibration.nodes.message_compensation import LiveCompensation
from imu_calibration.preprocessing.stamping import MIN_PERIOD_STEPS
from msg_adapters.imu import FIELDS, N_DOUBLES
from msg_adapters.write import encode_imu
from validation.imu_messages import parse_imu, patch_imu

from worlds.compensation_cases import random_calibration, random_motion

PERIOD_NS = 2_000_000
TRANSFER = Transfer.from_pose('base_link', (0.4, -0.3, 0.2), (0.3, 1.0, -2.0))
KNOWN = np.array([[4e-4, 1e-4, 0], [1e-4, 9e-4, -2e-4], [0, -2e-4, 5e-4]])


def imu_samples(n=200, seed=0):
    force, rate, _, _ = random_motion(n, seed)
    rate = np.cumsum(rate, axis=0) * 0.01
    return ImuSamples(10**18 + PERIOD_NS * np.arange(n), force, rate, 'imu_link')


def messages(imu, **covariances):
    return [row.tobytes() for row in encode_imu(imu, **covariances)]


def field(data, name):
    return np.array(parse_imu(data).doubles[FIELDS[name]])


def big_endian(data):
    body = len(data) - 8 * N_DOUBLES
    words = struct.unpack_from('<iII', data, 4)
    doubles = struct.unpack_from(f'<{N_DOUBLES}d', data, body)
    return (
        b'\0\0'
        + data[2:4]
        + struct.pack('>iII', *words)
        + data[16:body]
        + struct.pack(f'>{N_DOUBLES}d', *doubles)
    )


@pytest.mark.parametrize('transfer', [None, TRANSFER], ids=['in place', 'transfer'])
@pytest.mark.parametrize(
    'effects',
    [
        ((), ()),
        (('accel_size_effect',), ()),
        (('accel_size_effect', 'accel_quadratic'), ('gyro_g_sensitivity',)),
    ],
)
def test_messages_come_out_as_blocks_do_offline(effects, transfer):
    calibration, imu = random_calibration(2, *effects), imu_samples()
    live = LiveCompensation(calibration, transfer)
    out = [live(data) for data in messages(imu)]
    offline = CompensationStream(calibration, transfer=transfer).correct(imu)
    # The window of the derivative starts after the warm-up and is up to 20 ms + 20 ms long.
    settled = slice(MIN_PERIOD_STEPS + 60, None)
    np.testing.assert_allclose(
        [field(d, 'force_s') for d in out[settled]], offline.force[settled], atol=1e-9
    )
    np.testing.assert_allclose(
        [field(d, 'rate_s') for d in out[settled]], offline.rate[settled], atol=1e-10
    )
    assert [parse_imu(d).stamp_ns for d in out] == imu.stamp_ns.tolist()
    assert {parse_imu(d).frame_id for d in out} == {'imu_link' if transfer is None else 'base_link'}
    assert (live.received, live.corrected, dict(live.counts)) == (200, 200, {})


def test_everything_but_the_readings_and_their_covariances_stays_to_the_last_bit():
    live = LiveCompensation(random_calibration(2))
    for data in messages(imu_samples(5)):
        data = patch_imu(data, orientation=(0.1, 0.2, 0.3, 0.9), orientation_cov=KNOWN)
        out = live(data)
        assert len(out) == len(data)
        assert out[: len(data) - 8 * 24] == data[: len(data) - 8 * 24]
        assert out[-8 * 24 :] != data[-8 * 24 :]


def test_both_byte_orders_are_understood():
    calibration = random_calibration(2)
    one, other = LiveCompensation(calibration), LiveCompensation(calibration)
    for data in messages(imu_samples(30)):
        out = one(data)
        assert other(big_endian(data)) == big_endian(out)


def test_covariances_follow_the_message_definition():
    calibration = random_calibration(2, ())
    data = messages(imu_samples(1), rate_cov=KNOWN)[0]
    live = LiveCompensation(calibration)
    out = live(data)
    uncertainty = Uncertainty(calibration)
    expected = uncertainty.at().covariances(uncertainty.noise[0], KNOWN)  # the force's was unknown
    np.testing.assert_allclose(field(out, 'force_cov').reshape(3, 3), expected[0], rtol=1e-9)
    np.testing.assert_allclose(field(out, 'rate_cov').reshape(3, 3), expected[1], rtol=1e-9)
    without = LiveCompensation(calibration, with_parameters=False)(data)
    inverse = np.linalg.inv(calibration.value('gyroscope', 'matrix'))
    np.testing.assert_allclose(
        field(without, 'rate_cov').reshape(3, 3), inverse @ KNOWN @ inverse.T, rtol=1e-8, atol=1e-14
    )


@pytest.mark.parametrize(('absent', 'present'), [('rate', 'force'), ('force', 'rate')])
def test_an_absent_quantity_is_left_untouched(absent, present):
    calibration = random_calibration(2)
    live = LiveCompensation(calibration)
    for data in messages(imu_samples(40)):
        data = patch_imu(
            data, **{f'{absent}_s': (np.nan,) * 3, f'{absent}_cov': [-1.0] + [0.0] * 8}
        )
        out = live(data)
    np.testing.assert_array_equal(field(out, f'{absent}_s'), field(data, f'{absent}_s'))
    np.testing.assert_array_equal(field(out, f'{absent}_cov'), field(data, f'{absent}_cov'))
    assert np.isfinite(field(out, f'{present}_s')).all()
    sensor, bias = ('accelerometer', 'bias') if present == 'force' else ('gyroscope', 'bias')
    expected = np.linalg.inv(calibration.value(sensor, 'matrix')) @ (
        field(data, f'{present}_s') - calibration.value(sensor, bias)
    )
    np.testing.assert_allclose(field(out, f'{present}_s'), expected, atol=1e-12)


def test_covariances_are_taken_anew_at_the_present_motion():
    live = LiveCompensation(random_calibration(2))
    data = messages(imu_samples(200))  # a new slope changes the covariance after each sample
    before = [live(d) for d in data][-1]
    fast = patch_imu(data[-1], rate_s=(20.0, -30.0, 25.0))
    live(fast)
    assert np.array_equal(field(live(data[-1]), 'force_cov'), field(before, 'force_cov'))
    live(fast)
    live.refresh()
    assert not np.allclose(
        field(live(data[-1]), 'force_cov'), field(before, 'force_cov'), rtol=0.05
    )


def test_lost_doubled_and_late_messages_leave_the_others_right():
    calibration, imu, rng = random_calibration(2), imu_samples(400), np.random.default_rng(9)
    clean = LiveCompensation(calibration)
    expected = dict(enumerate(field(clean(d), 'force_s') for d in messages(imu)))
    order = [k for k in range(400) if rng.random() > 0.05]
    order = [k for k in order for _ in range(1 + (rng.random() < 0.05))]
    for i in np.flatnonzero(rng.random(len(order) - 1) < 0.05):
        order[i], order[i + 1] = order[i + 1], order[i]
    live, data = LiveCompensation(calibration), messages(imu)
    out = [field(live(data[k]), 'force_s') for k in order]
    error = [np.abs(force - expected[k]).max() for k, force in zip(order, out, strict=True)][60:]
    # Beside a hole or a late sample the angular acceleration is that of its neighbour: arms of 20
    # mm, jumps of 0.01 x 5 rad/s in 2 ms.
    assert len(out) == len(order) and max(error) < 0.02 * 2 * 25.0
    assert np.median(error) < 1e-3


def test_a_burst_of_nan_is_held_back_and_leaves_no_trace():
    calibration, imu = random_calibration(2), imu_samples()
    data = messages(imu)
    broken = [
        patch_imu(d, rate_s=(np.nan, 0, 0)) if 100 <= k < 103 else d for k, d in enumerate(data)
    ]
    live, clean = LiveCompensation(calibration), LiveCompensation(calibration)
    expected = [clean(d) for d in data]
    out = [live(d) for d in broken]
    assert [k for k, d in enumerate(out) if d is None] == [100, 101, 102]
    assert live.counts == {'not finite': 3}
    np.testing.assert_allclose(
        field(out[150], 'force_s'), field(expected[150], 'force_s'), atol=1e-10
    )
    assert np.isfinite([field(d, 'force_s') for d in out[103:]]).all()


def test_another_frame_is_not_corrected_unless_asked():
    data = messages(replace(imu_samples(3), frame_id='somebody_else'))
    live = LiveCompensation(random_calibration(2))
    assert [live(d) for d in data] == [None] * 3
    assert live.counts == {"frame_id 'somebody_else'": 3}
    assert (
        parse_imu(LiveCompensation(random_calibration(2), check_frame=False)(data[0])).frame_id
        == 'somebody_else'
    )
    mixed = [live(d) for d in messages(imu_samples(3)) for d in (d, data[0])]
    assert [d is None for d in mixed] == [False, True] * 3


def test_memory_stays_bounded_whatever_frames_come():
    live, data = LiveCompensation(random_calibration(2)), messages(imu_samples(1))[0]
    for k in range(100):
        live(patch_imu(data, frame_id=f'frame_{k}'))
    assert sum(live.counts.values()) == 100 and len(live.counts) <= 31


def test_transfer_turns_orientation_and_its_covariance():
    rotation = Rotation.from_euler('xyz', [0.3, -0.5, 1.0])
    data = patch_imu(
        messages(imu_samples(1))[0], orientation=rotation.as_quat(), orientation_cov=KNOWN
    )
    out = LiveCompensation(random_calibration(2), TRANSFER)(data)
    mat_wt = Rotation.from_quat(field(out, 'orientation')).as_matrix()
    np.testing.assert_allclose(mat_wt, rotation.as_matrix() @ TRANSFER.mat_ts.T, atol=1e-14)
    np.testing.assert_allclose(
        field(out, 'orientation_cov').reshape(3, 3),
        TRANSFER.mat_ts @ KNOWN @ TRANSFER.mat_ts.T,
        atol=1e-16,
    )
    absent = LiveCompensation(random_calibration(2), TRANSFER)(messages(imu_samples(1))[0])
    np.testing.assert_array_equal(
        field(absent, 'orientation'), field(messages(imu_samples(1))[0], 'orientation')
    )
    assert field(absent, 'orientation_cov')[0] == -1.0


def test_a_new_calibration_goes_on_where_the_old_one_stops():
    calibration, data = random_calibration(2), messages(imu_samples())
    alone, first = LiveCompensation(calibration), LiveCompensation(calibration)
    expected = [alone(d) for d in data]
    out = [first(d) for d in data[:100]]
    second = LiveCompensation(calibration)
    second.prepare(first)
    second.follow(first)
    out += [second(d) for d in data[100:]]
    np.testing.assert_allclose(
        [field(d, 'force_s') for d in out], [field(d, 'force_s') for d in expected], atol=1e-10
    )
    assert second.received == second.corrected == 200


def test_saturated_readings_are_marked_by_their_covariance():
    calibration = random_calibration(2, ('accel_saturation',))
    values = calibration.values.copy()
    values[calibration.model.slices['accelerometer', 'accel_saturation']] = 20.0
    live = LiveCompensation(replace(calibration, values=values))
    data = messages(imu_samples(1))[0]
    usual, marked = (
        live(patch_imu(data, force_s=(1.0, 2.0, 9.0))),
        live(patch_imu(data, force_s=(20.0, 2.0, 9.0))),
    )
    assert field(usual, 'force_cov')[0] < 1.0
    np.testing.assert_allclose(
        field(marked, 'force_cov').reshape(3, 3), 400.0 * np.eye(3), rtol=1e-5
    )
    np.testing.assert_array_equal(field(marked, 'rate_cov'), field(usual, 'rate_cov'))
    assert live.counts == {'saturated': 1}


def test_thermal_effects_wait_for_a_temperature_and_use_it():
    calibration, imu = (
        random_calibration(2, ('accel_thermal_bias',), ('gyro_thermal_scale',)),
        imu_samples(3),
    )
    live, data = LiveCompensation(calibration), messages(imu)
    assert live(data[0]) is None and live.counts == {'no temperature yet': 1}
    live.set_temperature(float('nan'))
    assert live(data[0]) is None
    live.set_temperature(37.0)
    offline = CompensationStream(
        calibration, temperature=TemperatureSamples(imu.stamp_ns[:1], np.array([37.0]))
    ).correct(imu)
    np.testing.assert_allclose(field(live(data[2]), 'force_s'), offline.force[2], atol=1e-12)


def test_stamps_move_only_when_asked():
    calibration = random_calibration(2)
    model = calibration.model.with_effect('reference', 'time_offset')
    late = replace(
        calibration,
        model=model,
        values=np.append(calibration.values, 3e-3),
        covariance=np.pad(calibration.covariance, (0, 1)),
        status=calibration.status + ('determined',),
    )
    data, stamp = messages(imu_samples(1))[0], 10**18
    assert parse_imu(LiveCompensation(late)(data)).stamp_ns == stamp
    moved = LiveCompensation(late, correct_stamps=True)(data)
    assert parse_imu(moved).stamp_ns == stamp - 3_000_000
    assert moved[12:] == LiveCompensation(late)(data)[12:]


@given(st.binary(max_size=400), st.integers(0, 360))
def test_broken_bytes_are_counted_and_harm_nobody(noise, cut):
    live, data = LiveCompensation(random_calibration(2)), messages(imu_samples(2))
    assert live(data[0]) is not None
    for broken in (noise, data[0][:cut], b''):
        live(broken)
    assert live(data[1]) is not None
