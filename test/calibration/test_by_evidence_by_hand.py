"""
By hand too, what the recording demands is in the model of `calibrate`.

As `diagnose` finds it, and nothing else.
"""

import numpy as np
import pytest
from test_diagnosis_workflow_by_hand import HIDDEN, NOTHING
from test_live_by_hand import assert_same, make_live, run

import imu_calibration as imu
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.samples import SampleBlock
from imu_calibration.references.gravity.hand_calibration import gather_by_hand, solve_by_hand
from imu_calibration.references.gravity.hand_parameters import HandOptions

from worlds.hand_sessions import GRAVITY, PARAM_NAMES, simulate
from worlds.physics_hand import hold_and_turn, warmed_up
from worlds.searched_by_hand import searched

QUADRATIC = 'gyro_quadratic'
ROWS = slice(12, 21)


@pytest.fixture(scope='module')
def bent():
    """A session with gyroscopes whose output bends with the rate, and the true parameters."""
    samples, _, truth = simulate(31, n_poses=18, spoil=HIDDEN[QUADRATIC])
    return samples, truth


@pytest.fixture(scope='module')
def asked(bent):
    return imu.calibrate(SampleBlock(bent[0]), gravity=GRAVITY)


def rows_missed(calibration, truth):
    """Errors of the gyroscope's matrix in reported standard deviations."""
    return [
        abs(calibration.values[k] - true) / calibration.sd[k]
        for name, true in zip(PARAM_NAMES[ROWS], truth[ROWS])
        for k in [calibration.param_names.index(name)]
    ]


def test_what_the_turns_demand_is_taken_in_and_said_in_one_line(bent, asked):
    assert asked.calibration.statistics['added'] == [QUADRATIC]
    assert len([line for line in asked.verdict.lines() if f'{QUADRATIC} (' in line]) == 1
    assert max(rows_missed(asked.calibration, bent[1])) < 4.5
    plain = imu.calibrate(SampleBlock(bent[0]), gravity=GRAVITY, model_as_asked=True).calibration
    assert 'added' not in plain.statistics and not any(
        QUADRATIC in name for name in plain.param_names
    )


@pytest.mark.long
def test_diagnose_hands_over_what_calibrate_does(bent, asked):
    found = imu.diagnose(SampleBlock(bent[0]), gravity=GRAVITY)
    assert found.calibration.param_names == asked.calibration.param_names
    # rounding of BLAS differs with the alignment of arrays, by 1e-14
    close = {'rtol': 1e-10, 'atol': 1e-13}
    np.testing.assert_allclose(found.calibration.values, asked.calibration.values, **close)
    np.testing.assert_allclose(found.calibration.sd, asked.calibration.sd, **close)
    name, (value, sd, _) = next(iter(found.findings[0].parameters.items()))
    place = asked.calibration.param_names.index(name)
    assert value == pytest.approx(asked.calibration.values[place], rel=1e-10)
    assert sd == pytest.approx(asked.calibration.sd[place], rel=1e-10)


@pytest.mark.long
def test_live_it_is_in_the_model_as_well(bent, asked):
    live = make_live(options=CalibrationOptions())
    poses = run(live, bent[0])
    result = live.solve(pending=True)
    assert result.calibration.statistics['added'] == [QUADRATIC]
    assert_same(result, asked.result)
    residual = live.residuals(poses)
    # Noise of a mean over two seconds, 2e-4, and the bias of each pose.
    assert np.abs(residual.rate_s).max() < 5e-3


@pytest.mark.long
def test_what_only_one_half_shows_is_left_out_and_widens():
    """
    What goes with the square of the rate grows threefold after the middle.

    Something has changed, and it is no property of the sensor.
    """

    def spoil(force, rate, time, pose):
        return NOTHING, HIDDEN[QUADRATIC](force, rate, time, pose)[1] * (
            1 + 2 * (pose > 17)[:, None]
        )

    samples, ranges, _ = simulate(31, n_poses=36, spoil=spoil)
    data = gather_by_hand(samples, ranges)
    solved = searched(data)
    changes = solved.extension.changes
    assert changes.unstable and set(changes.unstable) <= {QUADRATIC, 'gyro_scale_asymmetry'}
    assert changes.added == ()
    plain = solve_by_hand(data, HandOptions(GRAVITY))
    np.testing.assert_array_equal(solved.solution.values, plain.values)
    grown = solved.solution.sd[ROWS] / plain.sd[ROWS]
    assert grown.min() >= 1.0 and grown.max() > 1.2


@pytest.mark.long
def test_a_warm_up_is_not_sold_as_an_answer_to_gravity(seed=0):
    samples, ranges, _ = hold_and_turn(seed, n_poses=24, rate_hz=50.0, still=3.0)
    warm, _ = warmed_up(samples, seed, rate=0.01, time_constant=60.0)
    names = searched(gather_by_hand(warm, ranges)).solution.param_names
    assert not any('gyro_g_sensitivity' in name for name in names)


@pytest.mark.parametrize('seed', range(2))
def test_nothing_is_added_where_nothing_is_hidden(seed):
    samples, ranges, _ = hold_and_turn(seed, n_poses=24, rate_hz=50.0)
    data = gather_by_hand(samples, ranges)
    solved = searched(data)
    assert solved.extension.changes.to_mapping() == {}
    np.testing.assert_array_equal(
        solved.solution.values, solve_by_hand(data, HandOptions(GRAVITY)).values
    )
