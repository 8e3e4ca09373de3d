"""
calibration_node.

Calibrates an IMU on a table while the table moves, or by hand while it is turned from pose to pose.

in: imu/data_raw (sensor_msgs/Imu), joint_states (sensor_msgs/JointState, on a table),
imu/temperature (sensor_msgs/Temperature, for thermal effects). out: imu/calibration
(std_msgs/String, the calibration document, latched), imu/residual (sensor_msgs/Imu), imu/coverage
(visualization_msgs/MarkerArray, latched: the gain of each attitude, and the next motion),
/diagnostics. services: ~/solve, ~/diagnose (returns at once; the result is published on
/diagnostics), ~/save, ~/reset.
"""

import sys
import time
from concurrent.futures import wait
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from rclpy.node import Node
from sensor_msgs.msg import Imu, JointState, Temperature
from std_msgs.msg import String
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from imu_calibration.api.choices import calibration_options, provenance_with
from imu_calibration.calibration.live import LiveByHandSettings, LiveSession, LiveSettings
from imu_calibration.core.errors import ImuCalibrationError
from imu_calibration.core.settings import flag_setting, path_setting, setting, text_setting
from imu_calibration.document import files
from imu_calibration.nodes.calibration_status import CalibrationGuide, markers_of, statuses_of
from imu_calibration.nodes.calibration_worker import CalibrationWorker, SessionFiles
from imu_calibration.nodes.diagnosis_thread import Listeners, give_arrays_own_pages
from imu_calibration.nodes.diagnostics import (
    LOG_ERROR,
    LOG_INFO,
    REMINDER,
    Complaints,
    DiagnosticsPublisher,
    say,
)
from imu_calibration.nodes.inputs import BatchInput, latched_qos, output_qos, watch_inputs
from imu_calibration.nodes.lifecycle import HINTS, announce, declare_parameters, run_node
from imu_calibration.nodes.robot_stand import (
    RobotSettings,
    joint_topics,
    live_reference,
    stand_path,
    words_of,
)
from imu_calibration.preprocessing.window import WindowSettings
from msg_adapters.layout import Packed
from msg_adapters.live import LiveGatherer
from msg_adapters.write import encode_imu

INPUT_DEPTH = 5000
"""Messages that may wait: 2.5 s at 2 kHz, while numpy holds the interpreter."""
MOST_WAITING = 200_000
"""
Messages of a kind that wait for the worker at most, 100 s at 2 kHz; then the oldest are dropped and
counted.
"""
DOCUMENTED = (
    'accelerometer_model',
    'gyroscope_model',
    'reference_model',
    'model_as_asked',
    'serial',
    'operator',
)
"""Parameters that the document names with their values."""
MAX_SILENCE_SECONDS = 3.0
"""Seconds after the start from which a silent topic is reported."""


