"""
Slow and fast parts of moving windows.

Alike where the reference is right, apart where the fast part is wrong.
"""

import numpy as np
import pytest

from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window
from imu_calibration.references.turntable.accumulator import Accumulator
from imu_calibration.references.turntable.estimation.session_noise import band_misfit, misfit_along
from imu_calibration.references.turntable.estimation.solver import solve
from imu_calibration.references.turntable.noise_model import MovingFactors, NoiseModel
from imu_calibration.references.turntable.window_statistics import reduce_window, slow_part

TABLE = Table.from_mapping(
    {
        'joints': [{'name': 'shaft', 'axis': [0, 0, 1]}],
        'up': [0, 0, 1],
        'gravity': 9.80665,
        'latitude': None,
    }
)
MODEL = SensorModel(joint_names=('shaft',))
GAIN, NOISE = 1.02, 0.01


def sweeps(rng, fast_gain, n_windows=12, length=1500):
    """
    Return windows of a shaft that swings slowly and shakes at 11 Hz.

    The gyroscope shows the shaking with a gain of its own.
    """
    windows = []
    for number in range(n_windows):
        time = 20.0 * number + 0.01 * np.arange(length)
        slow, fast = 2 * np.pi * 0.3, 2 * np.pi * 11.13
        terms = [(1.0, slow, 0.0), (0.01, fast, 0.4)]
        parts = [
            [a * w**k * np.sin(w * time + p + k * np.pi / 2) for k in range(4)] for a, w, p in terms
        ]
        motion = JointMotion(time, *(sum(part[k] for part in parts)[:, None] for k in range(4)))
        rate = rng.normal(0, NOISE, (length, 3))
        rate[:, 2] += GAIN * parts[0][1] + fast_gain * parts[1][1]
        force = np.array([0.0, 0.0, 9.80665]) + rng.normal(0, 0.02, (length, 3))
        windows.append(
            Window('dynamic', (time * 1e9).astype(np.int64), time, force, rate, motion, None)
        )
    return windows


def solved(windows):
    """Return the gain along the shaft, its standard deviation, and the noise of the gyroscope."""
    accumulator = Accumulator()
    for window in windows:
        accumulator.add(reduce_window(window, MODEL, TABLE))
    solution = solve(accumulator, MODEL)
    place = list(solution.param_names).index('gyroscope.matrix.zz')
    return solution.values[place], solution.sd[place], solution.noise['gyroscope']


@pytest.mark.parametrize('fast_gain', [0.3, 0.85, 1.2])
def test_a_wrong_gain_at_high_frequency_does_not_bend_the_estimate(fast_gain):
    """
    Ripple that a low-pass has taken from the gyroscope, or the encoder from the reference.

    All samples alike would err by up to 8 %.
    """
    windows = sweeps(np.random.default_rng(1), fast_gain)
    value, sd, noise = solved(windows)
    assert abs(value - GAIN) < 4 * sd < 0.01
    assert noise.moving['dynamic'].slow[2] < 0.5 * noise.moving['dynamic'].centred[2]
    x = np.concatenate([w.motion.rate[:, 0] - w.motion.rate[:, 0].mean() for w in windows])
    y = np.concatenate([w.rate_s[:, 2] for w in windows])
    assert abs(x @ y / (x @ x) - GAIN) > 3 * abs(value - GAIN)


def test_nothing_is_thrown_away_where_the_reference_is_right():
    """
    The standard deviation is that of all samples, and estimates scatter by it.

    The mean square of 50 errors in sd scatters by 0.2; the bounds exclude an sd that is wrong by a
    factor of 1.3, in either direction, for this seed.
    """
    rng, errors = np.random.default_rng(2), []
    for _ in range(50):
        windows = sweeps(rng, GAIN, n_windows=6, length=400)
        value, sd, noise = solved(windows)
        assert np.all(noise.slow_weight('dynamic') == 0.0)
        errors.append((value - GAIN) / sd)
    power = sum(((w.motion.rate[:, 0] - w.motion.rate[:, 0].mean()) ** 2).sum() for w in windows)
    assert 0.95 < sd * np.sqrt(power) / NOISE < 1.1
    assert 0.6 < np.mean(np.square(errors)) < 1.6


def test_white_noise_has_the_same_variance_in_both_parts():
    rows = np.random.default_rng(3).normal(0, 2.0, (25000, 3))
    slow = slow_part(rows, 25)
    found = band_misfit((rows**2).sum(axis=0), len(rows), (slow**2).sum(axis=0), dof_slow=len(slow))
    assert not found.apart.any()
    np.testing.assert_allclose(found.overall, 4.0, rtol=0.05)
    np.testing.assert_allclose(found.slow, 4.0, rtol=0.2)
    factors = found.factors(NoiseModel(np.full(3, 4.0), np.ones(3)))
    np.testing.assert_array_equal(factors.centred, factors.slow)


def test_weights_of_slow_and_of_all_rows_give_each_part_its_own():
    fast, slow = np.full(3, 5.0), np.full(3, 2.0)
    noise = NoiseModel(
        np.full(3, 0.1),
        np.full(3, 2.0),
        moving={'apart': MovingFactors(fast, slow), 'alike': MovingFactors(slow, slow)},
    )
    np.testing.assert_allclose(
        1 / noise.row_variance('apart') + noise.slow_weight('apart') ** 2, 1 / (0.2 * slow)
    )
    np.testing.assert_array_equal(noise.slow_weight('alike'), 0.0)


def test_variance_along_the_columns_is_that_of_noise_and_shows_what_is_no_noise():
    rng = np.random.default_rng(4)
    design, noise = rng.normal(size=(20000, 4)), rng.normal(0, 3.0, 20000)

    def along(misfit):
        rows = np.column_stack([design, misfit])
        squares, rank = misfit_along((rows.T @ rows)[None])
        assert rank == 4
        return squares / rank

    assert 9 * 0.05 < along(noise) < 9 * 4
    assert along(noise + 0.2 * design[:, 1]) > 50


def test_the_slow_misfit_of_few_pieces_is_taken_larger():
    """
    By two standard deviations of a variance from so many.

    Parts are told apart where that is sure, and weighed by what is sure.
    """
    few, many = (
        band_misfit(
            np.full(3, 3.0 * (9 * dof) + dof), 10 * dof, np.full(3, float(dof)), dof_slow=dof
        )
        for dof in (8, 800)
    )
    assert not few.apart.any() and many.apart.all()
    np.testing.assert_allclose(many.slow, 1 + 2 * np.sqrt(2 / 800))


@pytest.mark.parametrize(
    ('slow', 'fast', 'inflation', 'structure'),
    [
        (1.2, 1.0, 1.0, False),  # within the scatter of 200 pieces
        (30.0, 30.0, 1.0, False),  # louder, and as white as at rest
        (3.0, 30.0, 1.0, False),  # vibration above the band of the pieces
        (60.0, 30.0, 1.0, True),
        (60.0, 30.0, 2.0, False),  # the sensor itself has this noise at low frequency
    ],
)
def test_only_a_slow_part_above_that_of_white_noise_is_structure(slow, fast, inflation, structure):
    misfit = band_misfit(
        np.full(3, 200 * slow + 1800 * fast), 2000, np.full(3, 200 * slow), dof_slow=200
    )
    assert (misfit.slow_over_fast(np.full(3, inflation)) > 1.0) == structure
