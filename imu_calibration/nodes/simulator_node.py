"""
simulator_node: a turntable that carries an IMU, live.

in: joint_trajectory (trajectory_msgs/JointTrajectory, as joint_trajectory_controller takes it;
without points the table stops). out: imu/data_raw (sensor_msgs/Imu), joint_states
(sensor_msgs/JointState), when asked for imu/temperature (sensor_msgs/Temperature), imu/truth
(sensor_msgs/Imu) and /clock, ~/truth (std_msgs/String, the true parameters, latched), /diagnostics.
"""

import queue
import sys
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import Imu, JointState, Temperature
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from imu_calibration.api.resources import config_file
from imu_calibration.core.errors import ImuCalibrationError
from imu_calibration.core.settings import flag_setting, path_setting, setting, text_setting
from imu_calibration.document import files
from imu_calibration.document.calibration import true_calibration
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.motion_limits import limits_of
from imu_calibration.kinematics.table import Table
from imu_calibration.nodes.diagnostics import OK, WARN, DiagnosticsPublisher, make_status
from imu_calibration.nodes.inputs import latched_qos, output_qos
from imu_calibration.nodes.lifecycle import HINTS, announce, declare_parameters, run_node
from imu_calibration.nodes.playback import CLOCK_RATE, PLAYBACK_DEPTH, Batch, Pace, Playback
from imu_calibration.nodes.robot_stand import RobotSettings, chain_of
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.sensor_noise import CAUSES, GRADES, hidden_causes
from imu_calibration.simulation.session import (
    LiveSimulation,
    SimulatedBlock,
    SimulationOptions,
    true_imu,
)
from imu_calibration.simulation.table_controller import ControllerSettings, TableController
from msg_adapters.joint_state import trajectory_from_message
from msg_adapters.layout import Packed
from msg_adapters.write import encode_imu, encode_joints, encode_temperature

STRETCH_SECONDS = 0.1
"""
Seconds of simulated time that are computed together, times the time factor; as playback makes some
such stretches ahead, a trajectory is effective about half a second later.
"""


@dataclass(frozen=True)
class SimulatorSettings:
    """The table, its motion, the IMU and the pace."""

    table_file: str = path_setting(
        'table description, path; empty: the installed config/table_simulated.yaml, or none with'
        ' urdf_file',
        'joint names differ from the expected ones',
    )
    profile: str = text_setting(
        "motion of the table, a name that 'imu_calibration simulate --help' lists; none: rest until"
        ' a trajectory is received on joint_trajectory',
        'the node refuses and lists the names',
        default='quick',
        session=True,
    )
    repeat: bool = flag_setting(
        'start the profile again at its end',
        'the table rests after one round',
    )
    stop_at_end: bool = flag_setting(
        'end the node at the end of the profile; otherwise the table remains at rest',
        'the node does not end',
    )
    calibration_file: str = path_setting(
        'calibration document with the true parameters, path; empty: a random IMU',
        'another IMU is simulated',
    )
    grade: str = text_setting(
        'grade of noise and of the random IMU: ' + ', '.join(sorted(GRADES)),
        'noise too large or small',
        default='industrial',
        choices=tuple(sorted(GRADES)),
    )
    hide: str = text_setting(
        'further errors of the IMU, by their physics, names joined by +: ' + ', '.join(CAUSES),
        'the diagnosis has a different finding, or none',
        session=True,
    )
    hide_size: float = setting(
        1.0,
        '1',
        'size of the hidden error, in units of the drawn size',
        (0.0, 100.0),
        'too small: not detectable',
    )
    seed: int = setting(0, '1', 'seed of noise and motion', (0, 2**31 - 1), 'two runs differ')
    imu_seed: int = setting(
        -1,
        '1',
        'seed of the random IMU; -1: the same as seed',
        (-1, 2**31 - 1),
        'two runs simulate different IMUs',
    )
    imu_rate: float = setting(
        200.0,
        'Hz',
        'Imu messages per second of simulated time',
        (1.0, 20000.0),
        'too large: the machine cannot keep up',
    )
    joint_rate: float = setting(
        100.0,
        'Hz',
        'JointState messages per second of simulated time',
        (1.0, 20000.0),
        'too small: fast motion is not followed',
    )
    velocity: bool = flag_setting(
        'whether JointState holds velocities',
        'velocities are missing',
        default=True,
    )
    encoder_resolution: float = setting(
        0.0,
        'rad',
        'step of the joint positions; 0: continuous',
        (0.0, 0.1),
        'too large: rough reference',
    )
    stamp_jitter: float = setting(
        0.0,
        's',
        'standard deviation of the Imu stamps',
        (0.0, 0.01),
        'too large: stamps out of order',
    )
    temperature: bool = flag_setting(
        'publish imu/temperature, warming up from 25 C',
        'thermal effects cannot be calibrated',
    )
    frame_id: str = text_setting(
        'frame of the Imu messages',
        'another frame_id',
        default='imu_link',
    )
    truth: bool = flag_setting(
        'publish imu/truth: readings of a perfect IMU',
        'no messages on imu/truth',
    )
    time_factor: float = setting(
        1.0,
        '1',
        'seconds of simulated time per second; 0: as fast as possible',
        (0.0, 10000.0),
        'too large: messages are lost',
    )
    clock: bool = flag_setting(
        'publish /clock, for nodes with use_sim_time',
        'nodes with use_sim_time do not advance',
    )
    start_time: float = setting(
        0.0, 's', 'first stamp; 0: the present time', (0.0, 4e9), 'stamps of another day'
    )
    wait_for_subscribers: int = setting(
        0,
        '1',
        'subscribers of imu/data_raw to wait for before the start',
        (0, 100),
        'the first messages are missed',
    )


