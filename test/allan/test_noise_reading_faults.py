"""Noise of readings with torn register reads, heavy tails and repeated readings."""

import numpy as np
import pytest

from imu_calibration.allan.document import lines, noise_from_text, noise_to_text
from imu_calibration.allan.identify import figures_of, identify_noise
from imu_calibration.allan.independent_errors import excess_of_errors
from imu_calibration.allan.outliers import outliers
from imu_calibration.allan.reading_faults import FaultSearch
from imu_calibration.core.samples import ImuSamples, SampleBlock
from imu_calibration.effects.base import SENSORS

from worlds.noise_worlds import identifying

RATE = 125.0
DENSITY = {'accelerometer': 1.9e-3, 'gyroscope': 1.5e-4}
"""White noise, m/s^2/sqrt(Hz) and rad/s/sqrt(Hz)."""
SCALE = {'accelerometer': 8192 / 9.80665, 'gyroscope': 65.5 * 180 / np.pi}
"""Counts per m/s^2 and per rad/s."""


def recording(values, rate):
    """Readings, shape (n, 6), as one block."""
    stamps = 10**18 + np.round(np.arange(len(values)) / rate * 1e9).astype(np.int64)
    return [SampleBlock(ImuSamples(stamps, values[:, :3], values[:, 3:], 'imu'))]


def torn_readings(seconds, share, level, times=1.0):
    """
    Counts near a change of the high byte, a share of them with the high byte of the last one.

    `times`: factor on the noise.
    """
    rng = np.random.default_rng(4)
    n = int(seconds * RATE)
    columns = []
    for sensor in SENSORS:
        for axis in range(3):
            spread = times * DENSITY[sensor] * RATE**0.5 * SCALE[sensor]
            centre = level[axis] if sensor == 'accelerometer' else 128.0
            count = np.round(rng.normal(centre, spread, n + 1)).astype(np.int64) & 0xFFFF
            torn = (count[:-1] & 0xFF00) | (count[1:] & 0xFF)
            read = np.where(rng.random(n) < share, torn, count[1:])
            columns.append(np.where(read > 0x7FFF, read - 0x10000, read) / SCALE[sensor])
    return np.column_stack(columns)


def white_interval(result, column):
    return result.axes[column].terms['white_noise'].interval


