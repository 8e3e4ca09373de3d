"""The live demonstration, in its short form, calibrates and improves another motion."""

import re

import pytest

pytest.importorskip('rclpy')
from examples import live_demo

from ros.forked_nodes import ForkedNodes
from ros.live_station import free_domain

pytestmark = [pytest.mark.slow, pytest.mark.live]


def test_the_smallest_live_demonstration_reduces_the_errors(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(live_demo, 'NodeProcesses', ForkedNodes)
    domain_id, lock = free_domain()
    # The demonstration sets both; they get their values of before when the test ends.
    monkeypatch.setenv('ROS_DOMAIN_ID', str(domain_id))
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    try:
        code = live_demo.main(
            ['--smallest', '--domain-id', str(domain_id), '--output', str(tmp_path)]
        )
    finally:
        lock.close()
    shown = capsys.readouterr()
    assert code == 0, shown.out + shown.err
    rows = dict(re.findall(r'(before|after) +accelerometer +([\d.]+) mg', shown.out))
    assert float(rows['after']) < 0.2 * float(rows['before']), shown.out
    assert (tmp_path / 'live_demo.png').is_file()
