"""The live demonstration, in its short form, calibrates and improves another motion."""

import re
import subprocess
import sys

import pytest

pytest.importorskip('rclpy')
from ros.live_station import free_domain
from ros.workspace import ROOT

pytestmark = [pytest.mark.slow, pytest.mark.live]


def test_the_smallest_live_demonstration_reduces_the_errors(tmp_path):
    domain_id, lock = free_domain()
    command = [sys.executable, ROOT / 'examples/live_demo.py', '--smallest']
    try:
        done = subprocess.run(
            [*command, '--domain-id', str(domain_id), '--output', tmp_path],
            capture_output=True,
            text=True,
            timeout=300,
        )
    finally:
        lock.close()
    assert done.returncode == 0, done.stdout + done.stderr
    rows = dict(re.findall(r'(before|after) +accelerometer +([\d.]+) mg', done.stdout))
    assert float(rows['after']) < 0.2 * float(rows['before']), done.stdout
    assert (tmp_path / 'live_demo.png').is_file()