@dataclass(frozen=True)
class CalibrationNodeSettings:
    """Inputs, reference and outputs of the node."""

    table_file: str = path_setting(
        'table description, path; empty or none: no table, calibrate by hand from poses held still'
        ' and the turns between them',
        'joint states are not listened to',
        fixed='all motion gathered so far belongs to the table',
    )
    frame_id: str = text_setting(
        'frame of the Imu messages to use, all other messages are dropped; empty: that of the first'
        ' message',
        'every Imu message is dropped, see diagnostics',
        session=True,
        fixed='all motion gathered so far is that of one sensor',
    )
    accelerometer_model: str = text_setting(
        'named model or effect names joined by +; empty: bias+matrix, and with a table'
        ' accel_size_effect when the rotation shows it',
        'an effect of the sensor remains in the residuals',
        fixed='motion is gathered for the model',
    )
    gyroscope_model: str = text_setting(
        'the same for the gyroscope; empty: bias+matrix',
        'an effect of the sensor remains in the residuals',
        fixed='motion is gathered for the model',
    )
    reference_model: str = text_setting(
        'effects of table and clock joined by +, or none; empty: table_tilt, and earth_rate when'
        ' latitude or azimuth is unknown',
        'a tilted table shows as accelerometer bias',
        fixed='motion is gathered for the model',
    )
    model_as_asked: bool = flag_setting(
        'do not extend the model by effects that the data support',
        'an unmodelled effect biases the parameters',
        fixed='motion is gathered for the model',
    )
    tolerances_file: str = path_setting(
        'tolerances, path; empty: the installed config/tolerances.yaml',
        'good parameters are called weak',
    )
    effects_file: str = path_setting(
        'own effects in addition to the catalogue, path: YAML with effects: NAME: {sensor, column,'
        ' unit, tolerance, text}, or a calibration with own effects; a model may then name them',
        'the node refuses a model that names them',
        fixed='motion is gathered for the model',
    )
    noise_file: str = path_setting(
        'noise.yaml of this IMU, from the verb noise: motion of its biases between windows, on a'
        ' table; empty: estimated from the windows',
        'standard deviations of the biases are too large or too small',
        fixed='one session is judged by one noise',
    )
    save_file: str = path_setting(
        'file of ~/save for the calibration; the accumulator is NAME.accumulator.npz in the same'
        ' folder, written also when the node ends with unsaved motion; files of an earlier session'
        ' are renamed (NAME.1), except with resume; empty: calibration.yaml in the working'
        ' directory, by ~/save only',
        'the node reports at its start that the folder is not writable',
    )
    serial: str = text_setting(
        'serial number of the IMU, for the calibration',
        'calibrations of several units are not distinguished',
        session=True,
    )
    operator: str = text_setting(
        'name of the operator, for the calibration',
        'a calibration does not name its operator',
        session=True,
    )
    resume: bool = flag_setting(
        'continue with the accumulator in the folder of save_file if it exists',
        'old motion of another IMU enters the calibration',
        session=True,
    )
    autosave_period: float = setting(
        0.0,
        's',
        'save the accumulator this often; 0: only with ~/save',
        (0.0, 86400.0),
        'after a crash the session starts from the last ~/save',
        live=True,
    )


