"""
Diagnosis without a table.

Causes hidden in recordings by hand by their physics, and recordings that hide nothing.
"""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusal import refused

from imu_calibration.calibration.diagnosis.diagnosis_result import diagnosis_mapping
from imu_calibration.calibration.diagnosis.diagnosis_workflow import diagnosis_lines
from imu_calibration.core.errors import NotObservableError
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.rotations import EARTH_RATE
from imu_calibration.kinematics.table import Table
from imu_calibration.references.gravity.diagnosis_of_poses import diagnosis_by_hand, traces_of_poses
from imu_calibration.references.gravity.hand_calibration import gather_by_hand, solve_by_hand
from imu_calibration.references.gravity.hand_parameters import HandOptions
from imu_calibration.references.gravity.model_selection import investigate_by_hand
from imu_calibration.references.gravity.pose_residual import regimes_by_hand
from imu_calibration.references.gravity.pose_rows import build_rows
from imu_calibration.references.rows.row_search import RowTests
from imu_calibration.selection import regimes
from imu_calibration.selection.gain import APPLIED, OF_MODEL
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.session import random_values
from imu_calibration.simulation.session import simulate_session as simulate_session

from worlds.hand_sessions import GRAVITY, simulate
from worlds.searched_by_hand import searched

NOTHING = np.zeros(3)
MG, DEG = 9.80665e-3, np.pi / 180
PRODUCTS = 'accel_quadratic+accel_scale_asymmetry+accel_cross_product'
DRIFTS = 'gyro_bias_drift+gyro_bias_trend+gyro_g_sensitivity'
"""Candidates, with those that resemble an effect that is hidden here."""
UNTESTABLE = ('accel_size_effect', 'table_tilt', 'accel_thermal_bias', 'gyro_saturation')
"""Effects that need a table, temperatures or another range."""
HIDDEN = {
    'accel_quadratic': lambda f, w, t, k: (
        4 * MG / 9.8**2 * np.array([1, -0.7, 0.5]) * f**2,
        NOTHING,
    ),
    'accel_scale_asymmetry': lambda f, w, t, k: (
        np.array([3e-3, -2e-3, 2e-3]) * np.abs(f),
        NOTHING,
    ),
    'gyro_g_sensitivity': lambda f, w, t, k: (
        NOTHING,
        f @ np.array([[0, 3, 0], [-4, 0, 2], [0, 0, 5]]).T * 1e-4,
    ),
    'gyro_quadratic': lambda f, w, t, k: (NOTHING, np.array([8e-3, -6e-3, 7e-3]) * w**2),
    'gyro_scale_asymmetry': lambda f, w, t, k: (
        NOTHING,
        np.array([1.2e-2, -1e-2, 1e-2]) * np.abs(w),
    ),
    'gyro_bias_drift': lambda f, w, t, k: (
        NOTHING,
        np.outer(-np.expm1(-t / 30), [0.3 * DEG, -0.2 * DEG, 0.25 * DEG]),
    ),
}
"""
What each cause adds to the accelerometer and to the gyroscope, from the true force, rate, time and
number of the pose.
"""


def stops(force, rate, time, pose):
    """A bias of the accelerometer that changes at every stop: no catalogue holds it."""
    steps = np.random.default_rng(99).normal(0, 3 * MG, (pose.max() + 1, 3))
    return steps[pose], NOTHING


def diagnose_by_hand(data, options):
    """The findings and the extended calibration."""
    found = investigate_by_hand(data, options)
    added = tuple(question.effect.key for question in found.adopted)
    hand = solve_by_hand(data, replace(options, added=added, point=found.point_of_adopted))
    diagnosis = diagnosis_by_hand(found, hand)
    traced = replace(diagnosis, traces=traces_of_poses(diagnosis.baseline, diagnosis.solution))
    return SimpleNamespace(diagnosis=traced, hand=hand, search=found)


def options_of(candidates=None):
    """Return the options of a search for some effects, or for all."""
    return HandOptions(GRAVITY, catalogue=CATALOGUE.with_candidates(candidates))


def diagnosed(seed, spoil=None, n_poses=24, candidates=None, **options):
    imu, ranges, _ = simulate(seed, n_poses=n_poses, spoil=spoil, **options)
    return diagnose_by_hand(gather_by_hand(imu, ranges), options_of(candidates))


