"""
The closed loop as processes over real DDS.

A simulated table, calibration_node, planner_node, then compensator_node.

An uncalibrated IMU with a fault outside its model is turned through its six faces. This motion
determines every parameter of the model, but at +-1 g a quadratic term and an asymmetry of the scale
factor are collinear, so the diagnosis reports a class of effects. The planner drives the motion
that separates them until one effect remains. The live calibration then includes this effect, and
the compensator corrects another motion with it. Run: ``python examples/live_demo.py`` (or ``make
live-demo``); it needs two to three minutes and no ``ros2 launch``, and writes ``live_demo.png``.
"""

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from examples.processes import NodeProcesses  # noqa: E402
from imu_calibration.document import files  # noqa: E402

G, DEG = 9.80665, np.pi / 180
TABLE = ROOT / 'config' / 'table_simulated.yaml'
PROFILE = 'six_faces'
"""First motion."""
SIMULATOR: dict[str, Any] = {
    'table_file': TABLE,
    'seed': 1,
    'imu_seed': 5,
    'truth': True,
    'hide_size': 2.0,
}


@dataclass(frozen=True)
class Length:
    """How much of the demonstration is carried out."""

    time_factor: float
    """Simulated seconds per second."""
    rate: float
    """Samples of the IMU and of the joints per simulated second."""
    hidden: str
    """Physical fault of the simulated IMU, '' for none."""
    separations: int
    """Largest number of motions that separate causes; 0: no diagnosis."""
    planned_seconds: float
    """Simulated seconds that the planner has."""
    models: Mapping[str, str]
    """Parameters of calibration_node and planner_node: their models of the sensors."""

    @property
    def simulator(self) -> dict[str, Any]:
        """Parameters of the simulator."""
        return SIMULATOR | {
            'time_factor': self.time_factor,
            'imu_rate': self.rate,
            'joint_rate': self.rate,
            'hide': self.hidden,
        }


COMPLETE = Length(4.0, 100.0, 'soft_spring', separations=2, planned_seconds=900.0, models={})
SMALLEST = Length(
    12.0,
    25.0,
    '',
    separations=0,
    planned_seconds=20.0,
    models={
        'accelerometer_model': 'bias+matrix+accel_size_effect',
        'gyroscope_model': 'bias+matrix',
    },
)
"""The same nodes and steps without a fault and a diagnosis, with the parameters of that IMU."""
START = 1_800_000_000.0
PATIENCE = 240.0


class Watcher:
    """A node that collects the messages of the other nodes."""

    def __init__(self, processes):
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from sensor_msgs.msg import Imu, JointState
        from std_msgs.msg import String

        from imu_calibration.nodes.inputs import BatchInput, latched_qos
        from msg_adapters.live import LiveGatherer

        self._rclpy, self._processes = rclpy, processes
        rclpy.init()
        self.node = rclpy.create_node('live_demo')
        self.streams = {
            topic: LiveGatherer() for topic in ('imu/data_raw', 'imu/data_corrected', 'imu/truth')
        }
        for topic, gatherer in self.streams.items():
            BatchInput(self.node, Imu, topic, add=gatherer.add_imu, depth=20_000)
        BatchInput(
            self.node,
            JointState,
            'joint_states',
            add=self.streams['imu/data_raw'].add_joints,
            depth=20_000,
        )
        self.documents, self.status, self.drive, self.stamp = [], {}, [], 0.0
        self.node.create_subscription(JointState, 'joint_states', self._joints, 100)
        self.node.create_subscription(
            String,
            'imu/calibration',
            self._document,
            latched_qos(),
        )
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._note, 100)

    def _document(self, message):
        self.documents.append((time.monotonic(), message.data))

    def _note(self, message):
        self.status |= {status.name: status for status in message.status}
        for status in message.status:
            if status.name == 'planner_node: drive':
                self.drive.append(
                    (
                        time.monotonic(),
                        status.message,
                        {pair.key: pair.value for pair in status.values},
                    )
                )

    def _joints(self, message):
        self.stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec

    def spin(self, until, deadline):
        """Spin until a condition holds; raise SystemExit at the deadline."""
        while not until():
            for process in self._processes.running:
                if process.poll():
                    raise SystemExit(
                        f'a node ended with exit code {process.returncode}:'
                        f' {" ".join(process.args[1:4])}'
                    )
            if time.monotonic() > deadline:
                raise SystemExit(
                    'the demonstration did not end within its time limit; run it again on an idle'
                    ' machine'
                )
            self._rclpy.spin_once(self.node, timeout_sec=0.1)

    def call(self, service, deadline):
        """Call a Trigger service and return its response."""
        from std_srvs.srv import Trigger

        client = self.node.create_client(Trigger, service)
        self.spin(client.service_is_ready, deadline)
        future = client.call_async(Trigger.Request())
        self.spin(future.done, deadline)
        return future.result()

    def take(self, topic):
        """Return the messages of a topic since the last call (SampleBlock)."""
        return self.streams[topic].flush()

    def close(self):
        """Destroy the node and shut rclpy down."""
        self.node.destroy_node()
        self._rclpy.try_shutdown()


