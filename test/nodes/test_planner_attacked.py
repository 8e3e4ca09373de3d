"""planner_node attacked over DDS: what is not known, not finite, not alone or not true stops the joints or keeps them from moving."""

import time

import pytest

from imu_calibration.driving.driver import DriveState

pytest.importorskip('rclpy')
from ros.planner_bench import PlannerBench  # noqa: E402

pytestmark = pytest.mark.dds


@pytest.fixture
def bench(monkeypatch, tmp_path):
    """Make benches, and close them."""
    made = []

    def make(*arguments, **parameters):
        made.append(PlannerBench(monkeypatch, tmp_path, *arguments, **parameters))
        return made[-1]
    yield make
    for each in made:
        each.close()


def test_joints_without_a_range_are_not_moved(bench):
    table = bench({})
    table.looks(lambda: table.planner.driver.position is not None, 'the joints')
    for what in ('start', 'next'):
        answer = table.ask(what)
        assert not answer.success and 'outer, inner' in answer.message and 'range_deg' in answer.message
    assert not table.trajectories and table.heard('every joint must have a range', 'warning') == 1


def test_start_answers_with_every_limit_and_its_origin(bench):
    table = bench({'endless': True, 'speed_deg_s': 90.0}, max_turns=2.0)
    assert table.heard('outer: endless (table file), 90 deg/s (table file), 300 deg/s^2 (default)') == 1
    table.looks(lambda: table.planner.driver.position is not None, 'the joints')
    answer = table.ask('next')
    assert answer.success and 'inner: endless, here -720 to 720 deg (table file), 90 deg/s (table file)' in answer.message


def test_positions_that_are_not_finite_are_ignored_and_counted_by_joint(bench):
    table = bench().moving()
    for value in (float('nan'), float('inf')):
        table.position[1] = value
        for _ in range(3):
            table.look()
    table.position[1] = 0.0
    table.rate = [float('nan'), float('inf')]   # not measured, which is usual
    seen = table.planner.driver._heard
    table.looks(lambda: table.planner.driver._heard > seen, 'the next joint state')
    assert table.planner.driver.ignored == {'inner': 6} and table.planner.driver.state is DriveState.MOVING
    assert table.heard('ignored because a position was not finite: inner', 'warning') == 1
    table.looks(lambda: table.figure('planner_node: drive', 'ignored joint states') == 'inner:6', 'the count')


def test_nothing_but_positions_that_are_not_finite_keeps_the_joints_where_they_are(bench):
    table = bench()
    table.position[:] = float('nan')
    table.looks(lambda: len(table.planner.driver.ignored) == 2, 'joint states')
    answer = table.ask('start')
    assert not answer.success and 'outer' in answer.message and 'not finite' in answer.message


@pytest.mark.parametrize('callback', ['observe', 'tick'])
def test_an_exception_in_a_callback_stops_the_joints_and_the_node_goes_on(bench, monkeypatch, callback):
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
    table = bench(silence=0.4, stall_patience=60.0).moving()
    began = time.monotonic()
    table.looks(lambda: table.planner.driver.state is DriveState.STOPPED, 'the stop', elapsed=0.0)
    assert time.monotonic() - began >= 0.4 and 'stamps of the joint states' in table.planner.driver.reason
    table.looks(lambda: not table.trajectories[-1].points, 'the empty trajectory', elapsed=0.0)
    answer = table.ask('start', elapsed=0.0)
    assert not answer.success and 'stamps of the joint states' in answer.message
