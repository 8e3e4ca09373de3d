"""
One mind for two verbs.

What a recording demands, on a table or by hand, is in the model of `calibrate`, as `diagnose` finds
it, and nothing else.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from types import SimpleNamespace

import numpy as np
import pytest
from test_diagnosis_workflow_by_hand import HIDDEN, NOTHING
from test_live_by_hand import assert_same, make_live, run

import imu_calibration as imu
from imu_calibration.calibration import by_evidence
from imu_calibration.calibration.by_evidence import _moves, _solved_with, stands_out
from imu_calibration.calibration.diagnosis.diagnose import diagnose_recording
from imu_calibration.calibration.from_solution import ModelExtension
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.samples import SampleBlock
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.effects.forward_equations import predict
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.table import Table
from imu_calibration.references.gravity.hand_calibration import gather_by_hand, solve_by_hand
from imu_calibration.references.gravity.hand_parameters import HandOptions
from imu_calibration.references.turntable.diagnosis_of_windows import build_diagnosis
from imu_calibration.references.turntable.requested_model import choose_model
from imu_calibration.references.turntable.residuals.residual_analysis import ResidualAnalysis
from imu_calibration.references.turntable.selection import investigation, testable_effects
from imu_calibration.references.turntable.selection.extended_model import without_saturation
from imu_calibration.references.turntable.selection.extended_solution import extended_solution
from imu_calibration.references.turntable.selection.investigation import investigate
from imu_calibration.references.turntable.selection.linearised_problem import SearchedWindows
from imu_calibration.references.turntable.selection.rivals import (
    Rival,
    same_questions,
    settle_rivals,
)
from imu_calibration.references.turntable.session_data import DecimatedWindows
from imu_calibration.references.turntable.table_reference import TableReference
from imu_calibration.references.turntable.window_search import baseline_model
from imu_calibration.report.diagnosis_page import diagnosis_report
from imu_calibration.selection.selected_effects import SelectionSettings
from imu_calibration.selection.unexplained import Unexplained, biases_off

from worlds.candidates import FEW, with_candidates
from worlds.hand_sessions import GRAVITY, PARAM_NAMES, simulate
from worlds.misfit_coverage import COARSE, calibrated, clean
from worlds.misfit_worlds import make_pair
from worlds.moments import Wander
from worlds.physics import TABLES, make_session
from worlds.physics_beyond import Beyond
from worlds.physics_hand import hold_and_turn, warmed_up
from worlds.searched_by_hand import searched

TABLE = Table.from_mapping(TABLES['three_axis'])
NAMES = tuple(TABLE.joint_names)
OFFSET = 'reference.time_offset.offset'
SHAFT = {'table': 'shaft', 'profile': 'sweeps'}
QUADRATIC = 'gyro_quadratic'
BENDS = f'{QUADRATIC}+gyro_scale_asymmetry+gyro_g_sensitivity'
"""Candidates by hand: the bend that is hidden, one that resembles it, and another one."""
LAGS = 'time_offset+gyro_bandwidth+gyro_quadratic'
SMOOTH = 'accel_bias_drift+accel_quadratic'
ROWS = slice(12, 21)


@dataclass(frozen=True, eq=False)
class Case:
    """A recording that demands an effect, and its calibration."""

    block: SampleBlock
    choices: dict
    """Stand or gravity, and candidates."""
    added: str
    """The effect."""
    said: str
    """What the line about it has."""
    truth: object
    """True values."""
    rtol: float
    """Largest relative difference of the values of `diagnose`, ..."""
    atol: float
    """... and largest absolute one."""

    @cached_property
    def asked(self):
        return imu.calibrate(self.block, **self.choices)

    @cached_property
    def plain(self):
        return imu.calibrate(self.block, **self.choices, model_as_asked=True).calibration


@pytest.fixture(scope='module')
def late():
    """A session on a shaft whose driver stamps 12 ms late, and the table."""
    pair = make_pair('driver_lag', 31, **SHAFT)
    return pair.first, Table.from_mapping(pair.table)


@pytest.fixture(scope='module')
def windows(late):
    return calibrated(late[0]).windows


@pytest.fixture(scope='module')
def lag(late):
    session, table = late
    truth = session.truth['gyroscope'].matrix[0, 0]
    choices = {'table': table, 'candidates': LAGS}
    return Case(session.block, choices, 'time_offset', 'time_offset (1', truth, 0.0, 0.0)


@pytest.fixture(scope='module')
def bent():
    """A session by hand with gyroscopes whose output bends with the rate."""
    samples, _, truth = simulate(31, n_poses=14, spoil=HIDDEN[QUADRATIC])
    # Rounding of BLAS differs with the alignment of arrays, by 1e-14.
    choices = {'gravity': GRAVITY, 'candidates': BENDS}
    return Case(SampleBlock(samples), choices, QUADRATIC, f'{QUADRATIC} (', truth, 1e-10, 1e-13)


@pytest.fixture(params=['lag', 'bent'])
def case(request):
    """Return the case of each reference."""
    return request.getfixturevalue(request.param)


def test_what_is_demanded_is_taken_into_the_model_and_said_in_one_line(case):
    assert case.asked.calibration.statistics['added'] == [case.added]
    assert len([line for line in case.asked.verdict.lines() if case.said in line]) == 1


def test_a_lag_is_estimated_and_its_error_of_the_scale_removed(lag):
    found, plain = lag.asked.calibration, lag.plain
    assert 'added' not in plain.statistics and OFFSET not in plain.param_names
    place = found.param_names.index('gyroscope.matrix.xx')
    assert float(found.value('reference', 'time_offset')) == pytest.approx(0.012, abs=1e-3)
    error = abs(found.values[place] - lag.truth)
    assert error < 4 * found.sd[place] and error < 2e-3
    assert abs(plain.values[plain.param_names.index('gyroscope.matrix.xx')] - lag.truth) > 3e-3


def test_a_bend_of_the_rate_leaves_no_error_in_the_matrix(bent):
    found, plain = bent.asked.calibration, bent.plain
    for name, true in zip(PARAM_NAMES[ROWS], bent.truth[ROWS]):
        place = found.param_names.index(name)
        assert abs(found.values[place] - true) < 4.5 * found.sd[place]
    assert 'added' not in plain.statistics
    assert not any(QUADRATIC in name for name in plain.param_names)


def test_diagnose_hands_over_what_calibrate_does(case):
    found, asked = imu.diagnose(case.block, **case.choices), case.asked.calibration
    assert found.calibration.param_names == asked.param_names
    close = {'rtol': case.rtol, 'atol': case.atol}
    np.testing.assert_allclose(found.calibration.values, asked.values, **close)
    np.testing.assert_allclose(found.calibration.sd, asked.sd, **close)
    name, (value, sd, _) = next(iter(found.findings[0].parameters.items()))
    place = asked.param_names.index(name)
    assert case.added in name
    np.testing.assert_allclose((value, sd), (asked.values[place], asked.sd[place]), **close)


def test_a_clean_session_adds_nothing():
    pair = make_pair(None, 12, profile='six_faces', **COARSE)
    found = imu.calibrate(pair.first.block, Table.from_mapping(pair.table), candidates=FEW)
    assert not set(found.calibration.statistics) & {'added', 'denied', 'unexplained'}


def test_the_search_begins_with_the_effects_that_it_may_not_test():
    """Their part of the residual would be unexplained, and the exit code 3, without a cause."""
    for names, begins_with_it in (('none', True), ('accel_size_effect', False), (None, False)):
        options = CalibrationOptions(catalogue=CATALOGUE.with_candidates(names))
        solved = choose_model(options, TABLE)
        baseline = baseline_model(options, TABLE, solved)
        assert ('accel_size_effect' in baseline.accelerometer) is begins_with_it
        assert 'accel_size_effect' in solved.accelerometer


def test_an_effect_of_one_half_is_not_adopted_and_widens_the_standard_deviations():
    """
    A g-sensitivity that comes in the middle of the session.

    The halves disagree, the model stays, its parameters are less certain.
    """
    windows, rng = clean(11).windows, np.random.default_rng(5)
    model = SensorModel(gyroscope=('bias', 'matrix', 'gyro_g_sensitivity'), joint_names=NAMES)

    def measured(share):
        made = []
        for k, window in enumerate(windows):
            values = model.start()
            values[model.slices['gyroscope', 'gyro_g_sensitivity']] = (
                1e-3 if k >= share * len(windows) else 0.0
            )
            outputs = [
                out + rng.normal(0, sd, (len(window.time), 3))
                for out, sd in zip(
                    predict(model, values, TABLE, motion=window.motion), (2e-2, 2e-3)
                )
            ]
            made.append(replace(window, force_s=outputs[0], rate_s=outputs[1]))
        return made

    bare = SensorModel(accelerometer=('bias', 'matrix'), joint_names=NAMES)
    bare = with_candidates(bare, 'gyro_g_sensitivity+gyro_bias_drift')
    whole, half = (
        ResidualAnalysis.of(investigate(measured(share), TABLE, bare)) for share in (0.0, 0.5)
    )
    assert [question.name for question in whole.named] == [
        'gyro_g_sensitivity'
    ] and not whole.unstable
    assert not half.named
    question = next(
        question for question in half.problem.questions if question.name == 'gyro_g_sensitivity'
    )
    assert (
        not half.problem.search.agrees_in_halves([question], question)
        and half.problem.search.score([], question).significant
    )
    added = _disagreement(replace(half, unstable=[question]), bare.param_names)
    assert (
        np.all(np.linalg.eigvalsh(added) > -1e-18)
        and np.sqrt(np.diag(added)[bare.slices['gyroscope', 'bias']]).max() > 1e-4
    )
    assert not _disagreement(whole, bare.param_names).any()


def test_windows_for_the_search_are_spread_and_bounded():
    """
    Of a long session every so many-th window of each kind is kept, moving ones and rests alike.

    Of a short one all.
    """
    windows = clean(11).windows
    every = DecimatedWindows()
    for window in windows:
        every.add(window)
    assert [w.time[0] for w in every.windows] == [w.time[0] for w in windows]
    some = DecimatedWindows(4000)
    for window in windows:
        some.add(window)
    assert some.n_samples == sum(len(w.time) for w in some.windows) <= 4000
    assert {w.kind for w in some.windows} == {w.kind for w in windows}
    assert some.windows[-1].time[0] > 0.7 * windows[-1].time[0]


def test_a_delay_and_a_lag_are_judged_where_each_is_as_large_as_it_is(late, windows):
    """
    Whichever a search met first, the delay that the world holds wins.

    The lag that a fit uses in its place is as large.
    """
    table = late[1]
    model = SensorModel(accelerometer=('bias', 'matrix'), joint_names=tuple(table.joint_names))
    model = with_candidates(model, LAGS)
    used = [window for window in windows if window.kind != 'unused']
    effects = without_saturation(testable_effects.testable_effects(model, table, used)[0])
    searched = SearchedWindows(used, table, model, effects, np.zeros(len(used), bool))
    first = searched.linearised()
    by_name = {question.name: question for question in first.questions}
    for start in ('time_offset', 'gyro_bandwidth'):
        settled, near = settle_rivals(first, [by_name[start]], searched)
        assert settled.search.run()[0].name == 'time_offset' and not near
    lag = searched.linearised(point=first.point([by_name['gyro_bandwidth']]))
    assert (
        lag.values(same_questions(lag, [by_name['gyro_bandwidth']]))[
            lag.space.names.index('gyroscope.gyro_bandwidth.time_constant')
        ]
        > 0.01
    )
    assert settle_rivals(first, [by_name['gyro_quadratic']], searched) == (first, [])


def _disagreement(found, names):
    """What an investigation adds to the covariance."""
    return ModelExtension(moves=_moves(found)).disagreement(names)


def investigated(late, windows):
    """Return what the search finds in the session beyond biases and matrices."""
    model = SensorModel(accelerometer=('bias', 'matrix'), joint_names=tuple(late[1].joint_names))
    model = with_candidates(model, LAGS)
    return ResidualAnalysis.of(investigate(windows, late[1], model))


@pytest.fixture(scope='module')
def examined(late, windows):
    return investigated(late, windows)


def test_a_rival_widens_by_its_weight_and_is_named_beside_the_finding(late, examined):
    found = examined
    names = found.problem.baseline.param_names
    question = found.named[0]
    rivals = [Rival(question, question, behind, {names[0]: 0.3}) for behind in (0.0, 800.0)]
    added = [
        _disagreement(replace(found, unstable=[], rejected=[], rivals=[rival]), names)[0, 0]
        for rival in rivals
    ]
    assert added[0] == pytest.approx(0.5 * 0.3**2) and added[1] < 1e-200
    beside = replace(found, rivals=[replace(rivals[0], other=found.problem.questions[0])])
    mates = build_diagnosis(beside).findings[0].indistinguishable_from
    assert mates[0] == found.problem.questions[0].name


def test_what_likelihood_asks_for_and_nobody_is_sure_of_is_not_named_but_widens(
    late, windows, monkeypatch
):
    monkeypatch.setattr(investigation.WindowTests, 'predicting', lambda *_: [])
    found = investigated(late, windows)
    assert not found.named and 'time_offset' in [question.name for question in found.rejected]
    names = found.problem.baseline.param_names
    added = _disagreement(found, names)
    assert (
        np.sqrt(added[names.index('gyroscope.matrix.xx'), names.index('gyroscope.matrix.xx')])
        > 3e-3
    )
    assert not _disagreement(replace(found, rejected=[]), names)[
        names.index('gyroscope.matrix.xx')
    ].any()


def test_a_finding_of_the_model_as_asked_must_stand_out_too(examined, monkeypatch):
    found = examined
    solution = extended_solution(found.problem, found.named)
    assert by_evidence._without_insignificant(found, solution, solution.model) is found
    monkeypatch.setattr(
        by_evidence, 'stands_out', lambda _, question, **settings: question is not found.named[0]
    )
    less = by_evidence._without_insignificant(found, solution, solution.model)
    assert found.named[0] not in less.named and list(less.unstable) == [
        *found.unstable,
        found.named[0],
    ]
    # By hand a requested effect remains.
    monkeypatch.setattr(type(found), 'settings', SelectionSettings(judge_requested=False))
    assert by_evidence._without_insignificant(found, solution, solution.model) is found


def test_an_effect_that_is_no_more_than_chance_with_honest_standard_deviations_is_left_out(
    late, lag, examined, monkeypatch
):
    found = examined
    solution = extended_solution(found.problem, found.named)
    question = found.named[0]
    assert stands_out(solution, question) and not stands_out(
        replace(solution, terms={'noise': 1e9 * solution.covariance}), question
    )
    part = solution.model.slices[question.sensor, question.name]
    doubled = SimpleNamespace(
        model=SimpleNamespace(slices={(question.sensor, question.name): slice(0, 2)}),
        held=np.zeros(2, bool),
        values=np.full(2, solution.values[part.start]),
        covariance=np.full((2, 2), 1e-12),
    )
    pair = SimpleNamespace(
        sensor=question.sensor,
        name=question.name,
        effect=replace(question.effect, components=('x', 'y')),
    )
    monkeypatch.setattr(by_evidence, 'make_prior', lambda model: SimpleNamespace(mean=np.zeros(2)))
    assert stands_out(doubled, pair)  # a convention makes covariances of whole effects singular

    def of(distances, correlation, sd=1e-6):
        shape = np.full((2, 2), correlation) + (1 - correlation) * np.eye(2)
        return SimpleNamespace(
            model=doubled.model,
            held=doubled.held,
            values=sd * np.array(distances),
            covariance=sd**2 * shape,
        )

    assert stands_out(of([6.0, 1.0], 0.0), pair)
    # One coefficient is significant, but not both together (chi2 12 with 2 degrees of freedom).
    alone = of([3.5, 0.0], 0.0)
    assert not stands_out(alone, pair) and stands_out(alone, pair, joint_test=False)
    # Significant together (chi2 125), but no coefficient is.
    assert not stands_out(of([2.5, -2.5], 0.9), pair)
    # A size of no instrument.
    assert not stands_out(of([6.0, 1.0], 0.0, sd=10 * question.effect.largest), pair)
    monkeypatch.undo()
    asked = lag.asked.calibration  # with the rule that is replaced below
    monkeypatch.setattr(by_evidence, 'stands_out', lambda *_, **settings: False)
    faint = imu.calibrate(late[0].block, late[1], candidates=LAGS).calibration
    rms = {sensor: rest['rms'] for sensor, rest in faint.statistics['unexplained'].items()}
    assert set(rms) == {'accelerometer', 'gyroscope'}
    assert 0.2 < rms['accelerometer'] < 0.35 and 2e-3 < rms['gyroscope'] < 4e-3
    assert (
        faint.statistics['denied'] == ['time_offset']
        and 'added' not in faint.statistics
        and OFFSET not in faint.param_names
    )
    place, was = (
        calibration.param_names.index('gyroscope.matrix.xx') for calibration in (faint, asked)
    )
    assert faint.sd[place] > 5 * asked.sd[was]


def test_calibrate_does_not_adopt_what_diagnose_withdraws(monkeypatch):
    """
    Three quarters of a response to the cube of a force look like one to the force.

    With a formula for the cube that name is in no model.
    """
    # Another guard, which sees to it here too.
    monkeypatch.setattr(by_evidence, 'stands_out', lambda *_, **settings: True)
    session = make_session(
        141,
        None,
        'realistic',
        profile='quick',
        cause=Beyond('force_cubed_in_gyro', 141),
        **COARSE,
    )
    found = imu.calibrate(
        session.block, Table.from_mapping(session.table), candidates='gyro_g_sensitivity'
    ).calibration
    assert not {'added', 'denied'} & set(found.statistics)
    bias = [found.param_names.index(f'gyroscope.bias.{axis}') for axis in 'xyz']
    assert np.all(np.abs(found.values[bias] - session.truth['gyroscope'].bias) < 4 * found.sd[bias])


@pytest.mark.long
def test_a_bias_is_not_known_better_than_windows_agree_on_it():
    """
    An offset after the outer joint turned forwards.

    Poses of each sense agree so well that their mean passed for sure, ten sd from the truth.
    """
    cause = Beyond('backlash', 2)
    session = make_session(2, None, 'realistic', profile='random_short', cause=cause, **COARSE)
    calibration = imu.calibrate(
        session.block, Table.from_mapping(session.table), candidates='none'
    ).calibration
    (axis,) = cause.axes
    places = {name: calibration.param_names.index(f'accelerometer.bias.{name}') for name in 'xyz'}
    errors = {
        name: abs(
            calibration.values[place] - session.truth['accelerometer'].bias['xyz'.index(name)]
        )
        for name, place in places.items()
    }
    assert errors[axis] < 2.5 * calibration.sd[places[axis]] and errors[axis] > 0.01
    assert all(
        calibration.sd[places[axis]] > 3 * calibration.sd[places[name]]
        for name in places
        if name != axis
    ), 'the others are as good as ever'


def test_what_a_rest_may_move_biases_by():
    """
    Of the axes that carry it, by the scatter of the means beyond noise.

    Of a rest that is none, nothing.
    """
    model, noise = SensorModel(), np.full((400, 3), 3.0)
    residual = np.outer(np.where(np.arange(400) % 2, 5.0, -5.0), [1.0, 1.0, 0.1])
    rest = Unexplained(True, 4.0, 9.0, None, 0.0, residual, noise, axes=('y',))
    assert biases_off(
        model, {'gyroscope': rest, 'accelerometer': replace(rest, significant=False)}
    ) == [{'gyroscope.bias.y': pytest.approx(4.0)}]
    assert biases_off(model, {'gyroscope': replace(rest, axes=('z',))}) == [
        {'gyroscope.bias.z': 0.0}
    ]


def diagnosed(session):
    return diagnose_recording(
        [session.block],
        TableReference(Table.from_mapping(session.table)),
        CalibrationOptions(catalogue=CATALOGUE.with_candidates(SMOOTH)),
    )


@pytest.mark.long
def test_a_bias_that_steps_on_every_axis_is_found_with_its_size():
    """A wander of all axes alike would follow the step, which passed for noise."""
    session = make_session(8, {'knock_step': 0.05}, 'realistic', profile='quick', **COARSE)
    result = diagnosed(session)
    onset = result.diagnosis.onset
    assert onset.what == 'bias of accelerometer' and not result.diagnosis.findings
    assert abs(onset.time - session.truth['knock']) < 0.04  # two samples
    for place, (name, before) in enumerate(onset.before.items()):
        step = 0.05 * session.truth['direction'][place]
        assert abs(onset.after[name] - before - step) < 4 * onset.sd[name]


@pytest.mark.long
def test_a_wander_of_every_axis_passes_for_noise_and_is_told():
    session = make_session(
        7, None, 'realistic', cause=Wander(sd=(0.02, 0.0)), profile='six_faces', **COARSE
    )
    result = diagnosed(session)
    assert (
        not result.diagnosis.findings
        and result.diagnosis.onset is None
        and not result.diagnosis.unexplained['accelerometer'].significant
    )
    (note,) = result.notes  # scatter of the means
    assert (
        'accelerometer' in note
        and f'note: {note}' in result.lines
        and note[1:] in diagnosis_report(result)
    )
    assert result.document['notes'] == [note]
    plain = make_session(7, None, 'realistic', profile='six_faces', **COARSE)
    assert not diagnosed(plain).notes


@dataclass(frozen=True)
class Stated:
    """Options with which a model was solved, in place of its solution."""

    options: CalibrationOptions
    extension: ModelExtension | None = None


@pytest.mark.parametrize(
    ('model', 'added'),
    [
        (SensorModel(), ['accel_thermal_bias_2', 'accel_thermal_bias']),
        (
            SensorModel().with_effect('accelerometer', 'accel_thermal_bias'),
            ['accel_thermal_bias_2'],
        ),
    ],
)
def test_a_bend_with_the_temperature_is_estimated_with_its_slope(model, added):
    """
    The vertex at the rounded first temperature is a convention.

    With the vertex 2 K away the coefficient of the square alone was wrong by 10 sd.
    """
    question = SimpleNamespace(
        sensor='accelerometer', effect=CATALOGUE.find('accelerometer', 'accel_thermal_bias_2')
    )
    solved = _solved_with(
        SimpleNamespace(solved=Stated),
        CalibrationOptions(),
        SimpleNamespace(model=model),
        [question],
        [],
    )
    assert solved.options.added == tuple(('accelerometer', name) for name in added)


@pytest.mark.long
def test_live_it_is_in_the_model_as_well(bent):
    live = make_live(options=CalibrationOptions(catalogue=CATALOGUE.with_candidates(BENDS)))
    poses = run(live, bent.block.imu)
    result = live.solve(pending=True)
    assert result.calibration.statistics['added'] == [QUADRATIC]
    assert_same(result, bent.asked.result)
    residual = live.residuals(poses)
    # Noise of a mean over two seconds, 2e-4, and the bias of each pose.
    assert np.abs(residual.rate_s).max() < 5e-3


def test_what_only_one_half_shows_is_left_out_and_widens():
    """
    What goes with the square of the rate grows threefold after the middle.

    Something has changed, and it is no property of the sensor.
    """

    def spoil(force, rate, time, pose):
        return NOTHING, HIDDEN[QUADRATIC](force, rate, time, pose)[1] * (
            1 + 2 * (pose > 11)[:, None]
        )

    samples, ranges, _ = simulate(31, n_poses=24, spoil=spoil)
    data = gather_by_hand(samples, ranges)
    few = CalibrationOptions(gravity=GRAVITY, catalogue=CATALOGUE.with_candidates(BENDS))
    solved = searched(data, few)
    changes = solved.extension.changes
    assert changes.unstable and set(changes.unstable) <= {QUADRATIC, 'gyro_scale_asymmetry'}
    assert changes.added == ()
    plain = solve_by_hand(data, HandOptions(GRAVITY))
    np.testing.assert_array_equal(solved.solution.values, plain.values)
    grown = solved.solution.sd[ROWS] / plain.sd[ROWS]
    assert grown.min() >= 1.0 and grown.max() > 1.2


def test_a_warm_up_is_not_sold_as_an_answer_to_gravity(seed=0):
    samples, ranges, _ = hold_and_turn(seed, n_poses=16, rate_hz=50.0, still=3.0)
    warm, _ = warmed_up(samples, seed, rate=0.01, time_constant=60.0)
    catalogue = CATALOGUE.with_candidates('gyro_g_sensitivity+gyro_bias_drift')
    few = CalibrationOptions(gravity=GRAVITY, catalogue=catalogue)
    names = searched(gather_by_hand(warm, ranges), few).solution.param_names
    assert not any('gyro_g_sensitivity' in name for name in names)


def test_by_hand_nothing_is_added_where_nothing_is_hidden(seed=0):
    samples, ranges, _ = hold_and_turn(seed, n_poses=24, rate_hz=50.0)
    data = gather_by_hand(samples, ranges)
    solved = searched(data)
    assert solved.extension.changes.to_mapping() == {}
    np.testing.assert_array_equal(
        solved.solution.values, solve_by_hand(data, HandOptions(GRAVITY)).values
    )
