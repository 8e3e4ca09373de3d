"""
The guards of the search, each in a case in which only it prevents a false claim.

Each guard then stands between the tool and a false claim by itself.
"""

from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest

from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.noise_likelihood import FLICKER_MARK, NoiseLikelihood
from imu_calibration.estimation.rows import Rows
from imu_calibration.estimation.sensor_noise import BiasProcess
from imu_calibration.references.turntable.estimation.noise_search import BiasProcessSearch
from imu_calibration.references.turntable.noise_model import NoiseModel, ReferenceNoise
from imu_calibration.references.turntable.residuals import unexplained_windows as rests
from imu_calibration.references.turntable.residuals.find_onset import _passed_once
from imu_calibration.references.turntable.selection import investigation, window_gain
from imu_calibration.references.turntable.selection.explained_windows import ExplainedWindows
from imu_calibration.references.turntable.selection.linearised_problem import LinearisedProblem
from imu_calibration.references.turntable.selection.noise_beside_effects import (
    _needed_smooth,
    drift_prior,
    natural_processes,
    plausible_processes,
)
from imu_calibration.references.turntable.selection.parameter_space import (
    ParameterSpace,
    mean_rows,
    parameter_space,
    scatter_of_each,
)
from imu_calibration.references.turntable.selection.window_evidence import (
    WindowEvidence,
    folds_of,
    locked_windows,
)
from imu_calibration.selection import gain
from imu_calibration.selection.evidence import MOST_FITS, Evidence
from imu_calibration.selection.explained_share import SHOWS, Explained, pruned
from imu_calibration.selection.order_of_tests import select_findings
from imu_calibration.selection.questions import Question
from imu_calibration.selection.search import MIN_GAIN_NATS, Search

from worlds.stub_windows import StubWindows

KINDS = np.array(['static'] * 20 + ['spin'] * 12)


def asked(sensor, name, *parameters):
    """The question about an effect of the catalogue."""
    return Question(CATALOGUE.find(sensor, name), parameters, len(parameters), name)


QUADRATIC, CUBIC, PRODUCT = (
    asked('accelerometer', name, k)
    for k, name in enumerate(('accel_quadratic', 'accel_cubic', 'accel_cross_product'))
)
TILT, OFFSET, DRIFT = (
    asked('reference', 'table_tilt', 0, 1),
    asked('reference', 'time_offset', 3),
    asked('accelerometer', 'accel_bias_drift', 4, 5, 6),
)


class Known(Evidence):
    """Evidence that is given: losses of choices, an estimate, a p-value."""

    def __init__(self, loss=dict, values=None, p=1e-12):
        super().__init__(
            [],
            [],
            total=np.zeros((10, 10)),
            without=np.zeros((0, 10, 10)),
            prior_sd=np.ones(9),
            prior_mean=np.zeros(9),
        )
        self.loss_of, self.values, self.p = loss, values, p

    def loss(self, used):
        return self.loss_of(frozenset(used))

    heldout = loss

    def p_value(self, smaller, larger):
        return self.p

    def fit(self, used):
        values = np.full(len(used), 1e-9) if self.values is None else np.asarray(self.values)
        return values, 1e-18 * np.eye(len(values))


def scored(fall=100.0, p=1e-12, questions=30):
    """Return the Score of an effect that makes the held-out loss fall by so much."""
    evidence = Known(lambda used: -fall * (0 in used), p=p)
    return Search(evidence, (), [QUADRATIC] * questions).score([], QUADRATIC)


def test_among_many_effects_one_is_significant_by_chance():
    """One in ten thousand is much for one question and nothing for thirty."""
    assert scored(p=1e-4, questions=1).significant
    assert not scored(p=1e-4, questions=30).significant
    assert scored(p=1e-4, questions=30).p_value == pytest.approx(0.003)


def test_a_finding_predicts_what_it_was_not_fitted_to():
    assert scored(2 * (MIN_GAIN_NATS + 1)).significant
    assert not scored(2 * (MIN_GAIN_NATS - 1)).significant
    assert not scored(-10.0).significant


@pytest.mark.parametrize(
    ('question', 'value', 'step', 'possible'),
    (
        (asked('gyroscope', 'gyro_bandwidth', 0), [2e-3], 0.0, True),
        (asked('gyroscope', 'gyro_bandwidth', 0), [-2e-3], 0.0, False),
        (TILT, [4e-6, 3e-6], 1e-5, False),
        (TILT, [6e-6, 3e-6], 1e-5, True),
        (TILT, [4e-6, 3e-6], 0.0, True),
        (asked('reference', 'encoder_harmonic', 0), [4e-6], 1e-5, False),
        (asked('reference', 'load_compliance', 0), [4e-7] * 9, 1e-5, False),
        (QUADRATIC, [100 * QUADRATIC.effect.largest], 0.0, False),
        (QUADRATIC, [9 * QUADRATIC.effect.largest], 0.0, True),
        (asked('reference', 'earth_rate', 0), [1e-4], 0.0, False),
    ),
)
def test_no_lag_is_negative_no_angle_within_an_encoder_step_no_size_beyond_what_is_known(
    question, value, step, possible
):
    assert (
        Search(Known(values=value), (), [question], encoder_step=step).allowed([question], question)
        == possible
    )


def test_an_earlier_choice_gives_way_to_what_explains_better_together():
    """
    The first effect is the best alone.

    With the second beside it a third does more, and the first is needed no longer.
    """
    losses = {
        frozenset(): 400.0,
        frozenset({0}): 100.0,
        frozenset({1}): 200.0,
        frozenset({2}): 190.0,
        frozenset({0, 1}): 80.0,
        frozenset({0, 2}): 90.0,
        frozenset({1, 2}): 4.0,
        frozenset({0, 1, 2}): 3.0,
    }
    found = Search(Known(losses.get), (), [QUADRATIC, CUBIC, PRODUCT]).run()
    assert {question.label for question in found} == {CUBIC.label, PRODUCT.label}


