"""
Standard deviations allow for what the model misses.

Parameters that drift, misfit that goes with the motion; clean sessions stay as they are.
"""

from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.effects.forward_equations import predict
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.model_error import MIN_SCATTER_BLOCKS, CosineScores, errors_of_waves
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable import accumulator as accumulator_module
from imu_calibration.references.turntable.accumulator import Accumulator, restrict
from imu_calibration.references.turntable.collector import from_bytes, to_bytes
from imu_calibration.references.turntable.estimation.model_error_of_windows import (
    SHORTEST_BIAS_TIME,
)
from imu_calibration.references.turntable.estimation.solver import solve
from imu_calibration.references.turntable.session_data import SessionData
from imu_calibration.references.turntable.window_statistics import reduce_windows

from worlds.misfit_coverage import COARSE, base_sd, calibrated, clean, errors_in_sd
from worlds.misfit_worlds import make_pair
from worlds.physics import TABLES

TABLE = Table.from_mapping(TABLES['three_axis'])
MODEL = SensorModel(joint_names=tuple(TABLE.joint_names))
YAW = 'gyroscope.matrix.zx'


@pytest.fixture(scope='module')
def windows():
    """Windows of a clean session."""
    return clean(11).windows


def measured(windows, change_of, seed):
    """
    Return the windows with white noise, and the gyroscope's matrix moved.

    At each window it is moved by `change_of(share of the session)`.
    """
    rng, end, found = np.random.default_rng(seed), windows[-1].time[-1], []
    for window in windows:
        values = MODEL.start()
        values[MODEL.param_names.index(YAW)] += change_of(window.time.mean() / end)
        outputs = [
            out + rng.normal(0, sd, (len(window.time), 3))
            for out, sd in zip(predict(MODEL, values, TABLE, motion=window.motion), (2e-2, 2e-3))
        ]
        found.append(replace(window, force_s=outputs[0], rate_s=outputs[1]))
    return found


def accumulated(windows, model=MODEL):
    """Return the Accumulator of windows."""
    total = Accumulator()
    for row in reduce_windows(windows, model, TABLE):
        total.add(row)
    return total


def solved(windows):
    """Return the Solution."""
    return solve(accumulated(windows), MODEL)


def grown(solution):
    """Return the standard deviations over those that noise alone gives."""
    return solution.sd / base_sd(solution)


def test_clean_sessions_stay_as_they_are(windows):
    """Where the model holds nothing is wider, but by the chance that the tests leave."""
    ratios = np.array(
        [grown(solved(measured(windows, lambda share: 0.0, seed))) for seed in range(6)]
    )
    assert np.median(ratios) == 1.0
    assert np.quantile(ratios, 0.95) < 1.3


def test_a_parameter_that_drifts_has_a_standard_deviation_that_repeats(windows):
    """
    A cross term that walks by 2e-3 during the session is not known to 2e-5.

    What is another sensor's stays.
    """
    rng = np.random.default_rng(3)
    walk = np.cumsum(rng.normal(0, 1, 50)) * 2e-3 / np.sqrt(50)
    found = solved(
        measured(windows, lambda share: np.interp(share, np.linspace(0, 1, 50), walk), 1)
    )
    place = MODEL.param_names.index(YAW)
    assert base_sd(found)[place] < 1e-4
    assert 3e-4 < found.sd[place] < 6e-3
    assert np.all(grown(found)[:12] < 1.3)


@pytest.mark.parametrize('cause', ['encoder_eccentricity', 'flexible_mount'])
def test_errors_that_go_with_the_motion_are_in_the_standard_deviations(cause):
    """
    With noise alone the errors of matrices are many standard deviations.

    With what the blocks show they are as large as they should be.
    """
    errors = [errors_in_sd(calibrated(make_pair(cause, seed, **COARSE).first)) for seed in (21, 22)]
    alone, with_it = (
        np.concatenate(
            [
                error[what, group]
                for error in errors
                for group in ('accelerometer.matrix', 'gyroscope.matrix')
            ]
        )
        for what in ('noise alone', 'reported')
    )
    assert np.sqrt(np.mean(alone**2)) > 3.0
    assert np.sqrt(np.mean(with_it**2)) < 1.7


def test_few_blocks_say_nothing(windows):
    """Scatter of fewer blocks than it takes is not looked at."""
    few = solved(measured(windows, lambda share: 0.01 * share, 1)[: MIN_SCATTER_BLOCKS - 1])
    assert np.all(grown(few) == 1.0)


def test_blocks_are_bounded_and_hold_all_rows(windows, monkeypatch):
    """
    However long the session, the number of blocks is bounded.

    Together the blocks hold the content of the entire session, and columns are picked in both.
    """
    monkeypatch.setattr(accumulator_module, 'MAX_ACCUMULATOR_BLOCKS', 6)
    total = accumulated(windows)
    assert 3 <= len(total.blocks) <= 6
    assert sum(block.windows for block in total.blocks) == len(windows)
    narrow = SensorModel(accelerometer=('bias', 'matrix'), joint_names=MODEL.joint_names)
    for found in (total, restrict(total, MODEL, narrow)):
        for key, factor in found.within.items():
            parts = sum(
                block.within[key].T @ block.within[key]
                for block in found.blocks
                if key in block.within
            )
            np.testing.assert_allclose(
                parts, factor.T @ factor, rtol=1e-9, atol=1e-9 * np.max(factor.T @ factor)
            )


