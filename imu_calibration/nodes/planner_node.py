"""
planner_node: moves a table or an arm to serve calibration_node.

It moves so that calibration_node can determine every parameter, and no further.

in: joint_states (sensor_msgs/JointState), imu/calibration (std_msgs/String, from calibration_node),
/diagnostics (its diagnosis). out: joint_trajectory (trajectory_msgs/JointTrajectory), or the action
follow_joint_trajectory where control_msgs is installed; /diagnostics; imu/coverage
(visualization_msgs/MarkerArray): the motion that is driven, beside calibration_node's picture.
services: ~/start (all motions that are needed), ~/next (one motion), ~/stop (at any moment).
Nothing moves before ~/start or ~/next.
"""

import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from imu_calibration.api.choices import calibration_options
from imu_calibration.core.errors import ImuCalibrationError, InputError, shortened
from imu_calibration.core.settings import path_setting, setting, text_setting
from imu_calibration.document import files
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.calibration_text import calibration_from_text
from imu_calibration.kinematics.motion_limits import (
    NOT_CHECKED,
    TrajectoryPoints,
    limit_words,
    limits_of,
    missing_ranges,
    range_warnings,
)
from imu_calibration.nodes.calibration_status import driven_markers
from imu_calibration.nodes.diagnostics import (
    ERROR,
    LOG_ERROR,
    LOG_INFO,
    OK,
    WARN,
    Complaints,
    DiagnosticsPublisher,
    make_status,
    say,
)
from imu_calibration.nodes.inputs import BatchInput, MatchedInput, latched_qos, watch_inputs
from imu_calibration.nodes.joint_commands import COMMANDS, OtherCommanders, make_command
from imu_calibration.nodes.lifecycle import (
    HINTS,
    announce,
    declare_parameters,
    every,
    guarded,
    run_node,
)
from imu_calibration.nodes.planner_worker import Peers, PlannerWorker, findings_from
from imu_calibration.nodes.robot_stand import RobotSettings, live_reference
from imu_calibration.planning.campaign import (
    Campaign,
    CampaignSettings,
    CollinearFinding,
    separator_of,
)
from imu_calibration.planning.driver import Driver, DriverSettings, DriveState
from imu_calibration.planning.motion_library import up_at
from imu_calibration.planning.planner import Planner, make_planner
from imu_calibration.planning.planning_problem import expected_noise
from imu_calibration.simulation.sensor_noise import GRADES
from msg_adapters.joint_state import decode_joints, find_joint_layout
from msg_adapters.layout import MessageError, Packed


@dataclass(frozen=True)
class PlannerNodeSettings:
    """Moved joints, parameters to determine, and interface of the commands."""

    table_file: str = path_setting(
        'description of the table with the limits of its joints, path; empty: urdf_file describes'
        ' the arm',
        'other joints, or limits that are not theirs',
    )
    tolerances_file: str = path_setting(
        'tolerances, path; empty: the installed config/tolerances.yaml',
        'motions last too long, or end too early',
    )
    accelerometer_model: str = text_setting(
        'as of calibration_node',
        'motions for parameters that are not estimated',
    )
    gyroscope_model: str = text_setting(
        'as of calibration_node',
        'motions for parameters that are not estimated',
    )
    reference_model: str = text_setting(
        'as of calibration_node',
        'motions for parameters that are not estimated',
    )
    grade: str = text_setting(
        'grade of the noise that is expected before it is known: ' + ', '.join(sorted(GRADES)),
        'the predicted standard deviations are not reached',
        default='industrial',
        choices=tuple(sorted(GRADES)),
    )
    noise_file: str = path_setting(
        'noise.yaml of this IMU, from the verb noise, path; empty: that of the grade',
        'the predicted standard deviations are not reached',
    )
    imu_rate: float = setting(
        100.0,
        'Hz',
        'Imu messages per second',
        (1.0, 20000.0),
        'the predicted standard deviations are not reached',
    )
    command: str = text_setting(
        'how trajectories are sent: topic (joint_trajectory), action (follow_joint_trajectory,'
        ' needs control_msgs) or auto (the action where there is one)',
        'nothing moves',
        default='topic',
        choices=COMMANDS,
    )
    max_turns: float = setting(
        1.0,
        '1',
        'turns of an endless joint to either side of its position at the first start, unwound at'
        ' the end; 0: unlimited, for slip rings',
        (0.0, 1e4),
        'too large: cables are wound up; too small: slow plans',
        fixed='the range of every joint is set at the first start',
    )
    reach_deg: float = setting(
        0.0,
        'deg',
        'largest angle of each joint to either side of its position at the first start; '
        'sliding joints do not move; 0: the whole range',
        (0.0, 3600.0),
        'too large: collisions',
        fixed='the range of every joint is set at the first start',
    )
    calibration_node: str = text_setting(
        'name of the node that collects the windows',
        '~/start reports a missing service',
        default='calibration_node',
    )


