"""planner_node over DDS, its ways to command joints, and what goes wrong with a table."""

import sys
import threading
import time
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import yaml
from refusal import refused

from imu_calibration.core.errors import InputError
from imu_calibration.core.settings import override
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.kinematics.motion_limits import TrajectoryPoints
from imu_calibration.nodes import joint_commands
from imu_calibration.nodes.planner_node import MID_MOTION, PlannerNodeSettings
from imu_calibration.nodes.planner_worker import (
    Activity,
    Peers,
    PlannerWorker,
    findings_from,
)
from imu_calibration.planning.campaign import CollinearFinding
from imu_calibration.planning.driver import DriverSettings, DriveState
from imu_calibration.references.turntable.live_diagnosis import FOUND

from ros.live_station import ROOT, TABLE, Station
from ros.one_process import OneProcess
from ros.threads import until
from worlds.compensation_cases import random_calibration

NAMES = ('outer', 'inner')
FEW_PARAMETERS = {'accelerometer_model': 'bias+matrix', 'gyroscope_model': 'bias+matrix'}
POINTS = TrajectoryPoints(
    NAMES, np.array([1.0]), np.array([[0.1, 0.2]]), np.zeros((1, 2)), np.zeros((1, 2))
)


def test_findings_are_read_from_the_values_of_the_status():
    told = {
        'outcome': str(FOUND),
        'effect': 'gyro_quadratic',
        'mates of gyro_quadratic': 'gyro_scale_asymmetry gyro_rate_product',
        'size of gyro_quadratic.gyroscope.gyro_quadratic.x': '0.001',
        'size of gyro_rate_product.gyroscope.gyro_rate_product.xyz': '0.5',
        'mates of time_offset': '',
        'size of time_offset.t': '-2e-05',
        'x': '0.001 +- 0.1 s/rad',
    }
    sizes = {'gyroscope.gyro_quadratic.x': 1e-3, 'gyroscope.gyro_rate_product.xyz': 0.5}
    assert findings_from(told) == [
        CollinearFinding('gyro_quadratic', ('gyro_scale_asymmetry', 'gyro_rate_product'), sizes),
        CollinearFinding('time_offset', (), {'t': -2e-5}),
    ]
    assert findings_from(told | {'outcome': 'nothing found'}) == findings_from({}) == []


class Future:
    """Stands for a future of rclpy: answered when the test says so."""

    def __init__(self):
        self.answer, self._then = None, []

    def add_done_callback(self, then):
        self._then.append(then)

    def done(self, answer):
        self.answer = answer
        for then in self._then:
            then(self)

    def result(self):
        return self.answer


class Goal:
    """Stands for a goal handle."""

    def __init__(self, accepted=True):
        self.accepted, self.cancelled, self.ended, self.goal_id = (
            accepted,
            0,
            Future(),
            SimpleNamespace(uuid=bytes(16)),
        )

    def cancel_goal_async(self):
        self.cancelled += 1

    def get_result_async(self):
        return self.ended


class Action:
    """
    Stands for ``rclpy.action.ActionClient``.

    Control_msgs is not on PyPI, so no server of its action can be run here.
    """

    def __init__(self, *_):
        self.goals, self.futures = [], []

    def server_is_ready(self):
        return True

    def send_goal_async(self, goal):
        self.goals.append(goal)
        self.futures.append(Future())
        return self.futures[-1]


@pytest.fixture
def action(monkeypatch):
    """
    An ActionCommand with a stand-in for control_msgs and its server.

    It also holds the messages sent to the topic, and the complaints.
    """
    package, module = ModuleType('control_msgs'), ModuleType('control_msgs.action')
    module.FollowJointTrajectory = SimpleNamespace(
        Goal=lambda trajectory: SimpleNamespace(trajectory=trajectory)
    )
    monkeypatch.setitem(sys.modules, 'control_msgs', package)
    monkeypatch.setitem(sys.modules, 'control_msgs.action', module)
    monkeypatch.setattr('rclpy.action.ActionClient', Action)
    sent, complaints = [], []
    publisher = SimpleNamespace(
        publish=sent.append, topic_name='/joint_trajectory', get_subscription_count=lambda: 1
    )
    node = SimpleNamespace(create_publisher=lambda *_: publisher)
    return joint_commands.make_command(node, 'action', complaints.append), sent, complaints


