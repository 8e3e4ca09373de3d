"""
Exports: each program's formula gives our compensation, or misses it as announced.

The formula of each program is written from its source, and a miss is as large as announced.
"""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from refusal import refused
from scipy.io import loadmat

from imu_calibration.allan.figures import AxisFigures, NoiseFigures
from imu_calibration.allan.terms import Term
from imu_calibration.cli.main import main
from imu_calibration.compensation.compensate import compensated_samples
from imu_calibration.core.errors import DocumentError, InputError
from imu_calibration.core.units import error_text
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.document.comparison import compare
from imu_calibration.document.exports.affine import capability_of, lower_times_rotation
from imu_calibration.document.exports.export import (
    UNITS,
    all_targets,
    export,
    find_target,
    loss_lines,
)
from imu_calibration.document.exports.loss import (
    ROUNDING_LOSS,
    import_file,
    motion_of,
    standard_motion,
)
from imu_calibration.document.exports.target import Readings
from imu_calibration.document.exports.targets.visual_inertial import upper_times_rotation
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.effects.forward_equations import sensor_output
from imu_calibration.kinematics.rotations import Reference, lever_matrix
from tools.exports_page import rendered

from worlds import export_formulas as programs
from worlds.compensation_cases import FURTHER, random_calibration, random_motion

ROOT = Path(__file__).resolve().parents[2]
SEEDS = st.integers(0, 2**31)
EXACT = 1e-12
"""Rounding of some ten operations on numbers up to 40 (m/s^2, rad/s), relative to them."""
ROUND_TRIP = 1e-12


def motion(seed, n=12):
    force, rate, alpha, temperature = random_motion(n, seed)
    return motion_of(force, rate, alpha, temperature_c=temperature, text='a random motion')


def readings(calibration, ref):
    return tuple(
        sensor_output(calibration.model, sensor, calibration.values, ref=ref) for sensor in SENSORS
    )


def with_values(calibration, **changed):
    """
    Return a calibration in which some roles of both sensors have other values; None: their prior.
    """
    values = calibration.values.copy()
    for effect in calibration.model.effects:
        if effect.role.name in changed:
            new = changed[effect.role.name]
            part = calibration.model.slices[effect.key]
            values[part] = (
                effect.prior_values()
                if new is None
                else np.ravel(new(values[part].reshape(effect.shape)))
            )
    return replace(calibration, values=values)


def applied(formula, content, *samples):
    """Return what a program makes of samples one by one, (force, rate)."""
    made = [formula(content.decode(), *each) for each in zip(*samples, strict=True)]
    return tuple(np.array(part) for part in zip(*made, strict=True))


def close(made, wanted):
    return all(
        np.allclose(m, w, rtol=0, atol=EXACT * 40) for m, w in zip(made, wanted, strict=True)
    )


def rms(values):
    return float(np.sqrt(np.mean(values**2)))


def held_by(name, seed, **fields):
    """
    Return a random calibration with only the effects that a target holds.

    Biases are gone where the target estimates them.
    """
    target = find_target(name)
    model = random_calibration(seed, FURTHER['accelerometer'], FURTHER['gyroscope']).model
    kept = {
        sensor: tuple(
            e.name
            for e in model.effects
            if e.sensor == sensor
            and capability_of(e, target.holds)
            and e.role not in (Role.OFFSET, Role.LINEAR)
        )
        for sensor in SENSORS
    }
    found = random_calibration(seed, kept['accelerometer'], kept['gyroscope'], **fields)
    return (
        with_values(found, OFFSET=None)
        if capability_of(found.model.effects[0], target.estimates)
        else found
    )


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
    mirror = np.diag([1.0, 1.0, -1.0])
    with refused(InputError, 'no_sensor_helps', -1.0):
        export(
            with_values(random_calibration(1), LINEAR=lambda m: mirror @ m), find_target('kalibr')
        )
    for split in (lower_times_rotation, upper_times_rotation):
        with refused(InputError, 'left_handed'):
            split(mirror)


