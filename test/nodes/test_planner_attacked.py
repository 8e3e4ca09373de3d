"""planner_node attacked over DDS: what is not known, not finite, not alone or not true stops the joints or keeps them from moving."""

import pytest

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