def test_windows_of_each_kind_are_locked_and_dealt_out_in_turn():
    locked, fold = locked_windows(KINDS), folds_of(KINDS)
    assert 0.2 < locked.mean() < 0.3
    for kind in np.unique(KINDS):
        assert locked[kind == KINDS].any() and len(set(fold[kind == KINDS])) >= 5


def evidence_of_folds(parts, size):
    """Return the evidence of normal matrices of folds, without explicit rows."""
    total = parts.sum(axis=0)
    wide = {'prior_sd': np.full(size, 1e3), 'prior_mean': np.zeros(size)}
    return Evidence([], [], total=total, without=total - parts, **wide)


def test_noise_gains_nothing_where_it_was_not_fitted():
    """
    Columns of noise fit the windows that they see, and predict others worse than one column does.

    On average of forty draws.
    """
    gained = []
    for seed in range(40):
        parts = np.array(
            [rows.T @ rows for rows in np.random.default_rng(seed).normal(size=(6, 6, 5))]
        )
        evidence = evidence_of_folds(parts, 4)
        gained.append(
            (
                evidence.loss([0]) - evidence.loss(range(4)),
                evidence.heldout([0]) - evidence.heldout(range(4)),
            )
        )
    fitted, held_out = np.mean(gained, axis=0)
    assert fitted > 2.0 and held_out < -2.0


def test_memory_of_a_search_does_not_grow_with_the_choices_it_tried():
    """
    A search tries thousands.

    Only their losses are kept, and the last fits and predictions, which come out the same again.
    """
    parts = np.array([rows.T @ rows for rows in np.random.default_rng(1).normal(size=(6, 20, 11))])
    evidence = evidence_of_folds(parts, 10)
    tried = list(combinations(range(10), 4))
    first = evidence.heldout_weights(tried[0])
    for choice in tried:
        evidence.heldout(choice)
    kept = [
        each
        for each in vars(evidence).values()
        if isinstance(each, dict) and any(isinstance(v, np.ndarray) for v in each.values())
    ]
    assert len(tried) > MOST_FITS and max(map(len, kept)) == MOST_FITS
    np.testing.assert_array_equal(evidence.heldout_weights(tried[0]), first)


def test_offsets_of_windows_are_in_the_weights_of_the_evidence():
    recording = StubWindows(
        kind=np.array(['static'] * 4),
        count=np.full(4, 100.0),
        duration=np.ones(4),
        keys=(),
        time=np.arange(4.0),
        session=np.zeros(4),
    )
    space = SimpleNamespace(
        recording=recording,
        mean={'gyroscope': [np.ones((4, 2))] * 3},
        places=lambda sensor, axis: np.arange(2),
    )
    for offset, weight in ((0.0, 10.0), (3.0, 1 / np.sqrt(9.01))):
        noise = {'gyroscope': NoiseModel(np.ones(3), np.ones(3), offset)}
        for rows in mean_rows(space, noise, 'gyroscope'):
            np.testing.assert_allclose(rows.white(), weight, rtol=1e-9)


class Squares:
    """
    Sums of squares of 30 windows that choose and of 10 locked ones.

    Shares of 97 about the means and of 0.15 in the means that a finding leaves.
    """

    evidence = SimpleNamespace(
        fold=np.arange(30) % 6,
        fit=lambda used: (-np.ones(len(used)), None),
        heldout_weights=lambda used: np.tile([float(len(used)), 1.0], (6, 1)),
    )
    search = SimpleNamespace(indices=lambda chosen: list(range(len(chosen))))
    space = SimpleNamespace(size=1)

    def __init__(self, within=0.4, means=0.12):
        self.all_samples, self.locked_samples = (30, within, means), (10, 0.9, 0.01)

    @staticmethod
    def of(space, values, _sensor):
        count, within, means, *rests = space
        within, means = (
            np.where(values[:, 0] > 0, left, 1.0) * size * np.ones(count)
            for left, size in ((within, 97.0), (means, 0.15))
        )
        still = np.where(values[:, 0] > 0, rests[0] if rests else 0.15, 0.15) * np.ones(count)
        return dict(
            zip(
                gain.MEASURES,
                (
                    (within + 100.0 / 3.0 * means, np.full(count, 100.0)),
                    (means, np.full(count, 3.0)),
                    (within, np.full(count, 97.0)),
                    (still, np.full(count, 3.0)),
                ),
            )
        )


def test_the_gain_is_that_of_locked_windows_by_the_measure_of_the_others(monkeypatch):
    """
    In the windows that choose the samples about the means fall most, in the locked ones the means.
    """
    monkeypatch.setattr(window_gain, '_squares', Squares.of)
    found = window_gain.heldout_gain(Squares(means=0.5), [], [QUADRATIC], sensors=['accelerometer'])
    assert (found.measure, found.windows) == ('samples about the mean of their window', 10)
    assert found.heldout_rms_after**2 == pytest.approx(0.9)
    assert window_gain.gain_in_turn(
        Squares(means=0.5), [], [QUADRATIC], sensors=['accelerometer']
    ).heldout_rms_after ** 2 == pytest.approx(0.4)


@pytest.mark.parametrize(
    ('risen', 'measure'), ((0.25, 'window means'), (3.0, 'samples about the mean of their window'))
)
def test_a_large_fall_of_a_few_means_may_be_chance(monkeypatch, risen, measure):
    """
    The means fall in two of three windows, and rise in the third.

    Where they rise so far that a fall of all is not sure the samples are told, by a little.
    """
    monkeypatch.setattr(window_gain, '_squares', Squares.of)
    means = np.where(np.arange(30) % 3, 0.001, risen)
    assert (
        window_gain.gain_in_turn(
            Squares(0.99, means), [], [QUADRATIC], sensors=['accelerometer']
        ).measure
        == measure
    )