# Each program's formula


@given(SEEDS)
@settings(max_examples=15, deadline=None)
def test_kalibr_predicts_our_readings(seed):
    calibration = held_by('kalibr', seed)
    calibration = with_values(calibration, ARMS=None)  # with arms see below
    ref = motion(seed).reference
    found = export(calibration, find_target('kalibr'), motion=motion(seed))
    force, rate = found.placement.truth(ref.force_s, ref.rate_s, ref.alpha_s)
    predicted = applied(
        programs.kalibr, found.content, force, rate, ref.alpha_s @ found.placement.mat_ts.T
    )
    assert close(predicted, readings(calibration, ref))
    assert found.loss.nothing


@given(SEEDS)
@settings(max_examples=15, deadline=None)
def test_arms_in_kalibr_differ_by_what_is_announced(seed):
    """
    Kalibr picks each arm's term before its matrix.

    Its gyroscopes feel the force at the x accelerometer.
    """
    calibration = held_by('kalibr', seed)
    ref = motion(seed).reference
    found = export(calibration, find_target('kalibr'), motion=motion(seed))
    force, rate = found.placement.truth(ref.force_s, ref.rate_s, ref.alpha_s)
    predicted = applied(
        programs.kalibr, found.content, force, rate, ref.alpha_s @ found.placement.mat_ts.T
    )
    arms = calibration.of('accelerometer', Role.ARMS)
    for sensor, made, read in zip(SENSORS, predicted, readings(calibration, ref), strict=True):
        gain = np.linalg.norm(calibration.of(sensor, Role.LINEAR), 2)
        assert 0.5 * rms(made - read) < gain * found.loss.remaining[sensor] < 2.0 * rms(made - read)
    felt = rms(np.einsum('nij,kj->nki', lever_matrix(ref.rate_s, ref.alpha_s), arms))
    # Of the second order: a matrix 0.02 to 0.05 from the identity.
    assert found.loss.remaining['accelerometer'] < 0.3 * felt


def test_arms_are_exact_in_kalibr_where_the_matrix_is_diagonal():
    calibration = with_values(
        random_calibration(4), LINEAR=lambda m: np.diag(np.diag(m)), OFFSET=None
    )
    assert export(calibration, find_target('kalibr')).loss.nothing


@pytest.mark.parametrize('name', ('openvins', 'openvins-rpng'))
@given(seed=SEEDS)
@settings(max_examples=15, deadline=None)
def test_openvins_corrects_as_we_do(name, seed):
    calibration = held_by(name, seed)
    ref = motion(seed).reference
    found = export(calibration, find_target(name), motion=motion(seed))
    assert close(
        applied(programs.openvins, found.content, *readings(calibration, ref)),
        (ref.force_s, ref.rate_s),
    )
    assert found.loss.nothing


@given(SEEDS)
@settings(max_examples=15, deadline=None)
def test_basalt_corrects_as_we_do_in_turned_axes(seed):
    calibration = held_by('basalt', seed)
    ref = motion(seed).reference
    found = export(calibration, find_target('basalt'), motion=motion(seed))
    assert close(
        applied(programs.basalt, found.content, *readings(calibration, ref)),
        (ref.force_s @ found.placement.mat_ts.T, ref.rate_s @ found.placement.mat_ts.T),
    )
    assert found.loss.nothing


@pytest.mark.parametrize('name', ('px4', 'ardupilot', 'autoware', 'imu-calib'))
@given(seed=SEEDS)
@settings(max_examples=15, deadline=None)
def test_programs_with_scale_factors_correct_as_we_do_where_nothing_is_lost(name, seed):
    """
    Diagonal matrices where the program has no more, the identity where it has none.

    Temperatures within the range of the calibration.
    """
    calibration = bare(name, held_by(name, seed, conditions={'temperature_range_c': [4.0, 46.0]}))
    ref = motion(seed).reference
    found = export(calibration, find_target(name), motion=motion(seed))
    warmth = (ref.temperature_c,) if name in THERMAL else ()
    made = applied(
        CORRECTING[name],
        found.content,
        *found.placement.readings(*readings(calibration, ref)),
        *warmth,
    )
    assert close(made, found.placement.truth(ref.force_s, ref.rate_s, ref.alpha_s))
    assert found.loss.nothing


