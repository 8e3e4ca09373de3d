"""
Noise identified from Allan curves.

The covariance between scales, the fit, its intervals, what is left out and taken out.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2

from imu_calibration.allan.curve import averaging_factors
from imu_calibration.allan.document import position_sd
from imu_calibration.allan.identify import RecordingTimes
from imu_calibration.allan.moment_fit import RIDGE, Moments, pearson_tails
from imu_calibration.allan.processes import (
    FLATNESS,
    FLICKER,
    QUANTISATION,
    RANDOM_WALK,
    WHITE,
    ScaleCovariance,
    allan_variance,
    gauss_markov,
    mean_covariance,
)
from imu_calibration.allan.terms import (
    PROCESSES,
    TIME_KEY,
    Choice,
    choose_form,
    fit_form,
    fit_names,
    identify_axis,
    log_cost,
    without_finest,
)
from imu_calibration.estimation.solution import DETERMINED, HELD, WEAK

from worlds.noise_worlds import (
    FORMS,
    AxisTruth,
    draw_truth,
    flicker,
    overlapping_allan_variance,
    random_walk,
)

PERIOD = 0.02
ALL = (QUANTISATION, WHITE, FLICKER, RANDOM_WALK, gauss_markov(3.0))


@lru_cache(maxsize=8)
def scales_of(n, period):
    """Expectations and covariances of a record of n samples, made once."""
    return ScaleCovariance(averaging_factors(n), [n], period)


def moments_of(figures, seconds, seed=0, period=PERIOD):
    """Allan variances of a drawn record."""
    n = int(seconds / period)
    return moments_from(AxisTruth(figures).draw(n, period, np.random.default_rng(seed)), period)


def moments_from(values, period=PERIOD):
    """Allan variances of given samples."""
    scales = scales_of(len(values), period)
    variance = overlapping_allan_variance(values[:, None], scales.factors)[:, 0]
    return Moments(scales, variance, variance > 0)


def expected_moments(figures, seconds):
    """Allan variances as they are on average."""
    scales = scales_of(int(seconds / PERIOD), PERIOD)
    processes = {
        name: gauss_markov(figures[TIME_KEY]) if name == 'gauss_markov' else PROCESSES[name]
        for name in figures
        if name != TIME_KEY
    }
    variance = sum(
        figures[name] ** 2 * scales.expectation(process) for name, process in processes.items()
    )
    return Moments(scales, variance, variance > 0)


def test_allan_variances_are_those_of_the_textbook():
    tau, time = np.geomspace(0.01, 1e4, 30), 50.0
    u = tau / time
    textbook = {
        QUANTISATION: 3 / tau**2,
        WHITE: 1 / tau,
        FLICKER: FLATNESS**2 + 0 * tau,
        RANDOM_WALK: tau / 3,
        gauss_markov(time): 2 / u * (1 - (3 - 4 * np.exp(-u) + np.exp(-2 * u)) / (2 * u)),
    }
    for process, variance in textbook.items():
        # the textbook's form of the Gauss-Markov variance cancels at short times
        long = u > 0.01 if process.time else u > 0
        np.testing.assert_allclose(allan_variance(process, tau)[long], variance[long], rtol=1e-7)


@pytest.mark.parametrize('process', ALL, ids=lambda process: process.name)
def test_the_covariance_between_scales_is_that_of_quadratic_forms(process):
    """
    2 tr(A S B S) with the covariance S of the samples.

    For a process without a variance any S that is right for contrasts will do.
    """
    n, factors = 120, np.array([1, 2, 3, 8, 21, 50])
    lag = np.subtract.outer(np.arange(n), np.arange(n)) * PERIOD
    samples = mean_covariance(process, lag, PERIOD)
    forms = []
    for m in factors:
        rows = np.zeros((n - 2 * m + 1, n))
        for k, row in enumerate(rows):
            row[k : k + m], row[k + m : k + 2 * m] = -1 / m, 1 / m
        forms.append(rows.T @ rows / (2 * len(rows)))
    exact = np.array([[2 * np.trace(a @ samples @ b @ samples) for b in forms] for a in forms])
    ours = ScaleCovariance(factors, [n], PERIOD).product(process, process)
    mean = [np.trace(a @ samples) for a in forms]
    np.testing.assert_allclose(
        ScaleCovariance(factors, [n], PERIOD).expectation(process), mean, rtol=1e-6
    )
    sd = np.sqrt(np.diag(exact))
    # a grid of lags stands for all of them: less than the ridge of the fit
    np.testing.assert_allclose(ours / np.outer(sd, sd), exact / np.outer(sd, sd), atol=0.01)


@pytest.mark.parametrize(
    'process',
    [FLICKER, RANDOM_WALK, *(gauss_markov(time) for time in (4.0, 87.0, 321.0, 3000.0))],
    ids=lambda p: f'{p.name}{p.time:g}',
)
def test_correlations_of_a_long_record_are_correlations(process):
    """
    No correlation is beyond one, no eigenvalue below zero by much of the ridge.

    Rounding once made correlations of thirty between the shortest averaging times, and lags too far
    apart eigenvalues of minus the ridge: likelihoods then jumped by ten from one correlation time
    to the next.
    """
    covariance = scales_of(1_080_000, 0.01).product(process, process)
    sd = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sd, sd)
    assert (
        np.abs(correlation).max() < 1 + 1e-9 and np.linalg.eigvalsh(correlation)[0] > -0.2 * RIDGE
    )


def test_several_stretches_add_up_like_one_when_nothing_connects_them():
    factors = np.array([1, 4, 16])
    one, two = (
        ScaleCovariance(factors, lengths, PERIOD).product(WHITE, WHITE)
        for lengths in ([4000], [4000, 4000])
    )
    np.testing.assert_allclose(two, one / 2, rtol=1e-9)


FIGURES = (
    {'white_noise': 1.0, 'random_walk': 0.05},
    {'white_noise': 1.0, 'bias_instability': 0.3},
    {'white_noise': 1.0, 'quantisation': 0.05},
    {'white_noise': 1.0, 'gauss_markov': 0.5, TIME_KEY: 1.1**36},
    {'white_noise': 1.0, 'bias_instability': 0.2, 'random_walk': 0.02},
)


@pytest.mark.parametrize('figures', FIGURES, ids=lambda figures: '+'.join(figures))
def test_the_average_curve_gives_back_its_figures(figures):
    names = tuple(
        name
        for name in (
            'quantisation',
            'white_noise',
            'bias_instability',
            'random_walk',
            'gauss_markov',
        )
        if name in figures
    )
    fit = fit_names(expected_moments(figures, 3600.0), names)
    np.testing.assert_allclose(
        np.sqrt(fit.coefficients), [figures[name] for name in names], rtol=1e-6
    )
    if TIME_KEY in figures:
        assert fit.processes[-1].time == pytest.approx(figures[TIME_KEY], rel=1e-9)


def test_intervals_of_one_variance_are_those_of_chi_square():
    """A sum of nu squares has skewness sqrt(8 / nu); its tails are exact."""
    for freedom in (3.0, 20.0, 400.0):
        for quantile in (0.01, 0.3, 0.975):
            value = chi2.ppf(quantile, freedom)
            above, below = pearson_tails(
                (value - freedom) / np.sqrt(2 * freedom), np.sqrt(8 / freedom)
            )
            assert (below, above) == pytest.approx((quantile, 1 - quantile), abs=1e-9)


def test_a_long_record_determines_its_noise():
    figures = {'white_noise': 1.0, 'random_walk': 0.05}
    found = identify_axis(moments_of(figures, 3600.0, 3))
    assert (
        found.form == ('random_walk',)
        and found.excess == 1.0
        and found.shortest == pytest.approx(PERIOD)
    )
    for name, value in figures.items():
        term = found.terms[name]
        assert (
            term.interval[0] < value < term.interval[1]
            and term.interval[0] < term.value < term.interval[1]
        )
    assert found.terms['white_noise'].status == DETERMINED
    assert (
        found.terms['bias_instability'].status == HELD
        and found.terms['bias_instability'].value is None
    )


def test_ten_minutes_cannot_determine_a_small_random_walk():
    figures = {'white_noise': 1.0, 'random_walk': 0.003}
    found = identify_axis(moments_of(figures, 600.0, 1))
    term = found.terms['random_walk']
    assert (
        term.status == HELD
        and term.value is None
        and term.interval[0] == 0.0
        and term.interval[1] > 0.003
    )
    assert term.reason == 'not seen'
    needed = RecordingTimes(PERIOD).needed((WHITE, RANDOM_WALK), np.array([1.0, 0.003**2]), 1)
    # the walk crosses the noise after N sqrt(3) / K = 580 s; some fifty of these, as a walk of 0.05
    # needs half an hour
    assert needed is not None and 10 * 3600 < needed <= 48 * 3600
    assert RecordingTimes(PERIOD).needed((WHITE, RANDOM_WALK), np.array([1.0, 0.05**2]), 1) <= 3600


def test_the_predicted_recording_time_is_what_a_fit_says_of_itself():
    """
    The interval of a fit just meets the criterion.

    The fit is on the average curve of a record of the predicted length.
    """
    figures = {'white_noise': 1.0, 'random_walk': 0.05}
    length = RecordingTimes(PERIOD).needed((WHITE, RANDOM_WALK), np.array([1.0, 0.05**2]), 1)
    for seconds, status in ((length, DETERMINED), (length / 3, WEAK)):
        term = identify_axis(expected_moments(figures, seconds)).terms['random_walk']
        ratio = term.interval[1] / term.interval[0]
        assert term.status == status, (seconds, ratio)


def test_a_form_that_explains_the_curve_as_well_makes_a_figure_weak():
    """
    At 15 minutes this flicker looks like a walk, or the other way round.

    Whichever is taken, the other is named.
    """
    found = identify_axis(moments_of({'white_noise': 1.0, 'bias_instability': 0.15}, 900.0, 1))
    assert found.others
    assert all(
        found.terms[name].status != DETERMINED
        for form in found.others
        for name in found.form
        if name not in form
    )


def test_what_the_sensor_filters_is_left_out_at_short_averaging_times():
    """
    A first-order low-pass of 0.03 s: fitted from longer times on.

    At 1 s it still takes 1.5 * 0.03 of the variance.
    """
    rng, n = np.random.default_rng(4), 180_000
    decay = np.exp(-PERIOD / 0.03)
    found = identify_axis(
        moments_from(lfilter([1 - decay], [1.0, -decay], rng.standard_normal(n) / np.sqrt(PERIOD)))
    )
    term = found.terms['white_noise']
    assert found.shortest > 5 * PERIOD
    assert term.value == pytest.approx(1.0, abs=0.04) and term.interval[1] / term.interval[0] < 1.15
    unfiltered = identify_axis(moments_of({'white_noise': 1.0}, n * PERIOD, 4))
    assert unfiltered.shortest == pytest.approx(PERIOD)


def shaken(seed, *hum, n=20_000):
    """
    Moments of white noise of 1 together with sines that no model explains.

    The sines are pairs of amplitude and Hz, and they make humps which no model explains.
    """
    rng, time = np.random.default_rng(seed), np.arange(n) * PERIOD
    sines = sum(
        amplitude * np.sin(2 * np.pi * frequency * time + frequency) for amplitude, frequency in hum
    )
    return moments_from(rng.standard_normal(n) / np.sqrt(PERIOD) + sines)


def test_a_vibration_is_named_with_its_frequency_and_widens_the_intervals():
    found = identify_axis(shaken(5, (1.0, 0.05), n=180_000))
    assert found.excess > 2
    frequency, amplitude = found.oscillation
    assert frequency == pytest.approx(0.05, rel=0.3) and amplitude == pytest.approx(1.0, rel=0.3)


def test_quantisation_is_taken_in_where_it_shows_only():
    with_steps = choose_form(moments_of({'white_noise': 1.0, 'quantisation': 0.1}, 1200.0, 6))
    without = choose_form(moments_of({'white_noise': 1.0}, 1200.0, 6))
    assert 'quantisation' in with_steps.best.names and 'quantisation' not in without.best.names


def test_a_vibration_does_not_hide_the_white_noise():
    """N is read where it shows, instead of leaving out until nothing of it is seen."""
    found = identify_axis(shaken(1, (2.0, 0.4), (4.0, 7.0)))
    term = found.terms['white_noise']
    assert (
        found.excess > 2
        and term.value == pytest.approx(1.0, rel=0.15)
        and 0.8 < term.interval[0] < 1.0 < term.interval[1]
    )


def test_forms_of_a_curve_that_none_explains_are_told_apart_less():
    """
    What a curve departs from every form by is no evidence between them.

    Intervals average over more of them.
    """
    moments = without_finest(shaken(1, (3.5, 0.25), (6.0, 7.0)), 4)
    counted = [len(choose_form(moments, excess).having('white_noise')[1]) for excess in (90.0, 1.0)]
    assert counted[0] > counted[1]


def test_a_correlation_time_that_fits_itself_gives_way_to_a_likelier_one():
    """
    Weights made with a time ask for it again.

    In this record, one of some hundred, that ends at fifteen times the true one.
    """
    rng = np.random.default_rng((20261203, 10800, 3, 1, 4))
    truth = draw_truth('tactical', 'gyroscope', FORMS[rng.integers(len(FORMS))], rng)
    moments = moments_from(truth.draw(1_080_000, 0.01, rng), 0.01)
    first, taken = (
        fit_names(moments, ('white_noise', 'gauss_markov')),
        fit_form(moments, ('gauss_markov',)),
    )
    assert (
        log_cost(moments, taken) < log_cost(moments, first) - 20
        and first.processes[-1].time > 10 * truth.figures[TIME_KEY]
    )
    assert taken.processes[-1].time == pytest.approx(truth.figures[TIME_KEY], rel=0.3)
    assert np.sqrt(taken.coefficients[-1]) == pytest.approx(truth.figures['gauss_markov'], rel=0.3)


@pytest.mark.long
def test_intervals_hold_the_truth_in_95_of_100_and_errors_are_close_to_the_bound():
    """
    Ten records of ten minutes; benchmarks/noise_records.py has 204 records.

    Three of ten outside have a chance of 1 %.
    """
    figures = {'white_noise': 1.0, 'random_walk': 0.05}
    inside, errors = {name: [] for name in figures}, []
    for seed in range(10):
        found = identify_axis(moments_of(figures, 600.0, 100 + seed))
        for name, value in figures.items():
            lower, upper = found.terms[name].interval
            inside[name].append(lower <= value <= upper)
        errors.append(found.terms['white_noise'].value ** 2 - 1.0)
    for name, held in inside.items():
        assert sum(held) >= 8, name
    # white noise of n samples: relative sd of the variance sqrt(2 / n)
    ratio = np.sqrt(np.mean(np.square(errors)) / (2 * PERIOD / 600.0))
    assert ratio < 1.5


def test_dead_reckoning_scatters_as_predicted():
    """400 drawn runs: 3.5 % sampling error of their sd."""
    rng, step, seconds, alignment = np.random.default_rng(8), 0.25, 30.0, 20.0
    before, after = int(alignment / step), int(seconds / step)
    figures = {WHITE: 1e-3, FLICKER: 2e-3, RANDOM_WALK: 3e-4}
    for process, size in figures.items():
        draw = {
            WHITE: lambda n, c: c / np.sqrt(step) * rng.standard_normal(n),
            FLICKER: lambda n, c: flicker(n, step, c, rng),
            RANDOM_WALK: lambda n, c: random_walk(n, step, c, rng),
        }[process]
        ends = []
        for _ in range(400):
            readings = draw(before + after, size)
            force = readings[before:] - readings[:before].mean()
            ends.append(np.sum(force * (seconds - (np.arange(after) + 0.5) * step)) * step)
        predicted = position_sd(
            [process], [size**2], 'accelerometer', seconds=seconds, alignment=alignment
        )[0]
        assert np.std(ends) == pytest.approx(predicted, rel=0.12), process.name
    white = position_sd([WHITE], [1.0], 'accelerometer', seconds=seconds, alignment=200.0)[0]
    assert white == pytest.approx(np.sqrt(seconds**3 / 3 + seconds**4 / 4 / 200.0), rel=1e-3)
    tilt = position_sd([WHITE], [1.0], 'gyroscope', seconds=seconds, alignment=200.0, gravity=10.0)[
        0
    ]
    assert tilt == pytest.approx(
        10.0 * np.sqrt(seconds**5 / 20 + seconds**6 / 36 / 200.0), rel=1e-3
    )


def test_a_fit_without_variance_costs_infinitely_and_is_never_preferred():
    """
    Steps as large as the noise left a form without any coefficient.

    Its cost was NaN, and no form remained (IndexError).
    """
    moments = moments_of({'white_noise': 1.0}, 400.0)
    form = fit_form(moments, ())
    empty = replace(form, coefficients=np.zeros(1))
    empty = replace(empty, cost=log_cost(moments, empty))
    assert empty.cost == np.inf and np.isfinite(form.cost)
    fits, weights = Choice((empty,), moments).having('white_noise')
    assert len(fits) == 1 and weights == [1.0]
    assert Choice((form, empty), moments).having('white_noise')[0] == [form]


def test_white_noise_that_is_not_seen_is_held_with_its_bound():
    """A random walk as coarse steps: the curve has no white noise."""
    rng, period = np.random.default_rng(44), 0.1
    step = 8 / np.sqrt(period)
    walk = random_walk(36_000, period, 0.3, rng)
    term = identify_axis(moments_from(np.round((walk + 0.3 * step) / step) * step, period)).terms[
        'white_noise'
    ]
    assert (term.status, term.value, term.interval[0]) == (HELD, None, 0.0) and 0 < term.interval[
        1
    ] < 2


def test_the_longest_of_many_rests_keeps_its_own_scales():
    """Classes of rests by their mean length had no term at the longest averaging time: 0 / 0."""
    lengths = [*range(200, 800, 5), 3000]
    scales = ScaleCovariance(averaging_factors(max(lengths)), lengths, PERIOD)
    assert np.isfinite(scales.product(WHITE, WHITE)).all()
