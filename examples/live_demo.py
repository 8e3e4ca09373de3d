"""
A simulated table, calibration_node and compensator_node as processes over real DDS: calibrate live, then compensate another motion.

Run: ``python examples/live_demo.py`` (or ``make live-demo``); takes about a minute and a half, needs no ``ros2 launch``.
"""

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from imu_calibration.nodes.processes import NodeProcesses  # noqa: E402

G, DEG = 9.80665, np.pi / 180
TABLE = ROOT / 'config' / 'table_three_axis.yaml'
FACTOR = 4.0
"""Simulated seconds per second."""
SIMULATOR = {'table_file': TABLE, 'seed': 3, 'imu_seed': 5, 'imu_rate': 100.0, 'joint_rate': 100.0, 'time_factor': FACTOR, 'truth': True,
             'stop_at_end': True, 'wait_for_subscribers': 3}
START = 1_800_000_000.0
PATIENCE = 110.0


class Watcher:
    """A node that collects what the others publish."""

    def __init__(self, processes):
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from sensor_msgs.msg import Imu
        from std_msgs.msg import String

        from imu_calibration.nodes.inputs import BatchInput
        from imu_calibration.nodes.qos import latched_qos
        from msg_adapters.live import LiveGatherer
        self._rclpy, self._processes = rclpy, processes
        rclpy.init()
        self.node = rclpy.create_node('live_demo')
        self.streams = {topic: LiveGatherer() for topic in ('imu/data_raw', 'imu/data_corrected', 'imu/truth')}
        for topic, gatherer in self.streams.items():
            BatchInput(self.node, Imu, topic, add=gatherer.add_imu)
        self.documents, self.status = [], {}
        self.node.create_subscription(String, 'imu/calibration', lambda message: self.documents.append(message.data), latched_qos())
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._note, 10)

    def _note(self, message):
        self.status |= {status.name: status for status in message.status}

    def spin(self, until, deadline):
        """Spin until a condition holds; give up at the deadline."""
        while not until():
            for process in self._processes.running:
                if process.poll():
                    raise SystemExit(f'a node ended with exit code {process.returncode}: {" ".join(process.args[1:4])}')
            if time.monotonic() > deadline:
                raise SystemExit('the demonstration did not come to an end in time; is the machine very busy?')
            self._rclpy.spin_once(self.node, timeout_sec=0.1)

    def call(self, service, deadline):
        """Call a Trigger service and return its answer."""
        from std_srvs.srv import Trigger
        client = self.node.create_client(Trigger, service)
        self.spin(client.service_is_ready, deadline)
        future = client.call_async(Trigger.Request())
        self.spin(future.done, deadline)
        return future.result()

    def take(self, topic):
        """Return the ImuSamples that came on a topic since the last call, in the order of their stamps, each once."""
        samples = self.streams[topic].flush().imu
        return None if samples is None else samples.select(np.unique(samples.stamp_ns, return_index=True)[1])

    def close(self):
        """Leave DDS."""
        self.node.destroy_node()
        self._rclpy.try_shutdown()


def errors(samples, truth):
    """Return root mean square errors of one-second means against the truth at the same stamps: (mg, deg/s, seconds compared)."""
    _, here, there = np.intersect1d(samples.stamp_ns, truth.stamp_ns, return_indices=True)
    rate = int(SIMULATOR['imu_rate'])
    count = len(here) // rate * rate
    found = []
    for name, unit in (('force_s', G * 1e-3), ('rate_s', DEG)):
        difference = getattr(samples, name)[here[:count]] - getattr(truth, name)[there[:count]]
        found.append(float(np.sqrt((difference.reshape(-1, rate, 3).mean(axis=1)**2).mean())) / unit)
    return (*found, count / rate)


def run(domain_id, folder):
    """Carry out the demonstration in a DDS domain."""
    deadline = time.monotonic() + PATIENCE
    os.environ |= {'ROS_DOMAIN_ID': str(domain_id), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    with NodeProcesses(domain_id) as processes:
        print(f'ROS_DOMAIN_ID {domain_id}: starting calibration_node, compensator_node and simulator_node')
        calibration_node = processes.start('calibration_node', {'table_file': TABLE, 'save_file': folder / 'calibration.yaml',
                                                                'solve_share': 0.3})
        compensator = processes.start('compensator_node')
        simulator = processes.start('simulator_node', {**SIMULATOR, 'profile': 'quick', 'start_time': START})
        watcher = Watcher(processes)
        try:
            calibrate(watcher, simulator, deadline)
            answer = watcher.call('/calibration_node/save', deadline)
            print(f'~/save: {answer.message}')
            if not answer.success:
                return 1
            watcher.spin(lambda: watcher.documents, deadline)
            code = processes.end(calibration_node)
            for topic in watcher.streams:
                watcher.take(topic)
            print('another motion of the same IMU, compensated live')
            simulator = processes.start('simulator_node', {**SIMULATOR, 'profile': 'tumbling', 'seed': 4, 'start_time': START + 1000.0,
                                                           'wait_for_subscribers': 2})
            watcher.spin(lambda: simulator.poll() is not None, deadline)
            end = time.monotonic() + 1.0
            watcher.spin(lambda: time.monotonic() > end, deadline)
            show(*(watcher.take(topic) for topic in watcher.streams))
            codes = [code, processes.end(compensator), simulator.returncode]
        finally:
            watcher.close()
    print(f'exit codes of the nodes: {codes}')
    return 0 if codes == [0, 0, 0] else 1


def calibrate(watcher, simulator, deadline):
    """Wait for the end of the motion and tell what is known on the way."""
    told = 0

    def ended():
        nonlocal told
        if len(watcher.documents) > told:
            told = len(watcher.documents)
            groups = [s for name, s in watcher.status.items() if name.startswith('calibration_node: ')
                      and name.split(': ')[1] not in ('streams', 'calibration')]
            good = sum(status.level == b'\0' for status in groups)
            print(f'solution {told}: {good} of {len(groups)} parameter groups determined' + next(
                (f'; {s.name.split(": ")[1]} {s.message.split("; ")[-1]}' for s in groups if 'needed' in s.message), ''))
        return simulator.poll() is not None
    watcher.spin(ended, deadline)


def show(raw, corrected, truth):
    """Print the errors before and after compensation."""
    if corrected is None:
        raise SystemExit('compensator_node published nothing')
    before, after = errors(raw, truth), errors(corrected, truth)
    print(f'\nErrors against the truth over {after[2]:.0f} s, root mean square of one-second means')
    for name, figures in (('before', before), ('after', after)):
        print(f'  {name:7} accelerometer {figures[0]:9.4f} mg    gyroscope {figures[1]:9.5f} deg/s')


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--domain-id', type=int, default=1 + os.getpid() % 100, help='ROS_DOMAIN_ID, default one of its own')
    with tempfile.TemporaryDirectory() as temporary:
        sys.exit(run(parser.parse_args().domain_id, Path(temporary)))
