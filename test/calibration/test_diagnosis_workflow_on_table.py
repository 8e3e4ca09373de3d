"""
Diagnosis: hidden effects are found, and empty sessions remain empty.

Stories are refused, and everything that is handed back holds together.
"""

import json
from dataclasses import asdict, replace
from functools import lru_cache

import numpy as np
import pytest
from refusal import refused
from scipy.stats import chi2

from imu_calibration.calibration.diagnosis.diagnosis_result import diagnosis_mapping
from imu_calibration.compensation.compensate import compensated_samples
from imu_calibration.core.errors import NotObservableError
from imu_calibration.document.calibration import Calibration
from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.references.turntable.residuals.residual_analysis import inquire
from imu_calibration.references.turntable.selection import testable_effects
from imu_calibration.references.turntable.selection.investigation import investigate
from imu_calibration.references.turntable.selection.window_evidence import locked_windows
from imu_calibration.references.turntable.selection.window_gain import heldout_gain
from imu_calibration.selection.gain import APPLIED, OF_MODEL

from worlds.candidates import FEW, with_candidates
from worlds.diagnosing import diagnose
from worlds.hide_and_seek_worlds import components_of
from worlds.hiding import Sizes, record

FOLLOWING = 'accel_thermal_bias+accel_thermal_scale+accel_bias_drift+gyro_thermal_bias'
"""Candidates whose columns change with the temperature or the time."""
CANDIDATES = FEW + '+accel_size_effect+lever_arm+encoder_harmonic+gyro_saturation'
THERMAL = 'accel_quadratic+accel_thermal_bias+gyro_thermal_scale'
"""Candidates of which two need a temperature."""
SEED, QUICK = 3, {'profile': 'quick', 'imu_rate': 50.0, 'joint_rate': 50.0}


@pytest.fixture(scope='module')
def empty():
    """Return a session that hides nothing."""
    return record(SEED, None, 'white', through_bag=False, **QUICK)


@pytest.fixture(scope='module')
def sizes(empty):
    """Return the smallest detectable sizes in that session."""
    return Sizes(empty)


@lru_cache(maxsize=None)
def seek(effect, sizes):
    """Return (recording, diagnosis) of the session with one effect hidden."""
    recording = record(
        SEED,
        {effect: sizes.hidden(effect, SEED, 5.0)},
        'white',
        through_bag=effect == 'accel_quadratic',
        **QUICK,
    )
    return recording, diagnose(
        recording.windows, recording.table, recording.model, candidates=CANDIDATES
    )


def test_nothing_is_found_where_nothing_is_hidden(sizes):
    search = sizes.problem.search
    assert search.run() == []
    assert not any(search.score([], question).significant for question in search.questions)


@pytest.mark.parametrize(
    'effect',
    [
        'accel_quadratic',
        'gyro_saturation',
        'encoder_harmonic',
        pytest.param('gyro_bandwidth', marks=pytest.mark.long),
    ],
)
def test_hidden_effect_is_the_first_finding_with_honest_parameters(effect, sizes):
    recording, diagnosis = seek(effect, sizes)
    first = diagnosis.findings[0]
    assert effect in (first.effect,) + first.indistinguishable_from
    assert len(diagnosis.findings) == 1
    assert not any(rest.significant for rest in diagnosis.unexplained.values())
    if first.effect == effect:
        true = np.ravel(recording.truth[effect])
        values, sds, _ = zip(*first.parameters.values())
        # four standard deviations, and a limit to within 1 %
        assert np.all(
            np.abs(values - true)
            < np.maximum(4 * np.array(sds), 0.01 * np.abs(true) * effect.endswith('saturation'))
        )


def test_a_single_component_of_a_drift_keeps_its_time_constant(sizes):
    hidden = sizes.hidden('gyro_bias_drift', SEED, 5.0, 1)
    assert np.flatnonzero(hidden).tolist() == [1, 3]
    assert hidden[3] == sizes.hidden('gyro_bias_drift', SEED, 5.0)[3]
    assert components_of(['gyro_bias_drift']) == [('gyro_bias_drift', k) for k in range(3)]


@pytest.mark.long
def test_cause_outside_the_catalogue_is_unexplained_and_not_named():
    recording = record(SEED, {'angle_bias_accel': None}, 'realistic', through_bag=False, **QUICK)
    diagnosis = diagnose(recording.windows, recording.table, recording.model)
    assert diagnosis.findings == ()
    assert diagnosis.unexplained['accelerometer'].significant
    assert not diagnosis.unexplained['gyroscope'].significant
    # 2 mg times a direction times a product of sines, of which turning windows average much away
    assert (
        0.15 < diagnosis.unexplained['accelerometer'].rms / (2 * 9.80665e-3 / np.sqrt(3) / 2) < 1.2
    )