def test_a_goal_holds_the_trajectory_and_its_end_is_told_in_words(action):
    command, sent, complaints = action
    command.send(POINTS)
    trajectory = command._client.goals[0].trajectory
    assert (
        list(trajectory.joint_names) == list(NAMES)
        and list(trajectory.points[0].positions) == [0.1, 0.2]
        and not sent
    )
    goal = Goal()
    command._client.futures[0].done(goal)
    goal.ended.done(
        SimpleNamespace(result=SimpleNamespace(error_code=-4, error_string='inner is late'))
    )
    assert complaints == ['a joint left the path (inner is late)']
    command.send(POINTS)
    command._client.futures[1].done(Goal(accepted=False))
    assert complaints[1:] == ['it refused the goal']
    command.send(POINTS)
    command._client.futures[2].done(goal := Goal())
    goal.ended.done(SimpleNamespace(result=SimpleNamespace(error_code=0, error_string='')))
    assert len(complaints) == 2


def test_a_stop_cancels_the_goal_and_empties_the_topic_whenever_it_comes(action):
    command, sent, complaints = action
    command.send(POINTS)
    command.stop(NAMES)  # before the server has answered
    command._client.futures[0].done(early := Goal())
    command.send(POINTS)
    command._client.futures[1].done(late := Goal())
    command.stop(NAMES)
    late.ended.done(SimpleNamespace(result=SimpleNamespace(error_code=-4, error_string='')))
    assert early.cancelled == late.cancelled == 1 and len(sent) == 2 and complaints == []
    assert sent[0] == joint_commands.encode_trajectory(TrajectoryPoints.stop(NAMES))


def test_an_action_without_control_msgs_is_refused_and_auto_takes_the_topic(monkeypatch):
    monkeypatch.setitem(sys.modules, 'control_msgs', None)
    node = SimpleNamespace(
        create_publisher=lambda *_: SimpleNamespace(topic_name='/joint_trajectory')
    )
    with refused(InputError, 'package_missing', 'control_msgs'):
        joint_commands.make_command(node, 'action', print)
    assert isinstance(joint_commands.make_command(node, 'auto', print), joint_commands.TopicCommand)
    with refused(InputError, 'choice_unknown', 'command', 'topic', 'action', 'auto'):
        override(PlannerNodeSettings(), {'command': 'telepathy'})


class Table:
    """Stands for the driver: joints that rest when the test says so."""

    def __init__(self, patience):
        self.settings, self.state, self.rests, self.is_driving, self.reason = (
            DriverSettings(settling_patience=patience),
            DriveState.IDLE,
            False,
            False,
            '',
        )
        self.position, self.motions, self.began, self.awaits_stop, self.silent = (
            np.zeros(2),
            0,
            [],
            False,
            False,
        )

    def start(self):
        self.state = DriveState.IDLE

    def is_silent(self, now):
        return self.silent

    def stamp_fault(self, now):
        return ''

    def begin(self, points, words, now):
        self.began.append(words)
        self.is_driving = True
        return points

    def stop(self, why):
        self.state, self.reason = DriveState.STOPPED, why


def working(patience):
    """A worker that is asked for a motion, its driver, and what it tells people."""
    said, driver = [], Table(patience)
    motion = SimpleNamespace(words='turn', points=lambda position: POINTS)
    campaign = SimpleNamespace(
        decide=lambda position, elapsed: SimpleNamespace(
            diagnose=False, motion=motion, why='it helps'
        ),
        worst=('', 0.0),
        planner=SimpleNamespace(excess={}),
    )
    worker = PlannerWorker(
        driver,
        lambda: campaign,
        lock=threading.RLock(),
        peers=Peers(
            None,
            None,
            None,
            said.append,
            lambda: said.append('stop'),
            lambda level, line: said.append(line),
        ),
    )
    worker.go(-1)
    worker.start()
    return worker, driver, said