class CalibrationNode(Node):
    """Passes messages to the worker and reports its results."""

    def __init__(self, **options: Any) -> None:
        super().__init__('calibration_node', **options)
        robot = self._declare_settings()

        # The reference and the session, new or resumed.
        joints = joint_topics(robot, self.settings.table_file)
        announce(
            self,
            ['imu/data_raw', *joints, 'imu/temperature'],
            ['imu/calibration', 'imu/residual', 'imu/coverage'],
        )
        gravity, gravity_sd = self._session_settings[LiveByHandSettings].place
        self._reference = live_reference(
            self,
            robot,
            self.settings.table_file,
            frame_id=self.settings.frame_id,
            gravity=gravity,
            gravity_sd=gravity_sd,
        )
        session_files = SessionFiles(self.settings.save_file)
        live = self._resumed(session_files) if self.settings.resume else self._make_live()
        self._gatherer = LiveGatherer(
            self._reference.joint_names, MOST_WAITING, self.settings.frame_id or live.frame_id
        )
        # The thread that makes the results.
        self.worker = CalibrationWorker(
            self._gatherer,
            live,
            self._make_live,
            session_files=session_files,
            autosave_period=self.settings.autosave_period,
            listeners=self._make_listeners(),
            hints=HINTS['calibration_node'],
            provenance=self._provenance(robot),
        )

        # Services and streams, then logs and diagnostics.
        for service in ('solve', 'diagnose', 'save', 'reset'):
            self.create_service(Trigger, f'~/{service}', partial(self._serve, service))
        self._complaints = Complaints(self.get_logger())
        self._started = time.monotonic()
        """Time of the start, s of the steady clock."""
        self._listen(joints)
        reference = self._reference.live_words(words_of(robot, self.settings.table_file))
        self.get_logger().info(f'calibrates {reference}; ~/save writes {session_files.calibration}')
        self._guide = CalibrationGuide(
            self._inputs,
            f'ros2 service call {self.get_fully_qualified_name()}/save std_srvs/srv/Trigger',
            live.observations.removesuffix('s'),
        )
        self._diagnostics = DiagnosticsPublisher(self, self._statuses)
        self.worker.start()

    def _declare_settings(self) -> RobotSettings:
        """Declare all parameters; return those of the arm, which are not kept."""
        self.settings = declare_parameters(
            self, CalibrationNodeSettings, self._change_files, hints=HINTS['calibration_node']
        )
        self._session_settings: dict[type, Any] = {
            LiveSettings: declare_parameters(self, LiveSettings, self._change_session),
            WindowSettings: declare_parameters(self, WindowSettings, self._change_session),
        }
        self._options = calibration_options(
            {name: chosen or None for name, chosen in self._choices().items()}
        )
        self._session_settings[LiveByHandSettings] = declare_parameters(
            self, LiveByHandSettings, self._change_place
        )
        return declare_parameters(self, RobotSettings)

    def _make_listeners(self) -> Listeners:
        """Make the publishers of the results; return the functions that publish on them."""
        document = self.create_publisher(String, 'imu/calibration', latched_qos())
        self._residual = self.create_publisher(Imu, 'imu/residual', output_qos())
        markers = self.create_publisher(MarkerArray, 'imu/coverage', latched_qos())
        return Listeners(
            lambda text: self._publish(document, String(data=text)),
            self._publish_residuals,
            lambda coverage: self._publish(
                markers, markers_of(coverage, self.get_clock().now().to_msg())
            ),
        )

    def _listen(self, joints: list[str]) -> None:
        """Subscribe to the streams; `joints` has the topic of the joint states, if there is one."""
        # Message type, topic, receiver.
        topics = {
            'imu': (Imu, 'imu/data_raw', self._gatherer.add_imu),
            'temperature': (Temperature, 'imu/temperature', self._gatherer.add_temperature),
        }
        for topic in joints:
            topics['joints'] = (JointState, topic, self._gatherer.add_joints)
        self._inputs: dict[str, BatchInput] = {}
        for name, (kind, topic, add) in topics.items():
            # The joints of an arm may have several publishers.
            single = name != 'joints'
            self._inputs[name] = BatchInput(
                self, kind, topic, add=add, depth=INPUT_DEPTH, single=single
            )
        watch_inputs(self, list(self._inputs.values()))

    def close(self) -> str:
        """End the worker after its present step; return the outcome for unsaved motion."""
        return self.worker.end()

    def _choices(self) -> dict[str, Any]:
        """Return the choices that the document names: option -> value or path."""
        settings = self.settings
        choices = {name: getattr(settings, name) for name in DOCUMENTED}
        paths = {
            'tolerances': settings.tolerances_file,
            'catalogue': settings.effects_file,
            'noise': settings.noise_file,
        }
        for name, path in paths.items():
            if path:
                choices[name] = files.user_path(path)
        return choices

    def _provenance(self, robot: RobotSettings) -> dict[str, Any]:
        """Return options and files for the document."""
        stand = stand_path(robot, self.settings.table_file)
        return provenance_with('calibration_node', (), self._choices(), stand=stand)

    def _make_live(self, saved: bytes | None = None) -> LiveSession:
        """Return a new session, or one that continues with the accumulator `saved`."""
        options = replace(self._options, windows=self._session_settings[WindowSettings])
        live = self._session_settings[LiveSettings]
        by_hand = self._session_settings[LiveByHandSettings]
        return self._reference.live(options, live, by_hand, saved=saved)

    def _resumed(self, session_files: SessionFiles) -> LiveSession:
        """Return the session that continues the saved one, or a new one where that fails."""
        try:
            live = self._make_live(session_files.earlier())
        except ImuCalibrationError as error:
            renamed = session_files.put_aside()  # a save would write over it
            say(
                self.get_logger(),
                LOG_ERROR,
                f'the saved session cannot be continued: {error}; a new one starts, '
                f'earlier motion is in {renamed}',
            )
            return self._make_live()
        session_files.continue_earlier()
        line = f'no session in {session_files.accumulator}: a new session starts'
        if live.n_windows:
            gathered = f'{live.n_windows} {live.observations}'
            line = f'continued with {gathered} from {session_files.accumulator}'
        self.get_logger().info(line)
        return live

    def _serve(
        self, service: str, _: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Execute a request in the worker's thread; receive messages meanwhile."""
        outcome = self.worker.ask(service)
        while not wait([outcome], 0.005).done:
            for source in self._inputs.values():
                source.drain()
            if not self.worker.is_alive():
                break
        response.success, response.message = outcome.result() if outcome.done() else (False, '')
        level = LOG_INFO
        if not response.success and not self.worker.state.is_gathering:
            level = LOG_ERROR
        say(self.get_logger(), level, f'~/{service}: {response.message}')
        self._diagnostics.publish_now()
        return response

    # Changed parameters: the period of saving is applied at once, the remaining ones by the worker
    # between two steps.

    def _change_files(self, group: CalibrationNodeSettings) -> None:
        """Use another period of saving."""
        self.worker.autosave_period = group.autosave_period
        self.settings = group

    def _change_place(self, group: LiveByHandSettings) -> None:
        """Use another place by hand; raises an ImuCalibrationError if the reference refuses it."""
        self._reference.check_place(self._session_settings[LiveByHandSettings].place, group.place)
        self._change_session(group)

    def _change_session(self, group: LiveSettings | WindowSettings | LiveByHandSettings) -> None:
        """Use other settings of the session from the worker's next step on."""
        self._session_settings[type(group)] = group
        self.worker.ask(lambda: self.worker.change(group))

    def _publish_residuals(self, residuals: Any) -> None:
        """Publish ImuSamples as messages."""
        for message in Packed.of_rows(encode_imu(residuals)).views():
            self._publish(self._residual, bytes(message))

    def _publish(self, publisher: Any, message: Any) -> None:
        """Publish a message, from the worker's thread."""
        try:
            publisher.publish(message)
        except Exception:
            if self.context.ok():  # false while the node shuts down and the worker finishes
                raise

    def _statuses(self) -> list:
        """Return the diagnostics, and print changes on the terminal."""
        state = self.worker.state
        streams = state.streams

        # Faults of the topics and silent streams; streams with faulty samples if none is silent.
        faults = self._topic_faults()
        trouble = []
        if streams is not None:
            for name in streams.silent:
                faults.append(self._inputs[name].silence(streams.unusable.get(name, '')))
            if streams.word == 'trouble' and not streams.silent:
                trouble.append(streams.message)
        if time.monotonic() - self._started > MAX_SILENCE_SECONDS:
            self._complaints.now('calibration', faults, state.faults)
            self._complaints.now('streams', trouble, patience=REMINDER)
        for level, line in self._guide.lines(state):
            say(self.get_logger(), level, line)
        return statuses_of(state, faults)

    def _topic_faults(self) -> list[str]:
        """Return the faults of the inputs, and a line on joint states that are not read."""
        lines = []
        for source in self._inputs.values():
            lines += source.faults()
        reads_joints = 'joints' in self._inputs
        if not reads_joints and self.count_publishers(self.resolve_topic_name('joint_states')):
            lines.append(
                'joint states are published and not listened to: '
                "to calibrate on a table or an arm give 'table_file' or 'urdf_file'"
            )
        return lines


def main(arguments: list[str] | None = None) -> int:
    """Run the node; return the exit code."""
    give_arrays_own_pages()
    return run_node(CalibrationNode, arguments, hints=HINTS['calibration_node'])


if __name__ == '__main__':
    sys.exit(main())