def bare(name, calibration):
    """
    Return a calibration whose matrices and biases a program can hold.

    Of its own axis, or not at all.
    """
    target, values = find_target(name), calibration.values.copy()
    for effect in calibration.model.effects:
        capability, part = capability_of(effect, target.holds), calibration.model.slices[effect.key]
        if capability is None:
            values[part] = effect.prior_values()
        elif capability.own_axis:
            values[part] = np.diag(np.diag(values[part].reshape(3, 3))).ravel()
    return replace(calibration, values=values)


def test_autopilots_get_forward_right_down():
    calibration = with_values(
        random_calibration(1, ()), OFFSET=lambda b: np.array([0.1, 0.2, 0.3]), LINEAR=None
    )
    found = programs.parameters(export(calibration, find_target('px4')).content.decode())
    assert [found[f'CAL_ACC0_{a}OFF'] for a in 'XYZ'] == [0.1, -0.2, -0.3]
    assert 'TC_A_ENABLE' not in found  # nothing thermal, nothing switched on


def test_the_temperature_stays_in_the_range_that_was_measured():
    """
    Both autopilots hold the ends of the range beyond it; with an unknown range their own defaults.
    """
    calibration = bare(
        'px4',
        random_calibration(
            3, ('accel_thermal_bias',), (), conditions={'temperature_range_c': [20.0, 30.0]}
        ),
    )
    for name in THERMAL:
        found = export(calibration, find_target(name))
        hot = [
            CORRECTING[name](found.content.decode(), np.ones(3), np.ones(3), t)[0]
            for t in (30.0, 60.0)
        ]
        np.testing.assert_array_equal(*hot)
        samples = Readings(
            np.ones((2, 3)), np.ones((2, 3)), np.zeros((2, 3)), np.array([30.0, 60.0])
        )
        np.testing.assert_array_equal(*find_target(name).corrected(found.numbers, samples)[0])


def test_parameters_that_an_autopilot_ignores_are_reported():
    small = with_values(
        random_calibration(1, ()),
        OFFSET=lambda b: np.full(3, 0.004),
        LINEAR=lambda m: np.eye(3) * 1.002,
    )
    large = with_values(small, OFFSET=lambda b: np.full(3, 0.4), LINEAR=lambda m: np.eye(3) * 1.02)
    far = with_values(small, OFFSET=lambda b: b + 4.0)
    for calibration, name, values in (
        (
            small,
            'px4',
            (('ACC', 'OFF', '0.0069'), ('ACC', 'SCALE', '0.0035'), ('GYRO', 'OFF', '0.0069')),
        ),
        (large, 'px4', ()),
        (small, 'ardupilot', (('INS_GYR_CAL',),)),
        (far, 'ardupilot', (('INS_ACCOFFS', '3.5', '4'), ('INS_GYR_CAL',))),
    ):
        target, found = find_target(name), export(calibration, find_target(name), anyway=True)
        lines = target.ignored(found.numbers)
        assert len(lines) == len(values) and all(f'note: {line}' in found.lines for line in lines)
        assert all(value in line for line, several in zip(lines, values) for value in several)


# Noise

RATE = 250.0
WHITE, WALK = (
    {'accelerometer': 2e-3, 'gyroscope': 1.7e-4},
    {'accelerometer': 3e-4, 'gyroscope': 1.9e-5},
)


def noise_figures():
    """Noise of 100 Hz recordings whose axes differ: the worst one counts."""

    def axis(sensor, share):
        term = {'white_noise': WHITE[sensor] * share, 'random_walk': WALK[sensor] * share}
        return AxisFigures(
            {
                name: Term(name, value, (0.9 * value, 1.1 * value), 'determined', '')
                for name, value in term.items()
            },
            form=('random_walk',),
        )

    return NoiseFigures(
        *(tuple(axis(sensor, share) for share in (0.7, 1.0, 0.9)) for sensor in SENSORS), rate=100.0
    )