def test_rests_are_told_of_where_no_other_measure_falls_for_sure(monkeypatch):
    """Moving windows of a quiet sensor show the encoder."""
    monkeypatch.setattr(window_gain, '_squares', Squares.of)
    unsure = np.where(np.arange(30) % 3, 0.001, 3.0)
    for within, measure in (
        (1.0, gain.REST_MEASURE),
        (0.99, 'samples about the mean of their window'),
    ):
        some = Squares(within, unsure)
        some.all_samples = (*some.all_samples, 0.02 if within == 1.0 else 0.001)
        assert (
            window_gain.gain_in_turn(some, [], [QUADRATIC], sensors=['accelerometer']).measure
            == measure
        )


def test_a_recording_without_rests_says_nothing_of_them(monkeypatch):
    """All measures rise; that of no windows at all does not, and must not stand for a fall."""
    monkeypatch.setattr(
        window_gain,
        '_squares',
        lambda *args: Squares.of(*args) | {gain.REST_MEASURE: (np.zeros(0), np.zeros(0))},
    )
    found = window_gain.gain_in_turn(Squares(1.2, 1.2), [], [QUADRATIC], sensors=['accelerometer'])
    assert found.measure != gain.REST_MEASURE and found.ci95[0] < 0


def test_an_interval_of_95_percent_holds_95_percent():
    """Of the reductions that windows drawn anew give."""
    rng = np.random.default_rng(8)
    before, number = rng.chisquare(20, 60), np.full(60, 20.0)
    after = before * rng.uniform(0.3, 0.7, 60)
    low, high = gain.reduction_interval([(before, number), (after, number)])
    draw = rng.integers(0, 60, (4000, 60))
    reductions = 1 - np.sqrt(after[draw].sum(axis=1) / before[draw].sum(axis=1))
    assert 0.93 < np.mean((reductions > low) & (reductions < high)) < 0.97


@pytest.mark.parametrize(
    ('question', 'share', 'kept'),
    ((QUADRATIC, 0.6, False), (QUADRATIC, 0.75, True), (DRIFT, 0.85, False), (DRIFT, 0.95, True)),
)
def test_what_leaves_most_unexplained_is_not_named(question, share, kept):
    assert pruned([question], lambda chosen, each: share) == ([question] if kept else [])


def test_a_cause_of_the_table_shows_in_both_sensors():
    """
    It removes all there is from the accelerometer, but not from the gyroscope.

    On the gyroscope twice as much remains as it removes.
    """
    explained = Explained.__new__(Explained)
    explained.numbers, explained.least_part = (
        dict.fromkeys(SENSORS, np.array([100.0, 1000.0])),
        SHOWS,
    )
    explained.excess = lambda chosen: (
        {'accelerometer': alike(0.0, 0.0), 'gyroscope': alike(2000.0, 0.0)}
        if chosen
        else {'accelerometer': alike(1000.0, 0.0), 'gyroscope': alike(3000.0, 0.0)}
    )
    assert explained.share([OFFSET], OFFSET) == pytest.approx(1 / 3)


@pytest.mark.parametrize(('within', 'share'), ((20.0, 1.0), (0.6e3, 0.5)))
def test_what_is_unexplained_where_an_effect_does_not_show_does_not_hide_it(within, share):
    """
    It explains the means.

    Within windows, where it shows or does not, as much stays as it removes in all.
    """
    explained = Explained.__new__(Explained)
    explained.numbers, explained.least_part = (
        dict.fromkeys(SENSORS, np.array([100.0, 1000.0])),
        SHOWS,
    )
    explained.excess = lambda chosen: {
        'accelerometer': (
            alike(0.0, 1000.0 + within) if chosen else alike(1000.0, 1000.0 + 2 * within)
        )
    }
    assert explained.share([QUADRATIC], QUADRATIC) == pytest.approx(share)


@pytest.mark.parametrize(('least_part', 'share'), ((SHOWS, 1.0), (-np.inf, 0.5)))
def test_an_effect_is_compared_with_the_excess_of_the_parts_in_which_it_counts(least_part, share):
    """
    It removes the excess of turns.

    As much remains in poses, which by hand count too, because parts are few.
    """
    explained = Explained(
        SimpleNamespace(indices=len),
        lambda used: {'accelerometer': np.array([[1100.0], [100.0 if used else 1100.0]])},
        {'accelerometer': np.array([100.0, 100.0])},
        least_part=least_part,
    )
    assert explained.share([QUADRATIC], QUADRATIC) == pytest.approx(share)
    assert explained.remaining_excess([QUADRATIC]) == pytest.approx(1000.0)


def alike(means, within):
    """Return an excess of the means and within windows of which each axis has a third."""
    return np.outer([means, within], np.full(3, 1 / 3))


def test_what_one_axis_has_is_not_hidden_by_the_quiet_of_the_others():
    """
    All together are below five standard deviations, one alone is above six.

    Three that share the same are not.
    """
    explained = Explained.__new__(Explained)
    explained.numbers, explained.least_part = {'accelerometer': np.array([300.0, 3000.0])}, SHOWS
    alone = np.array([[-20.0, 100.0, -20.0], [0.0, 0.0, 0.0]])
    explained.excess = lambda excess: {'accelerometer': excess}
    assert (
        explained.sigma('accelerometer', alone)[0] > 5.0
        and explained.remaining_excess(alone) == 100.0
    )
    assert (
        explained.remaining_excess(alike(60.0, 0.0))
        == explained.remaining_excess(np.array([[0.0, 80.0, 0.0], [0.0, 0.0, 0.0]]))
        == 0.0
    )
    explained.excess = lambda chosen: {
        'accelerometer': alone if chosen else alone + np.array([[0.0, 300.0, 0.0], [0.0, 0.0, 0.0]])
    }
    assert explained.share([DRIFT], DRIFT) == pytest.approx(0.75), (
        'too little for an effect that is smooth in time'
    )


