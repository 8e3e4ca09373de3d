"""calibration_node: calibrates an IMU on a table while the table moves, or by hand while it is turned from pose to pose."""

import sys
from dataclasses import dataclass
from pathlib import Path

from rclpy.node import Node
from sensor_msgs.msg import Imu, JointState, Temperature
from std_msgs.msg import String
from std_srvs.srv import Trigger

from imu_calibration import files
from imu_calibration.by_hand.live import LiveByHand, LiveByHandSettings
from imu_calibration.calibration import accumulator_state
from imu_calibration.calibration.live import LiveCalibration, LiveSettings
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.nodes.batches import BatchSubscription
from imu_calibration.nodes.calibration_status import statuses_of
from imu_calibration.nodes.calibration_worker import CalibrationWorker, accumulator_file
from imu_calibration.nodes.diagnostics import DiagnosticsPublisher
from imu_calibration.nodes.hints import HINTS
from imu_calibration.nodes.lifecycle import run_node
from imu_calibration.nodes.parameters import declare_parameters
from imu_calibration.nodes.qos import input_qos, latched_qos, output_qos
from imu_calibration.resources import config_file
from imu_calibration.segmentation.window_settings import WindowSettings
from imu_calibration.settings import setting
from msg_adapters.encode import encode_imu, rows
from msg_adapters.live import LiveGatherer

INPUT_DEPTH = 5000
"""Messages that may wait: 2.5 s at 2 kHz, while numpy holds the interpreter."""
MOST_WAITING = 200_000
"""Messages of a kind that wait for the worker at most, 100 s at 2 kHz; then the oldest are dropped and counted."""
COMPLAINT_PERIOD = 10.0
"""Seconds between two warnings."""


@dataclass(frozen=True)
class CalibrationNodeSettings:
    """What the node reads, asks for and writes."""

    table_file: str = setting('', '', 'table description, path; empty: no table, calibrate by hand from poses held still and the '
                              'turns between them', symptom='joint states are not listened to')
    frame_id: str = setting('', '', 'frame of the Imu messages to use, others are dropped; empty: that of the first message',
                            symptom='every Imu message is dropped, diagnostics say so')
    reliable: bool = setting(False, '', 'subscribe reliably instead of best-effort', symptom='a best-effort publisher never connects')
    accelerometer_model: str = setting('', '',
                                       'named model or effect names joined by +; empty: bias+matrix, and with a table accel_size_effect '
                                       'when the rotation shows it', symptom='an effect that is there stays in the residuals')
    gyroscope_model: str = setting('', '', 'the same for the gyroscope; empty: bias+matrix',
                                   symptom='an effect that is there stays in the residuals')
    reference_model: str = setting('', '',
                                   "effects of table and clock joined by +, or none; empty: table_tilt, and earth_rate when latitude or "
                                   'azimuth is unknown', symptom='a tilted table shows as accelerometer bias')
    tolerances_file: str = setting('', '', 'tolerances, path; empty: the installed config/tolerances.yaml',
                                   symptom='good parameters are called weak')
    save_file: str = setting('calibration.yaml', '',
                             'where ~/save writes the calibration; the accumulator goes beside it as NAME.accumulator.npz',
                             symptom='~/save answers that the place is not writable')
    resume: bool = setting(False, '', 'go on with the accumulator beside save_file when there is one',
                           symptom='old motion of another IMU enters the calibration')
    autosave_period: float = setting(0.0, 's', 'save the accumulator this often; 0: only with ~/save', (0.0, 86400.0),
                                     'after a crash the session starts from the last ~/save')


