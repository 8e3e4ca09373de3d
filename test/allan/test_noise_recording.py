"""
From a recording to noise.yaml.

What is at rest is found, trends are taken out and said, and the verb writes what it promises.
"""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import yaml
from refusal import refused
from scipy.signal import lfilter

from imu_calibration.allan import identify
from imu_calibration.allan.document import (
    filter_lines,
    lines,
    noise_exit_code,
    noise_from_text,
    noise_to_text,
)
from imu_calibration.allan.identify import figures_of, identify_noise, read_rest
from imu_calibration.allan.processes import RANDOM_WALK
from imu_calibration.allan.terms import Term, identify_axis
from imu_calibration.allan.trends import AxisTrend, Blocks, TrendSearch
from imu_calibration.cli.main import main
from imu_calibration.core.errors import DocumentError, InputError
from imu_calibration.core.samples import ImuSamples, SampleBlock, TemperatureSamples
from imu_calibration.document import files
from imu_calibration.document.exports.export import export, find_target
from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.solution import HELD
from imu_calibration.report.noise_page import noise_report
from msg_adapters.write import write_session

from worlds.compensation_cases import random_calibration
from worlds.noise_worlds import identifying, random_walk, white

PERIOD = 0.05
SIZES = np.array([2e-3] * 3 + [1e-4] * 3)
WALK = 0.03


def resting(seconds, seed=0, walk=WALK, period=PERIOD, sizes=SIZES):
    """An IMU at rest, z up: white noise of `sizes`, a random walk of `walk` times that."""
    rng, n = np.random.default_rng(seed), int(seconds / period)
    values = np.column_stack(
        [size * (white(n, period, 1.0, rng) + random_walk(n, period, walk, rng)) for size in sizes]
    )
    values[:, 2] += 9.81
    return ImuSamples(
        np.arange(n, dtype=np.int64) * round(period * 1e9) + 10**18,
        values[:, :3],
        values[:, 3:],
        'imu_link',
    )


def source(imu, temperature=None, size=20_000):
    """Blocks of a recording."""
    blocks = []
    for start in range(0, len(imu), size):
        part = imu.select(slice(start, start + size))
        warm = None
        if temperature is not None:
            warm = temperature.select(
                (temperature.stamp_ns >= part.stamp_ns[0])
                & (temperature.stamp_ns <= part.stamp_ns[-1])
            )
        blocks.append(SampleBlock(part, temperature=warm))
    return blocks


class Repeated:
    """100 s of samples, several times in succession, which are never all in memory."""

    def __init__(self, imu, times):
        self.imu, self.times = imu, times

    def __iter__(self):
        for k in range(self.times):
            yield SampleBlock(replace(self.imu, stamp_ns=self.imu.stamp_ns + k * 100_000_000_000))


def changed(imu, columns, start, values):
    """The samples with something added to columns (0 to 5) from sample `start` on."""
    both = np.concatenate([imu.force_s, imu.rate_s], axis=1)
    both[start : start + len(values), columns] += values
    return ImuSamples(imu.stamp_ns, both[:, :3], both[:, 3:], imu.frame_id)


@pytest.fixture(scope='module')
def quiet():
    """
    Twenty minutes at rest, and what is identified from them, of each sensor from its x axis.

    Y and z have the same noise.
    """
    imu = resting(1200.0)
    with identifying(0, 3):
        return imu, identify_noise(source(imu))


@pytest.fixture
def accelerometer_x_only(quiet, monkeypatch):
    """
    Identify the first axis only, and return it for each record.

    The others have the noise of the quiet record.
    """
    others, found = [], []

    def identified(moments):
        if others:
            return others.pop()
        others.extend(quiet[1].axes[:0:-1])
        found.append(identify_axis(moments))
        return found[-1]

    monkeypatch.setattr(identify, 'identify_axis', identified)
    return found