def test_every_bias_moves_by_half_the_white_noise_of_a_second():
    (process,) = natural_processes(NoiseModel(np.full(3, 0.04), np.ones(3)), 0.01)
    assert process.sd == pytest.approx(0.5 * np.sqrt(0.04 * 0.01)) and process.time == 100.0


def test_a_wander_that_was_found_passes_for_noise_as_far_as_biases_wander():
    """
    Natural is 0.01.

    The found one in its own time, up to three times as much, offsets of windows never.
    """
    for found, most in ((0.005, 0.01), (0.02, 0.02), (0.5, 0.03)):
        noise = NoiseModel(
            np.full(3, 0.04), np.ones(3), 0.2, (BiasProcess(max(found, 0.01), 15.0),)
        )
        (process,) = plausible_processes(noise, 0.01, sensor='gyroscope', duration=1e9)
        assert process.sd == pytest.approx(most) and process.time == 15.0
        assert noise.without_misfit(process).offset_sd == 0.0
    # Where most axes do so up to three times the middle one, and twelve times.
    for middle, most in (
        (0.008, 0.03),
        (0.02, 0.06),
        (0.2, 0.12),
    ):
        (process,) = plausible_processes(
            replace(noise, middle_wander=middle), 0.01, sensor='gyroscope', duration=1e9
        )
        assert process.sd == pytest.approx(most)
    measured = replace(noise, known=(BiasProcess(1e-4, 40.0),))
    assert plausible_processes(measured, 0.01, sensor='gyroscope', duration=1e9) == measured.known
    quiet = NoiseModel(np.full(3, 4e-8), np.ones(3), bias_processes=(BiasProcess(2e-4, 15.0),))
    assert plausible_processes(quiet, 0.01, sensor='accelerometer', duration=1e9)[0].sd == 2e-4


def test_a_quiet_instrument_drifts_less():
    """
    A column of rms 1 over the session.

    A hundred times a wander of 1e-6, or what the catalogue says.
    """
    columns = np.where(np.arange(20)[:, None, None] % 2, 1.0, -1.0) * np.ones((1, 3, 1))
    np.testing.assert_allclose(drift_prior(columns, np.full(1, 1e-2), 1e-6), 1e-4)
    np.testing.assert_allclose(drift_prior(columns, np.full(1, 1e-2), 1e-3), 1e-2)


def test_within_windows_nothing_is_told_of_what_is_smooth_in_time():
    """
    A scale factor shows within; a thermal bias does not, nor does what it takes off the residual.
    """
    model = SensorModel(accelerometer=('bias', 'matrix', 'accel_thermal_bias'))
    values = model.start()
    values[model.slices['accelerometer', 'accel_thermal_bias']] = 2.0
    recording = SimpleNamespace(
        sensors=SENSORS, model=model, values=values, bank={'accelerometer': (), 'gyroscope': ()}
    )
    space = parameter_space(recording, SensorModel(accelerometer=('bias', 'matrix')))
    used, mean, within = (
        some['accelerometer'][0] for some in (space.index, space.join, space.join_within)
    )
    thermal = np.array(['thermal' in space.names[k] for k in used])
    assert np.any(mean[:, :-1][:, thermal]) and not np.any(within[:, :-1][:, thermal])
    np.testing.assert_array_equal(within[:, :-1][:, ~thermal], mean[:, :-1][:, ~thermal])
    assert np.any(mean[:-3, -1]) and not np.any(within[:-3, -1])


@pytest.mark.parametrize('loud', ([1.0, 0.0, 0.0], [1.0, 0.0, 1.0], [1.0, 1.0, 1.0]))
def test_a_wander_is_as_large_as_on_the_middle_axis(loud):
    """
    A bias of ten times the noise of window means that moves with 15 s.

    It moves on one axis, on two, of which the third had no step yet, or on all.
    """
    rng, n, time = np.random.default_rng(3), 100, np.arange(100) * 5.0
    decay, drive = np.exp(-5.0 / 15.0), rng.normal(0.0, 10.0, (n, 3))
    wander = drive.copy()
    for k in range(1, n):
        wander[k] = decay * wander[k - 1] + np.sqrt(1 - decay**2) * drive[k]
    rows = np.stack([np.ones((n, 3)), wander * loud + rng.normal(0.0, 1.0, (n, 3))], axis=2)
    likelihood = NoiseLikelihood(Rows(equations=rows, variance=np.ones((n, 3)), time=time))
    search = BiasProcessSearch(likelihood, 1.0)
    shape = search.best([0])[0]
    assert shape[1] > 4.0
    assert search.of_middle_axis(shape, [0]) == pytest.approx(
        10.0 if sum(loud) > 1 else 0.0, abs=3.0
    )


def test_a_session_sees_a_part_of_a_slow_wander():
    """
    About the mean of a session of 100 s, a tenth of the correlation time.

    The variance of sums of the covariance, in steps of 0.1 s.
    """
    time = np.arange(0.05, 100.0, 0.1)
    covariance = 4.0 * np.exp(-np.abs(time[:, None] - time) / 1000.0)
    assert BiasProcess(2.0, 1000.0).within(100.0) == pytest.approx(
        np.sqrt(4.0 - covariance.mean()), rel=1e-3
    )
    assert BiasProcess(2.0, 15.0).within(1e9) == pytest.approx(2.0)
    noise = NoiseModel(np.full(3, 0.04), np.ones(3), bias_processes=(BiasProcess(0.08, 1000.0),))
    assert (
        plausible_processes(noise, 0.01, sensor='gyroscope', duration=100.0) == noise.bias_processes
    )