class CalibrationNode(Node):
    """Listens, and tells what the worker finds."""

    def __init__(self):
        super().__init__('calibration_node')
        self.settings = declare_parameters(self, CalibrationNodeSettings)
        self._live_settings = declare_parameters(self, LiveSettings)
        self._options = self._read_options(declare_parameters(self, WindowSettings))
        self._by_hand = declare_parameters(self, LiveByHandSettings)
        self._table = files.read_table(Path(self.settings.table_file).expanduser()) if self.settings.table_file else None
        self._gatherer = LiveGatherer(self._table and self._table.joint_names, MOST_WAITING, self.settings.frame_id)
        self._document = self.create_publisher(String, 'imu/calibration', latched_qos())
        self._residual = self.create_publisher(Imu, 'imu/residual', output_qos())
        self.worker = CalibrationWorker(self._gatherer, self._make_live, self.settings.save_file, self.settings.autosave_period,
                                        self._publish_document, self._publish_residuals, self._complain, self._table is None,
                                        HINTS['calibration_node'])
        self._diagnostics = DiagnosticsPublisher(self, self._statuses)
        for what in ('solve', 'save', 'reset'):
            self.create_service(Trigger, f'~/{what}', lambda request, response, what=what: self._serve(what, response))
        qos = input_qos(self.settings.reliable, INPUT_DEPTH)
        topics = [(Imu, 'imu/data_raw', self._gatherer.add_imu), (Temperature, 'imu/temperature', self._gatherer.add_temperature)]
        if self._table is not None:
            topics.append((JointState, 'joint_states', self._gatherer.add_joints))
        else:
            self.get_logger().info("no 'table_file' was given: calibrates by hand, hold the IMU still in many attitudes "
                                   'and turn it in between')
        self._inputs = [BatchSubscription(self, kind, topic, add, qos) for kind, topic, add in topics]
        self.worker.start()

    def close(self):
        """End the worker after what it is doing."""
        self.worker.end()

    def _read_options(self, windows):
        settings = self.settings
        tolerances = files.read_tolerances(settings.tolerances_file or config_file('tolerances.yaml'))
        return CalibrationOptions(settings.accelerometer_model or None, settings.gyroscope_model or None, settings.reference_model or None,
                                  tolerances, windows)

    def _make_live(self, resume):
        saved = accumulator_file(self.settings.save_file)
        data = saved.read_bytes() if resume and self.settings.resume and saved.is_file() else None
        live = self._make_by_hand(data) if self._table is None else self._make_on_table(data)
        if data is not None:
            self.get_logger().info(f'goes on with {live.n_windows} {"poses" if self._table is None else "windows"} from {saved}')
        return live

    def _make_by_hand(self, data):
        return LiveByHand(self._options, self._live_settings, self._by_hand, data)

    def _make_on_table(self, data):
        live = LiveCalibration(self._table, self._options, self._live_settings)
        if data is None:
            return live
        earlier = accumulator_state.from_bytes(data, live.model or accumulator_state.saved_model(data))
        return LiveCalibration(self._table, self._options, self._live_settings, earlier)

    def _serve(self, what, response):
        request = self.worker.ask(what)
        while not request.done.wait(0.005):
            for subscription in self._inputs:
                subscription.drain()
            if not self.worker.is_alive():
                break
        response.success, response.message = request.success, request.message
        self._diagnostics.publish_now()
        return response

    def _publish_document(self, text):
        self._publish(self._document, String(data=text))

    def _publish_residuals(self, residuals):
        for message in rows(encode_imu(residuals)):
            self._publish(self._residual, bytes(message))

    def _publish(self, publisher, message):
        try:
            publisher.publish(message)
        except Exception:
            if self.context.ok():   # else the node is being shut down while the worker finishes
                raise

    def _complain(self, line):
        self.get_logger().warning(line, throttle_duration_sec=COMPLAINT_PERIOD)

    def _statuses(self):
        if self.worker.failure is not None:
            raise self.worker.failure
        state = self.worker.state
        if state.streams is not None and state.streams.word == 'trouble':
            self._complain(state.streams.message)
        if self._table is None and self.count_publishers(self.resolve_topic_name('joint_states')):
            self.get_logger().info("joint states are published; to calibrate on a table give 'table_file'", once=True)
        return statuses_of(state)


def main(arguments=None):
    """Run the node; return the exit code."""
    return run_node(CalibrationNode, arguments, hints=HINTS['calibration_node'])


if __name__ == '__main__':
    sys.exit(main())