def test_earlier_choice_is_replaced_by_the_simpler_effect_that_does_as_well(sizes):
    recording = record(
        SEED,
        {'lever_arm': sizes.hidden('lever_arm', SEED, 5.0)},
        'white',
        through_bag=False,
        **QUICK,
    )
    model = with_candidates(recording.model, CANDIDATES)
    search = investigate(recording.windows, recording.table, model).problem.search
    nine_arms = next(q for q in search.questions if q.name == 'accel_size_effect')
    assert [q.name for q in search.reconsidered([nine_arms])] == ['lever_arm']


def test_document_holds_what_the_contract_asks_for(sizes):
    recording, diagnosis = seek('accel_quadratic', sizes)
    document = json.loads(json.dumps(diagnosis_mapping(diagnosis)))
    assert document['format'] == 'imu_calibration/diagnosis/1'
    finding = document['findings'][0]
    assert set(finding) >= {
        'effect',
        'sensor',
        'explanation',
        'parameters',
        'p_value',
        'gain',
        'indistinguishable_from',
        'separating_motion',
    }
    assert set(finding['gain']) >= {'heldout_rms_before', 'heldout_rms_after', 'reduction', 'ci95'}
    assert document['baseline']['accelerometer']['effects'] == ['bias', 'matrix']
    used = [window for window in recording.windows if window.kind != 'unused']
    _, not_testable = testable_effects.testable_effects(recording.model, recording.table, used)
    assert {entry['effect'] for entry in not_testable} == {'earth_rate'} | {
        f'{short}_{what}'
        for short in ('accel', 'gyro')
        for what in ('thermal_hysteresis', 'vibration_rectification')
    }
    assert set(document['unexplained']['gyroscope']) >= {'significant', 'rms', 'correlates_with'}
    # The extended model is a model like any other: its residual is noise.
    assert ('accelerometer', 'accel_quadratic') in diagnosis.model.slices
    # Three sd of some 100 degrees of freedom.
    assert 0.55 < diagnosis.solution.chi2_per_dof['accelerometer']['means'] < 1.45


@pytest.mark.long
def test_a_bias_that_follows_the_thermometer_is_named_beside_a_wander_and_a_wander_is_noise():
    """
    Fifteen mm/s^2 over eight kelvins in addition to a wander, and the wander by itself.

    The wander is three times the data sheet's size in 15 s, and learnt from the drift itself it hid
    the drift.
    """
    for hidden, names in (
        ({'accel_thermal_bias': np.array([2.0e-3, -1.5e-3, 1.2e-3])}, {'accel_thermal_bias'}),
        (None, set()),
    ):
        recording = record(110, hidden, 'wander_15', through_bag=False, **QUICK)
        diagnosis = diagnose(
            recording.windows, recording.table, recording.model, candidates=FOLLOWING
        )
        assert {finding.effect for finding in diagnosis.findings} == names
        assert not any(rest.significant for rest in diagnosis.unexplained.values())


def test_what_locked_windows_show_moves_the_gain_and_nothing_else(sizes):
    """Ten standard deviations onto one locked window of each kind."""
    recording, _ = seek('accel_quadratic', sizes)
    model = with_candidates(recording.model)
    used = [window for window in recording.windows if window.kind != 'unused']
    locked, kinds = (
        locked_windows(np.array([window.kind for window in used])),
        np.array([window.kind for window in used]),
    )
    struck = [
        next(window for window, out, own in zip(used, locked, kinds) if out and own == kind)
        for kind in np.unique(kinds)
    ]
    windows = [
        (
            replace(w, force_s=w.force_s + 10 * w.noise_sd[0], rate_s=w.rate_s + 10 * w.noise_sd[1])
            if w in struck
            else w
        )
        for w in used
    ]
    found, other = (investigate(some, recording.table, model) for some in (used, windows))
    assert [q.label for q in found.named] == [q.label for q in other.named] == ['accel_quadratic']
    one, two = (
        [search.score([], question).gain for question in search.questions]
        for search in (found.problem.search, other.problem.search)
    )
    assert one == two
    for one, two in zip(
        found.problem.evidence.fit(found.problem.search.indices(found.named)),
        other.problem.evidence.fit(other.problem.search.indices(other.named)),
    ):
        np.testing.assert_array_equal(one, two)
    for sensor, noise in found.problem.noise.items():
        assert noise_figures(noise) == noise_figures(other.problem.noise[sensor])
    gains = [
        heldout_gain(each.problem, [], each.named, sensors=['accelerometer'])
        for each in (found, other)
    ]
    assert gains[0].heldout_rms_after < 0.9 * gains[1].heldout_rms_after