@pytest.mark.parametrize(
    'name', ('kalibr', 'openvins', 'vins', 'lio-sam', 'fast-lio', 'orb-slam3', 'basalt')
)
def test_each_estimator_expects_the_spread_that_the_noise_has(name):
    """After a second N^2 for the integral and K^2 for the bias, at whatever rate."""
    for rate in (RATE, None):
        content = export(
            random_calibration(1, ()), find_target(name), noise=noise_figures(), rate=rate
        ).content.decode()
        found = programs.spread_in_a_second(name, content, 1.0 / (rate or 100.0))
        for sensor in SENSORS:
            assert found[sensor, 'white'] == pytest.approx(WHITE[sensor] ** 2, rel=1e-12)
            assert found[sensor, 'walk'] == pytest.approx(WALK[sensor] ** 2, rel=1e-12)


@pytest.mark.parametrize('name', ('robot-localization', 'autoware'))
def test_covariances_are_those_of_samples(name):
    """Of the noise document, or of the calibration's own recording."""
    own = random_calibration(1, ())
    for figures, white in (
        (noise_figures(), WHITE),
        (None, {s: own.noise(s)[0].max() / RATE**0.5 for s in SENSORS}),
    ):
        found = yaml.safe_load(export(own, find_target(name), noise=figures, rate=RATE).content)
        if name == 'autoware':
            found = found['/**']['ros__parameters']
            assert found['angular_velocity_stddev_yy'] ** 2 == pytest.approx(
                white['gyroscope'] ** 2 * RATE
            )
            assert found['acceleration_stddev'] ** 2 == pytest.approx(
                white['accelerometer'] ** 2 * RATE
            )
        else:
            assert np.diag(
                np.reshape(found['angular_velocity_covariance'], (3, 3))
            ) == pytest.approx([white['gyroscope'] ** 2 * RATE] * 3)
            assert found['linear_acceleration_covariance'][0] == pytest.approx(
                white['accelerometer'] ** 2 * RATE
            )


def test_a_random_walk_is_never_invented():
    calibration = random_calibration(1, ())
    for name in ('vins', 'lio-sam', 'fast-lio', 'orb-slam3'):
        with refused(InputError, 'noise_missing', find_target(name).title):
            export(calibration, find_target(name), rate=RATE)
    with refused(InputError, 'noise_missing', find_target('robot-localization').title):
        export(calibration, find_target('robot-localization'))
    content = export(calibration, find_target('kalibr'), rate=RATE).content.decode()
    assert not any(
        name in content for name in ('accelerometer_random_walk', 'accelerometer_noise_density')
    )


def test_a_random_walk_of_a_short_rest_is_not_exported():
    """From half a minute of rest no walk is measured; covariances of samples need none."""
    calibration = random_calibration(1, ())
    short = replace(noise_figures(), recording={'seconds_at_rest': 31.0})
    for name in ('vins', 'orb-slam3', 'openvins'):
        with refused(InputError, 'rest_too_short_for_walk', 31):
            export(calibration, find_target(name), noise=short, rate=RATE)
    assert export(calibration, find_target('robot-localization'), noise=short).content
    long = replace(noise_figures(), recording={'seconds_at_rest': 301.0})
    assert export(calibration, find_target('vins'), noise=long).content


def test_who_takes_no_calibration_is_to_be_fed_compensated_readings():
    found = export(random_calibration(1), find_target('vins'), noise=noise_figures())
    assert all(
        line in found.content.decode() for line in loss_lines(find_target('vins'), found.loss)
    )
    # Raw readings: scale factors of some percent at 1 g.
    assert found.loss.remaining['accelerometer'] > 0.01


# What is lost

