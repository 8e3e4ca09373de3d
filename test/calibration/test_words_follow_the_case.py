"""Advice and explanations speak of the case at hand."""

from dataclasses import replace

import numpy as np
import pytest
from refusal import refused

from imu_calibration.api.calibrate import calibrate_recordings
from imu_calibration.api.compensate import compensate_recording
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import SampleBlock
from imu_calibration.document.comparison import compare
from imu_calibration.document.decision import NOTE
from imu_calibration.document.verdict import incomplete_windows, motion_misfits
from imu_calibration.estimation.solution import (
    BIAS_PROCESS,
    DRIFT,
    GRAVITY,
    MODEL_ERROR,
    PLACE_REMEDY,
    REJECTED,
    REMEDIES,
    REMEDY_KEYS,
    SAMPLE_NOISE,
    WANDER_REMEDY,
    remedy,
)
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable.needs import motions_needed
from imu_calibration.references.turntable.standard_motions import (
    MOTIONS,
    OTHER_MOUNT,
    motions_about,
)
from imu_calibration.references.turntable.window_statistics import Regime

from worlds.compensation_cases import random_calibration
from worlds.misfit_coverage import COARSE
from worlds.misfit_worlds import SHAFT, make_pair, sweeps
from worlds.physics import make_session

REAL = COARSE | {'noise': 'realistic'}
VERTICAL = SHAFT | {'joints': [{'name': 'shaft', 'axis': [0, 0, 1]}], 'up': [0, 0, 1]}


def needed_motions(result, table):
    """Return the motions that a result needs, with the statistics of its document."""
    quality = result.calibration.statistics
    return motions_needed(result.solution, result.tolerances, table, quality=quality)


def test_a_single_shaft_is_told_to_be_mounted_at_another_angle():
    pair = make_pair(None, 1, table='shaft', profile='sweeps', **COARSE)
    table = Table.from_mapping(pair.table)
    result = calibrate_recordings(
        pair.first.block, table, accelerometer_model='bias+matrix', model_as_asked=True
    ).result
    needs = {text for text, _ in needed_motions(result, table).values()}
    possible = {motion.text for motion in motions_about((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))}
    assert OTHER_MOUNT in needs and needs - {PLACE_REMEDY} <= {OTHER_MOUNT} | possible
    assert possible == {
        motion.text for motion in MOTIONS if motion.name in ('spin_x', 'oscillate_x')
    }


def test_on_a_vertical_shaft_nothing_but_another_mount_turns_gravity():
    """
    Spins about a level axis would show every entry of the matrix.

    About the vertical one gravity stays where it is.
    """
    table = Table.from_mapping(VERTICAL)
    session = make_session(7, table=VERTICAL, profile=sweeps(seconds=50.0), **REAL)
    result = calibrate_recordings(
        SampleBlock(session.imu, session.joints),
        table,
        accelerometer_model='bias+matrix',
        model_as_asked=True,
    ).result
    needed = needed_motions(result, table)
    held = [
        name
        for name, status in zip(result.calibration.param_names, result.calibration.status)
        if status == 'held' and name.startswith('accelerometer.matrix')
    ]
    assert held and {needed[name][0] for name in held} == {OTHER_MOUNT}
    reasons = [
        reason
        for reason in result.verdict.reasons
        if held[0] in reason.what or 'accelerometer.matrix (' in reason.what
    ]
    assert reasons and all(OTHER_MOUNT in reason.next for reason in reasons)
    for motion in motions_about((0.0, 0.0, -1.0), (0.0, 0.6, -0.8)):
        assert all(
            abs(piece.force_s @ piece.rate_s[0]).max()
            == pytest.approx(0.8 * 9.8 * np.linalg.norm(piece.rate_s[0]))
            for piece in motion.make(9.8)
        )


def test_an_uncertain_gravity_needs_its_value_and_no_spins():
    """0.03 m/s^2 in 9.8 m/s^2 is 0.3 % of scale; more data do not reduce it."""
    session = make_session(3, profile='quick', **REAL)
    table = Table.from_mapping(session.table | {'gravity_sd': 0.03})
    result = calibrate_recordings(
        SampleBlock(session.imu, session.joints), table, model_as_asked=True
    ).result
    scales = [f'accelerometer.matrix.{axis}' for axis in ('xx', 'yy', 'zz')]
    needed = needed_motions(result, table)
    assert {needed[name][0] for name in scales} == {REMEDIES[GRAVITY,]}
    reasons = [reason for reason in result.verdict.reasons if 'matrix.xx' in reason.what]
    assert [reason.next for reason in reasons] == [REMEDIES[GRAVITY,]]


