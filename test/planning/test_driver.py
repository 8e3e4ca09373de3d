"""
The driver: nothing moves before start, limits are kept, and deviations stop it.

Whatever the joints do otherwise than commanded stops everything with one sentence.
"""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusal import refused

from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.errors import InputError
from imu_calibration.document.calibration import Calibration
from imu_calibration.estimation.solution import DETERMINED
from imu_calibration.kinematics.joint_motion import rest_at
from imu_calibration.kinematics.motion_limits import MotionLimits, TrajectoryPoints
from imu_calibration.kinematics.table import Table
from imu_calibration.planning.campaign import (
    IN_VAIN,
    STALL_MOTIONS,
    TIME_OVER,
    Campaign,
    CampaignSettings,
    CollinearFinding,
    separator_of,
    with_finding,
)
from imu_calibration.planning.driver import Driver, DriverSettings, DriveState
from imu_calibration.planning.path_watch import PathWatch
from imu_calibration.planning.planner import Decision
from imu_calibration.planning.planning_problem import noise_of_grade
from imu_calibration.references.turntable.requested_model import choose_model
from imu_calibration.simulation.motion_builder import MotionBuilder, Profile
from imu_calibration.simulation.sensor_noise import GRADES
from imu_calibration.simulation.table_controller import (
    ControllerSettings,
    TableController,
    limit_excess,
    trajectory_from,
)

STEP = 0.02
NAMES = ('outer', 'inner')
LIMITS = MotionLimits(
    np.array([-np.inf, -1.5]),
    np.array([np.inf, 1.5]),
    np.array([2.0, 1.0]),
    np.array([4.0, 2.0]),
    np.ones(2, bool),
)


def motion_points(limits, seed, names=NAMES, start=None, kind=None):
    """
    A planned motion from a place: a move, then a rest, a spin or a swing, with points every 0.05 s.
    """
    rng = np.random.default_rng(seed)
    builder = MotionBuilder(len(names), limits=limits)
    if start is not None:
        builder._position = start
    low, high = (
        np.where(np.isfinite(limits.lower), limits.lower, -3.0),
        np.where(np.isfinite(limits.upper), limits.upper, 3.0),
    )
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    builder.move_to(middle + 0.5 * half * rng.uniform(-1, 1, len(names)))
    builder.rest(1.0)
    kind = kind or rng.choice(['swing', 'spin', 'rest'])
    if kind == 'swing':
        frequency = 0.5
        builder.swing(
            0.5
            * np.minimum.reduce(
                [
                    0.4 * half,
                    limits.speed / (2 * np.pi * frequency),
                    limits.acceleration / (2 * np.pi * frequency) ** 2,
                ]
            ),
            np.full(len(names), frequency),
            4.0,
        )
    if kind == 'spin' and limits.endless.any():
        rates = np.where(limits.endless, 0.9 * np.degrees(limits.speed), 0.0)
        builder.spin([rates, -rates], 2.0)
    profile = Profile('motion', tuple(builder.segments))
    time = np.append(np.arange(0.05, profile.duration, 0.05), profile.duration)
    motion = profile.at(time)
    motion.rate[-1], motion.acceleration[-1] = 0.0, 0.0
    return TrajectoryPoints(names, time, motion.position, motion.rate, motion.acceleration)


class Bench:
    """
    A driver and a simulated table, joint states every `STEP`, with the noise of an encoder.

    Its clock may run ahead of ours.
    """

    def __init__(
        self, limits=LIMITS, names=NAMES, driver=DriverSettings(), clock=1.0, **controller
    ):
        self.table = TableController(
            None, names, limits=limits, settings=ControllerSettings(**controller)
        )
        self.driver, self.now, self.rng, self.silent = (
            Driver(names, limits, driver),
            0.0,
            np.random.default_rng(1),
            False,
        )
        self.sent, self.stops, self.clock = [], 0, clock
        self.look()

    @property
    def steady(self):
        """The time by our own clock."""
        return self.now / self.clock

    def look(self):
        """Go on by a step; a stop is obeyed at once."""
        self.now += STEP
        motion = self.table.at(np.array([self.now]))
        told = motion.position[0] + self.rng.normal(0, 1e-4, len(self.driver.joint_names))
        must_stop = (
            self.driver.tick(self.steady)
            if self.silent
            else self.driver.observe(self.now, told, motion.rate[0], now=self.steady)
        )
        if must_stop:
            self.stops += 1
            self.table.follow(self.now, TrajectoryPoints.stop(self.driver.joint_names))

    def move(self, points):
        """Begin a motion, once the joints rest."""
        for _ in range(200):
            if not self.driver.rests:
                self.look()
        self.sent.append(self.driver.begin(points, 'a motion', self.steady))
        self.table.follow(self.now, self.sent[-1])

    def until_it_rests(self, seconds=120.0):
        """Go on until the driver no longer drives."""
        end = self.now + seconds
        while self.driver.is_driving and self.now < end:
            self.look()
        return self.driver.state