@pytest.mark.long
def test_rest_is_used_whole_and_nothing_is_taken_out(quiet):
    found = quiet[1].record
    assert len(found.parts) == 1 and found.curve.seconds == pytest.approx(1200.0, abs=1.0)
    assert found.left_out['motion'] == 0 and not any(found.trends)
    for axis, size in zip(quiet[1].axes[::3], SIZES[::3]):
        lower, upper = axis.terms['white_noise'].interval
        assert lower * 0.995 < size < upper * 1.005
    np.testing.assert_allclose(found.sample_sd, SIZES / np.sqrt(PERIOD), rtol=0.02)


def test_the_outcome_does_not_depend_on_the_blocks(quiet):
    again = read_rest(source(quiet[0], size=3_333))
    np.testing.assert_allclose(again.curve.variance, quiet[1].record.curve.variance, rtol=1e-9)


def test_a_knock_is_left_out_and_the_noise_is_as_without_it(quiet):
    imu, before = quiet
    rng = np.random.default_rng(1)
    knocked = changed(
        imu, slice(0, 6), 12_000, rng.normal(0, 1, (16, 6)) * np.array([0.5] * 3 + [0.03] * 3)
    )
    found = read_rest(source(knocked))
    assert len(found.parts) == 2 and 0.5 < found.left_out['motion'] < 6.0
    # short averages are the same, but for two seconds in twenty minutes
    np.testing.assert_allclose(
        found.curve.variance[:10], before.record.curve.variance[:10], rtol=5e-3
    )


def test_an_imu_that_was_moved_is_two_stretches(quiet):
    imu, before = quiet
    # 3 mrad.
    tilted = changed(imu, 0, 12_000, np.full(12_000, 0.03))
    found = read_rest(source(tilted))
    assert len(found.parts) == 2
    # the step would add 0.03^2 / 12 at the longest averages
    longest = (found.curve.tau > 100) & (found.curve.tau < 300)
    assert np.all(found.curve.variance[longest, 0] < 0.3 * 0.03**2 / 12)
    assert found.parts[0].seconds == pytest.approx(600.0, abs=15.0)


def test_a_walking_bias_is_no_motion():
    """A bias that walks ten times the usual over twenty minutes stays in one part."""
    found = read_rest(source(resting(1200.0, 2, walk=0.3)))
    assert len(found.parts) == 1 and found.left_out['motion'] == 0


def warming(imu, per_kelvin, seed=3):
    """Temperature that rises by 10 K, and readings that follow it."""
    time = (imu.stamp_ns - imu.stamp_ns[0]) * 1e-9
    warmth = 25.0 + 10.0 * (1 - np.exp(-time / 400.0))
    stamps = imu.stamp_ns[::20]
    noisy = warmth[::20] + np.random.default_rng(seed).normal(0, 0.02, len(stamps))
    return changed(imu, 0, 0, per_kelvin * (warmth - 30.0)), TemperatureSamples(stamps, noisy)


@pytest.mark.long
def test_the_temperature_is_taken_out_and_said(quiet, accelerometer_x_only):
    imu, before = quiet
    warm, temperature = warming(imu, 5e-3)
    found = identify_noise(source(warm, temperature))
    (trend,) = found.record.trends[0]
    assert trend.name == 'temperature' and abs(trend.value - 5e-3) < 4 * trend.sd
    assert not any(found.record.trends[1:])
    # Ug/K.
    assert any(f'{1e6 * trend.value / 9.80665:.0f} ± ' in line for line in lines(figures_of(found)))
    # the curve with the trend is far above at long times, the one without it is not
    curve = found.record.curve
    longest = curve.tau > 100
    assert np.all(curve.raw[longest, 0] > 3 * curve.variance[longest, 0])
    lower, upper = found.axes[0].terms['random_walk'].interval
    assert lower < SIZES[0] * WALK < upper
    blind = read_rest(source(warm))
    assert blind.trends[0] and blind.trends[0][0].name in ('turn_on', 'ramp')