def noise_figures(noise):
    """Return all that a NoiseModel says as text of full precision."""
    return json.dumps(
        asdict(noise),
        default=lambda value: value.tolist() if isinstance(value, np.ndarray) else sorted(value),
    )


def test_gain_is_measured_on_windows_that_took_no_part(sizes):
    _, diagnosis = seek('accel_quadratic', sizes)
    gain = diagnosis.gain
    assert gain.windows == diagnosis.locked
    assert 0.2 < diagnosis.locked / diagnosis.windows < 0.3
    assert gain.ci95[0] < gain.reduction < gain.ci95[1]
    assert gain.ci95[0] > 0


def test_effects_without_their_data_are_not_testable():
    options = QUICK | {'profile': 'static_only', 'temperature': None}
    recording = record(SEED, None, 'white', through_bag=False, **options)
    document = diagnosis_mapping(
        diagnose(recording.windows, recording.table, recording.model, candidates=THERMAL)
    )
    lacking = {entry['effect']: entry for entry in document['not_testable']}
    assert {'accel_thermal_bias', 'gyro_thermal_scale'} <= set(lacking)
    assert all(entry['why'] and entry['needs'] for entry in lacking.values())
    assert document['findings'] == []


def test_too_few_windows_are_refused(empty):
    with refused(NotObservableError, 'too_few_windows', 8):
        diagnose(empty.windows[:4], empty.table, empty.model)


def test_falls_of_the_loss_are_chi_square_where_nothing_is_hidden(sizes):
    search = sizes.problem.search
    falls = np.array(
        [
            [
                search.evidence.loss(search.indices([]))
                - search.evidence.loss(search.indices([q])),
                len(q.parameters),
            ]
            for q in search.questions
            if '@' not in q.label
        ]
    )
    # 25 effects, partly dependent: their sum stays near its expectation
    assert 1e-3 < chi2.sf(falls[:, 0].sum(), falls[:, 1].sum()) < 1 - 1e-3


def test_the_gain_is_that_of_corrected_readings(sizes):
    """
    Two calibrations without the locked windows, applied to these, relative to the table, to 1e-9.

    The model's residual differs by the scale factors.
    """
    recording, diagnosis = seek('accel_quadratic', sizes)
    candidates = with_candidates(recording.model, CANDIDATES)
    found, rms = inquire(recording.windows, recording.table, candidates), []
    for chosen in ([], found.named):
        known = dict(zip(found.problem.space.names, found.problem.values(chosen)))
        model = (
            recording.model.with_effect('accelerometer', 'accel_quadratic')
            if chosen
            else recording.model
        )
        values = np.array([known[name] for name in model.param_names])
        calibration = Calibration(
            model, values, np.zeros((len(values),) * 2), ('determined',) * len(values)
        )
        means = []
        for window in (
            window for window, locked in zip(found.used, found.problem.locked) if locked
        ):
            ref = reference_motion(recording.table, window.motion)
            alpha = np.broadcast_to(ref.alpha_s, (len(window), 3))
            means.append(
                (
                    compensated_samples(
                        calibration, window.force_s, window.rate_s, alpha_s=alpha
                    ).force
                    - ref.force_s
                ).mean(axis=0)
            )
        rms.append(np.sqrt(np.mean(np.square(means))))
    gain, of_model = (
        diagnosis.findings[0].gain,
        heldout_gain(found.problem, [], found.named, sensors=['accelerometer']),
    )
    assert (gain.of, gain.measure, of_model.measure) == (APPLIED, 'window means', 'window means')
    assert 1 - gain.reduction == pytest.approx(rms[1] / rms[0], rel=1e-9)
    assert 1 - of_model.reduction != pytest.approx(rms[1] / rms[0], rel=1e-5)


def test_the_gain_of_an_error_of_the_table_is_that_of_the_model(sizes):
    assert seek('encoder_harmonic', sizes)[1].findings[0].gain.of == OF_MODEL
