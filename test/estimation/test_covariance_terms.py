"""
The covariance as named terms with the total as their sum.

Weak values are replaced by their prior.
"""

from dataclasses import replace

import numpy as np
import pytest
from refusal import refused

import imu_calibration as imu
from imu_calibration.calibration.from_solution import ModelExtension
from imu_calibration.compensation.compensate import invertible_values
from imu_calibration.core.errors import DocumentError
from imu_calibration.document.calibration_text import (
    calibration_from_text,
    calibration_mapping,
    calibration_to_text,
    from_mapping,
)
from imu_calibration.estimation.solution import (
    BIAS_PROCESS,
    HELD_PRIORS,
    REJECTED,
    REPLACEMENT,
    SAMPLE_NOISE,
    replace_weak,
    total,
)

SESSION = imu.simulate('quick', seed=2)


@pytest.fixture(scope='module')
def by_table():
    """
    Return the result of a short session of an IMU without errors.

    Where tolerances make some parameters weak, on a table of uncertain gravity.
    """
    return imu.calibrate(
        replace(SESSION.samples, imu=SESSION.truth.compensate(SESSION.samples.imu)),
        replace(SESSION.table, gravity_sd=1e-3),
        model_as_asked=True,
        tolerances={'accelerometer': {'bias': 1e-9}, 'gyroscope': {'matrix': 1e-9}},
    ).result


def test_a_weak_value_is_replaced_by_the_sd_of_the_fit_alone():
    """
    An allowance decides that a value is weak, not that its prior is nearer.

    Correlated values follow, and the shift enters the sds.
    """
    fit = np.array([[1.0, 0.9, 0.0], [0.9, 1.0, 0.0], [0.0, 0.0, 1.0]])
    terms, prior = (
        {SAMPLE_NOISE: 0.75 * fit, BIAS_PROCESS: 0.25 * fit, 'model_error': 100.0 * np.eye(3)},
        np.zeros(3),
    )
    for value, moves in ((0.5, True), (1.5, False)):
        values = np.array([value, 2.0, 1.0])
        found, grown, replaced = replace_weak(values, terms, prior, weak=[0])
        shift = np.array([-value, -0.9 * value, 0.0]) if moves else np.zeros(3)
        assert replaced.tolist() == [moves, False, False]
        np.testing.assert_allclose(found, values + shift, atol=1e-15)
        np.testing.assert_allclose(total(grown), total(terms) + np.outer(shift, shift), atol=1e-12)
    _, _, replaced = replace_weak(
        np.array([0.5, 0.5, 0.5]), terms, np.array([0.0, 0.0, np.inf]), weak=[0, 2]
    )
    assert replaced.tolist() == [True, False, False]  # no finite prior, no replacement
    for limit, moves in ((1.0, False), (np.array([3.84, 1.0, 1.0]), True)):
        assert replace_weak(np.array([1.5, 2.0, 1.0]), terms, prior, weak=[0], limit=limit)[
            2
        ].tolist() == [moves, False, False]


def test_the_sds_of_replaced_values_agree_with_their_errors():
    """
    Truths within 0.7 sd of the prior.

    Replacement lowers the errors, and the reported sds are not too small.
    """
    rng, fit = np.random.default_rng(3), np.array([[1.0, 0.6], [0.6, 1.0]])
    z, gain = [], []
    for truth in rng.normal(scale=0.7, size=(4000, 2)):
        values = rng.multivariate_normal(truth, fit)
        found, terms, replaced = replace_weak(values, {SAMPLE_NOISE: fit}, np.zeros(2), weak=[0])
        if replaced[0]:
            z.append((found - truth) ** 2 / np.diag(total(terms)))
            gain.append([(found - truth) ** 2, (values - truth) ** 2])
    assert len(z) > 1500 and np.all(np.mean(z, axis=0) < 1.0)
    assert np.all(np.mean(gain, axis=0)[0] < np.mean(gain, axis=0)[1])


def test_the_file_has_the_values_that_are_applied_and_the_terms_of_each_variance(by_table):
    calibration = by_table.calibration
    parts = calibration.covariance_terms
    np.testing.assert_allclose(sum(parts.values()), np.diag(calibration.covariance), rtol=1e-9)
    assert {'noise', 'bias_process', 'model_error', 'drift', 'gravity', 'held_parameters'} <= set(
        parts
    )
    assert np.all(parts['noise'] > -1e-30) and np.all(parts['bias_process'] > -1e-30)
    matrix = np.arange(len(calibration.values))[
        calibration.model.slices['accelerometer', 'matrix']
    ][::4]
    np.testing.assert_allclose(
        parts['gravity'][matrix],
        (calibration.values[matrix] * 1e-3 / by_table.gravity) ** 2,
        rtol=1e-3,
    )
    replaced = [name for name, reason in calibration.held_reason.items() if reason == REPLACEMENT]
    assert replaced
    for name in replaced:
        place = calibration.param_names.index(name)
        assert calibration.status[place] == 'held' and calibration.values[place] == float(
            name.endswith(('xx', 'yy', 'zz'))
        )
        assert parts['held_parameters'][place] > 0
    model, values = invertible_values(calibration)
    for effect in model.effects:
        np.testing.assert_array_equal(
            values[model.slices[effect.key]],
            calibration.values[calibration.model.slices[effect.key]],
        )


def test_terms_and_reasons_pass_through_the_file(by_table):
    found = calibration_from_text(calibration_to_text(by_table.calibration))
    assert found.held_reason == by_table.calibration.held_reason
    for name, variance in by_table.calibration.covariance_terms.items():
        np.testing.assert_array_equal(found.covariance_terms[name], variance)
    document = calibration_mapping(by_table.calibration)
    document['covariance_terms']['noise'][0] *= 2
    with refused(DocumentError, 'covariance_terms'):
        from_mapping(document)


def test_offsets_of_windows_are_a_term_apart_from_white_noise(by_table):
    """
    Without bias processes, offsets and differences between recordings the second term vanishes.
    """
    from imu_calibration.references.turntable.estimation.solver import solve

    solution, accumulator = by_table.solution, by_table.gathered.accumulator
    white = {
        sensor: replace(noise, offset_sd=0.0, bias_processes=())
        for sensor, noise in solution.noise.items()
    }
    walking = {sensor: replace(noise, offset_sd=1e-2) for sensor, noise in white.items()}
    first, second = (
        solve(accumulator, by_table.data.model, noise=each) for each in (white, walking)
    )
    scale = np.diag(first.terms[SAMPLE_NOISE])
    assert np.all(np.abs(np.diag(first.terms[BIAS_PROCESS])) <= 1e-6 * scale)
    bias = first.model.slices['accelerometer', 'bias']
    assert np.all(
        np.diag(second.terms[BIAS_PROCESS])[bias]
        > 0.9 * np.diag(second.covariance - second.terms[HELD_PRIORS])[bias]
    )


def test_the_solution_without_clipped_samples_has_the_terms_of_the_search(by_table):
    """What other choices would have moved enters the covariance of that solution too."""
    solution = by_table.solution
    name = solution.param_names[0]
    extension = ModelExtension(moves=(({name: 0.5}, 1.0),), clipped=solution)
    found = extension.applied(replace(solution, values=solution.values + 1.0))
    assert found.values[0] == solution.values[0] and found.terms[REJECTED][0, 0] == 0.25