NO_PROFILE = ('', 'none')
"""Values of `profile` with the table at rest."""


class SimulatorNode(Node):
    """Publishes the messages of a LiveSimulation."""

    def __init__(self) -> None:
        super().__init__('simulator_node')
        self.settings = settings = declare_parameters(self, SimulatorSettings)
        self._controller_settings = declare_parameters(self, ControllerSettings)
        kinds = [(Imu, 'imu/data_raw'), (JointState, 'joint_states')]
        if settings.temperature:
            kinds.append((Temperature, 'imu/temperature'))
        if settings.truth:
            kinds.append((Imu, 'imu/truth'))
        topics = [topic for _, topic in kinds]
        announce(self, ['joint_trajectory'], [*topics, '/clock'] if settings.clock else topics)
        self._table, self._motion = self._make_table()
        self._simulation = self._make_simulation()
        self._trajectories: queue.Queue[JointTrajectory] = queue.Queue()
        """Received trajectories, which the playback's thread starts between two batches."""
        self._trajectory_figures: dict[str, Any] = {'followed': 0, 'refused': 0, 'why refused': ''}
        """Numbers of trajectories, and the reason of the last refusal, for the diagnostics."""
        self._publish_truth(self._simulation.model, self._simulation.values)

        # The publishers, and the thread that uses them.
        publishers = [
            self.create_publisher(kind, topic, output_qos(PLAYBACK_DEPTH)) for kind, topic in kinds
        ]
        self._publisher_of = dict(zip(topics, publishers, strict=True))
        """Relative name of a topic -> its publisher."""
        pace = Pace(
            settings.time_factor,
            CLOCK_RATE if settings.clock else 0.0,
            settings.wait_for_subscribers,
        )
        self._playback = Playback(
            self,
            publishers,
            self._batches(),
            pace=pace,
            clock_start_ns=self._simulation.start_ns,
            awaited=publishers[:1],
            ended='the profile has ended, {} messages were published',
        )
        self.create_subscription(JointTrajectory, 'joint_trajectory', self._trajectories.put, 10)
        self._diagnostics = DiagnosticsPublisher(self, self._statuses)
        self._playback.start()
        moves = (
            'rests and follows joint_trajectory'
            if settings.profile in NO_PROFILE
            else f'moves by the profile {settings.profile}'
        )
        self.get_logger().info(
            f'a table with the joints {", ".join(self._table.joint_names)} {moves}, '
            f'{settings.time_factor:g} times as fast as real time'
        )

    def close(self) -> str:
        """Stop publishing; return the outcome."""
        return self._playback.end()

    @property
    def failed(self) -> bool:
        """Whether an error ended the simulation."""
        return self._playback.failed

    def _make_table(self) -> tuple[Table, TableController]:
        """Return the table, and its motion by the profile and received trajectories."""
        settings = self.settings
        robot = declare_parameters(self, RobotSettings)
        table = chain_of(self, robot, settings.table_file, frame_id=settings.frame_id)
        table = table or files.read_table(config_file('table_simulated.yaml'))
        profile = None
        if settings.profile not in NO_PROFILE:
            profile = make_profile(settings.profile, settings.seed, table)
            table = profile.table_moved(table)
        return table, TableController(
            profile,
            tuple(table.joint_names),
            limits=limits_of(table),
            settings=self._controller_settings,
            repeat=settings.repeat,
        )

    def _make_simulation(self) -> LiveSimulation:
        """Return the simulation of the IMU that the parameters describe, on the table."""
        settings = self.settings
        imu_seed = settings.seed if settings.imu_seed < 0 else settings.imu_seed
        given_imu = None
        if settings.calibration_file:
            truth = files.read_calibration(files.user_path(settings.calibration_file))
            given_imu = (truth.model, truth.values)
        model, values = true_imu(self._table, given_imu, settings.grade, seed=imu_seed)
        hidden = settings.hide.split('+') if settings.hide else []
        return LiveSimulation(
            model,
            values,
            self._table,
            motion=self._motion,
            options=self._options(),
            seed=settings.seed,
            start_ns=int(settings.start_time * 1e9) or time.time_ns(),
            causes=hidden_causes(hidden, imu_seed, settings.hide_size),
        )

    def _options(self) -> SimulationOptions:
        """Return rates, noise and parts of the simulated messages."""
        settings = self.settings
        noise = replace(
            GRADES[settings.grade].noise,
            encoder_resolution=settings.encoder_resolution,
            stamp_jitter=settings.stamp_jitter,
        )
        return SimulationOptions(
            settings.imu_rate,
            settings.joint_rate,
            noise,
            settings.velocity,
            25.0 if settings.temperature else None,
            frame_id=settings.frame_id,
        )

    def _publish_truth(self, model: SensorModel, values: np.ndarray) -> None:
        """Publish the true parameters as a calibration document."""
        truth = true_calibration(
            model, values, self.settings.frame_id, simulated={'seed': self.settings.seed}
        )
        self._truth = self.create_publisher(String, '~/truth', latched_qos())
        self._truth.publish(String(data=calibration_to_text(truth)))

    def _batches(self) -> Generator[Batch, None, None]:
        """Yield Batch after Batch; a received trajectory starts between two of them."""
        until = 0.0  # s of simulated time
        step = STRETCH_SECONDS * max(self.settings.time_factor, 1.0)
        while until < self._motion.end or not self.settings.stop_at_end:
            while not self._trajectories.empty():
                self._take_over(until, self._trajectories.get())
            until += step
            if self.settings.stop_at_end:
                until = min(until, self._motion.end)
            yield self._batch(self._simulation.take(until), until)

    def _batch(self, block: SimulatedBlock, until: float) -> Batch:
        """Return the messages of a block of samples in the order of their stamps."""
        encode_with_velocity = partial(encode_joints, with_velocity=self.settings.velocity)
        # Publisher, samples, and function that encodes them.
        parts: list[tuple[Any, Any, Callable]] = [
            (self._publisher_of['imu/data_raw'], block.imu, encode_imu),
            (self._publisher_of['joint_states'], block.joints, encode_with_velocity),
        ]
        if 'imu/temperature' in self._publisher_of:
            parts.append(
                (self._publisher_of['imu/temperature'], block.temperature, encode_temperature)
            )
        if 'imu/truth' in self._publisher_of:
            parts.append(
                (self._publisher_of['imu/truth'], self._simulation.truth(block), encode_imu)
            )
        due = np.concatenate(
            [(samples.stamp_ns - self._simulation.start_ns) * 1e-9 for _, samples, _ in parts]
        )
        publishers = []
        messages = []
        for publisher, samples, encode in parts:
            publishers += [publisher] * len(samples)
            if len(samples):
                messages += Packed.of_rows(encode(samples)).views()
        order = np.argsort(due, kind='stable')
        return Batch(
            due[order], [publishers[k] for k in order], [messages[k] for k in order], until
        )

    def _take_over(self, now: float, message: JointTrajectory) -> None:
        """Follow a trajectory from `now` on, s of simulated time, or report its refusal."""
        try:
            self._motion.follow(now, trajectory_from_message(message))
            self._trajectory_figures['followed'] += 1
        except ImuCalibrationError as error:
            self._trajectory_figures['refused'] += 1
            self._trajectory_figures['why refused'] = str(error)
            self.get_logger().warning(f'{error}; the trajectory is not followed')

    def _statuses(self) -> list:
        """Return the status 'table' for the diagnostics."""
        level = OK
        text = 'follows joint_trajectory'
        reason = self._trajectory_figures['why refused']
        if reason:
            level = WARN
            text = f'the last refused trajectory: {reason}'
        return [make_status(level, 'table', text, values=dict(self._trajectory_figures))]


def main(arguments: list[str] | None = None) -> int:
    """Run the node; return the exit code."""
    return run_node(SimulatorNode, arguments, hints=HINTS['simulator_node'])


if __name__ == '__main__':
    sys.exit(main())