def test_trends_are_not_found_in_a_walk():
    """Walks look like trends; against their own covariance they are not. 9 records of 6 axes."""
    rng, n = np.random.default_rng(4), 150
    time = np.arange(n) * 20.0 + 10.0
    found = 0
    for ratio in (0.0, 1.0, 50.0):
        for _ in range(3):
            means = rng.normal(size=(n, 6)) + np.cumsum(rng.normal(size=(n, 6)), axis=0) * np.sqrt(
                6 * ratio / n
            )
            search = TrendSearch(
                Blocks(time, means, np.zeros(n, int), 20.0, 25 + 10 * (1 - np.exp(-time / 900)))
            )
            found += sum(len(search.find(axis)) for axis in range(6))
    assert found <= 2  # of 54 axes; one in a thousand each for temperature, turn-on and ramp


def test_what_goes_with_a_trend_is_known():
    """Taking a line out of a walk takes variance at long averages: as much as `kept` says."""
    rng, n, seconds = np.random.default_rng(5), 60, 10.0
    time = (np.arange(n) + 0.5) * seconds
    ratios = []
    means = np.zeros((n, 6))
    search = TrendSearch(Blocks(time, means, np.zeros(n, int), seconds))
    for _ in range(300):
        walk = means[:, 0] = np.cumsum(rng.normal(size=n)) + 0.1 * rng.normal(size=n)
        values = search.regress(0, [('ramp', 0.0)]).values
        rest = walk - search.columns([('ramp', 0.0)])[:, 0] * values[0]
        ratios.append(
            [
                np.mean((series[40:] - 2 * series[20:-20] + series[:-40]) ** 2)
                for series in (np.concatenate([[0], np.cumsum(x)]) for x in (rest, walk))
            ]
        )
    kept = search.kept(0, (AxisTrend('ramp', 0.0, 1.0),)).of(RANDOM_WALK, np.array([20 * seconds]))[
        0
    ]
    left, whole = np.mean(ratios, axis=0)
    assert kept < 0.97
    assert left / whole == pytest.approx(kept, abs=0.06)  # 300 records with about one average each


def test_lost_samples_and_holes_in_time_change_little(quiet):
    imu, before = quiet
    keep = np.random.default_rng(6).random(len(imu)) > 0.005
    keep[8_000:8_160] = False
    found = read_rest(source(imu.select(keep)))
    assert found.curve.seconds == pytest.approx(1200.0, abs=2.0)
    # Over 20 draws of the losses the relative differences had an rms of 0.6 % sqrt(tau / 1 s) for
    # averages of up to 9 s; four times that is allowed.
    ratio = found.curve.variance[:15] / before.record.curve.variance[:15]
    assert np.all(np.abs(ratio - 1).T < 4 * 0.006 * np.sqrt(found.curve.tau[:15]))


def test_stamps_in_milliseconds_and_an_odd_rate_are_followed():
    imu = resting(300.0, 7, period=1 / 104.17)
    rounded = imu.stamp_ns // 1_000_000 * 1_000_000
    found = read_rest(source(ImuSamples(rounded, imu.force_s, imu.rate_s, imu.frame_id)))
    assert 1 / found.curve.period == pytest.approx(104.17, rel=1e-3)
    assert sum(found.curve.lengths) == pytest.approx(len(imu), abs=20)


def test_what_moves_all_the_time_is_refused(tmp_path, capsys):
    rng = np.random.default_rng(8)
    imu = changed(
        resting(50.0, 8), slice(0, 6), 0, np.cumsum(rng.normal(0, 0.05, (1000, 6)), axis=0)
    )
    with refused(InputError, 'rest_too_short', 1000):
        read_rest(source(imu))


def test_a_document_is_read_as_it_was_written(quiet):
    figures = figures_of(quiet[1], {'bags': [{'name': 'a', 'sha256': 'b'}]})
    text = noise_to_text(figures)
    assert noise_to_text(noise_from_text(text)) == text
    document = yaml.safe_load(text)
    assert document['format'] == 'imu_calibration/noise/1'
    assert set(document['accelerometer']['white_noise']) == {
        'value',
        'interval95',
        'status',
        'reason',
        'unit',
    }
    assert document['accelerometer']['white_noise']['unit'] == 'm/s^2/sqrt(Hz)'


