"""Exports: the formula of each program, written from its source, gives our compensation, or misses it by what was announced."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imu_calibration.calibration.comparison import compare
from imu_calibration.calibration.document import calibration_to_text
from imu_calibration.cli.main import main
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.effects.forward_equations import sensor_output
from imu_calibration.errors import InputError
from imu_calibration.exports.export import export
from imu_calibration.exports.gauges import lower_times_rotation, upper_times_rotation
from imu_calibration.exports.holdings import holding_of
from imu_calibration.exports.imported import import_file
from imu_calibration.exports.motion import motion_of, standard_motion
from imu_calibration.exports.registry import all_targets, find_target
from imu_calibration.reference.reference_motion import Reference, lever_matrix

from worlds import export_formulas as programs
from worlds.compensation_cases import FURTHER, random_calibration, random_motion

SEEDS = st.integers(0, 2**31)
EXACT = 1e-12
"""Rounding of some ten operations on numbers up to 40 (m/s^2, rad/s), relative to them."""
ROUND_TRIP = 1e-12


def motion(seed, n=40):
    force, rate, alpha, temperature = random_motion(n, seed)
    return motion_of(force, rate, alpha, temperature, 'a random motion')


def readings(calibration, ref):
    return tuple(sensor_output(calibration.model, sensor, calibration.values, ref) for sensor in SENSORS)


def with_values(calibration, **changed):
    """Return a calibration in which some roles of both sensors have other values; None: their prior."""
    values = calibration.values.copy()
    for effect in calibration.model.effects:
        if effect.role.name in changed:
            new = changed[effect.role.name]
            part = calibration.model.slices[effect.key]
            values[part] = effect.prior_values() if new is None else np.ravel(new(values[part].reshape(effect.shape)))
    return replace(calibration, values=values)


def applied(formula, content, *samples):
    """Return what a program makes of samples one by one, (force, rate)."""
    made = [formula(content.decode(), *each) for each in zip(*samples, strict=True)]
    return tuple(np.array(part) for part in zip(*made, strict=True))


def close(made, wanted):
    return all(np.allclose(m, w, rtol=0, atol=EXACT * 40) for m, w in zip(made, wanted, strict=True))


def rms(values):
    return float(np.sqrt(np.mean(values**2)))


def held_by(name, seed, **fields):
    """Return a random calibration with those effects alone that a target holds, biases gone where it estimates them."""
    target = find_target(name)
    model = random_calibration(seed, FURTHER['accelerometer'], FURTHER['gyroscope']).model
    kept = {sensor: tuple(e.name for e in model.effects if e.sensor == sensor and holding_of(e, target.holds) and e.role not in (Role.OFFSET, Role.LINEAR))
            for sensor in SENSORS}
    found = random_calibration(seed, kept['accelerometer'], kept['gyroscope'], **fields)
    return with_values(found, OFFSET=None) if holding_of(found.model.effects[0], target.estimates) else found


# Triangular times rotation

@given(SEEDS)
@settings(max_examples=50, deadline=None)
def test_a_matrix_is_a_triangle_times_a_rotation(seed):
    matrix = np.eye(3) + np.random.default_rng(seed).normal(0, 0.2, (3, 3))
    for split, half in ((lower_times_rotation, np.tril), (upper_times_rotation, np.triu)):
        triangle, turn = split(matrix)
        np.testing.assert_allclose(triangle @ turn, matrix, atol=1e-14)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(turn) > 0 and np.all(np.diag(triangle) > 0)
        np.testing.assert_allclose(half(triangle), triangle, atol=1e-15)


def test_left_handed_axes_are_refused():
    with pytest.raises(InputError, match='right-handed'):
        export(with_values(random_calibration(1), LINEAR=lambda m: np.diag([1.0, 1.0, -1.0]) @ m), find_target('kalibr'))


# Each program's formula

@given(SEEDS)
@settings(max_examples=15, deadline=None)
def test_kalibr_predicts_our_readings(seed):
    calibration = held_by('kalibr', seed)
    calibration = with_values(calibration, ARMS=None)   # with arms see below
    ref = motion(seed).reference
    found = export(calibration, find_target('kalibr'), motion=motion(seed))
    force, rate = found.placement.truth(ref.force_s, ref.rate_s, ref.alpha_s)
    predicted = applied(programs.kalibr, found.content, force, rate, ref.alpha_s @ found.placement.mat_ts.T)
    assert close(predicted, readings(calibration, ref))
    assert found.loss.nothing and 'lost: nothing' in found.lines


@given(SEEDS)
@settings(max_examples=15, deadline=None)
def test_arms_in_kalibr_differ_by_what_is_announced(seed):
    """Kalibr picks each arm's term before its matrix, and its gyroscopes feel the force at the x accelerometer."""
    calibration = held_by('kalibr', seed)
    ref = motion(seed).reference
    found = export(calibration, find_target('kalibr'), motion=motion(seed))
    force, rate = found.placement.truth(ref.force_s, ref.rate_s, ref.alpha_s)
    predicted = applied(programs.kalibr, found.content, force, rate, ref.alpha_s @ found.placement.mat_ts.T)
    arms = calibration.of('accelerometer', Role.ARMS)
    for sensor, made, read in zip(SENSORS, predicted, readings(calibration, ref), strict=True):
        gain = np.linalg.norm(calibration.of(sensor, Role.LINEAR), 2)
        assert 0.5 * rms(made - read) < gain * found.loss.left[sensor] < 2.0 * rms(made - read)
    felt = rms(np.einsum('nij,kj->nki', lever_matrix(ref.rate_s, ref.alpha_s), arms))
    assert found.loss.left['accelerometer'] < 0.3 * felt   # of the second order: a matrix 0.02 to 0.05 from the identity


