"""
Memory of the nodes over a long session.

The largest private memory, and its growth from the middle to the last third.

Run: ``python test/ros/soak.py --hours 6`` (or ``make soak``); the data are simulated and go faster
than real time.
"""

import argparse
import sys
import time
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1]), str(Path(__file__).resolve().parents[2])]

from examples.processes import NodeProcesses

from ros.live_station import Station

GROWTH_MB = 10.0
LARGEST_MB = {'calibration_node': 250.0, 'compensator_node': 70.0}
"""Largest private memory of each node."""


def private_mb(pid):
    """Return the memory that belongs to a process alone, MB (10^6 bytes)."""
    kb = 0
    with open(f'/proc/{pid}/smaps_rollup') as lines:
        for line in lines:
            if line.startswith(('Private_Clean:', 'Private_Dirty:', 'Private_Hugetlb:')):
                kb += int(line.split()[1])
    return kb * 1024 / 1e6


def thirds(samples):
    """Return the mean memory in the middle and in the last third of (time, MB) samples."""
    start, end = samples[0][0], samples[-1][0]
    edges = [start + (end - start) * share for share in (1 / 3, 2 / 3)]
    middle = [mb for when, mb in samples if edges[0] <= when < edges[1]]
    last = [mb for when, mb in samples if when >= edges[1]]
    return sum(middle) / len(middle), sum(last) / len(last)


def soak(
    seconds, factor, folder, imu_rate=200.0, joint_rate=100.0, tell=None, diagnosis_period=60.0
):
    """
    Run both nodes on `seconds` of simulated data.

    Parameters
    ----------
    seconds : float
        Length of the data.
    factor : float
        Seconds of data per second.
    folder : Path
        Where the calibration is saved.
    tell : callable, optional
        Called with a line of progress now and then.
    diagnosis_period : float
        Seconds, not of the data, between diagnoses; 0: none.

    Returns
    -------
    dict
        Node -> (MB in the middle third, MB in the last third, largest MB, Imu messages that reached
        calibration_node).

    """
    memory = {name: [] for name in LARGEST_MB}
    with Station(processes=NodeProcesses) as station:
        station.watch_diagnostics()
        running = {
            'calibration_node': station.calibration_node(
                folder, autosave_period=10.0, diagnosis_period=diagnosis_period, solve_share=0.2
            ),
            'compensator_node': station.start('compensator_node'),
        }
        station.until(lambda: len(station.status) > 2, 'the nodes')
        station.start(
            'simulator_node',
            {
                'profile': 'quick',
                'repeat': True,
                'seed': 1,
                'time_factor': factor,
                'imu_rate': imu_rate,
                'joint_rate': joint_rate,
                'wait_for_subscribers': 2,
            },
        )

        def count():
            return station.figure('imu messages', 'calibration_node: streams')

        station.until(count, 'the first messages')
        start, told = time.monotonic(), 0.0
        # Until the node has received all of them: a busy machine needs longer.
        while (n_imu := count()) < seconds * imu_rate:
            station.spin_for(min(1.0, seconds / factor / 60))
            now = time.monotonic() - start
            for name, process in running.items():
                assert process.poll() is None, f'{name} has ended'
                memory[name].append((now, private_mb(process.pid)))
            if tell and now - told > 60.0:
                told = now
                tell(
                    f'{n_imu / imu_rate / 3600:.2f} h: '
                    + ', '.join(
                        f'{name} {samples[-1][1]:.1f} MB' for name, samples in memory.items()
                    )
                )
    return {
        name: (*thirds(samples), max(mb for _, mb in samples), n_imu)
        for name, samples in memory.items()
    }


def main():
    """Run and judge."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--hours', type=float, default=6.0, help='length of the data')
    parser.add_argument('--factor', type=float, default=20.0, help='seconds of data per second')
    options = parser.parse_args()
    from tempfile import TemporaryDirectory

    with TemporaryDirectory() as folder:
        found = soak(
            options.hours * 3600.0,
            options.factor,
            Path(folder),
            tell=lambda line: print(line, flush=True),
        )
    for name, (middle, last, largest, n_imu) in found.items():
        print(
            f'{name}: {middle:.1f} MB in the middle third, {last:.1f} MB in the last, {largest:.1f}'
            f' MB at most ({n_imu} Imu messages)'
        )
    return (
        0
        if all(
            last - middle <= GROWTH_MB and largest <= LARGEST_MB[name]
            for name, (middle, last, largest, _) in found.items()
        )
        else 1
    )


if __name__ == '__main__':
    sys.exit(main())