@pytest.mark.parametrize(
    ('noise', 'misfit', 'gravity', 'cause'),
    (
        (0.5, 2.0, 1.0, MODEL_ERROR),
        (0.5, 1.0, 2.0, GRAVITY),
        (2.0, 3.0, 0.0, None),
        (0.5, 0.0, 0.0, None),
    ),
)
def test_the_remedy_of_a_weak_parameter_is_that_of_its_largest_term(noise, misfit, gravity, cause):
    terms = {
        name: np.diag([0.0, sd**2])
        for name, sd in ((SAMPLE_NOISE, noise), (MODEL_ERROR, misfit), (GRAVITY, gravity))
    }
    expected = [text for names, text in REMEDIES.items() if cause in names]
    assert [remedy(terms, 1, 1.0)] == (expected or [''])


def test_bias_processes_of_a_misfit_are_its_error():
    """A residual with structure in motion is described by a bias that moves."""
    terms = {SAMPLE_NOISE: np.diag([0.25]), BIAS_PROCESS: np.diag([9.0])}
    assert remedy(terms, 0, 1.0) == ''
    assert REMEDY_KEYS[remedy(terms, 0, 1.0, of_misfit=[BIAS_PROCESS])] == 'diagnose'
    assert remedy(terms | {SAMPLE_NOISE: np.diag([4.0])}, 0, 1.0, of_misfit=[BIAS_PROCESS]) == ''


def test_a_missing_effect_on_a_table_needs_its_cause_and_no_motions():
    """Arms of 3 cm that the model does not have: the residual is that of no moving bias."""
    session = make_session(6, profile='quick', arms=True, **REAL)
    result = calibrate_recordings(
        SampleBlock(session.imu, session.joints),
        Table.from_mapping(session.table),
        accelerometer_model='bias+matrix',
        model_as_asked=True,
    ).result
    needs = {need for need, _ in result.needed.values()}
    assert needs and {REMEDY_KEYS.get(need) for need in needs} == {'diagnose'}
    assert not any('window to window' in reason.what for reason in result.verdict.reasons)


@pytest.mark.parametrize(
    ('effects', 'keys'),
    [
        ({'gyro_quadratic': None, 'gyro_g_sensitivity': None}, {'diagnose'}),
        ({'gyro_quadratic': None}, set()),
    ],
)
def test_a_missing_effect_that_shows_at_rest_only_needs_its_cause(effects, keys):
    """A g-sensitivity scatters the means at rest; a later or warmer recording scatters as much."""
    session = make_session(9031, effects, profile='quick', grade='tactical', **REAL)
    found = calibrate_recordings(
        SampleBlock(session.imu, session.joints),
        Table.from_mapping(session.table),
        gyroscope_model='bias+matrix+gyro_quadratic',
        model_as_asked=True,
    )
    about = [
        reason
        for reason in found.result.verdict.reasons
        if reason.sensors == ('gyroscope',) and reason.word is NOTE
    ]
    assert {reason.key for reason in about} == keys
    assert set(incomplete_windows(found.calibration.statistics, 'gyroscope')) == (
        {'static'} if keys else set()
    )


def test_an_effect_that_is_held_for_a_misfit_needs_its_cause_and_no_motions():
    """Arms are not in the model: a quadratic response takes their part, and is not believed."""
    session = make_session(8, profile='quick', arms=True, **REAL)
    found = calibrate_recordings(
        SampleBlock(session.imu, session.joints),
        Table.from_mapping(session.table),
        accelerometer_model='bias+matrix+accel_quadratic',
        model_as_asked=True,
    )
    held = found.calibration.statistics['not_believed']
    assert {name.split('.')[1] for name in held} == {'accel_quadratic'}
    reasons = [
        reason
        for reason in found.result.verdict.reasons
        if reason.next and any(name in reason.what for name in ('accelerometer.', *held))
    ]
    assert reasons and {reason.key for reason in reasons} == {'diagnose'}
    # Those of the table are determined by the same residuals.
    keys = {name: REMEDY_KEYS.get(need) for name, (need, _) in found.result.needed.items()}
    of_table = {key for name, key in keys.items() if name.startswith('reference.table_tilt')}
    assert of_table == {'diagnose'}


def test_a_weak_rate_of_the_earth_needs_the_place_and_no_motion():
    session = make_session(8113, {'earth_rate': None}, profile='quick', **REAL)
    known = Table.from_mapping(session.table)
    nowhere = replace(
        known, gravity=known.gravity_value, latitude=None, height=None, azimuth_deg=None
    )
    found = calibrate_recordings(session.block, nowhere, model_as_asked=True)
    weak = {name: need for name, need in found.result.needed.items() if 'earth_rate' in name}
    assert weak and {REMEDY_KEYS[need] for need, _ in weak.values()} == {'table'}