@pytest.mark.parametrize(('won', 'found'), ((5.0, False), (30.0, True)))
def test_offsets_of_windows_have_their_price(won, found):
    """
    Flicker scatters means beyond a wander of 15 s by a little.

    What moves with the pose does by more.
    """
    likelihood = SimpleNamespace(
        typical=1.0, many=True, loss=lambda shape, used: 100.0 - won * (shape[0] > 0)
    )
    assert (BiasProcessSearch(likelihood, 1.0).best([])[0][0] > 0) == found


def test_what_replaces_an_effect_is_significant_itself():
    """
    The product predicts held-out windows better than the quadratic, and nobody would have named it.
    """
    for p_value, kept in ((1e-12, PRODUCT), (0.5, QUADRATIC)):
        evidence = Known(lambda used: {frozenset(): 200.0, frozenset([0]): 100.0}.get(used, 40.0))
        evidence.p_value = lambda smaller, larger: p_value if 2 in larger else 1e-12
        assert Search(evidence, (), [QUADRATIC, PRODUCT]).reconsidered([QUADRATIC]) == [kept]


@pytest.mark.parametrize('behind, alike', [(30.0, ['gyro_thermal_bias']), (90.0, [])])
def test_curves_in_time_that_are_nearly_collinear_are_named_together(behind, alike):
    """
    Of 60,000 nats, 30 do not separate two curves that the wander of a bias may bend.

    They separate causes that depend on motion.
    """
    warm, drift, product = (
        asked('gyroscope', name, *at)
        for name, at in (
            ('gyro_thermal_bias', (0, 1, 2)),
            ('gyro_bias_drift', (3, 4, 5, 6)),
            ('gyro_rate_product', (7, 8, 9)),
        )
    )
    evidence = Known(
        lambda used: 0.0 if 3 in used else 2 * (behind + 1.0) if used & {0, 7} else 120000.0
    )
    search = Search(evidence, (), [warm, drift, product])
    assert [mate.name for mate, _ in search.confounded([drift], drift)] == alike


def test_what_was_resolved_is_not_replaced():
    """The drift outweighs the lag, which could not come back beside it."""
    lag, drift = asked('gyroscope', 'gyro_delay', 0), replace(DRIFT, parameters=(1,))
    losses = {
        frozenset(): 2000.0,
        frozenset([0]): 1600.0,
        frozenset([1]): 400.0,
        frozenset([0, 1]): 0.0,
    }
    assert Search(Known(losses.get), (), [lag, drift], resolved={lag.name}).run([lag]) == [
        lag,
        drift,
    ]


@pytest.mark.parametrize(('p_value', 'kept'), ((1e-12, [QUADRATIC]), (0.01, [])))
def test_what_a_search_starts_from_is_significant_by_itself_too(p_value, kept):
    """Of the best pair one is dropped, and nobody would have named the other alone."""
    evidence = Known(lambda used: {frozenset(): 200.0}.get(used, 100.0), p=p_value)
    assert Search(evidence, (), [QUADRATIC, CUBIC]).reconsidered([QUADRATIC]) == kept


def test_windows_agree_on_what_they_tell_of_an_effect():
    """The second of two parameters shows nowhere, as one arm of three that add up to nothing."""
    evidence, alone = (
        evidence_of(0.3 + 0.1 * np.random.default_rng(4).normal(0.0, 1.0, 40), 1.0)
        for _ in range(2)
    )
    space = evidence.space
    space.size = 2
    space.places = lambda sensor, axis: np.array([0, 2])
    evidence.fit = lambda used: (
        np.append(alone.fit([0])[0], 0.0),
        np.diag([alone.fit([0])[1][0, 0], 1e12]),
    )
    assert evidence.p_value_by_scatter([0, 1], [0, 1]) == pytest.approx(
        alone.p_value_by_scatter([0], [0])
    )


def evidence_of(rows, noise_within, scatter=None):
    """
    Return evidence of moving windows of 100 samples, whose parameter shows within alone.

    Products of one column with itself, the residual and both.
    """
    count = len(rows)
    recording = StubWindows(
        kind=np.array(['spin'] * count),
        count=np.full(count, 100.0),
        duration=np.ones(count),
        keys=(),
        time=np.arange(float(count)),
        session=np.zeros(count),
        moving=np.ones(count, bool),
    )
    products = np.array(
        [[[100.0, 100.0 * a], [100.0 * a, 100.0 * (a**2 + noise_within)]] for a in rows]
    )
    still = np.zeros((count, 2))
    space = SimpleNamespace(
        sensors=SENSORS,
        recording=recording,
        size=1,
        prior_sd=np.full(1, 1e6),
        prior_mean=np.zeros(1),
        places=lambda sensor, axis: np.array([0, 1]),
        mean={sensor: [still + [0.0, 0.5]] * 3 for sensor in ('accelerometer', 'gyroscope')},
        within_sum=lambda sensor, axis, at: products[at].sum(axis=0),
        slopes_within=lambda sensor, axis, weights: products @ weights,
    )
    noise = NoiseModel(np.full(3, noise_within), np.ones(3))
    return WindowEvidence(
        space, {'accelerometer': noise, 'gyroscope': noise}, np.arange(count) % 6, scatter=scatter
    )


@pytest.mark.parametrize(('scatter', 'sure'), ((0.1, True), (1.0, False)))
def test_windows_agree_on_a_finding(scatter, sure):
    """
    A column of which 40 windows say 0.3 on average, to 0.1 each if the noise within were white.

    They scatter by that, or by ten times as much.
    """
    slopes = np.random.default_rng(4).normal(0.0, 1.0, 40)
    evidence = evidence_of(0.3 + scatter * (slopes - slopes.mean()) / slopes.std(), 1.0)
    (value,), covariance = evidence.fit([0])
    assert value / np.sqrt(covariance[0, 0]) > 30.0
    assert (evidence.p_value_by_scatter([0], [0]) < 1e-6) == sure
    problem = LinearisedProblem.__new__(LinearisedProblem)
    problem.evidence = evidence
    problem.search = SimpleNamespace(indices=lambda chosen: (0,), questions=[QUADRATIC] * 30)
    assert problem.windows_agree([QUADRATIC], QUADRATIC) == sure