def named(reason):
    """Return the joints that a reason names."""
    return {name for name in NAMES if name in reason}


@pytest.mark.parametrize('kind', ['rest', 'spin', 'swing'])
@pytest.mark.parametrize('controller', [{}, {'lag': 0.4}, {'speed_scaling': 0.3}])
def test_a_motion_is_followed_to_its_end_however_slow_and_late_the_controller_is(kind, controller):
    bench = Bench(**controller)
    bench.driver.start()
    for seed in (1, 2):
        bench.move(motion_points(LIMITS, seed, start=bench.driver.position, kind=kind))
        assert bench.until_it_rests() is DriveState.MEASURING, bench.driver.reason
    assert bench.stops == 0 and bench.driver.motions == 2
    np.testing.assert_allclose(bench.driver.position, bench.sent[-1].position[-1], atol=1e-3)


def test_the_first_motion_after_a_start_is_slow_and_the_next_is_not():
    bench = Bench()
    bench.driver.start()
    points = motion_points(LIMITS, 1)
    bench.move(points)
    assert bench.sent[0].duration == pytest.approx(points.duration / 0.3)
    bench.until_it_rests()
    again = motion_points(LIMITS, 2, start=bench.driver.position)
    bench.move(again)
    assert bench.sent[1].duration == again.duration


def test_nothing_moves_before_joint_states_and_after_a_stop():
    driver, points = Driver(NAMES, LIMITS), motion_points(LIMITS, 1)
    with refused(InputError, 'no_joint_states'):
        driver.begin(points, 'a motion', 0.0)
    bench = Bench()
    bench.driver.stop('somebody said so')
    with refused(InputError, 'wrong_state', 'stopped', 'somebody said so'):
        bench.move(points)
    bench.driver.start()
    bench.move(points)
    with refused(InputError, 'wrong_state', 'moving'):  # one motion at a time
        bench.move(points)


def test_a_motion_begins_only_where_the_joints_rest():
    bench = Bench()
    bench.driver.start()
    bench.move(motion_points(LIMITS, 3, kind='spin'))
    for _ in range(300):
        bench.look()
    # And started anew before anybody has seen the joints slow down.
    bench.driver.stop('stopped by hand')
    bench.table.follow(bench.now, TrajectoryPoints.stop(NAMES))
    bench.driver.start()
    began = bench.now
    while not bench.driver.rests:
        with refused(InputError, 'joints_moving'):
            bench.driver.begin(motion_points(LIMITS, 2), 'a motion', bench.now)
        bench.look()
    assert bench.now - began >= 0.5 and not bench.table.at(np.array([bench.now])).rate.any()
    bench.move(motion_points(LIMITS, 2, start=bench.driver.position))
    assert bench.until_it_rests() is DriveState.MEASURING, bench.driver.reason
    driver = Driver(NAMES, LIMITS)  # a clock that is set back begins to count anew
    for time in (100.0, 101.0):
        driver.observe(time, np.zeros(2), np.zeros(2), now=time)
    assert driver.rests
    driver.observe(5.0, np.zeros(2), np.zeros(2), now=102.0)
    assert not driver.rests
    driver.observe(6.0, np.zeros(2), np.zeros(2), now=103.0)
    assert driver.rests
    driver.start()  # what has just begun to move may not be seen yet
    assert not driver.rests


