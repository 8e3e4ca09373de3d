"""
planner_node attacked over DDS.

What is not known, not finite, not alone or not true stops the joints or keeps them from moving.
"""

import time
from contextlib import ExitStack

import numpy as np
import pytest
from action_msgs.msg import GoalStatus, GoalStatusArray
from rclpy.qos import qos_profile_action_status_default
from trajectory_msgs.msg import JointTrajectory

from imu_calibration.nodes.joint_commands import OtherCommanders
from imu_calibration.planning.driver import DriveState

from ros.planner_bench import PlannerBench

pytestmark = pytest.mark.live


@pytest.fixture
def bench(monkeypatch, tmp_path):
    """Make benches, and close them."""
    with ExitStack() as made:
        yield lambda *arguments, **parameters: made.enter_context(
            PlannerBench(monkeypatch, tmp_path, *arguments, **parameters)
        )


def test_joints_without_a_range_are_not_moved(bench):
    table = bench({})
    table.looks(lambda: table.planner.driver.position is not None, 'the joints')
    for what in ('start', 'next'):
        answer = table.ask(what)
        assert (
            not answer.success
            and 'outer, inner' in answer.message
            and 'range_deg' in answer.message
        )
    assert not table.trajectories and table.heard('range_deg', 'outer, inner', level='warning') == 1


def test_start_answers_with_every_limit_and_its_origin(bench):
    table = bench({'endless': True, 'speed_deg_s': 90.0}, max_turns=2.0)
    assert table.heard('outer', 'endless', '90 deg/s', '300 deg/s^2', level='info') == 1
    table.looks(lambda: table.planner.driver.position is not None, 'the joints')
    answer = table.ask('next')
    assert answer.success and all(
        value in answer.message for value in ('inner', 'endless', '-720 to 720 deg', '90 deg/s')
    )


def test_positions_that_are_not_finite_are_ignored_and_counted_by_joint(bench):
    table = bench().moving()
    for value in (float('nan'), float('inf')):
        table.position[1] = value
        for _ in range(3):
            table.look()
    table.position[1] = 0.0
    table.rate = [float('nan'), float('inf')]  # not measured, which is usual
    seen = table.planner.driver._heard_at
    table.looks(lambda: table.planner.driver._heard_at > seen, 'the next joint state')
    assert (
        table.planner.driver.ignored == {'inner': 6}
        and table.planner.driver.state is DriveState.MOVING
    )
    assert table.heard('inner', level='warning') == 1
    table.looks(
        lambda: table.figure('planner_node: drive', 'ignored joint states') == 'inner:6',
        'the count',
    )


def test_nothing_but_positions_that_are_not_finite_keeps_the_joints_where_they_are(bench):
    table = bench()
    table.position[:] = float('nan')
    table.looks(lambda: len(table.planner.driver.ignored) == 2, 'joint states')
    answer = table.ask('start')
    assert not answer.success and 'outer' in answer.message and not table.trajectories


@pytest.mark.parametrize('callback', ['observe', 'tick'])
def test_an_exception_in_a_callback_stops_the_joints_and_the_node_goes_on(
    bench, monkeypatch, callback
):
    table = bench().moving()

    def broken(*_, **__):
        raise ZeroDivisionError('by design')

    with monkeypatch.context() as patch:
        patch.setattr(table.planner.driver, callback, broken)
        table.looks(lambda: table.planner.driver.state is DriveState.STOPPED, 'the stop')
    assert 'ZeroDivisionError' in table.planner.driver.reason
    table.looks(lambda: not table.trajectories[-1].points, 'the empty trajectory')
    table.looks(lambda: table.planner.driver.rests, 'rest')
    assert table.ask('start').success


def test_stamps_that_stand_still_are_a_fault_within_the_silence(bench):
    table = bench(silence=3.0, stall_patience=60.0).moving()
    driver = table.planner.driver
    table.looks(lambda: driver.state is DriveState.STOPPED, 'the stop', elapsed=0.0)
    stopped_at = time.monotonic()
    assert stopped_at - table.advanced_at >= 3.0 and driver.stamp_fault(stopped_at)
    table.looks(lambda: not table.trajectories[-1].points, 'the empty trajectory', elapsed=0.0)
    answer = table.ask('start', elapsed=0.0)
    assert not answer.success and driver.state is DriveState.STOPPED


def test_a_second_publisher_of_trajectories_keeps_the_joints_from_being_driven(bench):
    table = bench()
    table.looks(lambda: table.planner.driver.position is not None, 'the joints')
    other = table.node.create_publisher(JointTrajectory, 'joint_trajectory', 10)
    table.looks(lambda: table.node.count_publishers('joint_trajectory') == 2, 'the other driver')
    for what in ('start', 'next'):
        answer = table.ask(what)
        assert not answer.success and '/tester' in answer.message, answer.message
    table.node.destroy_publisher(other)
    table.looks(lambda: not table.planner._other_commanders.obstacle(), 'its end')
    assert table.ask('next').success


def test_a_goal_of_another_client_keeps_the_joints_from_being_driven(bench):
    table = bench()
    table.looks(lambda: table.planner.driver.position is not None, 'the joints')
    controller = table.node.create_publisher(
        GoalStatusArray, 'follow_joint_trajectory/_action/status', qos_profile_action_status_default
    )
    goal = GoalStatus(status=GoalStatus.STATUS_EXECUTING)
    goal.goal_info.goal_id.uuid = [7] * 16
    controller.publish(GoalStatusArray(status_list=[goal]))
    table.looks(table.planner._other_commanders.obstacle, 'the status')
    answer = table.ask('start')
    assert not answer.success and '/follow_joint_trajectory' in answer.message
    table.planner._command.goals.add(bytes([7] * 16))  # a goal of its own
    assert not table.planner._other_commanders.obstacle()
    table.planner._command.goals.clear()
    goal.status = GoalStatus.STATUS_SUCCEEDED
    controller.publish(GoalStatusArray(status_list=[goal]))
    table.looks(lambda: not table.planner._other_commanders.obstacle(), 'the end of the goal')
    assert table.ask('next').success


def test_another_driver_that_appears_later_stops_before_the_next_motion(bench, monkeypatch):
    answers = ['']  # at ~/next
    monkeypatch.setattr(
        OtherCommanders, 'obstacle', lambda self: answers.pop() if answers else 'there is /rival'
    )
    table = bench(first_reach=0.0)
    table.looks(lambda: table.planner.driver.position is not None, 'the joints')
    assert table.ask('next').success
    table.looks(lambda: table.planner.driver.state is DriveState.STOPPED, 'the stop')
    assert '/rival' in table.planner.driver.reason and not any(
        message.points for message in table.trajectories
    )


def test_the_first_motion_is_small_and_slow_and_says_that_collisions_are_not_checked(bench):
    table = bench(reach_deg=30.0)
    assert table.heard('collisions', level='info') == 1
    table.position[:] = 0.5, -0.2
    table.moving()
    points = next(message.points for message in table.trajectories if message.points)
    position = np.array([point.positions for point in points]) - table.position
    np.testing.assert_allclose(np.abs(position).max(axis=0), 0.1, atol=1e-9)
    np.testing.assert_allclose(position[-1], 0.0, atol=1e-9)
    assert np.abs([point.velocities for point in points]).max() <= 0.3 * np.radians(100.0)
    limits = table.planner.driver.limits
    np.testing.assert_allclose(
        [limits.lower, limits.upper], np.add.outer(np.radians([-30, 30]), table.position)
    )