CORRECTING = {
    'openvins': programs.openvins,
    'openvins-rpng': programs.openvins,
    'basalt': programs.basalt,
    'px4': programs.px4,
    'ardupilot': programs.ardupilot,
    'autoware': programs.autoware,
    'imu-calib': programs.imu_calib,
}
"""Programs that make corrected readings of raw ones, sample by sample."""
THERMAL = ('px4', 'ardupilot')


@pytest.mark.parametrize('name', CORRECTING)
@given(seed=SEEDS)
@settings(max_examples=8, deadline=None)
def test_what_is_left_is_what_was_announced(name, seed):
    target = find_target(name)
    calibration = random_calibration(seed, FURTHER['accelerometer'], FURTHER['gyroscope'])
    ref = motion(seed).reference
    found = export(calibration, target, motion=motion(seed))
    # What the program estimates is known to it.
    known = replace(calibration, values=calibration.values.copy())
    for effect in calibration.model.effects:
        if capability_of(effect, target.estimates):
            known.values[calibration.model.slices[effect.key]] = effect.prior_values()
    warmth = (ref.temperature_c,) if name in THERMAL else ()
    made = applied(
        CORRECTING[name], found.content, *found.placement.readings(*readings(known, ref)), *warmth
    )
    for sensor, m, t in zip(
        SENSORS, made, found.placement.truth(ref.force_s, ref.rate_s, ref.alpha_s), strict=True
    ):
        assert found.loss.remaining[sensor] == pytest.approx(rms(m - t), rel=1e-9)
        printed = error_text(found.loss.remaining[sensor], UNITS[sensor])
        assert found.loss.remaining[sensor] < ROUNDING_LOSS or any(
            sensor in line and printed in line for line in found.lines
        )


@pytest.mark.parametrize(
    'name',
    sorted(name for name, target in all_targets().items() if target.write and not target.whole),
)
def test_every_effect_is_held_or_estimated_or_said_to_be_lost(name):
    target = find_target(name)
    if target.only_noise:
        return
    calibration = random_calibration(5, FURTHER['accelerometer'], FURTHER['gyroscope'])
    found = export(calibration, target)
    told = {lost.effect.key for lost in found.loss.effects} | {
        effect.key for effect in found.loss.estimated
    }
    for effect in calibration.model.effects:
        capability = capability_of(effect, target.holds)
        assert (effect.key in told) == (
            capability is None
            or capability.own_axis
            or capability_of(effect, target.estimates) is not None
        ), effect.key
    text = found.content.decode()
    for lost in found.loss.effects:
        assert f'{lost.effect.sensor} {lost.effect.name}' in text  # in the file as well


def test_an_effect_that_is_zero_is_not_lost():
    calibration = with_values(random_calibration(6, (), ('gyro_g_sensitivity',)), CROSS=None)
    assert export(calibration, find_target('basalt')).loss.nothing


def test_an_effect_that_is_lost_is_given_what_it_makes_in_the_readings():
    calibration = random_calibration(6, (), ('gyro_g_sensitivity',))
    found = export(calibration, find_target('basalt'), motion=motion(6))
    (lost,) = found.loss.effects
    made = motion(6).reference.force_s @ calibration.of('gyroscope', Role.CROSS).T
    assert lost.rms == pytest.approx(rms(made), rel=1e-12) and not lost.in_part


def test_the_standard_motion_is_that_of_the_conditions():
    calibration = replace(
        random_calibration(2),
        conditions={'largest_rate': 3.0, 'temperature_range_c': [10.0, 40.0], 'gravity': 9.81},
    )
    ref = standard_motion(calibration).reference
    np.testing.assert_allclose(np.linalg.norm(ref.force_s, axis=1), 9.81, rtol=1e-12)
    assert np.abs(ref.rate_s).max() == pytest.approx(3.0, rel=1e-3)
    assert (ref.temperature_c.min(), ref.temperature_c.max()) == (10.0, 40.0)
    slope = np.gradient(ref.rate_s, 1 / 50, axis=0)[1:-1]
    # Second order of a step of 20 ms: w^3 dt^2 / 6 at 0.5 Hz.
    np.testing.assert_allclose(slope, ref.alpha_s[1:-1], atol=3e-2)
    assert isinstance(ref, Reference)