@pytest.mark.parametrize('clock', [1.0, 4.0, 0.25])
def test_a_motion_that_was_stopped_before_the_controller_took_it_is_waited_for(clock):
    # Joints that rest say nothing as long as the controller may still have both before it: the
    # motion and the stop of it.
    bench = Bench(clock=clock, lag=1.0)
    bench.driver.start()
    bench.move(motion_points(LIMITS, 3, kind='spin'))
    sent, began = bench.now, bench.driver.position
    bench.look()
    bench.driver.stop('stopped by hand')
    bench.driver.start()  # at once, before anything has moved
    bench.table.follow(bench.now + 0.8, TrajectoryPoints.stop(NAMES))
    stopped = bench.now
    while not bench.driver.rests:
        assert bench.driver.awaits_stop or bench.now - stopped > 0.5
        bench.look()
    waited = bench.now - sent
    assert (
        np.max(np.abs(bench.driver.position - began)) > 0.01
        and not bench.table.at(np.array([bench.now + 5.0])).rate.any()
    )
    # By the joints' clock and by ours.
    assert waited == pytest.approx(3.0 * max(clock, 1.0), abs=0.1)
    bench.driver.stop('once more')  # nothing was in motion: nothing is waited for
    assert bench.driver.rests and not bench.driver.awaits_stop


def test_after_a_stop_a_clock_that_is_set_back_is_waited_for_from_where_it_is():
    bench = Bench()
    bench.driver.start()
    bench.move(motion_points(LIMITS, 3, kind='spin'))
    bench.driver.stop('stopped by hand')
    for time, awaits in ((-50.0, True), (-48.0, True), (-46.9, False)):
        bench.driver.observe(time, np.zeros(2), np.zeros(2), now=bench.now + 51.0 + time)
        assert bench.driver.awaits_stop is awaits
    assert bench.driver.is_silent(bench.now + 5.2) and not bench.driver.is_silent(bench.now + 5.0)


@pytest.mark.parametrize('moment', np.linspace(0.0, 9.0, 7))
def test_stop_is_safe_at_any_moment(moment):
    bench = Bench()
    bench.driver.start()
    bench.move(motion_points(LIMITS, 3, kind='spin'))
    while bench.now < moment:
        bench.look()
    bench.driver.stop('stopped by hand')
    bench.table.follow(bench.now, TrajectoryPoints.stop(NAMES))
    after = bench.table.at(bench.now + np.linspace(0, 3, 1000))
    assert (
        np.max(np.abs(after.acceleration) / LIMITS.acceleration) < 1 + 1e-6
        and not after.rate[-1].any()
    )
    assert bench.driver.state is DriveState.STOPPED and not bench.driver.observe(
        bench.now, np.full(2, 9.0), np.full(2, 9.0), now=bench.now
    )


@pytest.mark.parametrize(
    'controller, joints, number',
    [
        ({'stall_joint': 'inner', 'stall_time': 2.0}, {'inner'}, r'\d (deg|s)'),
        ({'stall_joint': 'inner', 'stall_time': 0.0}, {'inner'}, r'\d (deg|s)'),
        ({'refuse_after': 0}, set(), r'3\.\d s'),
    ],
)
def test_joints_that_stall_and_controllers_that_refuse_stop_everything_with_one_sentence(
    controller, joints, number
):
    bench = Bench(**controller)
    bench.driver.start()
    points = motion_points(LIMITS, 4, kind='swing')
    try:
        bench.move(points)
    except InputError:  # as on a topic, nobody is told that it was refused
        pass
    assert bench.until_it_rests() is DriveState.STOPPED and bench.stops == 1
    assert named(bench.driver.reason) == joints and re.search(number, bench.driver.reason), (
        bench.driver.reason
    )
    assert '\n' not in bench.driver.reason and bench.now < 25.0


@pytest.mark.parametrize('clock', [1.0, 4.0, 0.25])
def test_a_controller_has_its_patience_by_the_clock_of_the_joints_and_by_ours(clock):
    patience = 3.0 * max(clock, 1.0)

    def begun(**controller):
        bench = Bench(clock=clock, **controller)
        bench.driver.start()
        bench.move(motion_points(LIMITS, 2, kind='rest'))
        return bench, bench.now

    bench, _ = begun(lag=0.9 * patience)  # it begins late, and not at all too late
    assert bench.until_it_rests() is DriveState.MEASURING, bench.driver.reason
    bench, sent = begun(lag=60.0)
    assert bench.until_it_rests() is DriveState.STOPPED
    # What lies within the tolerance of where it was counts as come further.
    assert 0.0 <= bench.now - sent - patience < 1.0
    bench, _ = begun()
    while (
        np.max(np.abs(bench.driver.position - bench.sent[0].position[-1])) > 0.3
        and bench.driver.is_driving
    ):
        bench.look()
    # Somebody else stops it, long after it was sent.
    bench.table.follow(bench.now, TrajectoryPoints.stop(NAMES))
    stopped = bench.now
    assert bench.until_it_rests() is DriveState.STOPPED and len(named(bench.driver.reason)) == 1
    assert 0.0 <= bench.now - stopped - patience < 1.0