def test_the_worker_waits_until_the_joints_rest_and_not_for_ever():
    worker, driver, said = working(60.0)
    until(lambda: worker.doing == Activity.AWAITING_REST, 'the wait')
    assert not driver.began and not said
    driver.rests = True
    until(lambda: said[1:], 'what it says')
    worker.end()
    assert (
        driver.began == ['turn']
        and said[0] is POINTS
        and 'turn' in said[1]
        and 'it helps' in said[1]
    )
    worker, driver, said = working(0.5)
    until(lambda: said[1:], 'what it says')
    worker.end()
    assert not driver.began and said[0] == 'stop' and '0.5 s' in said[1] and len(said) == 2
    worker, driver, said = working(0.5)
    driver.awaits_stop = (
        True  # nobody moves the joints: the controller may be late, which is not complained of
    )
    until(lambda: worker.doing == Activity.AWAITING_STOP, 'the wait for the stop')
    time.sleep(1.0)
    assert not said and not driver.began
    driver.silent = True  # but no joint states at all are
    until(lambda: said[1:], 'what it says')
    worker.end()
    assert '0.5 s' in said[1] and not driver.began
    worker, driver, said = working(60.0)
    until(lambda: worker.doing == Activity.AWAITING_REST, 'the wait')
    worker.halt('stopped by hand')  # while it waits
    driver.rests = True
    time.sleep(0.2)
    worker.end()
    assert not driver.began and said == ['stop']


@pytest.mark.live
def test_joint_states_that_came_while_it_was_busy_are_all_taken_at_once(monkeypatch):
    from sensor_msgs.msg import JointState

    from imu_calibration.nodes.inputs import output_qos
    from imu_calibration.nodes.planner_node import PlannerNode

    with OneProcess(monkeypatch) as bench:
        planner = bench.start(PlannerNode, {'table_file': str(TABLE)})
        publisher = bench.node.create_publisher(JointState, 'joint_states', output_qos())
        bench.until(lambda: publisher.get_subscription_count() == 1, 'the connection')
        for k in range(300):
            publisher.publish(
                JointState(name=['inner', 'middle', 'outer'], position=[0.001 * k, 0.0, 0.0])
            )
        time.sleep(1.0)  # as while it plans
        bench.until(lambda: planner.driver.position is not None, 'joint states')
        np.testing.assert_allclose(planner.driver.position, [0.0, 0.0, 0.299])


class Loop(Station):
    """A simulated table, calibration_node and planner_node."""

    def begin(self, folder, planner=None, calibration=None, **simulator):
        """Start the three nodes and wait until they know each other."""
        self.watch_diagnostics()
        self.calibration_node(folder, **(calibration or {}))
        self.simulator = self.start(
            'simulator_node',
            {
                'table_file': TABLE,
                'profile': 'none',
                'time_factor': 4.0,
                'imu_rate': 25.0,
                'joint_rate': 25.0,
                'seed': 3,
                'imu_seed': 5,
                'start_time': 1.8e9,
                **simulator,
            },
        )
        self.planner = self.start(
            'planner_node',
            {'table_file': TABLE, 'first_speed': 1.0, 'imu_rate': 25.0, **(planner or {})},
        )
        self.until(
            lambda: 'simulator_node: table' in self.status and 'planner_node: drive' in self.status,
            'the nodes',
        )
        return self

    def ask(self, what):
        """Call a service of the planner until it takes it: discovery takes its time."""
        answers = []
        self.until(
            lambda: answers.append(self.call(f'/planner_node/{what}')) or answers[-1].success, what
        )
        return answers[-1].message

    def drive(self):
        """Return what the planner says."""
        return self.status['planner_node: drive'].message

    def told(self, key):
        """Return a figure of the planner, '' before it is told."""
        return next(
            (pair.value for pair in self.status['planner_node: drive'].values if pair.key == key),
            '',
        )

    def value(self, key):
        """Return a figure of the planner."""
        return next(
            pair.value for pair in self.status['planner_node: drive'].values if pair.key == key
        )