def test_torn_reads_change_neither_the_noise_nor_the_rest():
    values = torn_readings(250.0, 0.04, (513.0, -766.0, 8188.0))
    with identifying(0, 1, 2, 3):
        result = identify_noise(recording(values, RATE))
    for column in range(4):
        low, high = white_interval(result, column)
        # 95 % intervals of four axes: the truth is at most half a width outside
        margin = 0.5 * (high - low)
        assert low - margin < DENSITY[SENSORS[column // 3]] < high + margin
        assert high / low < 1.25
    assert set(result.record.left_out.values()) == {0.0}
    assert len(result.record.parts) == 1


def test_torn_reads_within_the_noise_widen_the_interval():
    """Noise of 64 steps, errors of 4 sd: too small for outliers, 9 % more noise on x."""
    times = 64.0 / (DENSITY['accelerometer'] * RATE**0.5 * SCALE['accelerometer'])
    values = torn_readings(200.0, 0.03, (1030.0, -895.0, 8188.0 + 128.0), times)
    with identifying(0, 1, 2):
        result = identify_noise(recording(values, RATE))
    density = times * DENSITY['accelerometer']
    for column in range(3):
        low, high = white_interval(result, column)
        assert low < density < 0.5 * high + 0.5 * density
    assert white_interval(result, 0)[1] > 1.05 * density
    # z, whose page begins 2 sd from its level, is 2 % too high; the gyroscope has no torn reads.
    faults = figures_of(result).recording['faults']
    assert 'accelerometer x' in faults
    assert all(axis.startswith('accelerometer') for axis in faults)


@pytest.mark.long
def test_heavy_tails_widen_the_interval():
    """Three readings in a hundred have four times the noise: none of them is a sure outlier."""
    rng = np.random.default_rng(12)
    n = int(400 * RATE)
    sd = np.repeat([0.02, 1e-3], 3)
    values = rng.normal(0, 1, (n, 6)) * sd + [0.0, 0.0, 9.8, 0.0, 0.0, 0.0]
    doubtful = rng.random(n) < 0.03
    values[doubtful, :2] += rng.normal(0, 4, (doubtful.sum(), 2)) * sd[:2]
    with identifying(0, 2, 3):
        result = identify_noise(recording(values, RATE))
    for column in (0, 2, 3):
        low, high = white_interval(result, column)
        margin = 0.5 * (high - low)
        assert low - margin < sd[column] / RATE**0.5 < high + margin
    assert low > 0.95 * sd[3] / RATE**0.5
    figures = figures_of(result)
    assert set(figures.recording['faults']) == {'accelerometer x', 'accelerometer y'}
    again = noise_from_text(noise_to_text(figures))
    assert any(line.startswith('accelerometer x: white noise') for line in lines(again))


def test_repeated_readings_of_one_sensor_are_named_with_their_effect():
    """Runs of one and two: the noise is sqrt(mean square) / mean of their lengths too high."""
    rng = np.random.default_rng(8)
    n_new = 30_000
    lengths = rng.integers(1, 3, n_new)
    values = rng.normal(0, 1, (lengths.sum(), 6)) * ([0.02] * 3 + [1e-3] * 3) + [0, 0, 9.8, 0, 0, 0]
    values[:, 3:] = np.repeat(values[:n_new, 3:], lengths, axis=0)
    search = FaultSearch()
    for part in np.array_split(values, 7):
        search.push(part, np.ones(len(part), bool))
    faults = search.result()
    assert faults.repeated == pytest.approx([0.0, 1 / 3], abs=0.01)
    assert faults.repetition == pytest.approx([1.0, np.sqrt(2.5) / 1.5], abs=0.005)
    assert not faults.named.any()
    # The interval of a recording of five minutes holds the density of the sensor.
    part = values[: int(300 * RATE)]
    with identifying(0, 3):
        result = identify_noise(recording(part, RATE))
    new_rate = RATE / 1.5
    low, high = white_interval(result, 3)
    assert low < 1e-3 / np.sqrt(new_rate) < high
    assert 'gyroscope' in figures_of(result).recording['faults']


def test_gaussian_readings_are_without_faults():
    rng = np.random.default_rng(3)
    values = rng.normal(0, 1, (30_000, 6))
    search = FaultSearch()
    search.push(values, np.ones(len(values), bool))
    faults = search.result()
    # Bounds: 30,000 readings can hide errors of one sd in a tenth of them, which add 5 %.
    assert np.all(faults.tails < 1.06)
    assert np.mean(faults.tails) < 1.045
    assert not faults.named.any()
    assert not faults.repeated.any()
    assert not outliers(values).any()


@pytest.mark.parametrize(
    ('size', 'widest'),
    [(0.0, 1.045), (0.7, 1.05), (1.0, 1.06), (1.5, 1.09), (2.5, 1.18), (4.0, 1.4)],
)
def test_independent_errors_are_bounded(size, widest):
    """Errors in a twentieth of the readings, whose noise they raise by sqrt(1 + 0.05 size^2)."""
    rng = np.random.default_rng(9731)
    readings = rng.normal(0, 1, (20, 25_600))
    wrong = rng.random(readings.shape) < 0.05
    readings += size * wrong * rng.choice([-1.0, 1.0], readings.shape)
    blocks = readings.reshape(20, -1, 32)
    deviations = (blocks - blocks.mean(axis=2, keepdims=True)).reshape(20, -1)
    excesses = [excess_of_errors(deviation, 32) for deviation in deviations]
    ratios = np.array([excess.ratio for excess in excesses])
    true = np.sqrt(1 + 0.05 * size**2)
    # One-sided 95 %: 4 of 20 too small have a chance of 2 %; 0.5 % is the scatter of `true`.
    assert np.sum(ratios < 0.995 * true) <= 3
    assert ratios.mean() < widest
    significant = [excess.sds > 3.0 for excess in excesses]
    if size > 1.2:
        assert np.mean(significant) >= 0.95
    elif size < 0.8:
        assert not any(significant)


def test_errors_of_one_byte_in_every_axis_leave_the_noise_as_it_is():
    """Errors of 256 counts in 5 % of the readings of each axis: 26 % of the samples hold one."""
    rng = np.random.default_rng(9732)
    sd = np.repeat([0.012, 1.2e-3], 3)
    values = rng.normal(0, 1, (12_000, 6)) * sd
    wrong = rng.random(values.shape) < 0.05
    values += 256 * sd / 20 * wrong * rng.choice([-1.0, 1.0], values.shape)
    values = np.round(values / sd * 20) / 20 * sd + [0, 0, 9.81, 0, 0, 0]
    result = identify_noise(recording(values, RATE))
    assert result.record.curve.period == pytest.approx(1 / RATE, rel=1e-6)
    assert result.record.curve.seconds > 0.95 * len(values) / RATE
    ratios = []
    for column in range(6):
        low, high = white_interval(result, column)
        assert low < sd[column] / RATE**0.5 < 1.01 * high
        ratios.append(high / low)
    # Short averaging times are left out where the holes bend the curve.
    assert np.median(ratios) < 1.25


def test_a_knock_is_no_outlier():
    """Twelve readings in a row deviate: the search for rest must see them."""
    rng = np.random.default_rng(3)
    values = rng.normal(0, 1, (1000, 6))
    values[500:512, 0] += 40 * (-1.0) ** np.arange(12)
    values[700, 1] += 12.0
    assert np.argwhere(outliers(values)).tolist() == [[700, 1]]


def test_torn_reads_of_noise_below_one_step_are_outliers():
    """Readings of one step, seldom of two, and four torn ones."""
    rng = np.random.default_rng(5)
    values = np.round(rng.normal(0.2, 0.2, (1000, 6)))
    values[:, 5] = np.repeat(rng.normal(0, 1, 50), 20)  # repeated readings are none
    places = [90, 300, 310, 800]
    values[places, 2] -= 256.0
    assert np.argwhere(outliers(values)).tolist() == [[place, 2] for place in places]