def test_a_window_that_scatters_more_within_has_a_less_certain_mean():
    evidence = evidence_of(np.zeros(12), 1.0)
    found = scatter_of_each(
        evidence.space,
        {
            sensor: NoiseModel(np.full(3, 0.25), np.ones(3))
            for sensor in ('accelerometer', 'gyroscope')
        },
        np.zeros(1),
    )
    np.testing.assert_allclose(found['gyroscope'], 4.0, rtol=0.02)
    means = evidence_of(np.zeros(12), 1.0, found).heldout_parts([0])['gyroscope'][0]
    assert means == pytest.approx(evidence.heldout_parts([0])['gyroscope'][0] / 4.0, rel=0.02)


def test_what_only_one_window_tells_is_not_held_against_it():
    """
    The level of a bias that hardly forgets is known from the first window alone.

    Held out, it is missed by what the others do not know.
    """
    rows = np.column_stack([[1.0, *[0.01] * 11], [50.0, *np.random.default_rng(0).normal(size=11)]])
    evidence, parts = (
        WindowEvidence.__new__(WindowEvidence),
        np.array([rows[k::6].T @ rows[k::6] for k in range(6)]),
    )
    Evidence.__init__(
        evidence,
        [],
        [],
        total=parts.sum(axis=0),
        without=parts.sum(axis=0) - parts,
        prior_sd=np.full(1, 1e3),
        prior_mean=np.zeros(1),
    )
    evidence.space = SimpleNamespace(size=1, places=lambda sensor, axis: np.array([0, 1]))
    evidence._of_axis, evidence._within_whole = (
        {'gyroscope': [np.stack([parts, 0 * parts])]},
        {'gyroscope': [0 * parts[None]]},
    )
    assert evidence.heldout([0]) > 500.0
    assert evidence.unpredicted([0])['gyroscope'][0, 0] < 30.0


def test_what_a_drift_does_within_windows_is_predicted_and_tells_nothing_of_it():
    """
    Means give 3, and within windows the slope differs.

    Within windows of 100 samples of unit noise the slope of the residual is 3 times that of the
    column too, or -7 times by a wander.
    """
    for slope, left in ((3.0, 0.0), (-7.0, 100.0)):
        count, each = (
            12,
            np.array([[100.0, 100.0 * slope], [100.0 * slope, 100.0 * (slope**2 + 1.0)]]),
        )
        recording = StubWindows(
            kind=np.array(['spin'] * count),
            count=np.full(count, 101.0),
            duration=np.ones(count),
            keys=(),
            time=np.arange(float(count)),
            moving=np.ones(count, bool),
            session=np.zeros(count),
            mean=lambda sensor: np.tile([1.0, 3.0], (12, 1)),
            product_sum=lambda sensor, part, rows: rows.sum() * each,
            factors_of=lambda sensor, part, rows: [
                (np.flatnonzero(rows), np.tile(np.linalg.cholesky(each).T, (rows.sum(), 1, 1)))
            ],
        )
        index, join, within = (
            {sensor: [some] * 3 for sensor in SENSORS}
            for some in (np.array([0]), np.eye(2), np.diag([0.0, 1.0]))
        )
        space = ParameterSpace(
            recording, ('drift',), np.full(1, 1e3), np.zeros(1), index, join, within
        )
        evidence = WindowEvidence(
            space, dict.fromkeys(SENSORS, NoiseModel(np.ones(3), np.ones(3))), np.arange(count) % 6
        )
        assert evidence.fit([0])[0] == pytest.approx(3.0, rel=1e-6)
        assert evidence.unpredicted([0])['gyroscope'][1].sum() == pytest.approx(
            3 * count * 100.0 * (1.0 + left), rel=1e-6
        )


def test_flicker_is_as_much_of_each_time():
    likelihood = NoiseLikelihood.__new__(NoiseLikelihood)
    likelihood._rows = SimpleNamespace(processes=())
    made = likelihood.processes(3.0, FLICKER_MARK)
    assert (
        len(made) > 3
        and len({process.sd for process in made}) == 1
        and sum(process.sd**2 for process in made) == pytest.approx(9.0)
    )
    assert likelihood.processes(3.0, 40.0) == (BiasProcess(3.0, 40.0),)
    likeliest = SimpleNamespace(
        typical=1.0, many=True, loss=lambda shape, used: 100.0 - 5.0 * (shape[2] == FLICKER_MARK)
    )
    assert BiasProcessSearch(likeliest, 1.0).best([])[0] == (0.0, 1.0, FLICKER_MARK)


def test_a_usual_wander_has_no_price():
    """Accelerometers may wander by so much whatever their white noise."""
    search = BiasProcessSearch(SimpleNamespace(typical=2.0), 1.0, 20.0)
    assert search.price(0.0, 10.0) == 0.0 and search.price(0.0, 20.0) == pytest.approx(
        (np.log(2.0) / 0.8) ** 2
    )


def test_a_turn_that_is_read_in_steps_leaves_more_in_the_mean_rate_than_the_sensor():
    """
    Steps of 1 mrad at both ends of 5 s beside 0.1 mrad/s of white noise at 100 Hz.

    At rest nothing turns.
    """
    rng = np.random.default_rng(9)
    turned = rng.uniform(0.0, 1.0, (20000, 2))
    read = np.round(turned / 1e-3) * 1e-3
    scatter = np.var(np.diff(read - turned, axis=1) / 5.0) + 1e-8 / 500
    noise = NoiseModel(
        np.full(3, 1e-8), np.ones(3), reference=ReferenceNoise.of_steps(1e-3, 'gyroscope')
    )
    moving, still = noise.mean_variance(['spin', 'static'], np.full(2, 500.0), np.full(2, 5.0))
    np.testing.assert_allclose(moving, scatter, rtol=0.05)
    np.testing.assert_allclose(still, 1e-8 / 500)


