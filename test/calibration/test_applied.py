"""
One function applies a calibration.

`check` reports the error of the compensated bag, and effects that it cannot undo are applied as a
constant.
"""

from dataclasses import replace

import numpy as np
import pytest

import imu_calibration as imu
from imu_calibration.api.recordings import Topics, source_of
from imu_calibration.core.samples import ImuSamples, SampleBlock, TemperatureSamples
from imu_calibration.core.units import DEG
from imu_calibration.document.calibration_text import calibration_from_text, calibration_to_text
from imu_calibration.document.trust import END, MEAN, caveats
from imu_calibration.effects.catalogue import CATALOGUE, term
from imu_calibration.effects.expressions import ColumnCentre
from imu_calibration.effects.forward_equations import centred, sensor_output
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.rotations import Reference
from imu_calibration.preprocessing.sample_recording import read_recording
from imu_calibration.references.gravity.hand_calibration import gather_by_hand
from imu_calibration.references.gravity.pose_readings import prove_hand_readings
from imu_calibration.references.turntable.held_out_windows import HeldOutWindows
from msg_adapters.write import write_session

from worlds.hand_sessions import GRAVITY, simulate

FEW = (
    'accel_quadratic+accel_bias_drift+gyro_g_sensitivity+gyro_bandwidth+gyro_bias_drift+'
    'gyro_bias_trend+time_offset'
)
DRIFTS = 'accel_bias_drift+gyro_bias_drift+gyro_bias_trend'
FORMULA = CATALOGUE.with_effects(
    term(
        'warm_force',
        sensor='gyroscope',
        column='f_x * (temperature_c - temperature_ref_c)',
        unit='(rad/s)/(m/s^2)/K',
        tolerance=1e-6,
        text='A formula.',
        largest=1e-4,
    )
)
SESSIONS = {
    'findings': {'effects': ['accel_quadratic', 'gyro_g_sensitivity', 'gyro_bias_drift']},
    'temperature': {
        'effects': ['accel_thermal_bias', 'gyro_thermal_scale', 'warm_force'],
        'catalogue': FORMULA,
    },
}
RATES = {'imu_rate': 50.0, 'joint_rate': 50.0}


def spoiled(calibration, seed=3):
    """
    Return a calibration with values that are off by a few per mille.

    So that the errors after compensation are no noise alone.
    """
    rng = np.random.default_rng(seed)
    return replace(
        calibration,
        values=calibration.values * (1 + 3e-3 * rng.normal(size=len(calibration.values))),
    )


def same(found, wanted):
    """Assert that two entries of proofs have the same errors in total and in each regime."""
    assert found.regimes.keys() == wanted.regimes.keys()
    pairs = [(found, wanted)]
    pairs += [(found.regimes[name], wanted.regimes[name]) for name in wanted.regimes]
    for part, other in pairs:
        assert (part.before, part.after) == pytest.approx((other.before, other.after), rel=1e-9)
        assert part.ci95 == pytest.approx(other.ci95, rel=1e-9)
        assert (part.seconds, part.unit) == (other.seconds, other.unit)


@pytest.mark.parametrize('name', SESSIONS)
def test_check_reports_the_error_of_the_compensated_bag(name, tmp_path):
    session = imu.simulate('six_faces', seed=4, **RATES, **SESSIONS[name])
    session.save(tmp_path / 'bag')
    known = spoiled(session.truth)
    checked = imu.check(tmp_path / 'bag', known, session.table)
    imu.compensate(tmp_path / 'bag', known, output=tmp_path / 'corrected', anyway=True)
    written = imu.check(
        tmp_path / 'corrected', known, session.table, imu_topic='/imu/data_corrected'
    )
    assert checked.proof.keys() == {'accelerometer', 'gyroscope'}
    for sensor, entry in checked.proof.items():
        assert entry.after == pytest.approx(written.proof[sensor].before, rel=1e-9)
        for regime, part in entry.regimes.items():
            assert part.after == pytest.approx(
                written.proof[sensor].regimes[regime].before, rel=1e-9
            )