@pytest.fixture(scope='module')
def responding():
    """A recording of gyroscopes that respond to gravity, diagnosed."""
    candidates = '+'.join((DRIFTS, 'accel_quadratic', *UNTESTABLE))
    return diagnosed(31, HIDDEN['gyro_g_sensitivity'], candidates=candidates)


@pytest.mark.parametrize(
    ('name', 'n_poses', 'candidates'),
    [
        (
            'accel_quadratic',
            36,
            'accel_quadratic+accel_cubic+accel_scale_asymmetry+gyro_g_sensitivity',
        ),
        ('gyro_bias_drift', 24, f'{DRIFTS}+accel_quadratic'),
        ('gyro_g_sensitivity', 24, None),
    ],
)
def test_a_hidden_effect_is_found_and_its_gain_measured(name, n_poses, candidates, responding):
    found = (
        responding
        if name == 'gyro_g_sensitivity'
        else diagnosed(31, HIDDEN[name], n_poses=n_poses, candidates=candidates)
    ).diagnosis
    assert found.findings, [
        (c.effect, c.gain_alone, c.p_value_alone, c.verdict) for c in found.candidates[:4]
    ]
    first = found.findings[0]
    assert name in (first.effect, *first.indistinguishable_from)
    assert first.gain.ci95[0] > 0 and first.gain.windows >= 23
    # A drift is replaced by its value at the end.
    assert first.gain.of == (OF_MODEL if name.endswith('drift') else APPLIED)
    assert len(found.findings) == 1


def test_the_attitudes_at_which_a_rest_appears_are_told():
    """A gyroscope whose bias is another one while y is level: no effect of the catalogue."""

    def spoil(f, w, t, k):
        return NOTHING, np.outer(np.abs(f[:, 1]) < 3.0, [0.0, 0.3 * DEG, 0.0])

    diagnosis = diagnosed(21500, spoil).diagnosis
    rest = diagnosis.unexplained['gyroscope']
    assert not diagnosis.findings and rest.axes == ('y',) and len(rest.regimes) == 1
    regime = rest.regimes[0]
    assert (
        regime.axis == 'y'
        and regime.variable == 'specific force along y'
        and -4.5 < regime.bounds[0] < -1.5
        and 1.5 < regime.bounds[1] < 4.5
    )
    assert any(
        regime.variable in line and 'gyroscope y' in line for line in diagnosis_lines(diagnosis)
    )
    # Calibrate and diagnose use one test of the unexplained residual.
    imu, ranges, _ = simulate(21500, n_poses=24, spoil=spoil)
    solved = searched(gather_by_hand(imu, ranges))
    assert solved.extension.changes.unexplained == {'gyroscope': rest.entry}
    assert rest.entry['rms'] == rest.rms > 0 and rest.entry['axes'] == ['y']


def test_the_earth_turns_about_the_vertical_and_is_no_finding():
    """Quiet gyroscopes see 80 % of its rate follow gravity."""
    diagnosis = diagnosed(
        52, lambda f, w, t, k: (NOTHING, 0.8 * EARTH_RATE / GRAVITY * f), n_poses=20, rate_sd=2e-4
    ).diagnosis
    assert not diagnosis.findings and not diagnosis.unexplained['gyroscope'].significant


def test_what_held_parameters_may_be_is_no_finding(monkeypatch):
    """
    Turns about (1, 1, 1) alone.

    A scale error along it lies in elements that are all held, and products of rates look like it.
    """
    profile = make_profile('avrutov_111')
    table = Table.from_mapping(profile.table)
    model = SensorModel(joint_names=table.joint_names)
    imu = simulate_session(model, random_values(model), table, profile=profile)[0]
    # What is asked about is known before the search.
    monkeypatch.setattr(RowTests, 'explaining', lambda self, chosen: [])
    found = investigate_by_hand(gather_by_hand(imu), HandOptions(GRAVITY))
    assert {'gyro_rate_product', 'gyro_quadratic'} <= {
        entry['effect'] for entry in found.not_testable
    }


