"""compensator_node: Imu in, corrected Imu out."""

import sys
from pathlib import Path

import rclpy
from rclpy.node import Node
from sensor_msgs.msg import Imu, Temperature
from std_msgs.msg import String
from std_srvs.srv import Trigger

from imu_calibration.calibration.document import calibration_from_text
from imu_calibration.calibration.plausibility import implausible
from imu_calibration.compensation.stream import refuse_corrected, requested_transfer
from imu_calibration.documents import version_of
from imu_calibration.errors import DocumentError, ImuCalibrationError, InputError
from imu_calibration.nodes import relay_loop
from imu_calibration.nodes.compensator_diagnostics import CompensatorDiagnostics
from imu_calibration.nodes.compensator_settings import CompensatorSettings
from imu_calibration.nodes.hints import HINTS
from imu_calibration.nodes.lifecycle import run_node
from imu_calibration.nodes.message_compensation import LiveCompensation
from imu_calibration.nodes.parameters import declare_parameters
from imu_calibration.nodes.qos import input_qos, latched_qos, output_qos

MARK = '/correction'
"""Behind the name of a corrected topic: a latched topic that says which calibration made it, and that it is corrected."""


class CompensatorNode(Node):
    """
    Corrects serialized messages with the calibration at hand.

    Two threads: one takes, corrects and publishes messages; all else (documents, temperature, service, diagnostics) runs in the
    other one, which prepares a new compensation; the first takes it over between two messages.
    """

    def __init__(self, **options):
        super().__init__('compensator_node', **options)
        self.settings = declare_parameters(self, CompensatorSettings)
        chosen = self.settings
        self._transfer = requested_transfer(chosen.target_frame, chosen.target_xyz, chosen.target_rpy)
        self._current = self._wanted = None
        self.version, self.source, self.problem, self.corrected_already = '', '', '', ''
        self.uncorrected = 0
        self.by_wait_set = relay_loop.available() and not chosen.public_executor
        group = relay_loop.OutsideExecutor() if self.by_wait_set else None
        self._publisher = self.create_publisher(Imu, 'imu/data_corrected', output_qos())
        self._mark = self.create_publisher(String, self._publisher.topic_name + MARK, latched_qos())
        self._imu = self.create_subscription(Imu, 'imu/data_raw', self._on_imu, input_qos(chosen.reliable), raw=True, callback_group=group)
        self._refuse_own_output()
        self._temperature = None
        self._diagnostics = CompensatorDiagnostics(self)
        self.create_subscription(String, 'imu/calibration', self._on_document, latched_qos())
        self.create_service(Trigger, '~/reload', self._on_reload)
        if chosen.calibration_file:
            self._load_file()
        else:
            self.get_logger().info('waiting for a calibration on ' + self.resolve_topic_name('imu/calibration'))
        if chosen.covariance_rate > 0:
            self.create_timer(1.0 / chosen.covariance_rate, self._refresh)

    @property
    def compensation(self):
        """The LiveCompensation in use, or about to be, or None."""
        return self._wanted

    @property
    def input_topic(self):
        """Full name of the topic of measured messages."""
        return self._imu.topic_name

    def spin(self):
        """Work until the context ends."""
        if self.by_wait_set:
            relay_loop.relay(self, self._imu, self._publisher, self.convert)
        else:
            rclpy.spin(self)

    def convert(self, data):
        """Return what to publish for a serialized message, or None."""
        current = self._current
        if current is not self._wanted:
            current = self._take_over()
        if current is None or self.corrected_already:
            self.uncorrected += 1
            return data if self.settings.passthrough and current is None and not self.corrected_already else None
        return current(data)

    def _take_over(self):
        wanted = self._wanted
        if self._current is not None:
            wanted.follow(self._current)
        self._current = wanted
        return wanted

    def _on_imu(self, data):
        converted = self.convert(data)
        if converted is not None:
            self._publisher.publish(converted)

    def _on_document(self, message):
        self.adopt(message.data, 'topic ' + self.resolve_topic_name('imu/calibration'))

    def adopt(self, text, source):
        """
        Take a calibration document over, or refuse it and keep the one there is.

        Returns
        -------
        str
            What was wrong with it, empty when it was taken over.

        """
        try:
            calibration = calibration_from_text(text)
            strange = implausible(calibration)
            if strange:
                raise DocumentError(f'{strange[0]}; calibrate again')
            self._check_frame(calibration.frame_id)
        except ImuCalibrationError as error:
            return self._refuse(source, error.told(HINTS['compensator_node']))
        chosen = self.settings
        compensation = LiveCompensation(calibration, self._transfer, chosen.check_frame_id, chosen.parameter_covariance,
                                        chosen.correct_stamps)
        if compensation.needs_temperature and self._temperature is None:
            self._temperature = self.create_subscription(Temperature, 'imu/temperature', self._on_temperature,
                                                         input_qos(chosen.reliable, 10))
        before = self._wanted
        if before is not None:
            compensation.prepare(before)
        self.version, self.source, self.problem = version_of(text), source, ''
        self._wanted = compensation
        self._mark.publish(String(data=f'corrected with calibration {self.version}'))
        self.get_logger().info(f'calibration {self.version} from {source} taken over')
        self._diagnostics.publish_now()
        return ''

    def _check_frame(self, frame_id):
        known = '' if self._wanted is None else self._wanted.frame_id
        if known and frame_id and frame_id != known:
            raise DocumentError(f"a new calibration must be for the same sensor, '{known}', this one is for '{frame_id}'; "
                                'restart the node for another sensor')

    def _refuse(self, source, why):
        self.problem = f'a calibration from {source} was refused: {why}'
        self.get_logger().error(self.problem)
        self._diagnostics.publish_now()
        return why

    def _load_file(self):
        path = self.settings.calibration_file
        try:
            text = Path(path).expanduser().read_text(encoding='utf-8')
        except (OSError, UnicodeDecodeError) as error:
            return self._refuse(f'file {path}', f'the file must be readable, {error}; correct parameter calibration_file')
        return self.adopt(text, f'file {path}')

    def _on_reload(self, request, response):
        if not self.settings.calibration_file:
            why = 'parameter calibration_file is empty; start the node with a file to return to'
        else:
            why = self._load_file()
        response.success, response.message = not why, why or f'calibration {self.version} from {self.source}'
        return response

    def _on_temperature(self, message):
        if self._wanted is not None:
            self._wanted.set_temperature(message.temperature)

    def _refresh(self):
        if self._wanted is not None:
            self._wanted.refresh()

    def look_for_correction(self):
        """Notice when another compensator publishes the input, and when it no longer does."""
        if self.count_publishers(self.input_topic + MARK):
            self.corrected_already = (f'{self.input_topic} is corrected already (a publisher of {self.input_topic + MARK} says so): '
                                      'nothing is published; remap imu/data_raw to the raw topic')
        else:
            self.corrected_already = ''

    def _refuse_own_output(self):
        if self._imu.topic_name == self._publisher.topic_name:
            raise InputError(f'input and output must be two topics, both are {self._imu.topic_name}; correct the remapping')
        refuse_corrected(self._imu.topic_name)


def main(arguments=None):
    """Run the node; return the exit code."""
    return run_node(CompensatorNode, arguments, CompensatorNode.spin, HINTS['compensator_node'])


if __name__ == '__main__':
    sys.exit(main())