@pytest.mark.parametrize(
    'change, code, values',
    [
        (lambda d: d.update(format='imu_calibration/1'), 'document_format', ['imu_calibration/1']),
        (lambda d: d.pop('sampling_rate'), 'document_parts', ['sampling_rate']),
        (lambda d: d['gyroscope'].pop('random_walk'), 'part_missing', ['random_walk']),
        (lambda d: d.update(sampling_rate=0.0), 'rate_not_positive', [0]),
        (
            lambda d: d['gyroscope']['white_noise'].update(value=[None] * 3),
            'value_missing',
            ['white_noise'],
        ),
        (
            lambda d: d['gyroscope']['white_noise'].update(
                interval95=[[2.0, 1.0], [2.0, 1.0], [2.0, 1.0]]
            ),
            'status_or_interval',
            ['white_noise', '[2.0, 1.0]'],
        ),
    ],
)
def test_a_spoiled_document_is_refused_in_one_line(quiet, change, code, values):
    document = yaml.safe_load(noise_to_text(figures_of(quiet[1])))
    change(document)
    with refused(DocumentError, code, *values) as caught:
        noise_from_text(yaml.safe_dump(document))
    assert '\n' not in str(caught.value)


def test_discrete_figures_follow_the_rate(quiet):
    figures = figures_of(quiet[1])
    found = figures.densities('accelerometer')
    assert found.sample_sd(400.0) == pytest.approx(2 * found.sample_sd(100.0))
    assert found.step_sd(400.0) == pytest.approx(0.5 * found.step_sd(100.0))
    assert len(filter_lines(figures, [50.0, 400.0])) == 8


def test_the_report_holds_the_plots_and_is_the_same_each_time(quiet):
    figures = figures_of(quiet[1])
    page = noise_report(quiet[1], figures)
    assert page == noise_report(quiet[1], figures)
    assert page.count('<svg') == 2 and 'nan' not in page.lower().replace('nano', '')


def test_memory_is_that_of_a_shorter_recording():
    """
    A longer one takes more for its means of a quarter of a second only.

    They take 0.2 kB of each second; samples, which are not kept, would take 1.1 kB.
    """
    peaks = []
    for seconds in (800.0, 1200.0):
        stream = Repeated(resting(100.0, 9), int(seconds / 100))
        tracemalloc.start()
        read_rest(stream)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < peaks[0] + 0.4e6


def test_the_verb_writes_prints_and_says_what_is_not_determined(tmp_path, capsys):
    sizes = SIZES * [1.0, 1.5, 2.2, 2.0, 1.4, 1.0]
    imu = resting(120.0, 10, sizes=sizes)
    write_session(tmp_path / 'bag', imu, None, temperature=None)
    assert (
        main(['noise', str(tmp_path / 'bag'), '--output', str(tmp_path / 'out'), '--rate', '200'])
        == 3
    )
    said = capsys.readouterr().out
    assert 'µg/√Hz' in said and '200 Hz' in said
    figures = files.read_noise(tmp_path / 'out/noise.yaml')
    assert (
        figures.frame_id == 'imu_link'
        and figures.rate == pytest.approx(20.0)
        and noise_exit_code(figures) == 3
    )
    # Every axis has its own noise, which 2400 readings give to 1.5 % (rms); five times are allowed.
    white = [axis.white for sensor in SENSORS for axis in figures.sensor(sensor)]
    np.testing.assert_allclose(white, sizes, rtol=0.075)
    assert figures.provenance['bags'][0]['name'] == 'bag'
    assert (tmp_path / 'out/report.html').read_text().startswith('<!DOCTYPE html>')
    short = imu.select(slice(0, 160))
    write_session(tmp_path / 'short', short, None, temperature=None)
    assert main(['noise', str(tmp_path / 'short'), '--output', str(tmp_path / 'none')]) == 1
    error = capsys.readouterr().err
    assert error.count('\n') == 1 and not (tmp_path / 'none').exists()


