"""By hand, too, advice follows the cause: motions only where other attitudes help."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import imu_calibration as imu
from imu_calibration.core.samples import SampleBlock
from imu_calibration.core.units import MILLI_G
from imu_calibration.document.calibration import surpassed_limit
from imu_calibration.document.decision import PARAMETERS
from imu_calibration.document.proof_entry import ProofEntry
from imu_calibration.document.verdict import _step_of, unsteady
from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.effects.motions import ALL_MOTIONS
from imu_calibration.estimation.solution import (
    EXCESS_REMEDY,
    MOVED_REMEDY,
    REMEDY_KEYS,
    TURNS_REMEDY,
)
from imu_calibration.references.gravity.advice import _Excesses, _without_motion
from imu_calibration.references.gravity.live_poses import _needs

from worlds.compensation_cases import random_calibration
from worlds.hand_sessions import GRAVITY, simulate
from worlds.physics_hand import hold_and_turn, warmed_up

SESSION = {'force_sd': 0.01, 'rate_sd': 0.001, 'period': 0.02, 'still': 3.0}


def calibrated(samples, **choices):
    """Calibrate with the model as it is."""
    return imu.calibrate(SampleBlock(samples), gravity=GRAVITY, model_as_asked=True, **choices)


def bends(force, rate, _time, _pose):
    """Squares of the force, 20 mg at 1 g: no bias and no matrix explain them."""
    return 0.002 * force**2, 0.0 * rate


def steps(force, rate, time, _pose):
    """Add a step of 5 mg in the x bias at half of the time."""
    late = (time > 0.5 * time[-1])[:, None]
    return late * np.array([5 * MILLI_G, 0.0, 0.0]), 0.0 * rate


@pytest.mark.parametrize('spoil', (bends, steps))
def test_a_model_error_needs_its_cause_and_no_motion(spoil):
    samples, *_ = simulate(21, n_poses=24, spoil=spoil, **SESSION)
    found = calibrated(samples)
    assert 'weak' in found.calibration.status_by_name.values()
    needs = {entry['needs'] for entry in found.calibration.undetermined}
    assert needs and {REMEDY_KEYS.get(need) for need in needs} == {'diagnose'}
    named = [r for r in found.result.verdict.reasons if r.word is PARAMETERS and r.next in needs]
    assert named and {reason.key for reason in named} == {'diagnose'}
    assert all('imu_calibration diagnose' in reason.advice() for reason in named)


def test_too_few_attitudes_need_another_whatever_the_residual():
    for spoil in (None, bends):
        samples, *_ = simulate(22, n_poses=6, spoil=spoil, **SESSION)
        undetermined = calibrated(samples).calibration.undetermined
        assert any(' up' in entry['needs'] for entry in undetermined)
        assert spoil or not {entry['needs'] for entry in undetermined} & set(REMEDY_KEYS)


def test_a_bias_that_moves_by_errors_of_the_model_is_not_called_unsteady():
    samples, *_ = simulate(23, n_poses=24, spoil=bends, **SESSION)
    few = 'accel_quadratic+accel_cubic'
    steady = imu.calibrate(SampleBlock(samples), gravity=GRAVITY, candidates=few)
    assert steady.calibration.statistics['accelerometer']['between_window_sd'] > 2 * MILLI_G
    assert not any('window to window' in reason.what for reason in steady.result.verdict.reasons)


@pytest.mark.parametrize('name', ('accel_bias_drift', 'gyro_bias_drift'))
def test_the_tolerance_of_a_time_constant_is_that_of_its_effect_on_the_bias(name):
    """The curves of two time constants, a tolerance apart, differ by one tolerance of the bias."""
    effect = next(
        effect
        for sensor in SENSORS
        for effect in [CATALOGUE.effects(()).get((sensor, name))]
        if effect
    )
    *of_bias, of_time = effect.tolerances(effect.tolerance)
    assert of_bias == [effect.tolerance] * 3
    constant, size = effect.prior_values()[-1], effect.prior_sds()[0]
    time = np.linspace(0.0, 5 * constant, 2000)
    curves = [
        size * (1 - np.exp(-time / each))
        for each in (constant - of_time / 2, constant + of_time / 2)
    ]
    assert np.max(np.abs(curves[1] - curves[0])) == pytest.approx(effect.tolerance, rel=0.01)


def test_a_warm_up_is_determined_and_a_weak_one_needs_no_attitude():
    samples, *_ = hold_and_turn(3, n_poses=12, rate_hz=50.0)
    model = 'bias+matrix+gyro_bias_drift'
    warm, _ = warmed_up(samples, 1, force=0.0, rate=0.01, time_constant=20.0)
    found = calibrated(warm, gyroscope_model=model)
    assert (
        found.calibration.status_by_name['gyroscope.gyro_bias_drift.time_constant'] == 'determined'
    )
    hand = found.result.applied
    index = hand.param_names.index('gyroscope.gyro_bias_drift.x')
    tight = replace(hand, tolerances=1e-3 * hand.tolerances)
    assert _without_motion(tight, index, _Excesses.of_solution(tight)) == ALL_MOTIONS['warm_up']


def test_live_the_next_step_is_the_cause_where_no_attitude_helps():
    """The planner would propose poses for ever."""
    status = {'accelerometer.bias.x': 'weak'}
    for need, expected in (
        (EXCESS_REMEDY, 'call ~/diagnose'),
        (MOVED_REMEDY, MOVED_REMEDY),
        (TURNS_REMEDY, TURNS_REMEDY),
        ('turn it', 'the planned pose'),
    ):
        calibration = SimpleNamespace(
            requested=status, undetermined=({'parameters': {}, 'needs': need},)
        )
        _, [shown] = _needs(
            SimpleNamespace(attitudes=20, absent=()),
            [],
            calibration,
            step='the planned pose',
            hints={'diagnose': 'call ~/diagnose to {}'},
        )
        assert shown.startswith(expected)


def test_the_next_step_of_an_unproven_sensor_is_that_of_its_reason():
    """Attitudes were proposed where the proof lacked rests, turns, or another sensor."""
    helps = ProofEntry(1.0, 0.1, (0.05, 0.2), unit='m/s^2', windows=9)
    proven = random_calibration(3, proof=dict.fromkeys(SENSORS, helps), decision={})
    by_hand = replace(proven, gauge={'axes': 'accelerometer_lower_triangular'})
    near_faces = replace(
        by_hand,
        proof={**proven.proof, 'accelerometer': replace(helps, few_directions=True)},
    )
    nothing = [replace(each, proof={}) for each in (proven, by_hand)]
    diagnosed = replace(proven, proof=dict.fromkeys(SENSORS, replace(helps, ci95=(0.5, 1.5))))
    of_accelerometer = [
        _step_of(each, 'accelerometer') for each in (*nothing, near_faces, diagnosed)
    ]
    assert len(set(of_accelerometer)) == 4 and of_accelerometer[-1][1] == 'diagnose'
    assert _step_of(near_faces, 'gyroscope') == ('', None)
    assert 'turn' in _step_of(nothing[1], 'gyroscope')[0]


def scaled(samples, matrix):
    """Return the recording with rates ``matrix w``."""
    return replace(samples, rate_s=samples.rate_s @ np.transpose(matrix))


def test_refused_values_have_the_remedy_of_their_cause():
    """Rates in a wrong unit had the advice to diagnose; axes of another sensor, other turns."""
    samples, *_ = simulate(24, n_poses=16, **SESSION)
    wrong_unit = calibrated(scaled(samples, 0.3 * np.eye(3)))
    [decided] = [r for r in wrong_unit.result.verdict.reasons if 'scale factor must' in r.what]
    assert decided.key == 'gyroscope_unit' and '--unit' in decided.advice(
        {'gyroscope_unit': '--unit'}
    )

    # The gyroscope is turned by 50 degrees to the accelerometer.
    turned = Rotation.from_euler('z', 50, degrees=True).as_matrix()
    other_axes = calibrated(scaled(samples, turned))
    needs = {
        entry['needs']
        for entry in other_axes.calibration.undetermined
        if any(name.startswith('gyroscope.matrix') for name in entry['parameters'])
    }
    assert needs == {TURNS_REMEDY}
    assert _step_of(other_axes.calibration, 'gyroscope') == (TURNS_REMEDY, None)


@pytest.mark.parametrize(
    ('value', 'limit'), (('gyroscope.matrix.xy', 0.6), ('gyroscope.bias.x', 80.0))
)
def test_no_measurement_is_missing_where_values_are_refused(value, limit):
    calibration = random_calibration(3)
    values = calibration.values.copy()
    values[calibration.param_names.index(value)] = limit
    refused = replace(calibration, values=values)
    found = surpassed_limit(refused, 'gyroscope')
    assert found is not None and surpassed_limit(calibration, 'gyroscope') is None
    assert _step_of(refused, 'gyroscope') == (found.remedy, found.key)


def test_noise_of_few_poses_is_no_unsteady_bias():
    """Means of three seconds have 15 mm/s^2 of noise; the tolerance of a bias is 10."""
    noisy = {**SESSION, 'force_sd': 0.2, 'rate_sd': 0.002, 'period': 0.012}
    found = calibrated(simulate(7362, n_poses=12, **noisy)[0])
    assert found.calibration.statistics['accelerometer']['between_window_sd'] > MILLI_G
    assert not any('window to window' in reason.what for reason in found.result.verdict.reasons)


@pytest.mark.parametrize(('freedom', 'certain'), ((3.0, False), (60.0, True)))
def test_a_scatter_of_few_degrees_of_freedom_is_uncertain(freedom, certain):
    """Lower limits of 1.5 tolerances at 2.5 %: 0.85 of 3 and 1.27 of 60 degrees of freedom."""
    calibration = random_calibration(3, proof={}, decision={})
    tolerances = np.full(len(calibration.values), 0.01)
    entry = {'between_window_sd': 0.015, 'between_window_dof': freedom}
    scattered = replace(calibration, statistics={'accelerometer': entry})
    assert bool(unsteady(scattered, tolerances)) is certain


def test_a_bias_that_moves_between_many_poses_is_called_unsteady():
    """5 mg of scatter from pose to pose, without noise and with a still hand."""
    found = calibrated(simulate(25, n_poses=24, pose_sd=5 * MILLI_G, **SESSION)[0])
    assert any('window to window' in reason.what for reason in found.result.verdict.reasons)