HOSTILE = (
    'imu\nARMING_CHECK,0\r1\t1\tCBRK_IO_SAFETY\t22027\t6\u2028gyroscope_noise_density: 9;'
    ' $(touch x)'
)


@pytest.mark.parametrize(
    'name',
    sorted(
        name for name, target in all_targets().items() if target.write and not target.only_noise
    ),
)
def test_a_name_in_a_calibration_adds_no_line_to_the_file_of_another_program(name):
    """
    A line end in frame_id ended the comment.

    What followed was a parameter line of a flight controller.
    """
    plain = random_calibration(4, ())
    files = [
        export(replace(plain, frame_id=frame), find_target(name), rate=200.0).content
        for frame in ('imu', HOSTILE)
    ]
    # JSON and MATLAB files: strings that escape themselves.
    if find_target(name).whole or b'comments' in files[0]:
        return
    lines = [
        [line for line in file.decode().splitlines() if not line.startswith('#')] for file in files
    ]
    assert lines[0] == lines[1]
    # Quoted for the shell.
    assert b"'imu?ARMING" in files[1] or b'static_transform_publisher' not in files[1]


# There and back


def back_and_forth(name, calibration):
    target = find_target(name)
    return import_file(target, export(calibration, target).content, 'file')


@pytest.mark.parametrize(
    'name',
    sorted(
        name
        for name, target in all_targets().items()
        if target.write and target.read and not target.whole
    ),
)
@given(seed=SEEDS)
@settings(max_examples=10, deadline=None)
def test_an_import_of_an_export_is_what_it_was(name, seed):
    target = find_target(name)
    calibration = bare(name, held_by(name, seed, conditions={'temperature_range_c': [4.0, 46.0]}))
    found = back_and_forth(name, calibration)
    compare_values(found, calibration, target)
    # A file without our note of the frame: the axes of the program, origin in the middle.
    if target.axes == 'accelerometer_lower_triangular':
        own = with_values(
            calibration,
            LINEAR=np.tril,
            **(
                {'ARMS': lambda arms: arms - arms.mean(axis=0)}
                if find_holding(target, Role.ARMS)
                else {}
            ),
        )
        text = export(own, target).content.replace(b'static_transform_publisher', b'')
        compare_values(import_file(target, text, 'file'), own, target)


def find_holding(target, role):
    return any(capability.role is role for capability in target.holds)


def compare_values(found, calibration, target):
    for effect in found.model.effects:
        wanted = (
            calibration.value(*effect.key)
            if effect.key in calibration.model.slices
            else effect.prior_values().reshape(effect.shape)
        )
        if capability_of(effect, target.estimates) is None:
            np.testing.assert_allclose(
                found.value(*effect.key), wanted, rtol=0, atol=ROUND_TRIP, err_msg=str(effect.key)
            )


def test_what_another_program_says_is_weak_unproven_and_of_unknown_certainty():
    calibration = held_by('kalibr', 8)
    found = back_and_forth('kalibr', calibration)
    assert (
        set(found.decisions.values()) == {'unproven'}
        and found.proof == {}
        and not found.uncertainty_known
    )
    assert dict(zip(found.param_names, found.status))['gyroscope.matrix.xy'] == 'weak'
    # Kalibr writes none.
    assert dict(zip(found.param_names, found.status))['gyroscope.bias.x'] == 'held'
    assert 'unknown' in calibration_to_text(found)
    against = compare(calibration, found)
    assert against.agree is None
    scale = next(row for row in against.rows if row.name == 'gyroscope.matrix.zz')
    # Of the one that is known.
    assert scale.sd == pytest.approx(calibration.sd[calibration.param_names.index(scale.name)])
    assert compare(found, found).rows[-1].ratio is None


