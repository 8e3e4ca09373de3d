"""The planner: what it asks for, what it promises, and that it keeps the promise."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from refusal import refused

from imu_calibration.api.calibrate import calibrate_recordings
from imu_calibration.api.plan import class_in
from imu_calibration.api.recordings import table_of
from imu_calibration.api.resources import config_file
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.cli.main import main
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import SampleBlock
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.effects.forward_equations import References, columns
from imu_calibration.effects.sensor_model import NAMED_MODELS, SensorModel
from imu_calibration.estimation.solution import tolerances_of
from imu_calibration.kinematics.motion_limits import limits_of
from imu_calibration.kinematics.table import Table
from imu_calibration.kinematics.urdf import table_from_urdf
from imu_calibration.planning import posterior
from imu_calibration.planning.campaign import make_separator
from imu_calibration.planning.coordinates import Coordinates
from imu_calibration.planning.motion_library import MotionKind, MotionLibrary
from imu_calibration.planning.planner import GOAL_REACHED, Planner, make_planner
from imu_calibration.planning.planning_problem import LEAST_RESTS, PlanningProblem, noise_of_grade
from imu_calibration.planning.posterior import SAMPLING, WindowPredictor, exact_information
from imu_calibration.references.turntable.live_windows import LiveCalibration
from imu_calibration.references.turntable.requested_model import choose_model
from imu_calibration.references.turntable.window_statistics import batch_statistics
from imu_calibration.simulation.motion_builder import MotionBuilder, Profile
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.sensor_noise import GRADES
from imu_calibration.simulation.session import SimulationOptions, random_values, simulate_session
from msg_adapters.joint_state import JOINT_TRAJECTORY_TYPE

from worlds.arms import SEVEN_AXES
from worlds.candidates import FEW
from worlds.live_sessions import TABLE, make_session
from worlds.random_tables import random_table

NOISE = noise_of_grade(GRADES['industrial'].noise, 100.0)
TIGHT = {
    'accelerometer': {'bias': 2e-3, 'matrix': 1.5e-4, 'accel_size_effect': 1e-4},
    'gyroscope': {'bias': 1e-4, 'matrix': 1e-4},
}


@pytest.fixture(scope='module')
def table():
    """The usual table."""
    return table_of(config_file('table_simulated.yaml'))


@pytest.fixture(scope='module')
def plan(table):
    """A plan for it."""
    return make_planner(table, noise=NOISE, tolerances=TIGHT).plan(with_bound=False)


def test_every_tolerance_is_met(plan):
    assert plan.missing == ()
    assert plan.seconds < 120
    assert np.all(plan.sd[plan.wanted] <= plan.tolerances[plan.wanted] * (1 + 1e-6))


@pytest.mark.long
def test_the_same_is_planned_again():
    table = Table.from_mapping(
        {
            'joints': [{'name': 'outer', 'axis': [0, 0, 1]}, {'name': 'inner', 'axis': [1, 0, 0]}],
            'gravity': 9.81,
        }
    )
    # Wider than TIGHT: a dozen motions, of which those after the first rests are searched.
    wider = {
        sensor: {name: 1.5 * value for name, value in of_sensor.items()}
        for sensor, of_sensor in TIGHT.items()
    }
    first, again = (
        make_planner(table, noise=NOISE, tolerances=wider).plan(with_bound=False) for _ in range(2)
    )
    assert len(first.motions) > 10 and [motion.words for motion in again.motions] == [
        motion.words for motion in first.motions
    ]


def test_what_is_promised_is_what_a_calibration_of_the_motion_comes_to(plan, table):
    profile = Profile(
        'plan', tuple(segment for one in plan.segments for segment in one), tuple(table.joint_names)
    )
    model = SensorModel(NAMED_MODELS['size_effect'], joint_names=table.joint_names)
    errors = []
    for seed in range(2):
        values = random_values(model, 'industrial', seed)
        samples = simulate_session(
            model,
            values,
            table,
            profile=profile,
            options=SimulationOptions(noise=GRADES['industrial'].noise),
            seed=seed,
        )
        found = calibrate_recordings(SampleBlock(*samples), table, model_as_asked=True).calibration
        errors += [
            (found.values[found.param_names.index(name)] - value)
            / plan.sd[plan.model.param_names.index(name)]
            for name, value in zip(model.param_names, values, strict=True)
        ]
    # 66 errors, correlated in groups: the root mean square of as many independent ones scatters by
    # 9 %
    assert 0.75 < np.sqrt(np.mean(np.square(errors))) < 1.25


def test_next_motions_end_when_all_is_known_and_take_says_what_is(plan, table):
    planner = make_planner(table, noise=NOISE, tolerances=TIGHT)
    position = np.zeros(3)
    first = planner.next_motion(position)
    assert first.motion.kind is MotionKind.POSE
    assert first.seconds == pytest.approx(first.motion.points(position).duration)
    known = Calibration(
        plan.model,
        plan.model.start(),
        np.diag((0.5 * np.minimum(plan.tolerances, plan.sd)) ** 2),
        ('determined',) * len(plan.sd),
    )
    planner.take(known)
    # the rests with which a session begins are made in any case: the proof holds out some of the
    # windows
    assert [planner.next_motion(position).motion.kind for _ in range(LEAST_RESTS - 1)] == [
        MotionKind.POSE
    ] * (LEAST_RESTS - 1)
    assert planner.next_motion(position).motion is None
    assert planner.next_motion(position).why == GOAL_REACHED
    far = replace(known, covariance=100.0 * known.covariance)
    planner.take(far)
    assert planner.next_motion(position).motion is not None


def test_spins_in_both_senses_follow_from_the_criterion_where_the_bias_wanders():
    table = Table.from_mapping(
        {
            'joints': [
                {'name': 'only', 'axis': [0, 0, 1], 'speed_deg_s': 100, 'acceleration_deg_s2': 400}
            ],
            'gravity': 9.81,
            'mount': {'xyz': [0, 0, 0]},
        }
    )
    planner = make_planner(
        table, noise=NOISE, tolerances={'gyroscope': {'matrix': 2e-5, 'bias': 1e-3}}
    )
    position, senses = np.zeros(1), set()
    for _ in range(25):
        step = planner.next_motion(position)
        if step.motion is None:
            break
        points = step.motion.points(position)
        senses |= {np.sign(points.rate[np.argmax(np.abs(points.rate)), 0])}
        position = points.position[-1]
    assert {1.0, -1.0} <= senses


def test_a_plan_at_the_default_tolerances_has_windows_enough_to_be_proven_and_diagnosed(table):
    """
    It needed 8 s with two windows, of which no proof can hold out any.

    The message is 'no plan takes less than 0 s'.
    """
    plan = make_planner(table, noise=NOISE).plan()
    rests = {
        tuple(motion.place.round(6)) for motion in plan.motions if motion.kind is MotionKind.POSE
    }
    assert len(rests) >= LEAST_RESTS and 15.0 < plan.lower_bound_seconds < plan.seconds < 30.0
    profile = Profile(
        'plan', tuple(segment for one in plan.segments for segment in one), tuple(table.joint_names)
    )
    model = SensorModel(NAMED_MODELS['size_effect'], joint_names=table.joint_names)
    values = random_values(model, 'industrial')
    samples = simulate_session(model, values, table, profile=profile)
    found = calibrate_recordings(SampleBlock(*samples), table, candidates=FEW).calibration
    status = dict(zip(found.param_names, found.status, strict=True))
    assert {
        status[name]
        for name, wanted in zip(plan.model.param_names, plan.wanted, strict=True)
        if wanted
    } == {'determined'}
    assert found.decision == {'accelerometer': 'helps', 'gyroscope': 'helps'}
    assert found.proof['accelerometer'].windows >= 8


def test_the_sd_of_a_plan_stays_below_the_tolerance_by_the_scatter_of_the_noise_estimate(
    plan, table
):
    """
    Plans used to stop at the tolerance itself, which every second estimate of the noise exceeds.
    """
    problem = make_planner(table, noise=NOISE, tolerances=TIGHT).problem
    rests = [problem.windows[k][0] for k in problem.first_rests(0)][1:]  # of equal length
    factor, rng = problem.variance_factor(rests), np.random.default_rng(9)
    exceeded = [
        max(
            np.mean(
                [
                    variance * inflation
                    for variance, inflation in (
                        batch_statistics(rng.normal(size=(130, 6))) for _ in rests
                    )
                ],
                axis=0,
            )
        )
        > factor
        for _ in range(400)
    ]
    assert 1.2 < factor < 1.8
    # 20 expected of 400, by counting 4.4 standard deviations apart; the estimate is skewed where
    # chi-square is not
    assert np.mean(exceeded) < 0.1
    kept = [
        next(
            k
            for k, m in enumerate(problem.motions)
            if (m.kind, m.text) == (motion.kind, motion.text)
            and np.array_equal(m.place, motion.place)
        )
        for motion in plan.motions
    ]
    cautious = problem.coordinates.excess(problem.covariance_after(kept, 0, cautious=True)[0])
    assert cautious.max() <= 1 + 1e-6 and (plan.sd / plan.tolerances)[plan.wanted].max() < 0.98


def test_a_single_shaft_gives_the_best_it_can_and_says_what_is_missing(capsys, tmp_path):
    assert main(['plan', '--motion', 'yaw-only', '--output', str(tmp_path / 'out')]) == 3
    document = yaml.safe_load((tmp_path / 'out/plan.yaml').read_text())
    assert 'gyroscope.matrix.zz' not in document['missing']
    assert document['lower_bound_seconds'] is None  # 1.9e45 s for tolerances out of reach
    assert {'gyroscope.matrix.xx', 'accelerometer.matrix.zz'} <= set(document['missing'])
    assert ', '.join(document['missing']) in capsys.readouterr().out


def test_the_verb_writes_a_plan_that_a_controller_can_follow(capsys, tmp_path):
    out = tmp_path / 'out'
    assert (
        main(
            [
                'plan',
                '--table',
                str(config_file('table_simulated.yaml')),
                '--output',
                str(out),
                '--no-bound',
            ]
        )
        == 0
    )
    document = yaml.safe_load((out / 'plan.yaml').read_text())
    trajectory = yaml.safe_load((out / 'trajectory.yaml').read_text())
    assert (
        document['format'] == 'imu_calibration/plan/1' and document['lower_bound_seconds'] is None
    )
    assert trajectory['joint_names'] == ['outer', 'middle', 'inner']
    assert all(
        len(point[name]) == 3
        for point in trajectory['points']
        for name in ('positions', 'velocities', 'accelerations')
    )
    last = trajectory['points'][-1]
    assert last['velocities'] == last['accelerations'] == [0.0] * 3
    assert last['time_from_start']['sec'] + 1e-9 * last['time_from_start'][
        'nanosec'
    ] == pytest.approx(document['seconds'], abs=1e-3)
    assert JOINT_TRAJECTORY_TYPE in (out / 'trajectory/metadata.yaml').read_text()
    assert '<svg' in (out / 'report.html').read_text()
    assert {str(len(document['motions'])), f'{document["seconds"]:.0f}'} <= set(
        capsys.readouterr().out.split()
    )


def test_a_plan_without_anything_that_moves_is_refused_in_one_line(capsys, tmp_path):
    assert main(['plan', '--output', str(tmp_path / 'out')]) == 1
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not (tmp_path / 'out').exists()


def test_squares_and_asymmetries_of_a_gyroscope_are_told_apart_by_other_speeds(table):
    pair = [('gyroscope', 'gyro_quadratic'), ('gyroscope', 'gyro_scale_asymmetry')]
    model = SensorModel(NAMED_MODELS['size_effect'], joint_names=table.joint_names).with_effect(
        *pair[0]
    )
    values = model.start()
    values[model.slices[pair[0]]] = [2e-4, -2e-4, 2e-4]
    calibration = Calibration(
        model, values, np.diag(model.prior()[1] ** 2), ('weak',) * len(values)
    )
    separator = make_separator(table, calibration, pair, noise=NOISE)
    before = separator.problem.goal.missing(separator.problem.posterior().covariance_z)
    assert 0 < separator.plan(longest=6.0).seconds <= 6.0
    plan = separator.plan(longest=180.0)
    assert (
        before == ('gyro_quadratic and gyro_scale_asymmetry',)
        and plan.missing == ()
        and plan.seconds < 180
    )
    speeds = {
        round(float(np.abs(motion.from_position(motion.place)[1].rate_to).max()), 1)
        for motion in plan.motions
        if motion.kind is MotionKind.SPIN
    }
    assert len(speeds) != 1


def test_no_time_is_spent_on_causes_that_no_motion_tells_apart(table):
    """
    A delay and a filter of 0.1 ms are one column.

    The plan says so at once instead of driving for three minutes.
    """
    causes = [('gyroscope', name) for name in ('gyro_delay', 'gyro_filter')]
    model = SensorModel(NAMED_MODELS['size_effect'], joint_names=table.joint_names).with_effect(
        *causes[0]
    )
    values = model.start()
    values[model.slices[causes[0]]] = 1e-4
    calibration = Calibration(
        model, values, np.diag(model.prior()[1] ** 2), ('weak',) * len(values)
    )
    separator = make_separator(
        table, calibration, causes, noise=NOISE, sizes={'gyroscope.gyro_filter.delay': 1e-4}
    )
    plan = separator.plan(longest=180.0)
    assert plan.missing == ('gyro_delay and gyro_filter',) and plan.seconds == 0
    assert separator.next_motion(plan.start).motion is None


def test_a_class_is_taken_from_a_diagnosis_or_refused():
    findings = [
        {'effect': 'a', 'indistinguishable_from': []},
        {
            'effect': 'b',
            'indistinguishable_from': ['c', 'd'],
            'sizes_of_mates': {'c': {'c.x': {'value': 2.0, 'unit': '1'}}},
        },
    ]
    assert class_in(json.loads(json.dumps({'findings': findings}))) == (
        ('b', 'c', 'd'),
        {'c.x': 2.0},
    )
    with refused(InputError, 'nothing_to_separate'):
        class_in({'findings': findings[:1]})


def test_a_slow_random_table_still_gets_a_plan():
    table = random_table(np.random.default_rng(5), 2, 1.0)
    plan = make_planner(table, noise=NOISE).plan(with_bound=False)
    assert plan.motions and np.all(np.diff(plan.ends) > 0)


def test_by_hand_the_steps_are_planned_in_words_and_pictures(capsys, tmp_path):
    out = tmp_path / 'out'
    assert main(['plan', '--by-hand', '--output', str(out)]) == 0
    document = yaml.safe_load((out / 'plan.yaml').read_text())
    kinds = [motion['kind'] for motion in document['motions']]
    # nine parameters of the norm of gravity take one equation per pose, three more estimate the
    # scatter; the gyroscope needs three turns
    assert len(kinds) >= 12 and kinds.count('turn') >= 3 and set(kinds) <= {'pose', 'turn'}
    assert document['seconds'] == pytest.approx(
        sum(motion['seconds'] for motion in document['motions'])
    )
    assert document['missing'] == [] and '<svg' in (out / 'report.html').read_text()
    printed = capsys.readouterr().out
    assert all(motion['text'] in printed for motion in document['motions'])


@pytest.mark.long
def test_a_plan_does_what_the_mixed_design_of_the_papers_does_in_no_more_time():
    profile = make_profile('zhang_m')
    table = Table.from_mapping(
        {
            **profile.table,
            'joints': [
                {**joint, 'speed_deg_s': 200.0 * 1.03, 'acceleration_deg_s2': 1000.0}
                for joint in profile.table['joints']
            ],
        }
    )
    model = choose_model(CalibrationOptions(), table)
    predictor = WindowPredictor(table, Coordinates(model, tolerances_of(model)), NOISE, rate=100.0)
    windows = predictor.predict([profile.segments])[0]
    problem = PlanningProblem(MotionLibrary(table, limits_of(table)), predictor.coordinates, NOISE)
    times, factor = (
        np.array([window.middle for window in windows]),
        problem.variance_factor(windows),
    )
    # With the same probability as the plan.
    information = exact_information(windows, times, NOISE, factor=factor)
    sd = predictor.coordinates.sd(
        np.linalg.inv(predictor.coordinates.prior_information + information)
    )
    worst = {}
    for effect in model.effects:
        worst.setdefault(effect.sensor, {})[effect.name] = float(sd[model.slices[effect.key]].max())
    # The library has no tolerances: both problems share it.
    coordinates = Coordinates(model, tolerances_of(model, worst))
    plan = Planner(PlanningProblem(problem.library, coordinates, NOISE)).plan(with_bound=False)
    # With its six rests, which the profile lacks.
    assert plan.missing == () and plan.seconds <= 1.01 * profile.duration


def test_what_a_live_session_saved_is_known_as_well_as_its_calibration(plan, capsys, tmp_path):
    live = LiveCalibration(TABLE, CalibrationOptions(as_asked=True))
    live.push(SampleBlock(*make_session(seconds=50.0)[:2]))
    (tmp_path / 'mine.accumulator.npz').write_bytes(live.saved(pending=True))
    (tmp_path / 'mine.yaml').write_text(calibration_to_text(live.solve(pending=True).calibration))
    documents = []
    for known in ('mine.accumulator.npz', 'mine.yaml'):
        assert (
            main(
                [
                    'plan',
                    '--table',
                    str(config_file('table_simulated.yaml')),
                    '--known',
                    str(tmp_path / known),
                    '--tolerances',
                    str(tight(tmp_path)),
                    '--output',
                    str(tmp_path / 'out'),
                    '--no-bound',
                    '--no-report',
                ]
            )
            == 0
        )
        documents.append(
            yaml.safe_load((tmp_path / 'out/plan.yaml').read_text()) | {'provenance': None}
        )
        (tmp_path / 'out').rename(tmp_path / f'plan of {known}')
    assert documents[0] == documents[1]
    assert documents[0]['seconds'] < 0.8 * plan.seconds
    capsys.readouterr()
    (tmp_path / 'mine.accumulator.npz').write_bytes(b'half')
    assert (
        main(
            [
                'plan',
                '--table',
                str(config_file('table_simulated.yaml')),
                '--known',
                str(tmp_path / 'mine.accumulator.npz'),
                '--output',
                str(tmp_path / 'no'),
            ]
        )
        == 1
    )
    assert 'mine.accumulator.npz' in capsys.readouterr().err


def tight(folder):
    """Return a file with the tolerances TIGHT."""
    (folder / 'tight.yaml').write_text(yaml.safe_dump(TIGHT))
    return folder / 'tight.yaml'


def test_a_moving_window_is_foretold_with_the_bias_wandering_in_it(table):
    """
    Against the dense covariance of the samples.

    Information of both sensors, the mean, and its variance.
    """
    model = choose_model(CalibrationOptions(), table)
    noise = noise_of_grade(GRADES['navigation'].noise, 100.0)
    coordinates = Coordinates(model, tolerances_of(model))
    builder = MotionBuilder(3)
    builder.move_to([1.0, -0.5, 2.0])
    segments = tuple(builder.segments)
    found, still = (
        WindowPredictor(table, coordinates, of, rate=100.0).predict([segments])[0][0]
        for of in (noise, {s: replace(own, bias_processes=()) for s, own in noise.items()})
    )
    count = int(np.ceil(found.length * SAMPLING))
    offsets = ((np.arange(count) + 0.5) / count - 0.5) * found.length
    motion = Profile('', segments).at(offsets + found.length / 2)
    total, predicted = 0.0, found.within
    for sensor, own in noise.items():
        process = own.bias_processes[0]
        wander = [
            [
                process.sd**2
                * (np.exp(-abs(a - b) / process.time) - np.exp(-(abs(a) + abs(b)) / process.time))
                for b in offsets
            ]
            for a in offsets
        ]
        inverse = np.linalg.inv(
            np.diag(np.full(count, own.low_variance[0] * count / found.samples)) + wander
        )
        design, slope, mean = (
            columns(References(coordinates.folded, table, motion), sensor),
            coordinates.slopes[sensor],
            found.means[sensor],
        )
        total = total + sum(
            slope[:, axis].T @ design.T @ inverse @ design @ slope[:, axis] for axis in range(3)
        )
        predicted = predicted + mean.T @ mean * inverse.sum()
        np.testing.assert_allclose(found.variance[sensor], 1 / inverse.sum(), rtol=1e-9)
    np.testing.assert_allclose(predicted, total, rtol=1e-7, atol=1e-9 * total.max())
    assert np.trace(found.within) < 0.9 * np.trace(still.within)


def test_the_memory_of_a_plan_does_not_grow_with_the_square_of_an_arms_joints(table, monkeypatch):
    """
    All moves of seven joints at once took 5.7 GB.

    Columns are computed by blocks, and a long chain has few places.
    """
    lengths = []

    def counted(references, sensor):
        lengths.append(len(references.motion))
        return columns(references, sensor)

    monkeypatch.setattr(posterior, 'columns', counted)
    model = choose_model(CalibrationOptions(), table)
    move = MotionBuilder(3)
    move.move_to([1.0, -0.5, 2.0])
    found = WindowPredictor(
        table, Coordinates(model, tolerances_of(model)), NOISE, rate=100.0
    ).predict([tuple(move.segments)] * 1000)
    assert (
        len(found) == 1000 and max(lengths) <= 1.05 * posterior.BELIEF_BLOCK_ROWS < sum(lengths) / 2
    )
    arm = table_from_urdf(SEVEN_AXES, 'imu_link', {'gravity': 9.81})
    assert 20 <= len(MotionLibrary(arm, limits_of(arm)).places) <= 45