def test_a_place_among_few_poses_is_paid_for(monkeypatch):
    """
    Any range of noise is the likeliest of many: its chance counts them all.

    One of 20 recordings is expected.
    """
    monkeypatch.setattr(regimes, 'MOST_OF_IT', 0.0)
    monkeypatch.setattr(regimes, 'SURE', 0.0)
    poses = SimpleNamespace(time=10.0 * np.arange(24), temperature_c=None)
    rng = np.random.default_rng(21501)
    told = []
    for _ in range(20):
        up = rng.normal(size=(24, 3))
        hand = SimpleNamespace(
            gravity=GRAVITY,
            state=SimpleNamespace(up=up / np.linalg.norm(up, axis=1, keepdims=True)),
            poses=poses,
        )
        block = SimpleNamespace(
            sensor='gyroscope', floor=np.ones((24, 3)), group=np.arange(24), time=poses.time
        )
        told += regimes_by_hand(hand, block, rng.normal(size=(24, 3)))
    assert len(told) <= 2


def test_the_gain_is_the_error_of_corrected_readings_in_held_out_poses(responding):
    """
    At rest: rates inverted by the model of the estimate, less that of the Earth about the vertical.

    Each side from the other poses.
    """
    found, gain = responding.search, responding.diagnosis.findings[0].gain
    poses, squares = found.baseline.poses, [0.0, 0.0]
    for part in found.held_out:
        out = part.groups
        of_gravity = [q for q in part.named if q.name == 'gyro_g_sensitivity']
        for side, chosen in enumerate(([], of_gravity)):
            model, values, earth = found.extended(part.problem, chosen)
            force, rate = model.compensate(values, poses.force[out], poses.rate[out])
            squares[side] += np.sum(
                (rate - earth * force / np.linalg.norm(force, axis=1)[:, None]) ** 2
            )
    assert (gain.of, gain.measure, gain.windows) == (APPLIED, 'poses', len(poses.start))
    assert_allclose(
        [gain.heldout_rms_before, gain.heldout_rms_after],
        np.sqrt(np.array(squares) / poses.rate.size),
        rtol=1e-7,
    )
    of_model = found.problem.gain(found.held_out, [], found.named, sensor='gyroscope')
    assert (
        of_model.of == OF_MODEL
        and abs(gain.heldout_rms_before / of_model.heldout_rms_before - 1) > 1e-3
    )


def test_the_variance_of_a_long_turn_includes_that_of_its_bias():
    """
    Turns of 12 s between rests of 1 s.

    Residuals have the stated variance, less the share of the nine fitted parameters.
    """
    ratios = []
    for seed in (21510, 21511):
        imu, ranges, _ = simulate(seed, n_poses=24, still=1.0, duration=12.0)
        data = gather_by_hand(imu, ranges)
        turns = build_rows(
            solve_by_hand(data, HandOptions(GRAVITY)), data.turns, [], constants=np.zeros(0)
        )[0][-1]
        ratios.append(np.mean(turns.equations[:, :, -1] ** 2 / turns.variance))
    assert turns.name == 'turns' and 0.5 < np.mean(ratios) < 1.3, ratios


def test_sizes_agree_with_what_was_hidden(responding):
    parameters = responding.diagnosis.findings[0].parameters
    for name, true in (('xy', 3e-4), ('yx', -4e-4), ('zz', 5e-4), ('xx', 0.0)):
        value, sd, _ = parameters[f'gyroscope.gyro_g_sensitivity.{name}']
        assert abs(value - true) < 4.5 * sd and sd < 1e-4


def test_the_turns_tell_apart_what_is_one_to_the_norm():
    """
    a_y a_z in x, a_x a_z in y and a_x a_y in z change the norm alike.

    The directions that the gyroscope carries along do not.
    """

    def spoil(f, w, t, k):
        return 15 * MG / 9.8**2 * np.stack([f[:, 1] * f[:, 2], 0 * t, 0 * t], axis=1), NOTHING

    imu, ranges, _ = simulate(36, n_poses=24, spoil=spoil)
    data = gather_by_hand(imu, ranges)
    result = diagnose_by_hand(data, options_of(PRODUCTS))
    assert result.diagnosis.findings[0].effect == 'accel_cross_product'
    for name, true in (('x_yz', 15 * MG / 9.8**2), ('y_xz', 0.0), ('z_xy', 0.0)):
        full = f'accelerometer.accel_cross_product.{name}'
        assert (
            abs(result.hand.value(full) - true) < 4.5 * result.hand.sd_of(full)
            and result.hand.sd_of(full) < 2 * MG / 9.8**2
        )
    products = HandOptions(GRAVITY, accelerometer=('bias', 'matrix', 'accel_cross_product'))
    alone = solve_by_hand(replace(data, turns=[]), products)
    assert alone.sd_of('accelerometer.accel_cross_product.x_yz') > 10 * result.hand.sd_of(
        'accelerometer.accel_cross_product.x_yz'
    )