def test_the_verbs_write_whole_files_or_refuse_in_one_line(tmp_path, capsys):
    calibration, out = tmp_path / 'calibration.yaml', tmp_path / 'imu.yaml'
    calibration.write_text(calibration_to_text(random_calibration(3)))
    assert main(['export', str(calibration), '--to', 'kalibr', '--output', str(out)]) == 0
    printed = capsys.readouterr().out
    assert all(word in printed for word in ('accelerometer', 'mg rms', str(out)))
    again = tmp_path / 'again.yaml'
    assert main(['import', str(out), '--from', 'kalibr', '--output', str(again)]) == 0
    assert 'accelerometer.bias.x' in capsys.readouterr().out
    assert main(['compare', str(calibration), str(again)]) == 0
    capsys.readouterr()
    for arguments, values in (
        (['export', '--to', 'kalibr', '--output', str(out)], ['CALIBRATION']),
        (
            ['export', str(calibration), '--to', 'nothing', '--output', str(out)],
            ["'nothing'", 'kalibr'],
        ),
        (
            ['export', str(calibration), '--to', 'kalibr', '--rate', '-1', '--output', str(out)],
            ['-1 Hz'],
        ),
        (
            ['export', str(calibration), '--to', 'kalibr', '--table', 'x', '--output', str(out)],
            ['--bag'],
        ),
        (['import', str(calibration), '--from', 'kalibr', '--output', str(out)], ["'calibrated'"]),
        (
            ['import', str(calibration), '--from', 'nothing', '--output', str(out)],
            ["'nothing'", 'kalibr'],
        ),
    ):
        before = out.read_bytes()
        assert main(arguments) == 1
        error = capsys.readouterr().err
        assert (
            all(value in error for value in values)
            and error.count('\n') == 1
            and out.read_bytes() == before
        )
    assert main(['export', '--list']) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name, target in all_targets().items() if target.write)


@pytest.mark.parametrize('name', ('json', 'mat'))
def test_the_whole_document_comes_back_whole_and_always_as_the_same_bytes(name):
    calibration = random_calibration(9, FURTHER['accelerometer'], FURTHER['gyroscope'])
    content = export(calibration, find_target(name)).content
    found = import_file(find_target(name), content, 'file')
    assert calibration_to_text(found) == calibration_to_text(calibration)
    assert found.uncertainty_known
    assert export(calibration, find_target(name)).content == content
    assert export(calibration, find_target(name)).loss.nothing


def test_matlab_sees_matrices_and_names(tmp_path):
    calibration = random_calibration(9)
    path = tmp_path / 'calibration.mat'
    path.write_bytes(export(calibration, find_target('mat')).content)
    found = loadmat(path, simplify_cells=True)
    np.testing.assert_array_equal(
        found['accelerometer']['matrix'], calibration.of('accelerometer', Role.LINEAR)
    )
    np.testing.assert_array_equal(found['covariance'], calibration.covariance)
    assert list(found['param_names']) == list(calibration.param_names)


@given(SEEDS)
@settings(max_examples=10, deadline=None)
def test_imu_tk_is_read_with_both_its_files(seed):
    rng = np.random.default_rng(seed)
    texts, ref = {}, motion(seed).reference
    for ending in ('.acc', '.gyro'):
        mis = np.eye(3) + rng.normal(0, 0.01, (3, 3))
        scale, bias = np.diag(rng.uniform(0.9, 1.1, 3)), rng.normal(0, 0.1, 3)
        texts[ending] = '\n\n'.join(
            '\n'.join(' '.join(map(repr, map(float, row))) for row in part)
            for part in (mis, scale, bias[:, None])
        )
    with TemporaryDirectory() as folder:
        for ending, text in texts.items():
            Path(folder, f'test_imu{ending}').write_text(text)
        for named in texts:
            path = Path(folder, f'test_imu{named}')
            found = import_file(find_target('imu-tk', read=True), path.read_bytes(), path)
            true = compensated_samples(found, ref.force_s, ref.rate_s, alpha_s=ref.alpha_s)
            for made, ending, raw in (
                (true.force, '.acc', ref.force_s),
                (true.rate, '.gyro', ref.rate_s),
            ):
                np.testing.assert_allclose(
                    made,
                    [programs.imu_tk(texts[ending], sample) for sample in raw],
                    rtol=0,
                    atol=40 * EXACT,
                )
        Path(folder, 'test_imu.gyro').unlink()
        path = Path(folder, 'test_imu.acc')
        alone = import_file(find_target('imu-tk', read=True), path.read_bytes(), path)
        assert set(
            np.array(alone.status)[[name.startswith('gyroscope') for name in alone.param_names]]
        ) == {'held'}