def test_arms_are_exact_in_kalibr_where_the_matrix_is_diagonal():
    calibration = with_values(random_calibration(4), LINEAR=lambda m: np.diag(np.diag(m)), OFFSET=None)
    assert export(calibration, find_target('kalibr')).loss.nothing


@pytest.mark.parametrize('name', ('openvins', 'openvins-rpng'))
@given(seed=SEEDS)
@settings(max_examples=15, deadline=None)
def test_openvins_corrects_as_we_do(name, seed):
    calibration = held_by(name, seed)
    ref = motion(seed).reference
    found = export(calibration, find_target(name), motion=motion(seed))
    assert close(applied(programs.openvins, found.content, *readings(calibration, ref)), (ref.force_s, ref.rate_s))
    assert found.loss.nothing


@given(SEEDS)
@settings(max_examples=15, deadline=None)
def test_basalt_corrects_as_we_do_in_turned_axes(seed):
    calibration = held_by('basalt', seed)
    ref = motion(seed).reference
    found = export(calibration, find_target('basalt'), motion=motion(seed))
    assert close(applied(programs.basalt, found.content, *readings(calibration, ref)), (ref.force_s @ found.placement.mat_ts.T, ref.rate_s @ found.placement.mat_ts.T))
    assert found.loss.nothing


# What is lost

CORRECTING = {'openvins': programs.openvins, 'openvins-rpng': programs.openvins, 'basalt': programs.basalt}
"""Programs that make corrected readings of raw ones, sample by sample."""


@pytest.mark.parametrize('name', CORRECTING)
@given(seed=SEEDS)
@settings(max_examples=8, deadline=None)
def test_what_is_left_is_what_was_announced(name, seed):
    target = find_target(name)
    calibration = random_calibration(seed, FURTHER['accelerometer'], FURTHER['gyroscope'])
    ref = motion(seed).reference
    found = export(calibration, target, motion=motion(seed))
    known = replace(calibration, values=calibration.values.copy())   # what the program estimates is known to it
    for effect in calibration.model.effects:
        if holding_of(effect, target.estimates):
            known.values[calibration.model.slices[effect.key]] = effect.prior_values()
    made = applied(CORRECTING[name], found.content, *found.placement.readings(*readings(known, ref)))
    for sensor, m, t in zip(SENSORS, made, found.placement.truth(ref.force_s, ref.rate_s, ref.alpha_s), strict=True):
        assert found.loss.left[sensor] == pytest.approx(rms(m - t), rel=1e-9)
        assert any(f'error that this leaves in the {sensor}' in line for line in found.lines)


@pytest.mark.parametrize('name', sorted(name for name, target in all_targets().items() if target.write and not target.whole))
def test_every_effect_is_held_or_estimated_or_said_to_be_lost(name):
    target = find_target(name)
    if target.only_noise:
        return
    calibration = random_calibration(5, FURTHER['accelerometer'], FURTHER['gyroscope'])
    found = export(calibration, target)
    told = {lost.effect.key for lost in found.loss.effects} | {effect.key for effect in found.loss.estimated}
    for effect in calibration.model.effects:
        holding = holding_of(effect, target.holds)
        assert (effect.key in told) == (holding is None or holding.own_axis or holding_of(effect, target.estimates) is not None), effect.key
    text = found.content.decode()
    for lost in found.loss.effects:
        assert f'{lost.effect.sensor} {lost.effect.name}' in text   # in the file as well


def test_an_effect_that_is_zero_is_not_lost():
    calibration = with_values(random_calibration(6, (), ('gyro_g_sensitivity',)), CROSS=None)
    assert export(calibration, find_target('basalt')).loss.nothing