def test_needs_and_verdict_have_one_rule_for_an_incomplete_model():
    """Its bias process is an error of the model, unless errors of the stamps explain it."""
    session = make_session(6, profile='quick', **REAL)
    table = Table.from_mapping(session.table)
    result = calibrate_recordings(
        SampleBlock(session.imu, session.joints), table, model_as_asked=True
    ).result
    size = len(result.tolerances)
    terms = {
        SAMPLE_NOISE: np.diag((0.1 * result.tolerances) ** 2),
        BIAS_PROCESS: np.diag((3.0 * result.tolerances) ** 2),
        MODEL_ERROR: np.zeros((size, size)),
    }
    wandering = replace(result.solution, terms=terms, held=np.zeros(size, bool))
    misfit = {'chi2_per_dof': {'spin': 20.0}, 'slow_over_fast': {'spin': 1.5}}
    louder = misfit | {'slow_over_fast': {'spin': 0.9}}
    of_stamps = {'stamp_jitter': {'variance_ratio': {'gyroscope': {'spin': 15.0}}}}
    rests, none = {'windows': {'static': 9}}, {'windows': {'spin': 9}}
    of_model = REMEDIES[MODEL_ERROR, DRIFT, REJECTED]
    tilting = {'attitude': {'variance_ratio': 9.0, 'p_value': 1e-9}}
    by_chance = {'attitude': {'variance_ratio': 9.0, 'p_value': 0.1}}
    for quality, is_incomplete in (
        ({'gyroscope': tilting} | rests, True),
        ({'gyroscope': by_chance} | rests, False),
        ({'gyroscope': misfit} | rests, True),
        ({'gyroscope': louder} | rests, False),
        ({'gyroscope': louder} | none, True),
        ({'gyroscope': misfit} | rests | of_stamps, False),
    ):
        found = replace(
            result, solution=wandering, calibration=replace(result.calibration, statistics=quality)
        )
        need, _ = needed_motions(found, table)['gyroscope.bias.x']
        assert need == (of_model if is_incomplete else WANDER_REMEDY)
        keys = {reason.key for reason in motion_misfits(found.calibration)}
        assert ('diagnose' in keys) is is_incomplete

    # More windows reduce independent offsets, and not the uncertainty of a bias that wanders.
    noise = wandering.noise['gyroscope']
    for offset_sd, is_motion in ((0.0, False), (2.0 * noise.bias_variance**0.5, True)):
        noises = wandering.noise | {'gyroscope': replace(noise, offset_sd=offset_sd)}
        found = replace(result, solution=replace(wandering, noise=noises))
        need, _ = needed_motions(found, table)['gyroscope.bias.x']
        assert (need in {motion.text for motion in MOTIONS}) is is_motion


def test_compare_says_that_off_diagonal_terms_include_the_mounting():
    first = random_calibration(1, gauge={'origin': 'mount', 'axes': 'mount'})
    values = first.values.copy()
    values[first.param_names.index('gyroscope.matrix.xy')] += 0.05
    by_hand = {'origin': 'not_needed', 'axes': 'accelerometer_lower_triangular'}
    pairs = [
        [replace(first, gauge=gauge), replace(first, gauge=gauge, values=values)]
        for gauge in (first.gauge, by_hand)
    ]
    on_table, without = (compare(*pair).lines for pair in pairs)
    assert len(on_table) == len(without) + 1 and sum('mounted' in line for line in on_table) == 1
    assert len(compare(first, first).lines) < len(without)


def test_a_ros_1_bag_is_told_how_to_be_converted(tmp_path):
    rosbags = pytest.importorskip('rosbags.rosbag1')
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    imu, header, stamp = (
        store.types[f'{name}']
        for name in ('sensor_msgs/msg/Imu', 'std_msgs/msg/Header', 'builtin_interfaces/msg/Time')
    )
    vector, quaternion, cov = (
        store.types['geometry_msgs/msg/Vector3'],
        store.types['geometry_msgs/msg/Quaternion'],
        np.zeros(9),
    )
    with rosbags.Writer(tmp_path / 'old.bag') as writer:
        connection = writer.add_connection('/imu/data_raw', imu.__msgtype__, typestore=store)
        message = imu(
            header(0, stamp(1, 0), 'imu_link'),
            quaternion(0.0, 0.0, 0.0, 1.0),
            cov,
            vector(0.0, 0.0, 0.0),
            cov,
            vector(0.0, 0.0, 9.8),
            cov,
        )
        writer.write(connection, 10**9, store.serialize_ros1(message, imu.__msgtype__))
    calibration = random_calibration(1)
    with refused(InputError, 'ros1_bag', 'rosbags-convert'):
        compensate_recording(
            tmp_path / 'old.bag', calibration, output=tmp_path / 'new', anyway=True
        )


def test_the_report_shows_the_proof_by_motion():
    pair = make_pair(None, 1, **COARSE)
    found = calibrate_recordings(
        pair.first.block, Table.from_mapping(pair.table), model_as_asked=True
    )
    assert 'id="proof"' in found.report and f'<td class="k">{Regime.FAST}</td>' in found.report
