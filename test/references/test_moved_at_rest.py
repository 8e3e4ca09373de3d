"""An IMU that was never still: hands or an engine move it in every pose."""

from dataclasses import replace

import numpy as np
import pytest
from refusal import refused
from scipy.ndimage import gaussian_filter1d

from imu_calibration.api.calibrate import calibrate_recordings
from imu_calibration.api.inspect import inspect_recording
from imu_calibration.api.recordings import Topics
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.errors import NotObservableError
from imu_calibration.core.samples import ImuSamples, SampleBlock
from imu_calibration.document.rest_noise import (
    MOVED_DENSITY,
    MOVED_TILT,
    moved_at_rest,
    rest_density,
    swayed_at_rest,
)
from imu_calibration.document.verdict import _step_of, judge
from imu_calibration.estimation.solution import LACKING, MOVED_REMEDY
from imu_calibration.references.gravity.gravity_reference import GravityReference
from imu_calibration.references.gravity.hand_calibration import gather_by_hand
from imu_calibration.references.gravity.sway import sway_at_rest

from worlds.candidates import FEW
from worlds.hand_sessions import GRAVITY, simulate

PERIOD_S = 0.01


def noise_of_motion(rng, n_samples, sd, correlation_s):
    """Return band-limited noise of three axes, shape (n, 3)."""
    smooth = gaussian_filter1d(rng.normal(size=(n_samples, 3)), correlation_s / PERIOD_S, axis=0)
    return sd * smooth / smooth.std()


def moved(seed, *, sway, shake, correlation_s):
    """Return a session by hand in which the IMU sways (rad/s) and shakes (m/s^2) all the time."""
    imu, _, _ = simulate(seed, n_poses=16, still=2.5, force_sd=0.01, rate_sd=1e-3)
    rng = np.random.default_rng(seed + 100)
    rate = noise_of_motion(rng, len(imu), sway, correlation_s)
    # The sway turns gravity: for small angles the force changes by force x angle.
    angle = np.cumsum(rate, axis=0) * PERIOD_S
    angle -= gaussian_filter1d(angle, 1.0 / PERIOD_S, axis=0)
    force = np.cross(imu.force_s, angle) + noise_of_motion(rng, len(imu), shake, correlation_s)
    return ImuSamples(imu.stamp_ns, imu.force_s + force, imu.rate_s + rate, imu.frame_id)


@pytest.mark.parametrize(
    ('sway', 'shake', 'correlation_s'), [(0.07, 0.4, 0.015), (0.12, 0.2, 0.02)]
)
def test_motion_at_rest_is_named_and_never_helps(sway, shake, correlation_s):
    imu = moved(4, sway=sway, shake=shake, correlation_s=correlation_s)
    found = calibrate_recordings(SampleBlock(imu), gravity=GRAVITY, candidates=FEW).calibration
    assert set(found.decisions.values()) <= {'unproven', 'harms'}
    for sensor in ('accelerometer', 'gyroscope'):
        text = moved_at_rest(found.by_hand, sensor)
        assert text and any(text in note for note in found.notes)
    # No pose and no turn repairs such a recording.
    lacking = [name for name, status in found.requested.items() if status in LACKING]
    assert lacking and {entry['needs'] for entry in found.undetermined} == {MOVED_REMEDY}
    for sensor in ('accelerometer', 'gyroscope'):
        assert _step_of(found, sensor) == (MOVED_REMEDY, None)
    # density of band-limited noise: sd^2 times twice the integral of its autocorrelation
    expected = shake * np.sqrt(2 * np.sqrt(np.pi) * correlation_s)
    assert rest_density(found.by_hand, 'accelerometer') == pytest.approx(expected, rel=0.5)


def test_a_steady_hand_is_not_named():
    imu = moved(5, sway=0.002, shake=0.01, correlation_s=0.02)
    found = calibrate_recordings(SampleBlock(imu), gravity=GRAVITY, candidates=FEW).calibration
    assert set(found.decisions.values()) == {'helps'}
    for sensor, limit in MOVED_DENSITY.items():
        assert 0 < rest_density(found.by_hand, sensor) < 0.3 * limit
        assert not moved_at_rest(found.by_hand, sensor)


