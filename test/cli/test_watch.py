"""
`imu_calibration watch`: bars in units of tolerance, in 80 columns, from a node that runs.

Ends with it.
"""

import io
import math
import os
import pty
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from imu_calibration.cli import watch
from imu_calibration.cli.terminal import Terminal
from imu_calibration.cli.watch import BAR, NodeStatus, NodeWatcher, bar, ratio_of, screen
from imu_calibration.core.errors import InputError

STATUSES = {
    'streams': NodeStatus(0, 'Imu messages come', {}),
    'calibration': NodeStatus(1, 'weak; accelerometer.bias.x: 3 mg', {}),
    'diagnosis': NodeStatus(
        1, 'gyro_g_sensitivity: the gyroscopes respond to specific force; more', {}
    ),
    'accelerometer accel_size_effect': NodeStatus(
        1, 'weak', {'standard error [m]': '0.005', 'tolerance [m]': '0.001', 'needs': 'spin'}
    ),
    'gyroscope bias': NodeStatus(
        0, 'determined', {'standard error [rad/s]': '1e-05', 'tolerance [rad/s]': '0.0001'}
    ),
    'gyroscope matrix': NodeStatus(0, 'no solution yet', {'parameter': 'x'}),
}


def shown(statuses=STATUSES, picture='hold it still with +x -y up, about 25 s left', width=80):
    """What stands on a terminal."""
    out = io.StringIO()
    terminal = Terminal(out, width)
    terminal.write(screen('calibration_node', statuses, picture, out=terminal))
    return out.getvalue()


def test_a_bar_shrinks_to_the_tick_and_below_it():
    ratios = [1000, 100, 10, 1, 0.3, 0.01]
    lengths = [bar(ratio).count('#') for ratio in ratios]
    assert (
        lengths == sorted(lengths, reverse=True)
        and lengths[-1] == 0
        and len({len(bar(ratio)) for ratio in ratios}) == 1
    )
    assert (
        bar(1.0).index('|') == bar(1.0).count('#')
        and bar(1e9) == bar(1000)
        and '?' in bar(math.nan)
    )


def test_ratios_are_those_of_the_node():
    assert ratio_of(STATUSES['accelerometer accel_size_effect']) == pytest.approx(5.0)
    assert math.isnan(ratio_of(STATUSES['gyroscope matrix'])) and math.isnan(
        ratio_of(NodeStatus(0, '', {'standard error [m]': 'x', 'tolerance [m]': '1'}))
    )


def test_everything_that_counts_stands_in_80_columns():
    text = shown()
    assert max(map(len, text.splitlines())) <= 80
    for words in (
        'calibration_node',
        'streams  Imu messages come',
        'verdict  weak',
        'finding  gyro_g_sensitivity',
        'accel. accel_size_effect',
        ' 5',
        'next  hold it still with +x -y up, about 25 s left',
    ):
        assert words in text, text
    assert '; more' not in text and text.count('|') >= 3 and BAR > 10


def test_before_anything_came_the_screen_is_short():
    assert shown({'streams': NodeStatus(2, 'no Imu messages come')}, '').strip().splitlines() == [
        'calibration_node',
        'streams  no Imu messages come',
    ]


class LateNode(NodeWatcher):
    """
    Stands for a watcher: the node starts at a time of a clock, and ends a second later.

    It has states of its streams from a later time on.
    """

    name, others, picture = 'calibration_node', set(), 'hold it still'

    def __init__(self, start, streams):
        self.now, self.start, self.streams = 0.0, start, streams
        self.heard, self.statuses = 0.0, {}

    def spin(self, seconds):
        self.now += seconds
        if self.start <= self.now <= max(self.start, self.streams) + 1.0:
            self.heard = self.now
            for name, status in STATUSES.items():
                if name != 'streams' or self.now >= self.streams:
                    self.statuses[name] = status


def watched(monkeypatch, start, streams=0.0, **options):
    """Watch a LateNode; return (result or code of the error, its clock at the end)."""
    node = LateNode(start, streams)
    monkeypatch.setattr(watch, 'time', SimpleNamespace(monotonic=lambda: node.now))
    given = {'node': node.name, 'patience': None, 'once': False, 'json': False} | options
    try:
        return watch._watch(node, SimpleNamespace(**given)), node.now
    except InputError:
        return None, node.now


def test_it_waits_for_its_node(monkeypatch, capsys):
    found, end = watched(monkeypatch, 600.0)
    assert found.exit_code == 0 and 600.0 < end < 620.0
    assert capsys.readouterr().err.count('calibration_node') == 1  # the missing node, once
    for options, limit in (
        ({'once': True}, 10.0),
        ({'json': True}, 10.0),
        ({'patience': 50.0}, 50),
    ):
        assert watched(monkeypatch, 600.0, **options) == (None, limit)
    found, end = watched(monkeypatch, 5.0, once=True)
    assert found.exit_code == 0 and end <= 16.0


def test_once_it_waits_for_the_line_of_the_streams(monkeypatch):
    for streams, patience in ((8.0, None), (40.0, 60.0)):
        found, end = watched(monkeypatch, 5.0, streams, once=True, patience=patience)
        assert 'streams' in found.document['status'] and end < streams + 1.0
    found, end = watched(monkeypatch, 5.0, 100.0, once=True)
    assert 'streams' not in found.document['status'] and end <= 16.0


@pytest.mark.long
@pytest.mark.live
def test_it_watches_a_running_node_and_ends_with_it(tmp_path):
    pytest.importorskip('rclpy')
    from examples.processes import local_environment, node_command

    from ros.forked_nodes import ForkedNode
    from ros.live_station import TABLE, free_domain

    domain_id, lock = free_domain()
    environment = local_environment(domain_id) | {'COLUMNS': '80', 'LINES': '40', 'TERM': 'xterm'}
    command = [sys.executable, '-m', 'imu_calibration', 'watch']
    nobody = subprocess.run(
        [*command, '--patience', '1'], env=environment, capture_output=True, text=True, timeout=60
    )
    assert (
        nobody.returncode == 1
        and "'calibration_node' must run" in nobody.stderr
        and nobody.stderr.count('\n') == 1
    )
    nodes = [
        ForkedNode(node_command(name, parameters), environment, os.devnull)
        for name, parameters in (
            (
                'simulator_node',
                {'profile': 'quick', 'time_factor': 8.0, 'imu_rate': 25.0, 'joint_rate': 25.0},
            ),
            ('calibration_node', {'table_file': str(TABLE), 'diagnosis_period': 0.0}),
        )
    ]
    try:
        once = subprocess.run(
            [*command, '--once', '--patience', '60'],
            env=environment,
            capture_output=True,
            text=True,
            timeout=90,
        )
        assert once.returncode == 0 and 'streams' in once.stdout and '|' in once.stdout, once
        screen_end, terminal = pty.openpty()
        with subprocess.Popen(
            command, env=environment, stdin=subprocess.DEVNULL, stdout=terminal, stderr=terminal
        ) as watching:
            os.close(terminal)
            drawn, running, deadline = b'', list(nodes), time.monotonic() + 60.0
            while True:
                try:
                    drawn += os.read(screen_end, 65536)
                except OSError:  # the other end is closed: it has ended
                    break
                if b'accel.' in drawn or time.monotonic() > deadline:
                    while running:
                        running.pop().send_signal(signal.SIGTERM)
            assert watching.wait(60) == 0
        assert (
            b'calibration_node has ended' in drawn
            and b'Traceback' not in drawn
            and b'accel.' in drawn
        )
    finally:
        for node in nodes:
            node.kill()
            node.wait()
        lock.close()