def test_a_joint_that_is_pushed_off_its_path_beyond_its_range_or_too_fast_stops_everything():
    for place, rate, joint, number in (
        ([0.0, 0.2], [0.0, 0.0], 'outer', '11.4 deg'),
        ([0.0, 1.6], [0.0, 0.0], 'inner', '91.7 deg'),
        ([0.0, 0.0], [0.0, 2.0], 'inner', '2.00'),
    ):
        bench = Bench()
        bench.driver.start()
        bench.move(motion_points(LIMITS, 5))
        assert bench.driver.observe(
            bench.now + STEP, np.array(place), np.array(rate), now=bench.now
        )
        assert (
            bench.driver.state is DriveState.STOPPED
            and named(bench.driver.reason) == {joint}
            and number in bench.driver.reason
        )


def test_joint_states_that_fall_silent_stop_everything():
    bench = Bench()
    bench.driver.start()
    bench.move(motion_points(LIMITS, 6))
    for _ in range(50):
        bench.look()
    bench.silent, before = True, bench.now
    assert bench.until_it_rests() is DriveState.STOPPED and bench.now - before < 1.1
    assert bench.driver.reason.count('1.0 s') == 1


def test_joints_that_do_not_come_to_rest_stop_everything():
    bench = Bench(driver=DriverSettings(settling_patience=2.0))
    bench.driver.start()
    bench.move(motion_points(LIMITS, 7, kind='rest'))
    while bench.driver.state is DriveState.MOVING:
        bench.look()
    place = bench.driver.position
    for k in range(300):
        if bench.driver.observe(
            bench.now + k * STEP, place + 0.02 * np.sin(k * 0.5), np.zeros(2), now=bench.now
        ):
            break
    assert ' 2 s' in bench.driver.reason and not named(bench.driver.reason)