def write_tolerances(path, factor):
    """Write the usual tolerances times a factor, and return the path."""
    tolerances = yaml.safe_load((ROOT / 'config' / 'tolerances.yaml').read_text())
    path.write_text(
        yaml.safe_dump(
            {
                sensor: {name: factor * value for name, value in each.items()}
                for sensor, each in tolerances.items()
            }
        )
    )
    return path


@pytest.mark.live
@pytest.mark.long
def test_the_planner_drives_until_every_parameter_is_within_its_tolerance(tmp_path):
    # An IMU without errors beyond the model: then noise is the limit, and motion reduces it.
    truth = tmp_path / 'truth.yaml'
    truth.write_text(calibration_to_text(random_calibration(1, accelerometer=())))
    with Loop(tmp_path / 'out.txt') as loop:
        loop.begin(
            tmp_path,
            {
                'tolerances_file': write_tolerances(tmp_path / 'tolerances.yaml', 10.0),
                # A busy machine delays joint states; other tests have the silence and the stall.
                'silence': 10.0,
                'stall_patience': 15.0,
                **FEW_PARAMETERS,
            },
            # The only diagnosis is that which the planner requests.
            FEW_PARAMETERS
            | {'model_as_asked': True, 'diagnosis_period': 600.0, 'candidates': 'none'},
            calibration_file=truth,
        )
        loop.spin_for(1.0)
        # Nothing moves before start.
        assert loop.value('state') == 'idle' and loop.value('motion') == '0'
        loop.ask('next')
        loop.until(
            lambda: loop.value('motion') == '1' and loop.value('state') == 'idle',
            'the end of one motion',
        )
        loop.ask('start')
        loop.until(lambda: loop.value('state') in ('done', 'stopped'), 'the end', 180.0)
        assert loop.value('state') == 'done' and int(loop.value('motion')) >= 3, loop.drive()
        assert loop.value('outside tolerance') == '0', loop.drive()
        documents = loop.watch_documents()
        loop.until(lambda: documents, 'the calibration')
        loop.until(
            lambda: loop.figure('diagnoses', 'calibration_node: diagnosis') > 0,
            'the diagnosis before the end',
        )
        assert loop.processes.end(loop.planner) == 0
    assert 'Traceback' not in (tmp_path / 'out.txt').read_text()


@pytest.mark.long
@pytest.mark.live
@pytest.mark.parametrize(
    'fault', [{'refuse_after': 0}, {'stall_joint': 'middle', 'stall_time': 0.0}]
)
def test_a_table_that_refuses_or_stalls_ends_everything_with_one_sentence(tmp_path, fault):
    with Loop(tmp_path / 'out.txt') as loop:
        # Large enough for a joint that stands still to be noticed.
        loop.begin(tmp_path, {'first_reach': 0.5}, **fault)
        loop.ask('start')
        loop.until(lambda: loop.value('state') == 'stopped', 'the stop')
        assert loop.status['planner_node: drive'].level == b'\x02', loop.drive()
        loop.spin_for(1.0)
        assert loop.value('state') == 'stopped'  # and nothing goes on