def once(samples):
    """Return ImuSamples in the order of their stamps, each once."""
    return samples.select(np.unique(samples.stamp_ns, return_index=True)[1])


def differences(samples, truth, rate):
    """
    Return time (s) and one-second means of measured minus true force and rate.

    Measured and true values are at the same stamps, `rate` per second. The means have shape (n, 3)
    each.
    """
    _, here, there = np.intersect1d(samples.stamp_ns, truth.stamp_ns, return_indices=True)
    count = len(here) // rate * rate
    means = [
        (getattr(samples, name)[here[:count]] - getattr(truth, name)[there[:count]])
        .reshape(-1, rate, 3)
        .mean(axis=1)
        for name in ('force_s', 'rate_s')
    ]
    return np.arange(count // rate, dtype=float), *means


def run(domain_id, folder, output, *, length=COMPLETE):
    """Carry out the demonstration in a DDS domain."""
    begin = time.monotonic()
    deadline = begin + PATIENCE
    os.environ |= {'ROS_DOMAIN_ID': str(domain_id), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    with NodeProcesses(domain_id) as processes:
        print(
            f'ROS_DOMAIN_ID {domain_id}: starting calibration_node, simulator_node and'
            f' planner_node; hidden effect of the IMU: {length.hidden or "none"}',
            flush=True,
        )
        calibration_node = processes.start(
            'calibration_node',
            {
                'table_file': TABLE,
                'save_file': folder / 'live.yaml',
                'diagnosis_period': 3600.0 if length.separations else 0.0,
                **length.models,
            },
        )
        planner = processes.start(
            'planner_node',
            {
                'table_file': TABLE,
                'time_limit': length.planned_seconds,
                'separations': length.separations,
                'first_speed': 0.6,
                'stall_patience': 15.0,
                'silence': 5.0,
                **length.models,
            },
        )
        watcher = Watcher(processes)
        simulator = processes.start(
            'simulator_node',
            {
                **length.simulator,
                'profile': PROFILE,
                'start_time': START,
                'wait_for_subscribers': 2,
            },
        )
        try:
            first_motion(watcher, deadline)
            drive(watcher, deadline)
            saved = watcher.call('/calibration_node/save', deadline)
            print(f'~/save: {saved.message}')
            codes = [processes.end(node) for node in (planner, calibration_node, simulator)]
            calibration = files.read_calibration(folder / 'live.yaml')
            compensator = processes.start(
                'compensator_node', {'calibration_file': folder / 'live.yaml'}
            )
            errors = compare(watcher, processes, deadline, simulated=length.simulator)
            codes.append(processes.end(compensator))
        finally:
            watcher.close()
    if errors is not None:
        picture(output / 'live_demo.png', watcher, calibration, errors=errors, hidden=length.hidden)
        print(f'written: {output / "live_demo.png"}')
    print(f'exit codes of the nodes: {codes}; {time.monotonic() - begin:.0f} s')
    separated = not length.separations or (
        any(values.get('separating') == 'True' for _, _, values in watcher.drive)
        and watcher.drive[-1][2].get('mates', '') == ''
    )
    return 0 if saved.success and separated and errors is not None and codes == [0] * 4 else 1


def first_motion(watcher, deadline):
    """Wait until the profile is over, by the stamps of the joint states."""
    from imu_calibration.simulation.profiles import make_profile

    seconds = make_profile(PROFILE, SIMULATOR['seed'], files.read_table(TABLE)).duration
    watcher.spin(lambda: watcher.stamp > START + seconds, deadline)
    print(f'{PROFILE}: {seconds:.0f} s; the planner starts', flush=True)


def drive(watcher, deadline):
    """Start the planner and wait until it has finished."""
    while not watcher.call(
        '/planner_node/start', deadline
    ).success:  # until DDS discovery is complete
        pause = time.monotonic() + 0.5
        watcher.spin(lambda end=pause: time.monotonic() > end, deadline)

    def ended():
        return watcher.drive and watcher.drive[-1][2]['state'] in ('done', 'stopped')

    watcher.spin(ended, deadline)
    if watcher.drive[-1][2]['state'] == 'stopped':
        raise SystemExit(f'the planner stopped: {watcher.drive[-1][1]}')


def compare(watcher, processes, deadline, *, simulated):
    """
    Compensate another motion of the same IMU.

    Return time and differences before and after, None without corrected messages.
    """
    for topic in watcher.streams:
        watcher.take(topic)
    print('compensating another motion of the same IMU', flush=True)
    simulator = processes.start(
        'simulator_node',
        {
            **simulated,
            'profile': 'tumbling',
            'seed': 4,
            'start_time': START + 10_000.0,
            'stop_at_end': True,
            'wait_for_subscribers': 2,
        },
    )
    watcher.spin(lambda: simulator.poll() is not None, deadline)
    end = time.monotonic() + 1.0
    watcher.spin(lambda: time.monotonic() > end, deadline)
    raw, corrected, truth = (watcher.take(topic).imu for topic in watcher.streams)
    if corrected is None:
        print('compensator_node published nothing')
        return None
    rate = int(simulated['imu_rate'])
    before = differences(once(raw), once(truth), rate)
    after = differences(once(corrected), once(truth), rate)
    print(
        f'\nErrors against the truth over {len(after[0])} s, root mean square of one-second means'
    )
    for name, (_, force, rate) in (('before', before), ('after', after)):
        print(
            f'  {name:7} accelerometer {np.sqrt((force**2).mean()) / (G * 1e-3):9.4f} mg   '
            f' gyroscope {np.sqrt((rate**2).mean()) / DEG:9.5f} deg/s'
        )
    return before, after


def events(drive):
    """Yield (time, text) of the diagnosis requests, separations and findings of the planner."""
    previous = None
    for at, text, values in drive:
        candidates, found = (
            values.get(key, '').replace(' ', ', ') for key in ('told apart', 'found')
        )
        event = (
            'waits for the diagnosis'
            if text == 'diagnosing'
            else (
                f'separates {candidates}'
                if values.get('separating') == 'True'
                else f'found: {found}'
                if values['state'] == 'done' and found
                else ''
            )
        )
        if event and event != previous:
            yield at, event
        previous = event or previous


def picture(path, watcher, calibration, *, errors, hidden):
    """
    Draw standard deviations over time, the planner's actions, and the errors.

    The errors are drawn before and after compensation.
    """
    import matplotlib

    matplotlib.use('Agg')
    import matplotlib.pyplot as plt

    from imu_calibration.document.calibration_text import calibration_from_text
    from imu_calibration.estimation.solution import tolerances_of

    start = next(at for at, text, _ in watcher.drive if not text.startswith('idle'))
    figure, (known, errors_axes) = plt.subplots(2, 1, figsize=(9, 7), constrained_layout=True)
    usual, lines = files.read_tolerances(ROOT / 'config' / 'tolerances.yaml'), {}
    for at, text in watcher.documents:
        found = calibration_from_text(text)
        for name, value in zip(
            found.param_names,
            np.sqrt(np.diag(found.covariance)) / tolerances_of(found.model, usual),
            strict=True,
        ):
            if not name.startswith('reference'):
                lines.setdefault(name, []).append((at - start, value))
    for name, points in lines.items():
        known.semilogy(
            *zip(*points, strict=True),
            color='tab:blue' if name.startswith('accel') else 'tab:orange',
            lw=0.8,
        )
    known.axhline(1.0, color='k', lw=1)
    end = max(at for at, _, _ in watcher.drive)
    for row, (at, event) in enumerate(events(watcher.drive)):
        known.axvline(at - start, color='tab:red', lw=1)
        side = 'left' if at - start < 0.5 * (end - start) else 'right'
        known.text(
            at - start,
            0.93 - 0.09 * row,
            f' {event} ',
            color='tab:red',
            ha=side,
            fontsize=8,
            transform=known.get_xaxis_transform(),
            in_layout=False,
            bbox={'facecolor': 'white', 'edgecolor': 'none', 'alpha': 0.8, 'pad': 0.5},
        )
    known.set(
        xlabel='s since the planner started',
        ylabel='standard deviation / tolerance',
        title=(
            f'{PROFILE}, then {watcher.drive[-1][2]["motion"]} planned motions: parameters of'
            ' accelerometer (blue) and gyroscope (orange)'
        ),
    )
    found = [
        effect.name
        for effect in calibration.model.effects
        if effect.sensor == 'accelerometer' and effect.name not in ('bias', 'matrix')
    ]
    for label, (seconds, force, _), color in (
        ('as measured', errors[0], 'tab:gray'),
        ('compensated', errors[1], 'tab:green'),
    ):
        errors_axes.plot(
            seconds, np.linalg.norm(force, axis=1) / (1e-3 * G), color=color, label=label
        )
    errors_axes.set(
        xlabel='s of another motion',
        ylabel='error of the accelerometer, mg',
        yscale='log',
        title=(
            f'hidden effect: {hidden or "none"}; effects in the final model:'
            f' {", ".join(found) or "none"}'
        ),
    )
    errors_axes.legend(loc='upper right')
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def main(arguments=None):
    """Read the arguments and carry out the demonstration; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument(
        '--domain-id',
        type=int,
        default=1 + os.getpid() % 100,
        help='ROS_DOMAIN_ID, default derived from the process id',
    )
    parser.add_argument(
        '--output', type=Path, default=Path('demo'), help='folder for the picture, default demo'
    )
    parser.add_argument(
        '--smallest',
        action='store_true',
        help='the same steps in about half a minute, without a fault and its diagnosis',
    )
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as temporary:
        length = SMALLEST if options.smallest else COMPLETE
        return run(options.domain_id, Path(temporary), options.output, length=length)


if __name__ == '__main__':
    sys.exit(main())