def test_the_standard_motion_is_that_of_the_conditions():
    calibration = replace(random_calibration(2), conditions={'largest_rate': 3.0, 'temperature_range_c': [10.0, 40.0], 'gravity': 9.81})
    ref = standard_motion(calibration).reference
    np.testing.assert_allclose(np.linalg.norm(ref.force_s, axis=1), 9.81, rtol=1e-12)
    assert np.abs(ref.rate_s).max() == pytest.approx(3.0, rel=1e-3)
    assert (ref.temperature_c.min(), ref.temperature_c.max()) == (10.0, 40.0)
    slope = np.gradient(ref.rate_s, 1 / 50, axis=0)[1:-1]
    np.testing.assert_allclose(slope, ref.alpha_s[1:-1], atol=3e-2)   # second order of a step of 20 ms: w^3 dt^2 / 6 at 0.5 Hz
    assert isinstance(ref, Reference)


# There and back

def back_and_forth(name, calibration):
    target = find_target(name)
    return import_file(target, export(calibration, target).content, 'file')


@pytest.mark.parametrize('name', sorted(name for name, target in all_targets().items() if target.write and target.read and not target.whole))
@given(seed=SEEDS)
@settings(max_examples=10, deadline=None)
def test_an_import_of_an_export_is_what_it_was(name, seed):
    target = find_target(name)
    calibration = held_by(name, seed)
    if any(holding.own_axis for holding in target.holds):
        scaled = {h.sensor for h in target.holds if h.own_axis}
        values = calibration.values.copy()
        for effect in calibration.model.effects:
            if effect.role is Role.LINEAR:
                part = calibration.model.slices[effect.key]
                values[part] = np.diag(np.diag(values[part].reshape(3, 3))).ravel() if effect.sensor in scaled else np.eye(3).ravel()
        calibration = replace(calibration, values=values)
    if target.axes == 'accelerometer_lower_triangular':
        calibration = with_values(calibration, LINEAR=lambda m: np.tril(m))
    if calibration.of('accelerometer', Role.ARMS) is not None:
        calibration = with_values(calibration, ARMS=lambda arms: arms - arms.mean(axis=0))
    found = back_and_forth(name, calibration)
    for effect in found.model.effects:
        wanted = calibration.value(*effect.key) if effect.key in calibration.model.slices else effect.prior_values().reshape(effect.shape)
        if holding_of(effect, target.estimates) is None:
            np.testing.assert_allclose(found.value(*effect.key), wanted, rtol=0, atol=ROUND_TRIP, err_msg=str(effect.key))


def test_what_another_program_says_is_weak_unproven_and_of_unknown_certainty():
    calibration = held_by('kalibr', 8)
    found = back_and_forth('kalibr', calibration)
    assert found.verdict == 'weak' and found.proof == {} and not found.uncertainty_known
    assert dict(zip(found.param_names, found.status))['gyroscope.matrix.xy'] == 'weak'
    assert dict(zip(found.param_names, found.status))['gyroscope.bias.x'] == 'held'   # Kalibr writes none
    assert 'unknown' in calibration_to_text(found)
    against = compare(calibration, found)
    assert against.agree is None and 'cannot be told' in against.lines[-1]
    scale = next(row for row in against.rows if row.name == 'gyroscope.matrix.zz')
    assert scale.sd == pytest.approx(calibration.sd[calibration.param_names.index(scale.name)])   # of the one that is known
    assert compare(found, found).rows[-1].ratio is None


def test_the_verbs_write_whole_files_or_refuse_in_one_line(tmp_path, capsys):
    calibration, out = tmp_path / 'calibration.yaml', tmp_path / 'imu.yaml'
    calibration.write_text(calibration_to_text(random_calibration(3)))
    assert main(['export', str(calibration), '--to', 'kalibr', '--output', str(out)]) == 0
    printed = capsys.readouterr().out
    assert 'error that this leaves in the accelerometer' in printed and f'written: {out}' in printed
    again = tmp_path / 'again.yaml'
    assert main(['import', str(out), '--from', 'kalibr', '--output', str(again)]) == 0
    assert 'held at the prior: accelerometer.bias.x' in capsys.readouterr().out
    assert main(['compare', str(calibration), str(again)]) == 0
    capsys.readouterr()
    for arguments, said in ((['export', '--to', 'kalibr', '--output', str(out)], 'CALIBRATION'),
                            (['export', str(calibration), '--to', 'nothing', '--output', str(out)], 'choose from'),
                            (['export', str(calibration), '--to', 'kalibr', '--rate', '-1', '--output', str(out)], 'above zero'),
                            (['export', str(calibration), '--to', 'kalibr', '--table', 'x', '--output', str(out)], '--bag'),
                            (['import', str(calibration), '--from', 'kalibr', '--output', str(out)], 'intrinsics'),
                            (['import', str(calibration), '--from', 'nothing', '--output', str(out)], 'choose from')):
        before = out.read_bytes()
        assert main(arguments) == 1
        error = capsys.readouterr().err
        assert said in error and error.count('\n') == 1 and out.read_bytes() == before
    assert main(['export', '--list']) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name, target in all_targets().items() if target.write)
