"""The loop that leans on inner parts of rclpy knows when they are missing."""

import os
from pathlib import Path

import pytest

from imu_calibration.nodes import relay_loop


def test_the_inner_parts_are_there():
    assert relay_loop.available()


@pytest.mark.parametrize('missing', ['WaitSet', 'Subscription', 'Publisher'])
def test_a_missing_part_is_noticed(monkeypatch, missing):
    class Some:
        """rclpy's inner module without one of its parts."""

    for name in {'WaitSet', 'Subscription', 'Publisher'} - {missing}:
        setattr(Some, name, getattr(relay_loop._inner, name))
    monkeypatch.setattr(relay_loop, '_inner', Some)
    assert not relay_loop.available()


def test_no_inner_module_at_all_is_noticed(monkeypatch):
    monkeypatch.setattr(relay_loop, '_inner', None)
    assert not relay_loop.available()


def test_the_executor_never_takes_what_the_loop_reads():
    group = relay_loop.OutsideExecutor()
    assert not group.can_execute(object()) and not group.beginning_execution(object())


@pytest.mark.live
def test_the_ends_of_the_benchmark_still_fit_the_loop(monkeypatch):
    """They lean on it as the compensator does; nothing else runs them."""
    monkeypatch.syspath_prepend(Path(__file__).resolve().parents[2])
    from benchmarks.bench_compensator import Ends

    from ros.live_station import STAY_LOCAL, free_domain

    domain_id, lock = free_domain()
    ends = Ends(os.environ | STAY_LOCAL | {'ROS_DOMAIN_ID': str(domain_id)})
    try:
        for _ in range(2):  # the processes measure again
            sent, came, _ = ends.run_once('/bench_direct', '/bench_direct', 100.0, 0.5)
            assert sent['sent'] == came['came'] == 50
            assert came['doubled'] == 0 and 0 < came['late_us'][50]
    finally:
        ends.stop()
        lock.close()
