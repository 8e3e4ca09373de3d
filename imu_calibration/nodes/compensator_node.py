"""
compensator_node: Imu in, corrected Imu out.

in: imu/data_raw (sensor_msgs/Imu), imu/calibration (std_msgs/String, a calibration document),
imu/temperature (sensor_msgs/Temperature, where the calibration has thermal effects). out:
imu/data_corrected (sensor_msgs/Imu), /diagnostics. services: ~/reload (the file again).
"""

import sys
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.timer import Timer
from sensor_msgs.msg import Imu, Temperature
from std_msgs.msg import String
from std_srvs.srv import Trigger

from imu_calibration.compensation.health import HARMS
from imu_calibration.compensation.stream import refuse_corrected
from imu_calibration.core.documents import version_of
from imu_calibration.core.errors import DocumentError, ImuCalibrationError, InputError, shortened
from imu_calibration.document import files
from imu_calibration.nodes import relay_loop
from imu_calibration.nodes.adoption import (
    Adopted,
    Awaited,
    CompensatorSettings,
    adopt,
    has_moved,
    may_become_ready,
    with_settings,
)
from imu_calibration.nodes.compensator_diagnostics import CompensatorDiagnostics
from imu_calibration.nodes.diagnostics import LOG_ERROR, Complaints
from imu_calibration.nodes.inputs import (
    MatchedInput,
    latched_qos,
    node_of,
    output_qos,
    sent_ns,
    watch_inputs,
)
from imu_calibration.nodes.lifecycle import (
    HINTS,
    announce,
    declare_parameters,
    every,
    guarded,
    run_node,
)
from imu_calibration.nodes.message_compensation import LiveCompensation
from imu_calibration.nodes.robot_stand import StaticFrames

LOOK_FOR_FILE = 1.0
"""Seconds between two attempts to find a calibration file that is waited for."""
MARK = '/correction'
"""
Suffix of a corrected topic's name: a latched topic that marks it as corrected and names the
calibration.
"""