def test_an_axis_whose_steps_hide_its_noise_is_named_and_refused_without_another_sensor():
    """It changes while the sensor is knocked, and stays at one step of a coarse converter else."""
    imu = resting(120.0, 11)
    knock = np.random.default_rng(11).normal(0, 1, (16, 6)) * np.array([0.5] * 3 + [0.03] * 3)
    frozen = ImuSamples(
        imu.stamp_ns, np.where([False, True, False], 0.5, imu.force_s), imu.rate_s, imu.frame_id
    )
    coarse = changed(frozen, slice(0, 6), 1200, knock)
    record = read_rest(source(coarse))
    assert list(record.unusable) == ['accelerometer']
    assert 'accelerometer y' in record.unusable['accelerometer']
    assert [moments is None for moments in record.moments] == [True] * 3 + [False] * 3
    with refused(InputError, 'coarse_steps', 'accelerometer y'):
        read_rest(source(replace(coarse, rate_s=np.full_like(coarse.rate_s, np.nan))))


def hummed(extra, seed, period=0.05, n=12_000):
    """
    Ten minutes at rest with something added to the x axis of the accelerometer.

    It is added in sizes of the accelerometer's sample noise.
    """
    rng = np.random.default_rng(seed)
    values = SIZES / np.sqrt(period) * rng.standard_normal((n, 6))
    values[:, 0] += extra * SIZES[0] / np.sqrt(period)
    values[:, 2] += 9.81
    return ImuSamples(
        np.arange(n, dtype=np.int64) * round(period * 1e9) + 10**18,
        values[:, :3],
        values[:, 3:],
        'imu_link',
    )


@pytest.mark.long
def test_an_oscillation_needs_a_line_in_the_periodogram(accelerometer_x_only):
    """A resonance that noise excites makes the hump of a sine, and no line."""
    time = np.arange(12_000) * 0.05
    sine = hummed(1.5 * np.sin(2 * np.pi * 0.41 * time), 11)
    radius, angle = 0.99, 2 * np.pi * 0.1 * 0.05
    noise = lfilter(
        [1.0],
        [1.0, -2 * radius * np.cos(angle), radius**2],
        np.random.default_rng(12).standard_normal(12_000),
    )
    broad = hummed(1.2 * noise / noise.std(), 13)
    found, other = (identify_noise(source(imu)) for imu in (sine, broad))
    frequency, amplitude = found.axes[0].oscillation
    assert frequency == pytest.approx(0.41, rel=0.01)
    assert amplitude == pytest.approx(1.5 * SIZES[0] / np.sqrt(0.05), rel=0.1)
    candidate = accelerometer_x_only[1]
    assert (
        candidate.excess > 1
        and candidate.oscillation is not None
        and other.axes[0].oscillation is None
    )


def numbers(part):
    """All numbers of a document."""
    if isinstance(part, (dict, list)):
        return [
            number
            for item in (part.values() if isinstance(part, dict) else part)
            for number in numbers(item)
        ]
    return [part] if isinstance(part, float) else []


def test_an_interval_without_an_upper_end_is_null_in_the_file_and_finite_where_filters_take_it(
    quiet,
):
    figures = figures_of(quiet[1])
    open_ends = {
        name: Term(name, None, (0.0, np.inf), HELD) for name in ('white_noise', 'random_walk')
    }
    axis = replace(figures.gyroscope[2], terms=figures.gyroscope[2].terms | open_ends, form=())
    without = replace(figures, gyroscope=(axis,) * 3)
    text = noise_to_text(without)
    document = yaml.safe_load(text)
    assert (
        np.isfinite(numbers(document)).all()
        and document['gyroscope']['random_walk']['interval95'] == [[0.0, None]] * 3
    )
    assert document['recording']['intervals_hold_for']
    again = noise_from_text(text)
    assert (
        again.gyroscope[0].terms['random_walk'].interval == (0.0, np.inf)
        and noise_to_text(again) == text
    )
    assert again.gyroscope[0].white == pytest.approx(axis.sample_sd * np.sqrt(axis.shortest))
    assert not {'inf', 'nan'} & {
        word for line in (*filter_lines(without, [100.0]), *lines(without)) for word in line.split()
    }
    with refused(InputError, 'walk_unbounded', 'gyroscope'):
        export(random_calibration(1), find_target('kalibr'), noise=without)