def test_a_wander_far_beyond_the_natural_one_has_its_price():
    """
    Two units of likelihood less for eight times the natural size are a drift.

    It is a drift together with a natural wander, not a wander.
    """
    likelihood = SimpleNamespace(
        typical=1.0,
        many=True,
        loss=lambda shape, used: 100.0 - 2.0 * (shape[1] == 8.0 and shape[2] == 100.0),
    )
    assert BiasProcessSearch(likelihood, 1.0).best([]) == ((0.0, 1.0, 100.0), 100.0)
    assert BiasProcessSearch(likelihood, 4.0).best([])[0] == (0.0, 8.0, 100.0)


def test_what_is_smooth_in_time_has_to_beat_the_wander_of_the_bias():
    """
    Three parameters whose priors are ten wide win three units of likelihood by chance.

    14 are what the priors cost, 10 are very strong evidence.
    """
    for won, needed in ((3.0, []), (22.0, []), (26.0, [7, 8, 9])):
        search = SimpleNamespace(best=lambda used, won=won: (None, 100.0 - won * (len(used) > 0)))
        assert _needed_smooth(search, [[7, 8, 9]], prior_sd=np.full(10, 10.0)) == needed


@pytest.mark.parametrize(('apart', 'agree'), ((2.0, True), (6.0, False)))
def test_halves_agree_within_chance(apart, agree):
    """
    An effect of two standard deviations of the whole, halves that differ by so many of theirs.
    """
    halves = [
        np.array([[1.0, value], [value, value**2]])
        for value in (apart / np.sqrt(2), -apart / np.sqrt(2))
    ]
    evidence = WindowEvidence.__new__(WindowEvidence)
    Evidence.__init__(
        evidence,
        [],
        [],
        total=np.zeros((2, 2)),
        without=np.array(halves),
        prior_sd=np.full(1, 1e6),
        prior_mean=np.zeros(1),
    )
    evidence._halves = halves
    evidence.fit = lambda used: (np.array([2.0]), np.eye(1) / 2)
    search = Search(evidence, (), [QUADRATIC])
    assert search.agrees_in_halves([QUADRATIC], QUADRATIC) == agree


def judging_tests(
    monkeypatch,
    paid=None,
    agree=lambda question: True,
    windows_agree=lambda named, question: True,
    drop_insignificant=list,
):
    """Return tests of which the residual in the sensor's unit and the halves say this."""
    monkeypatch.setattr(
        investigation, '_sure_reduction', lambda problem, kept, each: (paid or {}).get(each, 0.5)
    )
    monkeypatch.setattr(investigation, '_needed_reduction', lambda *given: 0.0)
    monkeypatch.setattr(investigation.WindowTests, 'explaining', lambda tests, chosen: chosen)
    problem = SimpleNamespace(
        search=SimpleNamespace(
            allowed=lambda named, question: True,
            drop_insignificant=drop_insignificant,
            agrees_in_halves=lambda named, question: agree(question),
        ),
        windows_agree=windows_agree,
    )
    return investigation.WindowTests(problem)


def test_a_finding_lowers_the_residual_in_the_sensors_own_unit(monkeypatch):
    tests = judging_tests(monkeypatch, {CUBIC: -0.01})
    assert tests.predicting([QUADRATIC, CUBIC]) == [QUADRATIC]


def test_what_the_windows_disagree_on_is_not_named(monkeypatch):
    tests = judging_tests(monkeypatch, windows_agree=lambda named, question: question is not CUBIC)
    assert tests.predicting([QUADRATIC, CUBIC]) == [QUADRATIC]


def test_what_the_halves_disagree_on_is_denied(monkeypatch):
    tests = judging_tests(monkeypatch, agree=lambda question: question is not CUBIC)
    found = select_findings(tests, [QUADRATIC, CUBIC])
    assert (found.named, found.unstable) == ([QUADRATIC], [CUBIC])


def test_what_is_nothing_without_what_was_taken_out_is_not_named(monkeypatch):
    """
    A clock that is early and a lag that makes up for it.

    Each is significant beside the other alone.
    """
    losses = {
        frozenset(): 100.0,
        frozenset([0]): 99.0,
        frozenset([1]): 99.0,
        frozenset([0, 1]): 0.0,
    }
    drop_insignificant = Search(Known(losses.get), (), [QUADRATIC, CUBIC]).drop_insignificant
    for agree, named in (
        (lambda question: True, [QUADRATIC, CUBIC]),
        (lambda question: question is not CUBIC, []),
    ):
        tests = judging_tests(monkeypatch, agree=agree, drop_insignificant=drop_insignificant)
        assert select_findings(tests, [QUADRATIC, CUBIC]).named == named


@pytest.mark.parametrize(
    ('value', 'fall', 'asked_about'),
    ((-1e-4, 100.0, True), (1e-4, 100.0, False), (-1e-4, 2.0, False)),
)
def test_a_lag_that_would_be_negative_is_no_finding_and_asks_for_an_explanation(
    value, fall, asked_about
):
    lag = asked('accelerometer', 'accel_delay', 0)
    search = Search(Known(lambda used: -fall * (0 in used), values=[value]), (), [lag])
    assert search.early([]) == ([lag] if asked_about else []) and search.run() == (
        [lag] if value > 0 else []
    )