def random_limits(seed):
    """Limits of a table of one to six joints, some endless, some slow, some that slide."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 7))
    turns = rng.random(count) < 0.8
    endless = turns & (rng.random(count) < 0.5)
    low, span = rng.uniform(-3, 0, count), rng.uniform(0.2, 5.0, count)
    return MotionLimits(
        np.where(endless, -np.inf, low),
        np.where(endless, np.inf, low + span),
        rng.uniform(0.05, 6.0, count),
        rng.uniform(0.1, 20.0, count),
        turns,
    )


@given(st.integers(0, 10**6), st.floats(0.5, 4.0))
def test_no_limit_of_any_table_is_ever_exceeded_by_what_is_sent(seed, hurry):
    limits = random_limits(seed)
    names = tuple(f'joint_{k}' for k in range(len(limits)))
    start = np.clip(np.zeros(len(limits)), limits.lower, limits.upper)
    driver = Driver(names, limits)
    driver.start()
    for time in (0.0, 1.0):
        driver.observe(time, start, np.zeros(len(limits)), now=time)
    points = motion_points(limits, seed, names=names, start=start)
    # What a planner does wrong: it is in a hurry. `hurry` above the slow first motion's 1 / 0.3 is
    # too fast where the motion is at its limits.
    asked = TrajectoryPoints(
        names,
        points.time / hurry,
        points.position,
        points.rate * hurry,
        points.acceleration * hurry**2,
    )
    try:
        sent = driver.begin(asked, 'a motion', 1.0)
    except InputError:
        assert driver.state is DriveState.IDLE and hurry > 1.0
        return
    beyond, speed, acceleration = limit_excess(
        trajectory_from(rest_at(start[None]), sent), limits, step=0.001
    )
    assert beyond < 1e-5 and speed < 1 + 1e-3 and acceleration < 1 + 1e-3


def test_a_motion_without_accelerations_or_of_other_joints_is_not_sent():
    bench = Bench()
    bench.driver.start()
    points = motion_points(LIMITS, 1)
    with refused(InputError, 'joint_limits'):
        bench.move(TrajectoryPoints(NAMES, points.time, points.position, points.rate))
    with refused(InputError, 'joint_names', 'outer, tool'):
        bench.move(
            TrajectoryPoints(
                ('outer', 'tool'), points.time, points.position, points.rate, points.acceleration
            )
        )


class OldHand:
    """
    Stands for a planner.

    So many motions of ten seconds, each of which halves what is left until `floor`.
    """

    def __init__(self, motions=4, floor=0.0):
        self.motions, self.floor, self.excess, self.separated = (
            motions,
            floor,
            {'accelerometer.bias.x': 16.0},
            [],
        )
        self.separable = True

    def separator(self, finding):
        self.separated.append(finding)
        if not self.separable:
            raise InputError('no joint turns')
        return OldHand(2)

    def take(self, excess):
        self.excess = {'accelerometer.bias.x': max(excess, self.floor)}

    def next_motion(self, position):
        self.motions -= 1
        moves = self.motions >= 0
        return Decision(
            'a motion' if moves else None, 'it helps' if moves else 'all within tolerance', 10.0
        )


def carried_out(campaign, answers=(), most=60):
    """
    What a campaign decides, each motion taking ten seconds and halving what is left.

    The answers of the diagnosis in order.
    """
    decided, elapsed, left, answers = [], 0.0, 16.0, list(answers)
    for _ in range(most):
        decision = campaign.decide(np.zeros(2), elapsed)
        decided.append(
            'move' if decision.motion else 'diagnose' if decision.diagnose else decision.why
        )
        if decision.motion:
            elapsed, left = elapsed + 10.0, left / 2
            campaign.take(left)
        elif decision.diagnose:
            campaign.take_findings(answers.pop(0) if answers else [])
        else:
            return decided
    raise AssertionError(f'no end: {decided}')


def test_a_campaign_moves_asks_what_is_wrong_separates_and_ends_with_its_reason():
    hand = OldHand()
    assert carried_out(Campaign(hand)) == ['move'] * 4 + ['diagnose', 'all within tolerance']
    assert carried_out(Campaign(OldHand(), CampaignSettings(separations=0))) == ['move'] * 4 + [
        'all within tolerance'
    ]
    hand = OldHand()
    campaign, alike, alone = (
        Campaign(hand, make_separator=hand.separator),
        CollinearFinding('gyro_quadratic', ('gyro_scale_asymmetry',), {'x': 1e-3}),
        CollinearFinding('gyro_scale_asymmetry'),
    )
    decided = carried_out(campaign, [[alike], [alone]])
    assert decided[:-1] == ['move'] * 4 + ['diagnose', 'move', 'move', 'diagnose'] and decided[
        -1
    ].startswith('all within tolerance')
    assert 'gyro_scale_asymmetry' in decided[-1] and 'gyro_quadratic' not in decided[-1]
    assert hand.separated == [alike] and campaign.separations == 1
    stubborn = Campaign(hand := OldHand(), CampaignSettings(separations=2), hand.separator)
    why = carried_out(stubborn, [[alike]] * 9)[-1]
    assert 'gyro_quadratic' in why and 'gyro_scale_asymmetry' in why
    assert stubborn.separations == 2
    hand.separable = False
    assert 'no joint turns' in Campaign(hand, make_separator=hand.separator).take_findings([alike])


def test_a_campaign_ends_when_the_time_is_over_or_motions_bring_nothing_any_more():
    over = carried_out(Campaign(OldHand(100), CampaignSettings(time_limit=35.0)))
    assert (
        over[:3] == ['move'] * 3
        and len(over) == 4
        and over[3].startswith(TIME_OVER)
        and ' 10 s' in over[3]
    )
    assert carried_out(Campaign(OldHand(100), CampaignSettings(time_limit=30.0)))[3].startswith(
        TIME_OVER
    )
    vain = carried_out(Campaign(OldHand(100, floor=8.0)))  # misfit, say, that no motion takes away
    assert (
        vain[: STALL_MOTIONS + 1] == ['move'] * (STALL_MOTIONS + 1)
        and vain[-2] == 'diagnose'
        and vain[-1].startswith(IN_VAIN)
    )
    # What goes on halving is worth its while.
    assert carried_out(Campaign(OldHand(30)))[-1] == 'all within tolerance'


def test_what_a_diagnosis_said_becomes_motions_that_tell_its_causes_apart():
    table = Table.from_mapping(
        {
            'joints': [
                {'name': name, 'axis': axis}
                for name, axis in (
                    ('outer', [0, 0, 1]),
                    ('middle', [0, 1, 0]),
                    ('inner', [1, 0, 0]),
                )
            ],
            'up': [0, 0, 1],
            'gravity': 9.81,
        }
    )
    model = choose_model(CalibrationOptions(), table)
    values, sd = model.prior()
    known = Calibration(
        model.at(values),
        values,
        np.diag((0.01 * sd) ** 2),
        (DETERMINED,) * len(values),
        'imu_link',
        {},
        provenance={},
    )
    sizes = {
        f'gyroscope.gyro_scale_asymmetry.{axis}': size
        for axis, size in zip('xyz', (2e-3, -2e-3, 2e-3), strict=True)
    }
    wider = with_finding(known, ('gyroscope', 'gyro_scale_asymmetry'), sizes)
    part = wider.model.slices['gyroscope', 'gyro_scale_asymmetry']
    np.testing.assert_array_equal(wider.values[part], [2e-3, -2e-3, 2e-3])
    places = [wider.param_names.index(name) for name in known.param_names]
    np.testing.assert_array_equal(wider.covariance[np.ix_(places, places)], known.covariance)
    noise = noise_of_grade(GRADES['industrial'].noise, 100.0)
    finding = CollinearFinding('gyro_scale_asymmetry', ('gyro_quadratic',), sizes)
    separator, motions, position = separator_of(table, known, finding, noise=noise), [], np.zeros(3)
    while (step := separator.next_motion(position)).motion is not None and len(motions) < 40:
        motions.append(step.motion)
        position = step.motion.points(position).position[-1]
    assert 0 < len(motions) < 40  # and it ends by itself
    mate = {
        f'gyroscope.gyro_quadratic.{axis}': size
        for axis, size in zip('xyz', (1e-3, -1e-3, 1e-3), strict=True)
    }
    told = separator_of(
        table,
        known,
        CollinearFinding('gyro_scale_asymmetry', ('gyro_quadratic',), sizes | mate),
        noise=noise,
    ).problem
    imitating = separator.problem.goal.causes[1]
    quadratic = (
        told.goal.causes[1].size
        * told.coordinates.units[told.coordinates.model.slices['gyroscope', 'gyro_quadratic']]
    )
    # As the diagnosis says, not as a usual session would have it.
    np.testing.assert_allclose(quadratic, [1e-3, -1e-3, 1e-3])
    assert not np.allclose(told.goal.causes[1].size, imitating.size, rtol=0.1)
    with refused(InputError, 'effect_unknown', 'gremlins'):
        separator_of(table, known, CollinearFinding('gyro_quadratic', ('gremlins',)), noise=noise)


def test_of_joints_that_move_alike_the_one_that_stands_still_is_named():
    points = TrajectoryPoints(
        ('outer', 'middle', 'inner'),
        np.array([2.0]),
        np.full((1, 3), 0.1),
        np.zeros((1, 3)),
        np.zeros((1, 3)),
    )
    watch = PathWatch(np.zeros(3), points, np.full(3, 0.06))
    # Outer and inner arrive, middle does not move; half of the way is within the tolerance.
    for time in np.arange(0.0, 6.0, 0.05):
        part = 0.1 * min(time / 2.0, 1.0)
        watch.observe(time, np.array([part, 0.0, part]), now=time)
    assert not watch.has_strayed and watch.has_stalled_for > 1.0 and watch.hindered_joint() == 1


def test_after_a_motion_there_and_back_the_joint_that_never_moved_is_named():
    points = TrajectoryPoints(
        ('outer', 'middle', 'inner'),
        np.array([2.0, 4.0]),
        np.array([[0.1] * 3, [0.0] * 3]),
        np.zeros((2, 3)),
        np.zeros((2, 3)),
    )
    watch = PathWatch(np.zeros(3), points, np.full(3, 0.06))
    for time in np.arange(0.0, 9.0, 0.05):
        part = 0.1 * max(1.0 - abs(time / 2.0 - 1.0), 0.0)
        watch.observe(time, np.array([part, 0.0, part]), now=time)
    assert watch.hindered_joint() == 1