def test_blocks_hold_all_rows_when_means_are_joined(windows, monkeypatch):
    """
    The difference of two windows that are joined into one mean row goes to their block as well.
    """
    monkeypatch.setattr(accumulator_module, 'MAX_MEAN_ROWS', 20)
    total = accumulated(windows)
    key = ('gyroscope', 'static')
    parts = sum(
        block.within[key].T @ block.within[key] for block in total.blocks if key in block.within
    )
    np.testing.assert_allclose(
        parts, total.within[key].T @ total.within[key], rtol=1e-9, atol=1e-9 * np.max(parts)
    )


def test_copies_and_merged_systems_go_their_own_way(windows):
    """
    A window added to one accumulator shows in no copy of it, nor in one that it was merged into.
    """
    first = accumulated(windows[:9])
    total, twin = Accumulator(), first.copy()
    total.merge(first)
    before = [block.windows for block in total.blocks]
    first.block_length = 20
    first.add(reduce_windows(windows[9:10], MODEL, TABLE)[0])
    assert sum(block.windows for block in first.blocks) == 10
    assert (
        [block.windows for block in total.blocks]
        == before
        == [block.windows for block in twin.blocks]
    )


def test_blocks_survive_a_restart(windows):
    """A session that goes on where it was saved has the same standard deviations."""
    total = accumulated(measured(windows, lambda share: 5e-3 * share, 1))
    again = from_bytes(to_bytes(SessionData(accumulator=total), MODEL))[0].accumulator
    first, second = solve(total, MODEL), solve(again, MODEL)
    assert np.any(grown(first) > 1.0)
    np.testing.assert_array_equal(first.sd, second.sd)


def test_accumulators_of_one_recording_share_its_memory(windows, monkeypatch):
    monkeypatch.setattr(accumulator_module, 'MAX_MEAN_ROWS', 40)
    monkeypatch.setattr(accumulator_module, 'LEAST_ROWS', 4)
    shared = Accumulator(share=8)
    for window in reduce_windows(windows, MODEL, TABLE):
        shared.add(window)
    assert len(windows) > 20
    assert len(shared.rows) <= 5
    assert shared.copy().share == restrict(shared, MODEL, MODEL).share == 8
    assert sum(shared.windows.values()) == len(windows)


def test_biases_carry_what_goes_with_the_attitude_as_offsets_or_as_a_bias_too_fast_to_be_one():
    """
    A flexible mount is even in the attitude.

    The mean of what it adds is as large as its scatter, which the noise takes for a process of 6 s
    here.
    """
    found = calibrated(make_pair('flexible_mount', 9313, **COARSE).first)
    noise, part = (
        found.solution.noise['accelerometer'],
        found.solution.model.slices['accelerometer', 'bias'],
    )
    assert any(
        process.time < SHORTEST_BIAS_TIME and process.sd > 2 * noise.offset_sd
        for process in noise.bias_processes
    )
    error = (found.solution.values[part] - found.truth['accelerometer'].bias) / found.solution.sd[
        part
    ]
    assert np.abs(error).max() < 2.0


def test_a_drift_shows_beside_noise_that_was_taken_too_large():
    """
    Ripple that is fast and not white is taken for noise.

    A drift of 1.7 such deviations counts where the fast cosines scatter by a third of one, and not
    by all.
    """

    def waves(fast):
        rng = np.random.default_rng(5)
        moved = fast * rng.choice([-1.0, 1.0], (12, 3))
        moved[0] = 1.7
        return CosineScores(own, moved, np.tile(np.eye(3), (12, 1, 1)), covariance=np.eye(3))

    own = np.arange(len(SensorModel().param_names))[SensorModel().slices['gyroscope', 'bias']]
    assert np.all(errors_of_waves(waves(0.33), SensorModel())[0].drift_variance[own] > 1.0)
    assert not errors_of_waves(waves(1.0), SensorModel())[0].drift_variance.any()


def test_parts_that_ask_for_more_than_noise_explains_widen_by_half_more_than_they_show():
    """Twelve cosines, each of two sds: the excess of three variances counts 1.5 times."""
    moved = 2.0 * np.random.default_rng(6).choice([-1.0, 1.0], (12, 3))
    own = SensorModel().slices['gyroscope', 'bias']
    waves = CosineScores(
        np.arange(own.start, own.stop), moved, np.tile(np.eye(3), (12, 1, 1)), covariance=np.eye(3)
    )
    found, misfits = errors_of_waves(waves, SensorModel())
    assert misfits == {'gyroscope'}
    np.testing.assert_allclose(found.factor[own], np.sqrt(1 + 1.5 * 3))