def rest_of(sigma, residual):
    """
    Return the Unexplained of a residual whose windows exceed noise by so many standard deviations.
    """
    count = len(residual)
    recording = StubWindows(
        kind=np.array(['static'] * count),
        moving=np.zeros(count, bool),
        count=np.full(count, 100.0),
        duration=np.ones(count),
        keys=(),
        time=np.arange(float(count)),
        describe={
            'time': np.arange(float(count)),
            'temperature': np.full(count, np.nan),
            'rate': np.zeros(count),
            'specific force': np.full(count, 9.8),
        },
    )
    space = SimpleNamespace(
        sensors=SENSORS,
        mean={'accelerometer': [column[:, None] for column in residual.T]},
        recording=recording,
        places=lambda sensor, axis: np.array([0]),
    )
    explained = ExplainedWindows.__new__(ExplainedWindows)
    explained.floor = SimpleNamespace(
        noise={'accelerometer': NoiseModel(np.full(3, 100.0), np.ones(3))}
    )
    explained.numbers = {'accelerometer': np.array([3.0 * count, 0.0])}
    return rests._unexplained(
        SimpleNamespace(space=space, recording=recording, explained=explained),
        'accelerometer',
        alike(sigma * np.sqrt(6.0 * count), 0.0),
        np.ones(1),
    )


def test_a_rest_of_some_standard_deviations_is_unexplained():
    residual = 2 * np.random.default_rng(5).normal(size=(40, 3))
    assert rest_of(10.0, residual).significant
    assert not rest_of(4.0, residual).significant


def test_noise_goes_with_nothing():
    """Twenty curves, none of which the residual follows."""
    rng = np.random.default_rng(6)
    curves = [(f'curve {k}', rng.normal(size=(60, 2)), np.ones(60, bool)) for k in range(20)]
    noise, noise_sd = rng.normal(size=(60, 3)), np.ones((60, 3))
    assert rests.correlate(iter(curves), noise, noise_sd) == (None, 0.0)
    noise = rng.normal(size=(60, 3))
    followed = noise + 1.5 * curves[3][1][:, :1]
    assert rests.correlate(iter(curves), followed, noise_sd)[0] == 'curve 3'


@pytest.mark.parametrize('lag', [0, 45, 90])
def test_a_bias_that_follows_the_temperature_late_is_named(lag):
    """The thermometer warms up, cools and warms up; the sensor follows it later."""
    rng = np.random.default_rng(7462)
    time = np.sort(rng.uniform(0, 900, 200))

    def temperature(t):
        return 25 + 6 * (1 - np.exp(-t / 200)) + 2 * np.sin(t / 70)

    late = np.outer(temperature(time - lag) - 25, [1.0, -0.5, 0.2])
    measured = temperature(time) + rng.normal(0, 0.02, len(time))
    residual = late + rng.normal(0, 0.3, late.shape)
    noise_sd = np.ones(residual.shape)
    name, share = rests.correlate(rests.slow_explanations(time, measured), residual, noise_sd)
    assert name == (f'the temperature {lag} s earlier' if lag else 'temperature') and share > 0.8
    # With the temperature itself in the model, its rate is left.
    beside = residual - np.outer(measured - 25, [1.0, -0.5, 0.2])
    name, share = rests.correlate(rests.slow_explanations(time, measured), beside, noise_sd)
    assert {0: None, 45: 'temperature rate'}.get(lag, name) == name


def test_a_temperature_behind_a_thermal_mass_is_named_with_its_lag():
    rng = np.random.default_rng(9211)
    time = np.sort(rng.uniform(0, 900, 200))
    fine = np.arange(0.0, 900.0, 0.1)
    warm = 25 + 4 * (1 - np.exp(-fine / 90)) + 2 * np.sin(2 * np.pi * fine / 110)
    mass = warm.copy()
    for k in range(1, len(fine)):
        mass[k] = mass[k - 1] + 0.1 / 45.0 * (warm[k - 1] - mass[k - 1])
    residual = np.outer(np.interp(time, fine, mass) - 25, [1.0, -0.5, 0.2])
    residual += rng.normal(0, 0.1, residual.shape)
    measured = np.interp(time, fine, warm) + rng.normal(0, 0.02, len(time))
    noise_sd = np.ones(residual.shape)
    name, share = rests.correlate(rests.slow_explanations(time, measured), residual, noise_sd)
    assert name == 'the temperature with a lag of 45 s' and share > 0.9


def test_the_lag_of_a_temperature_is_named_where_the_fit_has_absorbed_a_part_of_it():
    """
    Six minutes with one warm-up: a curve in time follows it nearly as well.

    Windows differ in length, and a matrix takes the part that the attitudes resemble.
    """
    rng = np.random.default_rng(10052)
    time = np.sort(rng.uniform(0, 360, 72))
    fine = np.arange(0.0, 360.0, 0.1)
    warm = 8 * (1 - np.exp(-fine / 144)) + 0.5 * np.sin(2 * np.pi * fine / 252)
    mass = warm.copy()
    for k in range(1, len(fine)):
        mass[k] = mass[k - 1] + 0.1 / 45.0 * (warm[k - 1] - mass[k - 1])
    noise_sd = np.repeat(rng.uniform(0.5, 2.0, (72, 1)), 3, axis=1)
    output = rng.normal(0.0, noise_sd)
    output[:, 0] += 25 * np.interp(time, fine, mass)
    fitted = np.column_stack([np.ones(72), rng.normal(size=(72, 3))])
    weighed = fitted / noise_sd[:, :1]
    residual = output - fitted @ np.linalg.lstsq(weighed, output / noise_sd, rcond=None)[0]
    measured = np.interp(time, fine, warm) + rng.normal(0, 0.002, 72)
    slow = rests.slow_explanations(time, measured)
    name, share = rests.correlate(slow, residual, noise_sd, fitted=[fitted] * 3)
    assert name == 'the temperature with a lag of 45 s' and share > 0.99


@pytest.mark.parametrize(('first', 'passed'), [((20.0, 24.0), 25.0), ((20.0, 27.0), None)])
def test_a_temperature_that_is_passed_once_is_that_of_the_moment(first, passed):
    warmth = np.array([*first, 26.0, 29.0])
    for sign in (1.0, -1.0):
        found = _passed_once(sign * warmth, 1)
        assert found == (None if passed is None else sign * passed)