MODELS = ('accelerometer_model', 'gyroscope_model', 'reference_model')
"""Parameters that are choices of a calibration."""
CLOCK_CHECK_SECONDS = 0.1
"""Seconds between two checks of the clock."""
MID_MOTION = 'stopped in mid-motion'
"""Outcome of a node that ended during a motion."""
RESPONSE_SECONDS = 60.0
"""Seconds to wait for a solution, and for a diagnosis that has begun."""


class PlannerNode(Node):
    """Receives the joint states, and executes the decisions of its worker."""

    def __init__(self, **options: Any) -> None:
        super().__init__('planner_node', **options)
        self.settings = settings = declare_parameters(self, PlannerNodeSettings)
        self._campaign_settings = declare_parameters(self, CampaignSettings, self._change_campaign)
        driver_settings = declare_parameters(self, DriverSettings, self._change_driver)
        robot = declare_parameters(self, RobotSettings)
        announce(
            self,
            ['joint_states', 'imu/calibration', '/diagnostics'],
            ['joint_trajectory', 'imu/coverage'],
            note=NOT_CHECKED,
        )

        # The joints to be moved, and the calibration to be planned for.
        self._table = live_reference(self, robot, settings.table_file).table_for(
            "planner_node moves the joints of 'table_file' or 'urdf_file'", 'table_missing'
        )
        self._options = calibration_options(self._choices())

        # State that several threads use.
        self._lock = threading.RLock()
        """Guards the driver."""
        self._stamp = 0.0
        """Stamp of the last joint state, s."""
        self._received = threading.Condition()
        """Guards the three messages of calibration_node below; notified by each new one."""
        self._diagnosis_values: dict[str, str] = {}
        """Values of the last status 'diagnosis'."""
        self._document_text: str | None = None
        """The last calibration document."""
        self._n_documents = 0
        """Number of received documents."""
        self._is_halted = False
        """Whether the end of the node stopped a motion."""
        self._driven_marker: MarkerArray | None = None
        """Picture of the motion that is driven, or was driven last."""
        self._complaints = Complaints(self.get_logger())
        self._names = tuple(self._table.joint_names)
        self.driver = Driver(self._names, limits_of(self._table), driver_settings)
        self._is_placed = False
        """Whether the ranges of the joints are set, at the first start."""

        # Commands to the joints, and the thread that selects them.
        self._command = make_command(self, settings.command, self._refused)
        self._other_commanders = OtherCommanders(self, self._command)
        self.worker = self._make_worker()
        self._connect()
        self._diagnostics = DiagnosticsPublisher(self, self._statuses)
        self.worker.start()
        self.get_logger().info(
            f'will move the joints {", ".join(self._table.joint_names)} by {self._command.name}; '
            f'no motion before ~/start; limits: {self._limit_words()}'
        )
        for line in range_warnings(self._table):
            self.get_logger().warning(line)

    def _choices(self) -> dict[str, Any]:
        """Return the choices of the calibration that is planned for, by name."""
        settings = self.settings
        choices = {name: getattr(settings, name) or None for name in MODELS}
        if settings.tolerances_file:
            choices['tolerances'] = files.user_path(settings.tolerances_file)
        if settings.noise_file:
            choices['noise'] = files.user_path(settings.noise_file)
        return choices

    def _make_worker(self) -> PlannerWorker:
        """Return the thread that selects the motions; its time is that of the joint states."""
        peers = Peers(
            measure=self._measure,
            latest=self._latest,
            diagnose=self._diagnose,
            send=self._send,
            stop=self._stop_joints,
            say=self._say,
            obstacle=self._other_commanders.obstacle,
        )
        worker = PlannerWorker(self.driver, self._make_campaign, peers=peers, lock=self._lock)
        worker.stamp = lambda: self._stamp
        return worker

    def _connect(self) -> None:
        """Subscribe to the inputs, and offer the services and the picture of the motion."""
        # All waiting joint states at once: one by one they would be delayed while a plan is made,
        # and the motion would begin at an earlier position of the joints.
        self._joints = BatchInput(
            self, JointState, 'joint_states', add=self._guarded(self._joint_state), single=False
        )
        self._calibrations = MatchedInput(
            self,
            String,
            'imu/calibration',
            callback=self._guarded(self._document),
            raw=False,
            latched=True,
        )
        watch_inputs(self, [self._joints, self._calibrations])
        self.create_subscription(
            DiagnosticArray, '/diagnostics', self._guarded(self._diagnostic), 100
        )
        self._calibration_clients = {
            service: self.create_client(Trigger, f'{self.settings.calibration_node}/{service}')
            for service in ('solve', 'diagnose')
        }
        actions = {
            'start': lambda: self._go(-1),
            'next': lambda: self._go(1),
            'stop': self._stop,
        }
        for service, action in actions.items():
            self.create_service(Trigger, f'~/{service}', partial(self._serve, service, action))
        every(self, CLOCK_CHECK_SECONDS, self._guarded(self._tick))
        self._coverage = self.create_publisher(MarkerArray, 'imu/coverage', latched_qos())

    def close(self) -> str:
        """Stop the joints; return the outcome."""
        unstopped = self.driver.is_driving  # the context has ended, and no message can be sent
        self.worker.end()
        if unstopped:
            return 'the joints finish the motion that they are in'
        return MID_MOTION if self._is_halted else ''

    def halt(self) -> None:
        """Stop the joints; called at the first signal, while messages can still be sent."""
        if self.driver.is_driving:
            self._is_halted = True
            self.worker.halt('the node is ending')

    def _change_campaign(self, group: CampaignSettings) -> None:
        """Use other settings for the selection of motions."""
        self._campaign_settings = group
        if self.worker.campaign is not None:
            self.worker.campaign.settings = group

    def _change_driver(self, group: DriverSettings) -> None:
        """Use other settings for the execution of motions."""
        with self._lock:
            self.driver.change(group)

    def _make_campaign(self) -> Campaign:
        """Return a campaign for the table, from the present calibration if there is one."""
        noise = expected_noise(self._options.noise, self.settings.grade, self.settings.imu_rate)
        planner = make_planner(
            self._table,
            noise=noise,
            tolerances=self._options.tolerances,
            rate=self.settings.imu_rate,
            options=self._options,
            limits=self.driver.limits,
            calibration=self._latest(),
        )
        return Campaign(
            planner,
            self._campaign_settings,
            lambda finding: self._make_separator(finding, noise),
            first=lambda position: planner.probe(position, self.driver.first_reach),
            unwind=planner.unwinding,
        )

    def _make_separator(self, finding: CollinearFinding, noise: dict) -> Planner:
        """Return the planner of motions that separate a finding from its collinear effects."""
        calibration = self._latest()
        if calibration is None:
            raise InputError(
                'a calibration is required before causes can be separated, none was received;'
                ' publish imu/calibration'
            )
        return separator_of(
            self._table,
            calibration,
            finding,
            noise=noise,
            rate=self.settings.imu_rate,
            options=self._options,
            limits=self.driver.limits,
        )

    def _send(self, points: TrajectoryPoints) -> None:
        """Send a trajectory to the controller, and publish its picture."""
        self._command.send(points)
        calibration = self._latest()
        self._driven_marker = driven_markers(
            up_at(self._table, points.position[-1]),
            f'motion {self.driver.motions}: {self.worker.motion.words}',
            frame_id=calibration.frame_id if calibration else '',
            stamp=self.get_clock().now().to_msg(),
        )
        self._coverage.publish(self._driven_marker)

    # Received messages.

    def _joint_state(self, serialized: bytes, _: int) -> None:
        """Pass a JointState to the driver, and stop the joints if it requires that."""
        try:
            samples = decode_joints(
                find_joint_layout(serialized), Packed.join([serialized]), self._names
            )
        except MessageError as error:
            self._complaints.event(f'joint_states: {error}; it is left out')
            return
        now = time.monotonic()
        self._stamp = float(samples.stamp_ns[0]) * 1e-9 if samples.stamp_ns[0] else now
        with self._lock:
            ignored = dict(self.driver.ignored)
            must_stop = self.driver.observe(
                self._stamp, samples.position[0], samples.velocity[0], now=now
            )
        if self.driver.ignored != ignored:
            self._complaints.event(
                f'joint_states: positions must be finite{self.driver.ignored_words()}; see the'
                ' driver of that joint'
            )
        if must_stop:
            self._stopped()

    def _document(self, message: String) -> None:
        """Store a calibration document."""
        with self._received:
            self._document_text = message.data
            self._n_documents += 1
            self._received.notify_all()

    def _diagnostic(self, message: DiagnosticArray) -> None:
        """Store the values of calibration_node's status 'diagnosis'."""
        wanted = f'{self.settings.calibration_node.lstrip("/")}: diagnosis'
        for status in message.status:
            if status.name.endswith(wanted):
                with self._received:
                    self._diagnosis_values = {pair.key: pair.value for pair in status.values}
                    self._received.notify_all()

    def _tick(self) -> None:
        """Stop the joints when the driver requires it by the time, as without joint states."""
        with self._lock:
            must_stop = self.driver.tick(time.monotonic())
        if must_stop:
            self._stopped()

    def _guarded(self, callback: Callable) -> Callable:
        """Return a callback whose exceptions stop the joints instead of ending the node."""
        return guarded(callback, self._failed)

    def _failed(self, error: Exception) -> str:
        """Stop the joints after an exception; return the line that is logged."""
        if not self.context.ok():  # the node is ending
            return ''
        line = shortened(f'an internal error: {type(error).__name__}: {error}', 200)
        if self.driver.is_driving or self.worker.doing:
            self.worker.halt(f'{line}: stopped; start again, and report it')
        self._complaints.event(line, LOG_ERROR)
        return line

    def _refused(self, why: str) -> None:
        """Process the refusal of a trajectory by the controller."""
        with self._lock:
            must_stop = self.driver.refused(why)
        if must_stop:
            self._stopped()

    def _stopped(self) -> None:
        """Stop the joints, and log the reason of the driver."""
        self._stop_joints()
        self._say(LOG_ERROR, self.driver.reason)

    def _stop_joints(self) -> None:
        """Send the stop to the controller unless the context has ended."""
        if not self.context.ok():
            return
        self._command.stop(self._names)
        self._diagnostics.publish_now()

    # Requests of the worker.

    def _latest(self) -> Calibration | None:
        """Return the last received calibration."""
        with self._received:
            text = self._document_text
        return None if text is None else calibration_from_text(text)

    def _ask(self, service: str) -> Trigger.Response | None:
        """Call a service of calibration_node from the worker's thread; None without a response."""
        future = self._calibration_clients[service].call_async(Trigger.Request())
        done = threading.Event()
        future.add_done_callback(lambda _: done.set())
        return future.result() if done.wait(RESPONSE_SECONDS) else None

    def _measure(self) -> Calibration | None:
        """Request a solution; return its calibration, None while there is none."""
        n_before = self._n_documents
        response = self._ask('solve')
        if response is None:
            raise InputError(
                f'calibration must answer ~/solve within {RESPONSE_SECONDS:g} s,'
                f" '{self.settings.calibration_node}' did not; check that it runs"
            )
        if not response.success:
            self._say(LOG_INFO, f'no calibration yet: {response.message}')
            return None
        with self._received:
            self._received.wait_for(lambda: self._n_documents > n_before, timeout=2.0)
        return self._latest()

    def _diagnose(self) -> list[CollinearFinding] | None:
        """Request a diagnosis; return its findings, None without a result in time."""
        n_before = self._diagnosis_values.get('diagnoses', '0')
        response = self._ask('diagnose')
        if response is None or not response.success:
            reason = response.message if response else 'no answer'
            self._say(LOG_INFO, f'no diagnosis: {reason}')
            return None

        def is_complete() -> bool:
            values = self._diagnosis_values
            has_new = values.get('diagnoses', '0') != n_before
            return has_new and values.get('being made') == 'False'

        with self._received:
            is_in_time = self._received.wait_for(is_complete, timeout=RESPONSE_SECONDS)
            values = dict(self._diagnosis_values)
        return findings_from(values) if is_in_time else None

    # Requests of the user.

    def _go(self, motions: int) -> tuple[bool, str]:
        """Begin so many motions, -1: all that are needed; return (success, message)."""
        refusal = self._refusal_to_start()
        if refusal:
            return False, refusal

        # The position at the first start is the middle of the permitted ranges.
        if not self._is_placed:
            assert self.driver.position is not None  # otherwise the start is refused
            limits = self.driver.limits.wound(self.driver.position, self.settings.max_turns)
            if self.settings.reach_deg:
                limits = limits.reached(self.driver.position, self.settings.reach_deg)
            self.driver.limits = limits
            self._is_placed = True
        self.worker.go(motions)
        extent = 'one motion, then it rests'
        if motions <= 0:
            extent = (
                'plans and moves until every parameter is within its tolerance; the first motion is'
                ' small, the first large one slow'
            )
        return True, f'{extent}; limits: {self._limit_words()}'

    def _refusal_to_start(self) -> str:
        """Return the first precondition of a motion that is not met, '' if all are met."""
        if self.driver.is_driving or self.worker.doing:
            activity = self.worker.doing or self.driver.reason
            return f'it is at work already: {activity}; ~/stop stops it'
        if missing_ranges(self._table):
            return range_warnings(self._table)[0]
        if self.driver.position is None:
            return self._joints.silence(self.driver.ignored_words().strip(' ()'))
        stamp_fault = self.driver.stamp_fault(time.monotonic())
        if stamp_fault:
            return stamp_fault
        if not self._command.is_heard:
            return (
                f'{self._command.name} has no subscriber: start the controller, or remap'
                ' joint_trajectory'
            )
        obstacle = self._other_commanders.obstacle()
        if obstacle:
            return obstacle
        solve = self._calibration_clients['solve']
        if not solve.service_is_ready():
            return (
                f'service {solve.srv_name} does not exist; start'
                ' calibration_node, which collects the windows'
            )
        return ''

    def _limit_words(self) -> str:
        """Return a text on the present limits of the joints."""
        return '; '.join(limit_words(self._table, self.driver.limits))

    def _stop(self) -> tuple[bool, str]:
        """Stop at once; return (success, message)."""
        self.worker.halt('stopped by ~/stop')
        return True, 'stopped: no motion before the next ~/start'

    def _serve(
        self,
        service: str,
        action: Callable[[], tuple[bool, str]],
        _: Trigger.Request,
        response: Trigger.Response,
    ) -> Trigger.Response:
        """Respond to a request with (success, message) of `action`, or its error."""
        try:
            response.success, response.message = action()
        except ImuCalibrationError as error:
            response.message = error.with_hint(HINTS['planner_node'])
        except Exception as error:
            response.message = self._failed(error)
        self._say(LOG_INFO if response.success else LOG_ERROR, f'~/{service}: {response.message}')
        self._diagnostics.publish_now()
        return response

    def _say(self, level: str, line: str) -> None:
        """Log a line unless the node is ending."""
        if self.context.ok():
            say(self.get_logger(), level, line)

    def _statuses(self) -> list:
        """Return the status 'drive' for the diagnostics."""
        # Again, because calibration_node's markers begin with DELETEALL.
        if self._driven_marker is not None:
            self._coverage.publish(self._driven_marker)
        driver = self.driver
        worker = self.worker
        campaign = worker.campaign
        worst_name, worst_excess = worker.worst
        ignored = [f'{name}:{count}' for name, count in driver.ignored.items()]
        values = {
            'state': driver.state.value,
            'motion': driver.motions,
            'of it driven [s]': f'{driver.progress:.1f}',
            'it takes [s]': f'{worker.seconds:.1f}',
            'elapsed [s]': f'{worker.elapsed:.1f}',
            'outside tolerance': worker.outside,
            'furthest outside': worst_name,
            'standard deviation over tolerance': f'{worst_excess:.2f}',
            'commands': self._command.name,
            'ignored joint states': ' '.join(ignored),
        }
        if campaign is not None and campaign.findings is not None:
            mates: list[str] = []
            for finding in campaign.findings:
                mates += finding.mates
            values |= {
                'found': ' '.join(finding.effect for finding in campaign.findings),
                'mates': ' '.join(mates),
                'separations': campaign.separations,
                'separating': campaign.is_separating,
                'told apart': ' '.join(campaign.told_apart),
            }
        faults = self._joints.faults() + self._calibrations.faults()
        level = WARN if faults else OK
        if driver.state == DriveState.STOPPED:
            level = ERROR
        return [
            make_status(
                level,
                'drive',
                '; '.join([worker.doing or f'{driver.state}: {driver.reason}', *faults]),
                values=values,
            )
        ]


def main(arguments: list[str] | None = None) -> int:
    """Run the node; return the exit code."""
    return run_node(PlannerNode, arguments, hints=HINTS['planner_node'])


if __name__ == '__main__':
    sys.exit(main())