class CompensatorNode(Node):
    """
    Corrects serialized messages with the calibration at hand.

    Two threads: one receives, corrects and publishes messages; documents, temperature, services,
    parameters and diagnostics run in the second, which prepares a new compensation; the first
    switches to it between two messages.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('compensator_node', **options)
        self.settings = declare_parameters(
            self, CompensatorSettings, self._change_compensation, hints=HINTS['compensator_node']
        )
        self.adopted: Adopted | None = None
        """The calibration in force."""
        self._previous: Adopted | None = None
        """The calibration in force before, to return to where the present one increases errors."""
        self._reported: Adopted | None = None
        """The calibration that was logged last."""
        self._harmful_version = ''
        """Version of a calibration that increased the error at rest and is refused."""
        self._newest: LiveCompensation | None = None
        """Compensation by the calibration in force, set by the second thread."""
        self._in_use: LiveCompensation | None = None
        """Compensation of the last message; the first thread replaces it by `_newest`."""
        self._document = ''
        """The last calibration document that was received."""
        self.awaited = ''
        """Transform without which a calibration cannot be adopted yet; '' for none."""
        self.unready = ''
        """Why the received calibration has too few data so far; '' otherwise."""
        self.problem = ''
        """Why the last calibration was refused; '' after an adoption."""
        self.refusal = ''
        """Code of the error of the last refusal; '' after an adoption."""
        self.corrected_already = ''
        """Why the input is corrected already, so that no message is published; '' otherwise."""

        self.uncorrected = 0
        """Messages that were not corrected: published unchanged or not at all."""
        self.complaints = Complaints(self.get_logger())
        self._connect()
        self.diagnostics = CompensatorDiagnostics(self)
        self.create_service(Trigger, '~/reload', self._on_reload)
        self._start()
        self._refresh_timer: Timer | None = None
        self._set_refresh(self.settings.covariance_rate)

    def _connect(self) -> None:
        """
        Subscribe to the inputs and make the publishers of the output and its mark.

        With the wait set the messages of the IMU are received outside the executor.
        """
        announce(
            self, ['imu/data_raw', 'imu/calibration', 'imu/temperature'], ['imu/data_corrected']
        )
        self._frames = StaticFrames(self, self._guarded(self._on_transforms))
        self.by_wait_set = relay_loop.available() and not self.settings.public_executor
        self._publisher = self.create_publisher(Imu, 'imu/data_corrected', output_qos())
        self._mark = self.create_publisher(String, self._publisher.topic_name + MARK, latched_qos())
        group = relay_loop.OutsideExecutor() if self.by_wait_set else None
        self.imu = MatchedInput(self, Imu, 'imu/data_raw', callback=self._on_imu, group=group)
        if self.imu.topic_name == self._publisher.topic_name:
            raise InputError(
                f'input and output must be two topics, both are {self.imu.topic_name}; correct the'
                ' remapping'
            )
        refuse_corrected(self.imu.topic_name)
        self.documents = MatchedInput(
            self,
            String,
            'imu/calibration',
            callback=self._guarded(self._on_document),
            raw=False,
            latched=True,
        )
        self.temperature: MatchedInput | None = None
        self.inputs = [self.imu, self.documents]
        watch_inputs(self, self.inputs)

    def _start(self) -> None:
        """Adopt the calibration file, or log for which calibration the node waits."""
        path = self.settings.calibration_path
        if self.settings.calibration_file and not path.exists():
            if not self.settings.wait_for_file:
                raise InputError(
                    f"parameter 'calibration_file' must name an existing file, {path} is missing;"
                    ' correct it, or wait for it with wait_for_file:=true',
                    code='calibration_missing',
                )
            self._file_timer = every(self, LOOK_FOR_FILE, self._guarded(self._look_for_file))
            self.get_logger().info(f'waits for the file {path}')
        elif self.settings.calibration_file:
            self._try_file()
        else:
            self.get_logger().info(
                f'waiting for a calibration on {self.documents.topic_name}'
                if self.settings.takes_topic
                else "waiting for parameter 'calibration_file'"
            )

    def _look_for_file(self) -> None:
        """Adopt the calibration file once it exists."""
        if self.settings.calibration_path.exists():
            self.destroy_timer(self._file_timer)
            self._try_file()

    @property
    def compensation(self) -> LiveCompensation | None:
        """Compensation by the calibration in force, used from the next message on, or None."""
        return self._newest

    def spin(self) -> None:
        """Work until the context ends."""
        if self.by_wait_set:
            relay_loop.relay(self, self.imu, self._publisher, convert=self.convert)
        else:
            rclpy.spin(self)

    def convert(self, data: bytes, information: dict) -> bytes | None:
        """Return the serialized message to publish, or None."""
        current = self._in_use
        if current is not self._newest:
            current = self._use_newest()
        if self.corrected_already:
            self.uncorrected += 1
            return None
        if current is None:
            self.uncorrected += 1
            return data if self.settings.passthrough else None
        try:
            return current(data, sent_ns(information))
        except Exception as error:  # an unforeseen message must not end the stream
            current.counts[shortened(f'failed with {type(error).__name__}: {error}', 100)] += 1
            return None

    def _use_newest(self) -> LiveCompensation | None:
        """Continue the stream with the newest compensation, in the first thread."""
        newest = self._newest
        if self._in_use is not None and newest is not None:
            newest.follow(self._in_use)
        self._in_use = newest
        return newest

    def _on_imu(self, data: bytes, information: dict) -> None:
        """Correct and publish a message, where the public executor receives it."""
        converted = self.convert(data, information)
        if converted is not None:
            self._publisher.publish(converted)

    def _guarded(self, callback: Callable) -> Callable:
        """Return a callback whose exceptions are printed instead of ending the node."""
        return guarded(callback, self._failed)

    def _failed(self, error: Exception) -> None:
        """Log an exception of a callback."""
        if self.context.ok():  # false while the node ends and publishing is impossible
            self.complaints.event(
                'a message could not be used, the node continues unchanged: '
                + shortened(f'{type(error).__name__}: {error}', 200),
                LOG_ERROR,
            )

    def _on_document(self, message: String) -> None:
        """Adopt a received document, unless the settings or its publishers forbid that."""
        self.documents.look()
        if self.documents.mixed:
            self.complaints.event(
                f'{self.documents.topic_name} has the publishers'
                f' {", ".join(sorted(self.documents.names()))}: no calibration is adopted; stop all'
                ' but one'
            )
            return
        self._document = message.data
        if self.settings.takes_topic:
            self._try_to_adopt(self._topic, self._take_topic)
        else:
            self.complaints.event(
                f"a calibration on {self.documents.topic_name} was not adopted: parameter 'adopt'"
                f" is '{self.settings.adopt}' and 'calibration_file' is"
                f" '{self.settings.calibration_file}'"
            )

    def _adopt(
        self, text: str, source: str, settings: CompensatorSettings, *, from_topic: bool = False
    ) -> None:
        """
        Put the calibration in a document in force, and log a change that must be reported.

        Where it raises an ImuCalibrationError the present calibration remains in force.
        """
        adopted = adopt(
            text,
            source,
            settings,
            frames=self._frames,
            before=self.adopted,
            from_topic=from_topic,
        )
        self._put_in_force(adopted)
        if adopted.must_be_reported_after(self._reported):
            self._reported = adopted
            self.get_logger().info(adopted.line())
            for line in adopted.caveats:
                self.get_logger().warning(f'calibration {adopted.version}: {line}')

    def return_from_harm(self) -> None:
        """
        Return to the previous calibration where the present one increases the error at a stop.
        """
        harmful = self.adopted
        previous = self._previous
        watch = None if harmful is None else harmful.compensation.watch
        if harmful is None or previous is None or watch is None or watch.health.state.word != HARMS:
            return
        self.complaints.event(
            f'calibration {harmful.version} harms, the previous calibration {previous.version} is'
            f' used again: {watch.health.state.message}',
            LOG_ERROR,
        )
        self._harmful_version = harmful.version
        self._previous = None
        self.adopted = None
        self._put_in_force(with_settings(previous, self.settings, self._frames))

    def _put_in_force(self, adopted: Adopted) -> None:
        """Correct with a calibration from the next message on, and mark the output with it."""
        if self.adopted is not None and self.adopted.version != adopted.version:
            self._previous = self.adopted
        self.adopted = adopted
        self.problem = ''
        self.refusal = ''
        self.awaited = ''
        self.unready = ''
        self._newest = adopted.compensation
        # For the correction, or to compare with the temperatures of the calibration.
        uses_temperature = (
            adopted.compensation.needs_temperature
            or adopted.calibration.conditions.get('temperature_range_c')
        )
        if uses_temperature and self.temperature is None:
            self.temperature = MatchedInput(
                self,
                Temperature,
                'imu/temperature',
                callback=self._guarded(self._on_temperature),
                depth=10,
                raw=False,
            )
            self.inputs.append(self.temperature)
        self._mark.publish(String(data=f'corrected with calibration {adopted.version}'))
        self.diagnostics.publish_now()

    @property
    def _topic(self) -> str:
        """Source of a calibration from the topic, readable."""
        return f'topic {self.documents.topic_name}'

    def _take_topic(self, settings: CompensatorSettings) -> None:
        """Adopt the last received document; raises an ImuCalibrationError as `_adopt`."""
        if version_of(self._document) == self._harmful_version:
            raise DocumentError(
                f'calibration {self._harmful_version} increased the error at rest; calibrate again',
                code='increased_error',
            )
        self._adopt(self._document, self._topic, settings, from_topic=True)

    def _load_file(self, settings: CompensatorSettings) -> None:
        """Adopt the calibration file; raises an ImuCalibrationError as `_adopt`."""
        path = settings.calibration_path
        self._adopt(files.read_text(path, 'calibration'), f'file {path}', settings)

    def _try_file(self) -> str:
        """Adopt the calibration file; return as `_try_to_adopt`."""
        return self._try_to_adopt("parameter 'calibration_file'", self._load_file)

    def _try_to_adopt(self, source: str, action: Callable[[CompensatorSettings], None]) -> str:
        """
        Adopt a calibration by `action` with the present settings.

        Return the reason of its refusal, '' when it was adopted.
        """
        try:
            action(self.settings)
        except Awaited as awaited:
            self.awaited = str(awaited)
            self.get_logger().info(f'waits for {awaited}')
            self.diagnostics.publish_now()
            return f'waiting for {awaited}'
        except ImuCalibrationError as error:
            why = error.with_hint(HINTS['compensator_node'])
            self.refusal = error.code
            # The first calibration from the topic may be in progress, which is not a fault.
            is_first = self.adopted is None and source == self._topic
            if is_first and may_become_ready(error, self._document):
                self._wait_until_ready(source, why)
                return why
            self.unready = ''
            self.problem = f'the calibration from {source} was refused: {why}'
            self.diagnostics.publish_now()
            return why
        return ''

    def _wait_until_ready(self, source: str, why: str) -> None:
        """Report a calibration in progress, whose next version may be applied."""
        is_first = not self.unready
        self.unready = f'the calibration from {source} is not ready yet: {why}'
        self.problem = ''
        if is_first:
            self.get_logger().info(self.unready)
        self.diagnostics.publish_now()

    def _on_transforms(self) -> None:
        """Resume an adoption that waited for a transform, or apply a changed transform."""
        if self.awaited:
            self._retry()
        elif self.adopted is not None and has_moved(self.adopted, self.settings, self._frames):
            self._put_in_force(with_settings(self.adopted, self.settings, self._frames))
            self.get_logger().warning(
                f"the static transform to '{self.settings.target_frame}' has moved: readings"
                ' follow it'
            )

    def _retry(self) -> None:
        """Adopt the calibration again that a missing transform delayed."""
        if self.settings.takes_topic and self._document:
            self._try_to_adopt(self._topic, self._take_topic)
        elif self.settings.calibration_file:
            self._try_file()

    def _on_reload(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Read the calibration file again."""
        if self.settings.calibration_file:
            why = self._try_file()
        else:
            why = (
                "parameter 'calibration_file' is empty; start the node with the file to read again"
            )
        response.success = not why
        response.message = why
        if not why and self.adopted:
            response.message = self.adopted.line()
        return response

    def _change_compensation(self, settings: CompensatorSettings) -> None:
        """Apply changed parameters; on an ImuCalibrationError all remain unchanged."""
        old = self.settings
        # New consent, or the topic as a new source, may adopt a calibration that was refused or
        # ignored before.
        consents = settings.anyway and not old.anyway
        if settings.takes_topic:
            tries_again = bool(self._document) and (consents or not old.takes_topic)
        else:
            tries_again = bool(settings.calibration_file) and consents
        if tries_again and settings.takes_topic:
            self._take_topic(settings)
        elif tries_again:
            self._load_file(settings)
        elif self.adopted is not None:
            self._put_in_force(with_settings(self.adopted, settings, self._frames))
        if settings.covariance_rate != old.covariance_rate:
            self._set_refresh(settings.covariance_rate)
        self.settings = settings
        if self.awaited:
            self._retry()

    def _on_temperature(self, message: Temperature) -> None:
        """Pass a usable temperature to the compensation."""
        if self.diagnostics.note_temperature(message.temperature) and self.compensation is not None:
            self.compensation.set_temperature(message.temperature)

    def _set_refresh(self, rate: float) -> None:
        """Update the covariances at a rate, Hz; 0: only with a new calibration."""
        if self._refresh_timer is not None:
            self.destroy_timer(self._refresh_timer)
        self._refresh_timer = None
        if rate > 0:
            self._refresh_timer = self.create_timer(1.0 / rate, self._guarded(self._refresh))

    def _refresh(self) -> None:
        """Update the covariances at the present motion."""
        if self.compensation is not None:
            self.compensation.refresh()

    def look_for_correction(self) -> None:
        """
        Set `corrected_already` while another compensator publishes the input.

        A compensator publishes both the topic and its mark; a mark from a node that does not
        publish the topic is ignored, because any participant could stop the output with it.
        """
        topic = self.imu.topic_name
        markers = {
            node_of(endpoint) for endpoint in self.get_publishers_info_by_topic(topic + MARK)
        }
        senders = {node_of(endpoint) for endpoint in self.get_publishers_info_by_topic(topic)}
        compensators = sorted(markers & senders)
        self.corrected_already = ''
        if compensators:
            self.corrected_already = (
                f'{topic} is corrected already ({compensators[0]} publishes it and'
                f' {topic + MARK}): no messages are published; remap imu/data_raw to the raw topic'
            )


def main(arguments: list[str] | None = None) -> int:
    """Run the node; return the exit code."""
    return run_node(
        CompensatorNode, arguments, spin=CompensatorNode.spin, hints=HINTS['compensator_node']
    )


if __name__ == '__main__':
    sys.exit(main())
