"""Live readings in other units: conversion, covariances, and the check before the first output."""

from dataclasses import replace

import numpy as np
import pytest
from refusal import refused
from test_live_compensation import field, imu_samples, messages

from imu_calibration.api.compensate import compensate_recording
from imu_calibration.compensation.unit_gate import MOST_READINGS, GravityScale, UnitGate
from imu_calibration.core.errors import InputError
from imu_calibration.core.readings import RawReadings, combined
from imu_calibration.core.samples import ImuSamples
from imu_calibration.effects.base import Role
from imu_calibration.nodes.message_compensation import WITHHELD, LiveCompensation
from validation.imu_messages import patch_imu

from worlds.compensation_cases import random_calibration

G, DEG = 9.80665, np.pi / 180
IN_G = combined(RawReadings(), accelerometer_unit='g', gyroscope_unit='deg/s')


def raw_of(imu):
    return replace(imu, force_s=imu.force_s / G, rate_s=imu.rate_s / DEG)


def test_live_readings_in_g_and_deg_are_corrected_to_si():
    calibration, imu = random_calibration(4), imu_samples()
    live = LiveCompensation(calibration, readings=IN_G)
    cov = np.diag([1e-6, 4e-6, 9e-6])
    plain = LiveCompensation(calibration)
    out, expected = [], []
    for raw, si in zip(messages(raw_of(imu)), messages(imu), strict=True):
        out.append(live(patch_imu(raw, force_cov=cov / G**2, rate_cov=cov / DEG**2)))
        expected.append(plain(patch_imu(si, force_cov=cov, rate_cov=cov)))
    for name in ('force_s', 'rate_s'):
        np.testing.assert_allclose(
            [field(d, name) for d in out], [field(d, name) for d in expected], rtol=1e-9, atol=1e-9
        )
    for name in ('force_cov', 'rate_cov'):
        np.testing.assert_allclose(field(out[-1], name), field(expected[-1], name), rtol=1e-9)


def run(gate, lengths, period=0.01):
    """Return which readings pass."""
    return [
        gate.passes(10**9 + round(k * period * 1e9), (0.1 * length, 0.0, length * 0.99**0.5))
        for k, length in enumerate(lengths)
    ]


@pytest.mark.parametrize('length', [1.0, 980.0, 16384.0, 0.05])
def test_no_reading_in_another_unit_passes(length):
    rng = np.random.default_rng(5)
    gate = UnitGate(RawReadings())
    assert not any(run(gate, length * (1 + 0.005 * rng.standard_normal(400))))
    code = 'without_gravity' if length < 0.5 else 'force_unit'
    assert gate.error is not None and gate.error.code == code


def test_the_first_reading_of_gravity_opens_and_a_motion_does_not_close():
    gate = UnitGate(RawReadings())
    assert all(run(gate, [9.8, *np.linspace(9.8, 160.0, 200), *np.full(200, 1.0)]))


def test_a_shock_at_the_start_delays_the_first_output_by_one_window():
    gate = UnitGate(RawReadings())
    passed = run(gate, [60.0, *np.full(300, 9.75)])
    assert passed.index(True) == 100 and gate.error is None and all(passed[100:])


def test_a_violent_motion_at_the_start_delays_the_output_by_one_window():
    shaken = 40.0 + 25.0 * np.sin(np.arange(400))
    passed = run(UnitGate(RawReadings()), [60.0, *shaken])
    assert passed.index(True) == 100 and all(passed[100:])


def test_frozen_stamps_do_not_keep_the_gate_from_a_decision():
    gate = UnitGate(RawReadings())
    assert not any(run(gate, np.ones(MOST_READINGS), period=0.0))
    assert gate.error is not None and gate.error.code == 'force_unit'
    gate = UnitGate(RawReadings())
    assert run(gate, [60.0, *np.full(MOST_READINGS, 9.75)], period=0.0)[-1]


def test_a_shaken_imu_in_g_does_not_pass():
    gate = UnitGate(RawReadings())
    assert not any(run(gate, np.tile([1.0, 1.0, 1.0, 5.0, 0.6], 100)))


def test_withheld_messages_are_counted_by_their_reason():
    live = LiveCompensation(random_calibration(4), gate=UnitGate(RawReadings()))
    raw = messages(raw_of(imu_samples()))
    assert [live(data) for data in raw] == [None] * len(raw)
    assert live.counts[WITHHELD] == len(raw)


def made_for(scale):
    """Return a calibration of an accelerometer that reads `scale` times the truth."""
    calibration = random_calibration(4, (), ())
    values = calibration.values.copy()
    for role in (Role.LINEAR, Role.OFFSET):
        values[calibration.model.part('accelerometer', role)] *= scale
    return replace(calibration, values=values)


def at_rest(scale, n=400):
    noise = np.random.default_rng(10460).normal(0.0, 0.01, (n, 6))
    readings = noise + [0.1, 0.2, scale * G, 0.0, 0.0, 0.0]
    return ImuSamples(10**9 + 10**7 * np.arange(n), readings[:, :3], readings[:, 3:], 'imu_link')


@pytest.mark.parametrize(('scale', 'given'), [(0.48, 2.0), (1.9, 0.45), (2.3, 0.8)])
def test_a_calibration_for_another_scale_is_refused(scale, given):
    """Readings of a usual length, which this calibration makes four times as long as gravity."""
    imu = at_rest(given)
    with refused(InputError, 'corrected_scale', 9.807):
        compensate_recording(imu, made_for(scale))
    gate = UnitGate(RawReadings(), GravityScale(made_for(scale)))
    assert not any(map(gate.passes, imu.stamp_ns.tolist(), imu.force_s.tolist()))
    assert gate.error is not None and gate.error.code == 'corrected_scale'


@pytest.mark.parametrize(('scale', 'given', 'code'), [(0.5, 1.0, 3), (1.0, 0.5, 3), (0.5, 0.5, 0)])
def test_a_calibration_for_a_doubtful_scale_is_a_caution(scale, given, code):
    imu = at_rest(given)
    found = compensate_recording(imu, made_for(scale))
    assert (len(found.cautions), found.exit_code) == (code // 3, code)
    gate = UnitGate(RawReadings(), GravityScale(made_for(scale)))
    assert any(map(gate.passes, imu.stamp_ns.tolist(), imu.force_s.tolist()))