def test_check_by_hand_reports_the_error_of_the_compensated_bag(tmp_path):
    samples, ranges, _ = simulate(6, n_poses=16)
    write_session(tmp_path / 'bag', samples)
    known = spoiled(imu.calibrate(tmp_path / 'bag', gravity=GRAVITY, candidates=FEW).calibration)
    checked = imu.check(tmp_path / 'bag', known, gravity=GRAVITY)
    imu.compensate(tmp_path / 'bag', known, output=tmp_path / 'corrected', anyway=True)
    raw, corrected = (
        read_recording(source_of(tmp_path / 'corrected', Topics(topic), want_joints=False)).imu
        for topic in ('/imu/data_raw', '/imu/data_corrected')
    )
    written = prove_hand_readings(gather_by_hand(raw), raw, corrected, gravity=GRAVITY)
    for sensor, entry in checked.proof.items():
        assert (
            entry.after == pytest.approx(written[sensor].after, rel=1e-9)
            and entry.after < 0.5 * entry.before
        )


def test_the_proof_from_window_statistics_differs_by_the_square_of_the_errors():
    """With the same values for all folds: held-out statistics against corrected readings."""
    from imu_calibration.calibration.proof import prove
    from imu_calibration.effects.forward_equations import applied_values

    effects = ['accel_quadratic', 'gyro_g_sensitivity']
    session = imu.simulate('six_faces', seed=4, effects=effects)
    result = imu.calibrate(
        session.samples,
        session.table,
        accelerometer_model='bias+matrix+accel_size_effect+accel_quadratic',
        gyroscope_model='bias+matrix+gyro_g_sensitivity',
        model_as_asked=True,
    ).result
    model, values = (
        result.solution.model,
        applied_values(result.solution.model, result.solution.values),
    )
    dealt = result.gathered.held_out.restricted(result.data.model, model)
    found = prove(HeldOutWindows(result.solution, [values], [], dealt, {}))
    checked = imu.check(session.samples, result.calibration, session.table)
    for sensor, entry in checked.proof.items():
        assert found[sensor].after == pytest.approx(entry.after, rel=0.02)


def drifting(size=0.5 * DEG, time_constant=35.0):
    """
    Return a session with a gyroscope bias that drifts by `size` on each axis.

    It is (samples, table, bias at the end, bias at the start, duration in s).
    """
    session = imu.simulate('quick', seed=7, **RATES)
    time = 1e-9 * (session.samples.imu.stamp_ns - session.samples.imu.stamp_ns[0])
    course = (
        -size * np.expm1(-time / time_constant)
        if np.isfinite(time_constant)
        else size * time / time[-1]
    )
    bias = session.truth.value('gyroscope', 'bias')
    moved = replace(
        session.samples,
        imu=replace(session.samples.imu, rate_s=session.samples.imu.rate_s + course[:, None]),
    )
    return moved, session.table, bias + course[-1], bias, time[-1]


@pytest.mark.long
def test_a_drift_is_applied_as_its_value_at_the_end_and_proven_on_the_last_third():
    samples, table, at_end, at_start, duration = drifting()
    calibration = imu.calibrate(samples, table, candidates=DRIFTS).calibration
    bias, sd = (
        calibration.value('gyroscope', 'bias'),
        calibration.sd[calibration.model.slices['gyroscope', 'bias']],
    )
    assert (
        np.all(np.abs(bias - at_end) < 5 * sd)
        and np.all(sd < 0.05 * DEG)
        and np.all(np.abs(bias - at_start) > 0.4 * DEG)
    )
    (entry,) = calibration.statistics['uncorrected']
    assert (entry['effect'], entry['applied']) == ('gyro_bias_drift', END)
    assert 0.05 * DEG < min(entry['rms']) and max(entry['rms']) < 0.5 * DEG
    line = next(line for line in caveats(calibration) if 'gyro_bias_drift' in line)
    assert line in imu.compensate(samples, calibration, anyway=True).warnings
    judged, every = (
        calibration.proof['gyroscope'].windows,
        sum(calibration.statistics['windows'].values()),
    )
    assert 0.2 * every < judged < 0.5 * every
    assert calibration.proof['gyroscope'].after < 0.2 * DEG
    again = calibration_from_text(calibration_to_text(calibration))
    np.testing.assert_array_equal(
        again.model.centre['gyro_warm_up'].constant,
        calibration.model.centre['gyro_warm_up'].constant,
    )
    assert not calibration.model.centre['gyro_warm_up'].slope.any()
    ref_start, ref_end = (model_output(again, time) for time in (0.0, duration))
    np.testing.assert_allclose(ref_end, bias, atol=1e-3 * DEG)
    np.testing.assert_allclose(ref_start - ref_end, at_start - at_end, atol=0.1 * DEG)