def swaying(imu, amplitude):
    """Return samples of an IMU that also turns by ``amplitude sin(2 pi t / 1.4 s)`` (rad, xyz)."""
    speed = 2 * np.pi / 1.4
    time = np.arange(len(imu)) * PERIOD_S
    angle = amplitude * np.sin(speed * time)[:, None] * [1.0, -0.8, 0.6]
    rate = amplitude * speed * np.cos(speed * time)[:, None] * [1.0, -0.8, 0.6]
    force = imu.force_s + np.cross(imu.force_s, angle)
    return ImuSamples(imu.stamp_ns, force, imu.rate_s + rate, imu.frame_id)


def test_a_slow_sway_is_named_by_calibrate_and_inspect():
    imu, _, _ = simulate(10272, n_poses=14, period=PERIOD_S, still=2.5, force_sd=0.01, rate_sd=1e-3)
    # Rates of 4.5 mrad/s: the white noise of the rests does not show them.
    imu = swaying(imu, 1e-3)
    found = calibrate_recordings(SampleBlock(imu), gravity=GRAVITY).calibration
    text = swayed_at_rest(found.by_hand)
    assert text and any(text in note for note in found.notes)
    assert not any(moved_at_rest(found.by_hand, sensor) for sensor in found.sensors)
    lacking = [name for name, status in found.requested.items() if status in LACKING]
    assert lacking and {entry['needs'] for entry in found.undetermined} == {MOVED_REMEDY}

    options = CalibrationOptions(gravity=GRAVITY)
    (look,) = inspect_recording(SampleBlock(imu), [Topics()], GravityReference(), options=options)
    assert look.calibrated.calibration.by_hand['sway'] == found.by_hand['sway']


@pytest.mark.parametrize('amplitude', [3e-3, 1e-2])
def test_a_sway_that_leaves_no_attitude_at_rest_is_named(amplitude):
    imu, _, _ = simulate(10451, n_poses=5, period=PERIOD_S, still=2.5, force_sd=0.01, rate_sd=1e-3)
    with refused(NotObservableError, 'moved_at_rest', 4, 5, 'mrad'):
        gather_by_hand(swaying(imu, amplitude))
    # The cause of too few attitudes is another one where the IMU was still.
    imu, _, _ = simulate(10452, n_poses=3, period=PERIOD_S, still=2.5, force_sd=0.01, rate_sd=1e-3)
    with refused(NotObservableError, 'too_few_attitudes', 3):
        gather_by_hand(imu)


def test_the_tilt_of_a_sway_is_measured_and_noise_is_none():
    imu, ranges, _ = simulate(
        10273, n_poses=10, period=PERIOD_S, still=2.8, force_sd=0.1, rate_sd=8e-3, drift_sd=2e-3
    )

    def tilt_of(samples):
        forces = [samples.force_s[part] for part in ranges]
        return sway_at_rest(forces, [samples.rate_s[part] for part in ranges], np.full(10, 2.8))

    assert tilt_of(imu) < 0.3 * MOVED_TILT
    # Two periods: the mean square of a sine is a half; a third of it is along gravity.
    expected = 5e-3 * np.sqrt(0.5 * 2.0 * 2 / 3)
    assert tilt_of(swaying(imu, 5e-3)) == pytest.approx(expected, rel=0.15)


def test_a_sensor_without_a_determined_parameter_is_not_said_to_help():
    imu, _, _ = simulate(6, n_poses=14, still=2.0, force_sd=0.004, rate_sd=4e-4)
    found = calibrate_recordings(SampleBlock(imu), gravity=GRAVITY, candidates=FEW).calibration
    assert set(found.decisions.values()) == {'helps'}
    weak = tuple(
        'weak' if name.startswith('accelerometer') and status == 'determined' else status
        for name, status in zip(found.param_names, found.status, strict=True)
    )
    verdict = judge(replace(found, status=weak), np.ones(len(weak)))
    assert verdict.decisions == {'accelerometer': 'unproven', 'gyroscope': 'helps'}