def test_nothing_hidden_nothing_found():
    """Poses and biases that scatter from pose to pose are no effect."""
    found = diagnosed(40, pose_sd=0.002, drift_sd=2e-4, n_poses=20).diagnosis
    assert not found.findings


def test_a_cause_that_no_catalogue_holds_is_unexplained():
    """Beside a bias of every stop no place is told."""
    found = diagnosed(33, stops).diagnosis
    assert not found.findings
    rest = found.unexplained['accelerometer']
    assert rest.significant and not rest.regimes
    assert rest.rms == pytest.approx(3 * MG, rel=0.5)


def test_what_turns_leave_is_an_angle_per_turn():
    """
    A rate that comes only while it turns, another one in each turn: 0.6 deg/s per axis for 1.6 s.
    """

    def slips(force, rate, time, pose):
        offsets = np.random.default_rng(98).normal(0, 0.6 * DEG, (pose.max() + 1, 3))
        return NOTHING, offsets[pose] * (np.linalg.norm(rate, axis=1) > 0.01)[:, None]

    found = diagnosed(33, slips).diagnosis
    rest = found.unexplained['gyroscope']
    (text,) = (
        line
        for line in diagnosis_lines(found)
        if line.startswith('unexplained') and 'gyroscope' in line
    )
    assert (
        rest.significant
        and rest.unit == diagnosis_mapping(found)['unexplained']['gyroscope']['unit'] == 'rad/turn'
    )
    assert 'deg per turn' in text
    assert rest.rms == pytest.approx(0.6 * DEG * 1.6, rel=0.4)  # the matrix takes a part


def test_the_document_and_the_extended_model_go_together(responding):
    document = diagnosis_mapping(responding.diagnosis)
    json.dumps(document)
    assert document['findings'][0]['gain']['measure'] == 'poses'
    assert 'gyro_g_sensitivity' in responding.hand.model.gyroscope
    assert {entry['effect'] for entry in document['not_testable']} == {*UNTESTABLE}


def test_too_few_poses_are_refused_with_their_number():
    imu, ranges, _ = simulate(35, n_poses=10)
    with refused(NotObservableError, 'too_few_poses', 12, 10):
        diagnose_by_hand(gather_by_hand(imu, ranges), HandOptions(GRAVITY))


@pytest.mark.long
@pytest.mark.real_data
def test_xsens_counts_tells_no_stories(recordings):
    """
    The accelerometer scatters beyond its noise and no effect claims it.

    The gyroscope's answer to gravity is found and predicts.
    """
    from imu_calibration.calibration.diagnosis.diagnose import diagnose_recording
    from imu_calibration.calibration.options import CalibrationOptions
    from imu_calibration.core.readings import RawReadings
    from imu_calibration.references.gravity.gravity_reference import GravityReference
    from msg_adapters.bag import open_recording

    options = CalibrationOptions(
        nominal=RawReadings.of_scales(32768, 415, 32768, gyroscope_scale=4770)
    )
    with open_recording(recordings / 'xsens_counts', want_joints=False) as recording:
        found = diagnose_recording(
            recording.blocks(), GravityReference(), replace(options, gravity=9.81744)
        ).diagnosis
    assert [f.effect for f in found.findings] == ['gyro_g_sensitivity']
    gain = found.findings[0].gain
    rest = found.unexplained['accelerometer']
    print(
        f'xsens_counts: g-sensitivity lowers held-out rates by {100 * gain.reduction:.0f} % (95 %:'
        f' {100 * gain.ci95[0]:.0f} to {100 * gain.ci95[1]:.0f} %); accelerometer unexplained'
        f' {1e3 * rest.rms:.2f} mm/s^2 rms, {rest.sigma:.0f} sd beyond noise'
    )
    assert gain.ci95[0] > 0.5
    assert rest.significant and 5e-4 < rest.rms < 2e-3