@pytest.mark.parametrize(
    'name, size, time_constant',
    [
        pytest.param('gyro_bias_drift', 1.5 * DEG, 400.0, marks=pytest.mark.long),
        ('gyro_bias_trend', 0.4 * DEG, np.inf),
    ],
)
def test_a_drift_that_has_not_settled_is_applied_as_its_mean_and_proven_on_all_windows(
    name, size, time_constant
):
    """Its value at the end holds neither afterwards nor in a session that repeats it."""
    samples, table, at_end, at_start, duration = drifting(size, time_constant)
    calibration = imu.calibrate(samples, table, candidates=DRIFTS).calibration
    (entry,) = calibration.statistics['uncorrected']
    assert (entry['effect'], entry['applied']) == (name, MEAN)
    time = np.linspace(0.0, duration, 1000)
    course = (
        -size * np.expm1(-time / time_constant)
        if np.isfinite(time_constant)
        else size * time / duration
    )
    np.testing.assert_allclose(
        calibration.value('gyroscope', 'bias'), at_start + course.mean(), atol=0.03 * course[-1]
    )
    np.testing.assert_allclose(entry['rms'], course.std(), rtol=0.1)
    assert calibration.proof['gyroscope'].windows > 0.5 * sum(
        calibration.statistics['windows'].values()
    )
    assert not any('starts again' in line for line in caveats(calibration))


def model_output(calibration, time):
    """Return the output of the gyroscope of a calibration at rest at a time, rad/s, shape (3,)."""
    nothing = np.zeros((1, 3))
    ref = Reference(np.array([time]), np.eye(3)[None], nothing, nothing, nothing, 0.0)
    return sensor_output(calibration.model, 'gyroscope', calibration.values, ref=ref)[0]


def test_a_centred_model_has_the_output_of_the_model():
    """Bias and matrix contain what the columns lose, for any centre; the slope is exact."""
    rng = np.random.default_rng(3)
    effect = term(
        'own',
        sensor='gyroscope',
        column=['time * w_x', 'time', 'c_xz'],
        unit='1',
        tolerance=1e-4,
        text='A formula.',
    )
    model = SensorModel(
        gyroscope=('bias', 'matrix', 'own'), catalogue=CATALOGUE.with_effects(effect)
    )
    values = rng.normal(size=len(model.param_names))
    parts = ColumnCentre(rng.normal(size=3), rng.normal(size=(3, 3)), 'rate_s')
    centre = {'own': parts}
    motion = [rng.normal(size=(9, 3)) for _ in range(3)]
    ref = Reference(np.arange(9.0), rng.normal(size=(9, 3, 3)), *motion, 9.8)

    moved, slope = centred(model, values, centre)

    wanted = sensor_output(model, 'gyroscope', values, ref=ref)[0]
    found = sensor_output(replace(model, centre=centre), 'gyroscope', moved, ref=ref)[0]
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12)
    np.testing.assert_allclose(moved, slope @ values, rtol=0, atol=1e-12)


def test_a_scale_that_settles_is_applied_as_its_mean_over_the_motion():
    """
    In another session it starts again: its part in the matrix is that of a plain fit.

    Uncertainty 1e-4: noise of the matrix.
    """
    effect = term(
        'settling_scale',
        sensor='gyroscope',
        column=[f'(1 - exp(-time / 80)) * w_{axis}' for axis in 'xyz'],
        unit='1',
        tolerance=1e-4,
        text='A formula.',
    )
    session = imu.simulate('quick', seed=5, **RATES)
    samples = session.samples
    time = 1e-9 * (samples.imu.stamp_ns - samples.imu.stamp_ns[0])
    growth = -np.expm1(-time / 80)[:, None]
    rate = samples.imu.rate_s
    moved = replace(samples, imu=replace(samples.imu, rate_s=rate + 0.02 * growth * rate))
    calibration = imu.calibrate(
        moved,
        session.table,
        catalogue=CATALOGUE.with_effects(effect),
        gyroscope_model='bias+matrix+settling_scale',
        model_as_asked=True,
    ).result.calibration
    mean = (growth * rate**2).sum(axis=0) / (rate**2).sum(axis=0)
    change = np.diag(
        calibration.value('gyroscope', 'matrix') - session.truth.value('gyroscope', 'matrix')
    )
    np.testing.assert_allclose(change, 0.02 * mean, rtol=0, atol=4e-4)
    np.testing.assert_allclose(
        calibration.value('gyroscope', 'settling_scale'), 0.02, rtol=0, atol=4e-4
    )
    stored = calibration_from_text(calibration_to_text(calibration)).model.centre['settling_scale']
    centre = calibration.model.centre['settling_scale']
    np.testing.assert_allclose(stored.constant, centre.constant, rtol=1e-9)
    np.testing.assert_allclose(stored.slope, centre.slope, rtol=1e-9)