@pytest.mark.parametrize(
    'name', sorted(name for name, target in all_targets().items() if target.read)
)
@pytest.mark.parametrize(
    'content',
    (
        b'',
        b'\xff\xfe\x00',
        b'[1, 2]',
        b'a: [',
        b'{"value0": 3}',
        b'imu0: 5',
        b'CAL_ACC0_XOFF nan x',
        b'SM: [1]',
    ),
)
def test_files_of_something_else_are_refused_in_one_line(name, content, tmp_path):
    with pytest.raises(InputError) as error:
        import_file(find_target(name, read=True), content, tmp_path / 'file')
    assert '\n' not in str(error.value)


@pytest.mark.parametrize(
    'name, line, values',
    (
        (
            'px4',
            '1 1 CAL_ACC0_XOFF 0.1 9\n1 1 TC_A_ENABLE 1 6\n1 1 TC_A0_X2_0 0.1 9',
            ('TC_A0_X2_0', 0.1),
        ),
        (
            'ardupilot',
            'INS_ACCOFFS_X,0.1\nINS_TCAL1_ENABLE,1\nINS_TCAL1_GYR3_Z,2',
            ('INS_TCAL1_GYR3_Z', 2),
        ),
    ),
)
def test_thermal_curves_are_refused_rather_than_cut(name, line, values):
    with refused(InputError, 'not_linear', *values):
        import_file(find_target(name, read=True), line.encode(), 'file')


def test_a_chain_without_intrinsics_is_the_perfect_imu_and_its_noise_is_kept():
    chain = (
        b'%YAML:1.0\nimu0:\n  accelerometer_noise_density: 0.002\n  gyroscope_noise_density:'
        b' 0.0001\n  update_rate: 400.0\n'
    )
    found = import_file(find_target('openvins', read=True), chain, 'chain.yaml')
    np.testing.assert_array_equal(found.of('gyroscope', Role.LINEAR), np.eye(3))
    assert found.noise('accelerometer')[0][0] == pytest.approx(0.002 * 20)


def test_the_page_of_targets_is_that_of_the_records():
    """`make answers` writes it."""
    assert (ROOT / 'docs/exports.md').read_text() == rendered()


def test_a_file_of_ours_brings_the_frame_back_and_none_where_there_was_none():
    for frame in ('imu_link', ''):
        found = back_and_forth('basalt', random_calibration(3, (), frame_id=frame))
        assert (found.frame_id, found.gauge['axes']) == (frame, 'mount')


def test_what_speaks_against_a_calibration_travels_along():
    bad = random_calibration(
        3,
        (),
        decision=dict.fromkeys(('accelerometer', 'gyroscope'), 'harms'),
        decision_reasons={'accelerometer': 'the error grows', 'gyroscope': 'the error grows'},
    )
    assert (
        'accelerometer harms: the error grows'
        in export(bad, find_target('px4'), anyway=True).content.decode()
    )
    with refused(DocumentError, 'no_sensor_helps', 'the error grows'):
        export(bad, find_target('px4'))
    found = export(bad, find_target('json'))  # it includes the decisions
    assert found.exit_code == 3 and len(found.reasons) == 2
    # with consent its numbers are written, and the code remains that of `compensate`
    assert export(bad, find_target('json'), anyway=True).exit_code == 3
    assert not any(
        'the error grows' in line
        for line in export(
            replace(bad, decision=dict.fromkeys(bad.decision, 'helps')), find_target('px4')
        ).lines
    )
