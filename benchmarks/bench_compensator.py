"""
CPU time and latency of the compensator relative to an rclpy relay.

Both run between a serialized source and sink, alternately in one run.

CPU time includes all DDS threads of the process while messages are sent. Latency is the time from
publication by the source to reception by the sink; added latency is the latency minus that of a
direct connection from source to sink. Run it separately with ``python
benchmarks/bench_compensator.py [--seconds S]``.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

ROOT = Path(__file__).resolve().parents[1]
if __name__ == '__main__':
    sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402

from imu_calibration.document.calibration_text import (
    Calibration,  # noqa: E402
    calibration_to_text,  # noqa: E402
)
from imu_calibration.effects.sensor_model import SensorModel  # noqa: E402
from imu_calibration.simulation.session import random_values  # noqa: E402
from tools.smallest import add_smallest  # noqa: E402

ENDS = str(ROOT / 'benchmarks' / 'relay_ends.py')
TURN = 5.0
"""Duration of one measurement of each node, s."""
RATES = (2000, 3000, 4000, 5000, 6000, 7000, 8000, 10000)
TARGETS = {'CPU time per message': 0.4, 'median added latency': 0.5}
MEANING = {
    'plain relay': 'rclpy node that republishes each message',
    'compensator': 'bias, matrix and nine lever arms',
}


def bench_calibration():
    """Return the text of a calibration with bias, matrix and nine lever arms."""
    model = SensorModel(accelerometer=('bias', 'matrix', 'accel_size_effect'))
    values = random_values(model, seed=1)
    noise = {'accelerometer': {'noise_sd': [0.04] * 3}, 'gyroscope': {'noise_sd': [0.004] * 3}}
    covariance, status = 1e-8 * np.eye(len(values)), ('determined',) * len(values)
    return calibration_to_text(
        Calibration(model, values, covariance, status, 'imu_link', statistics=noise)
    )


class Process:
    """A node under test, on separate topics."""

    def __init__(self, name, command, environment):
        self.name, self.topics = (
            name,
            tuple(f'/bench_{name.replace(" ", "_")}/{end}' for end in ('raw', 'corrected')),
        )
        remap = [
            '--ros-args',
            '-r',
            f'imu/data_raw:={self.topics[0]}',
            '-r',
            f'imu/data_corrected:={self.topics[1]}',
        ]
        with_more = command[:-1] + remap + command[-1]
        self.process = subprocess.Popen(
            with_more, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        self.cpu, self.messages, self.medians, self.tails, self.lost = 0.0, 0, [], [], 0

    def cpu_seconds(self):
        """Return the CPU time of all its threads until now."""
        tasks = Path(f'/proc/{self.process.pid}/task')
        return (
            sum(int((task / 'schedstat').read_text().split()[0]) for task in tasks.iterdir()) * 1e-9
        )

    def stop(self):
        """
        End the process; kill it where a plain node has missed the signal.

        An executor of rclpy that looks at its context between the signal and its effect waits on.
        """
        self.process.terminate()
        _await_end(self.process)


def _await_end(process):
    """Wait until a process has ended, which reads nothing more; kill it after 10 s."""
    try:
        process.communicate(timeout=10)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()


class Ends:
    """
    The source and the sink of messages: two processes for all measurements.

    Each measures once for every line of arguments that it reads.
    """

    def __init__(self, environment):
        self._source, self._sink = (
            subprocess.Popen(
                [sys.executable, ENDS, part],
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            for part in ('source', 'sink')
        )

    def run_once(self, raw, corrected, rate, seconds, cpu_seconds=lambda: 0.0):
        """
        Send messages to `raw` and receive them from `corrected`.

        Return (report of the source, report of the sink, CPU seconds).
        """
        _ask(self._sink, corrected)
        is_direct = raw == corrected
        if is_direct:  # each waits for the other
            _ask(self._source, raw, rate, seconds)
        _line(self._sink)
        if not is_direct:
            _ask(self._source, raw, rate, seconds)
        _line(self._source)
        before = cpu_seconds()
        sent = json.loads(_line(self._source))
        used = cpu_seconds() - before
        return sent, json.loads(_line(self._sink)), used

    def stop(self):
        """End both: they have nothing more to read."""
        for process in (self._source, self._sink):
            _await_end(process)


def _ask(process, *arguments):
    """Let a process measure once."""
    assert process.stdin is not None, 'both processes read from a pipe'
    print(json.dumps(arguments), file=process.stdin, flush=True)


def _line(process):
    """Return the next line that a process prints."""
    assert process.stdout is not None, 'both processes print into a pipe'
    return process.stdout.readline()


def compare(nodes, seconds, ends, rate=1000.0):
    """
    Measure each node and the direct connection alternately for `TURN` s at `rate`.

    Return the direct median latency, microseconds.
    """
    direct = []
    for _ in range(max(1, round(seconds / TURN))):
        for node in nodes:
            raw, corrected = node.topics
            sent, came, used = ends.run_once(
                raw, corrected, rate, min(TURN, seconds), node.cpu_seconds
            )
            node.cpu += used
            node.messages += came['came']
            node.lost += sent['sent'] - came['came']
            node.medians.append(came['late_us'][50])
            node.tails.append(came['late_us'][99])
        _, came, _ = ends.run_once('/bench_direct', '/bench_direct', rate, min(TURN, seconds))
        direct.append(came['late_us'][50])
    return median(direct)


def highest_rate(node, ends, seconds, *, rates):
    """
    Return [(requested rate, actual rate, lost messages)] with rising rates until messages are lost.
    """
    raw, corrected = node.topics
    rows = []
    for rate in rates:
        sent, came, _ = ends.run_once(raw, corrected, rate, seconds)
        rows.append((rate, sent['rate'], sent['sent'] - came['came']))
        if rows[-1][2]:
            break
    return rows


def bench_compensator(seconds=30.0, rates=RATES):
    """Return (figures, ratios): a dict per node, and ratios by name."""
    environment = os.environ | {
        'PYTHONPATH': f'{ROOT}:{os.environ.get("PYTHONPATH", "")}',
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'ROS_DOMAIN_ID': os.environ.get('ROS_DOMAIN_ID', '83'),
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'calibration.yaml')
        path.write_text(bench_calibration())
        nodes = [
            Process('plain relay', [sys.executable, ENDS, 'relay', []], environment),
            Process(
                'compensator',
                [
                    sys.executable,
                    '-m',
                    'imu_calibration.nodes.compensator_node',
                    ['-p', f'calibration_file:={path}', '-p', 'anyway:=true'],
                ],
                environment,
            ),
        ]
        ends = Ends(environment)
        try:
            time.sleep(4.0)
            direct = compare(nodes, seconds, ends)
            figures = {
                node.name: (
                    _figures(node, direct)
                    | {'rates': highest_rate(node, ends, min(5.0, seconds), rates=rates)}
                )
                for node in nodes
            }
        finally:
            ends.stop()
            for node in nodes:
                node.stop()
    relay, ours = figures['plain relay'], figures['compensator']
    keys = (
        'CPU time per message',
        'median latency',
        'median added latency',
        '99th percentile of latency',
    )
    return figures | {'direct': direct}, {key: ours[key] / relay[key] for key in keys}


def _figures(node, direct):
    return {
        'CPU time per message': node.cpu / max(node.messages, 1) * 1e6,
        'median latency': median(node.medians),
        'median added latency': median(node.medians) - direct,
        '99th percentile of latency': median(node.tails),
        'lost': node.lost,
    }


def main():
    """Print the figures; exit code 1 when a target is missed at full size."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument(
        '--seconds',
        type=float,
        default=30.0,
        help='duration of the measurement of each node at 1 kHz, default 30',
    )
    parser.add_argument(
        '--rates',
        type=int,
        nargs='+',
        default=RATES,
        help='rates at which losses are counted, Hz',
    )
    add_smallest(parser, seconds=0.2, rates=RATES[:1])
    options = parser.parse_args()
    figures, ratios = bench_compensator(options.seconds, options.rates)
    print(
        'at 1 kHz, reliable, depth 1000; direct connection from source to sink'
        f' {figures["direct"]:.0f} us'
    )
    for name, text in MEANING.items():
        shown = ', '.join(f'{key} {figures[name][key]:.0f} us' for key in ratios)
        print(f'{name:12s} ({text}): {shown}, {figures[name]["lost"]} lost')
    missed = False
    for key, ratio in ratios.items():
        target = TARGETS.get(key)
        missed |= target is not None and ratio > target
        print(f'ratio of {key}: {ratio:.2f}' + (f'  (at most {target})' if target else ''))
    for name in MEANING:
        rows = figures[name]['rates']
        held = [sent for _, sent, lost in rows if not lost]
        print(
            f'{name}: '
            + (f'{max(held):.0f} Hz without loss' if held else 'loss at every rate')
            + (
                f', {rows[-1][2]} lost at {rows[-1][1]:.0f} Hz'
                if rows[-1][2]
                else ' (largest rate of the source)'
            )
        )
        missed |= name == 'compensator' and not any(
            asked >= 6000 and not lost for asked, _, lost in rows
        )
    return int(missed and not options.smallest)


if __name__ == '__main__':
    sys.exit(main())