@pytest.mark.long
@pytest.mark.live
def test_a_stop_in_mid_motion_and_joint_states_that_fall_silent_leave_nothing_moving(tmp_path):
    from sensor_msgs.msg import JointState

    with Loop(tmp_path / 'out.txt') as loop:
        # A slow motion of slow joints, so that it is long enough to be stopped in.
        slow = {'speed_deg_s': 15.0, 'acceleration_deg_s2': 30.0}
        table = yaml.safe_load(TABLE.read_text())
        table['joints'] = [joint | slow for joint in table['joints']]
        path = tmp_path / 'slow.yaml'
        path.write_text(yaml.safe_dump(table))
        # The controller begins and stops late. Few parameters and a small range, because the
        # second motion is planned.
        loop.begin(
            tmp_path,
            {
                'table_file': path,
                'stall_patience': 6.0,
                'silence': 6.0,
                'first_reach': 1.0,
                'first_speed': 0.25,
                'reach_deg': 60.0,
                **FEW_PARAMETERS,
            },
            FEW_PARAMETERS | {'model_as_asked': True, 'diagnosis_period': 0.0},
            table_file=path,
            lag=0.8,
            time_factor=2.0,
        )
        places = []
        loop.node.create_subscription(
            JointState, 'joint_states', lambda message: places.append(list(message.position)), 1000
        )

        def away():
            """The largest angle from where the joints were at first, rad."""
            return np.abs(np.subtract(places[-1], places[0])).max() if places else 0.0

        loop.ask('start')
        loop.until(lambda: loop.value('state') == 'moving' and away() > 0.05, 'the first motion')
        assert loop.call('/planner_node/stop').success
        loop.until(lambda: len(places) > 100 and np.ptp(places[-50:], axis=0).max() == 0.0, 'rest')
        loop.until(
            lambda: loop.value('state') == 'stopped' and '~/stop' in loop.drive(), 'the stop'
        )
        # The first motion ends where it began; it was stopped on the way.
        assert away() > 0.05
        assert loop.call('/planner_node/stop').success  # twice is no harm
        loop.ask('start')  # goes on with what is known; slowly at first
        loop.until(lambda: loop.value('state') == 'moving', 'another motion')
        loop.processes.end(loop.simulator)
        loop.until(
            lambda: loop.value('state') == 'stopped' and '~/stop' not in loop.drive(), 'the silence'
        )


@pytest.mark.live
@pytest.mark.long
def test_a_class_of_effects_after_six_faces_is_separated_and_an_ending_node_stops_all_motion(
    tmp_path,
):
    from sensor_msgs.msg import JointState
    from visualization_msgs.msg import MarkerArray

    from imu_calibration.nodes.inputs import latched_qos

    with Loop(tmp_path / 'out.txt') as loop:
        # Tolerances that the six faces reach: the diagnosis follows at once, and no motion for a
        # parameter separates the class before.
        wide = write_tolerances(tmp_path / 'wide.yaml', 1e4)
        arms = {'accelerometer_model': 'bias+matrix+accel_size_effect'}
        loop.begin(
            tmp_path,
            {
                'stall_patience': 30.0,
                'silence': 10.0,
                'first_speed': 0.1,
                'tolerances_file': wide,
                **arms,
            },
            arms
            | {
                'model_as_asked': True,
                'diagnosis_period': 600.0,
                'candidates': 'accel_quadratic+accel_scale_asymmetry+gyro_g_sensitivity',
            },
            profile='six_faces',
            hide='soft_spring',
            hide_size=1.8,
            seed=1,
            time_factor=5.0,
            wait_for_subscribers=1,
        )
        places, words = [], []
        loop.node.create_subscription(
            MarkerArray,
            'imu/coverage',
            lambda m: words.extend(
                each.text for each in m.markers if each.ns == 'driven' and each.text
            ),
            latched_qos(),
        )
        ear = loop.node.create_subscription(
            JointState, 'joint_states', lambda m: places.append(m.header.stamp.sec), 1000
        )
        loop.until(lambda: places and places[-1] > 1.8e9 + 64, 'the end of the six faces')
        loop.node.destroy_subscription(ear)  # messages that nobody needs
        # It drives nothing before it asks: the class does not depend on how busy the machine is.
        loop.ask('start')
        loop.until(
            lambda: loop.told('separating') == 'True' and loop.value('state') == 'moving',
            'the separating motion',
        )
        assert {loop.value('found').split()[-1], *loop.value('mates').split()} == {
            'accel_quadratic',
            'accel_scale_asymmetry',
        }
        assert loop.value('separations') == '1'
        loop.until(
            lambda: words and f' {loop.value("motion")}:' in words[-1], 'the picture of the motion'
        )
        places.clear()
        loop.node.create_subscription(
            JointState, 'joint_states', lambda m: places.append(list(m.position)), 1000
        )
        loop.until(lambda: len(places) > 20 and np.ptp(places[-20:], axis=0).max() > 0.02, 'motion')
        assert loop.processes.end(loop.planner) == 0
        loop.until(lambda: np.ptp(places[-100:], axis=0).max() == 0.0, 'rest')
    said = (tmp_path / 'out.txt').read_text()
    assert MID_MOTION in said and 'Traceback' not in said