def test_a_formula_in_the_joint_angle_is_centred_on_the_mean_of_the_recording():
    """
    The bias contains its mean.

    Without that the applied bias is off by the mean, here ten times the scatter about it.
    """
    effect = term(
        'by_angle',
        sensor='gyroscope',
        column='cos(0.1 * angle_1)',
        unit='rad/s',
        tolerance=1e-4,
        text='A formula.',
    )
    session = imu.simulate('six_faces', seed=5, **RATES)
    catalogue, mean = CATALOGUE.with_effects(effect), 0.5 * DEG
    moved = replace(
        session.samples, imu=replace(session.samples.imu, rate_s=session.samples.imu.rate_s + mean)
    )
    result = imu.calibrate(
        moved,
        session.table,
        catalogue=catalogue,
        gyroscope_model='bias+matrix+by_angle',
        model_as_asked=True,
    ).result
    calibration = result.calibration
    assert calibration.statistics['uncorrected'][0]['applied'] == MEAN
    truth = session.truth.value('gyroscope', 'bias') + mean
    uncentred = result.solution.values[result.model.slices['gyroscope', 'bias']]
    assert np.abs(calibration.value('gyroscope', 'bias') - truth).max() < 0.01 * DEG
    assert calibration.proof['gyroscope'].after < 0.05 * DEG
    part = calibration.model.slices['gyroscope', 'by_angle']
    mean_column = calibration.model.centre['by_angle'].constant
    np.testing.assert_allclose(
        calibration.value('gyroscope', 'bias') - uncentred,
        mean_column * calibration.values[part],
        rtol=1e-9,
    )


@pytest.mark.long
def test_a_drift_by_hand_is_applied_as_its_value_at_the_end():
    samples, _, truth = simulate(8, n_poses=24)
    time = 1e-9 * (samples.stamp_ns - samples.stamp_ns[0])
    course = -1.0 * DEG * np.expm1(-time / (0.3 * time[-1]))
    moved = SampleBlock(replace(samples, rate_s=samples.rate_s + course[:, None]))
    calibration = imu.calibrate(moved, gravity=GRAVITY, candidates=DRIFTS).calibration
    step = calibration.value('gyroscope', 'bias') - truth[9:12]
    np.testing.assert_allclose(step, course[-1], atol=0.05 * DEG)
    # Its columns are taken at a point, not at its prior.
    assert 'gyroscope.gyro_bias_drift.time_constant' not in calibration.held_reason
    assert calibration.statistics['uncorrected'][0]['applied'] == END
    assert calibration.proof['accelerometer'].windows < 24 / 2


def test_corrected_readings_travel_with_their_sample():
    from imu_calibration.preprocessing.window_finder import MotionGatherer

    session = imu.simulate('six_faces', seed=2, stamp_jitter_us=3000.0, **RATES)
    block = session.samples
    marked = replace(
        block,
        imu=replace(block.imu, corrected=np.hstack([2 * block.imu.force_s, 3 * block.imu.rate_s])),
    )
    windows = MotionGatherer(session.table, keep_unused=True).all_of([marked])
    assert sum(map(len, windows)) > 0.9 * len(block.imu)
    for window in windows:
        np.testing.assert_array_equal(
            window.corrected, np.hstack([2 * window.force_s, 3 * window.rate_s])
        )
    assert isinstance(block.imu, ImuSamples) and (
        block.temperature is None or isinstance(block.temperature, TemperatureSamples)
    )
