"""
Serialized Imu message in, corrected serialized message out, with one calibration.

Independent of ROS.
"""

from typing import Any

import numpy as np

from imu_calibration.compensation.compensate import FittedErrors, Transfer
from imu_calibration.compensation.covariance import is_known
from imu_calibration.compensation.health import StopWatch
from imu_calibration.compensation.stream import SampleCompensation, late_ns
from imu_calibration.compensation.unit_gate import UnitGate
from imu_calibration.core.readings import RawReadings
from imu_calibration.preprocessing.recording_evidence import ABSENT_MARK
from msg_adapters.imu_stream import ImuStream
from msg_adapters.layout import MessageError

WITHHELD = 'unit of the readings'
"""Reason of messages before the unit is known."""
MAX_COUNTED_REASONS = 30
"""Largest number of reasons with separate counts: it bounds the memory."""


class LiveCompensation(SampleCompensation):
    """
    Corrects message after message.

    Parameters
    ----------
    calibration : Calibration
    transfer : compensation.Transfer, optional
        Another point and frame.
    check_frame : bool
        Whether messages must carry the calibration's frame_id.
    with_parameters : bool
        Whether the uncertainty of the calibration enters the covariances.
    correct_stamps : bool
        Whether the stamps are moved back by the calibration's time_offset.
    watch : StopWatch, optional
        Evaluates the stops, and may subtract the bias that they show.
    readings : RawReadings
        Units of the readings; they are converted to SI before the correction.
    gate : UnitGate, optional
        Withholds the output until the readings are known to be in their unit.

    """

    def __init__(
        self,
        calibration: FittedErrors,
        transfer: Transfer | None = None,
        *,
        check_frame: bool = True,
        with_parameters: bool = True,
        correct_stamps: bool = False,
        watch: StopWatch | None = None,
        readings: RawReadings = RawReadings(),
        gate: UnitGate | None = None,
    ):
        super().__init__(calibration, transfer, with_parameters)
        self.watch = watch
        self.gate = gate
        self.readings = readings
        self._convert = not readings.is_si
        self.frame_id = calibration.frame_id if check_frame else ''
        """Frame that messages must carry; '': any."""
        self.received = 0
        """Number of messages."""
        self._message = ImuStream(
            None if transfer is None else transfer.frame_id, late_ns(calibration, correct_stamps)
        )

        # From the covariances of the last message that differed from its predecessor.
        self._cov_revision = -1
        """`revision` at which they were computed; another one requires a new computation."""
        self._rate_cov = b''
        """Covariance of the corrected rate, packed."""
        self._force_cov = b''
        """Covariance of the corrected specific force, packed."""
        self._no_rate = False
        """Whether the messages mark the rate as absent."""
        self._no_force = False
        """Whether the messages mark the specific force as absent."""
        self._is_one_absent = False
        """Whether either is absent."""
        self._has_invalid_cov = False
        """Whether a stated covariance is not usable."""

        self._orientation_cov: bytes | None = None
        """Covariance of the last orientation as received, packed; None after a new head."""
        self._turned_orientation_cov = b''
        """The same in the target frame."""
        self._no_orientation = False
        """Whether the messages mark the orientation as absent."""
        self._can_saturate = any(np.isfinite(self.levels))

    def follow(self, before: 'LiveCompensation') -> None:  # type: ignore[override]
        """Continue from the state of another compensation, with its gate for the same units."""
        super().follow(before)
        self.received = before.received
        if before.gate is not None and before.readings == self.readings:
            self.gate = before.gate

    def __call__(self, data: bytes, sent_ns: int = 0) -> bytes | None:
        """
        Return the corrected message as bytes, or None when there is no message to publish.

        The reason is counted in `counts`.

        Parameters
        ----------
        data : bytes
        sent_ns : int
            Time of sending or reception, which replaces the stamp where a driver sets none.

        """
        self.received += 1
        message = self._message

        # Read: at once where head and covariances equal the previous ones.
        content = message.take(data) if self._cov_revision == self.revision else None
        if content is None:
            if not message.heads(data) and not self._open(data):
                return None
            self._update_covariances(data)
            content = message.read(data)
        stamp_ns, raw = content

        # To SI. An absent sensor gets the reading of zero input, which does not disturb the other
        # one.
        readings = self.readings.convert_message(raw) if self._convert else raw
        if self.gate is not None and not (
            self._no_force or self.gate.passes(stamp_ns or sent_ns, readings[3:])
        ):
            self.counts[WITHHELD] += 1
            return None
        if self._is_one_absent:
            zero = self.at_zero['gyroscope'] + self.at_zero['accelerometer']
            readings = self._readings_by_sensor(zero, readings)

        # Correct; a sample may change the covariances (`revision`).
        if not stamp_ns:
            self.counts['zero stamp'] += 1
        corrected = self.correct(stamp_ns or sent_ns, *readings)
        if corrected is None:
            return None
        if self._cov_revision != self.revision:
            self._update_covariances(data)
        if self.watch is not None:
            corrected = self.watch.follow(stamp_ns or sent_ns, readings, corrected)

        # Write: readings of an absent sensor are unchanged.
        if self._has_invalid_cov:
            self.counts['covariance not finite'] += 1
        rate_cov = self._rate_cov
        force_cov = self._force_cov
        if self._can_saturate:
            rate_cov, force_cov = self._covariances_with_saturation(readings)
        if self._is_one_absent:
            corrected = self._readings_by_sensor(raw, corrected)
        orientation = None if self.transfer is None else self._orientation(data)
        return message.rewritten(
            data,
            stamp_ns,
            corrected,
            rate_cov=rate_cov,
            force_cov=force_cov,
            orientation=orientation,
        )

    def _open(self, data: bytes) -> bool:
        """Read a new head; return whether its messages can be corrected."""
        try:
            frame_id = self._message.open(data)
        except MessageError:
            self.counts['not an Imu message'] += 1
            return False
        if self.frame_id and frame_id != self.frame_id:
            self._message.forget()
            reason = f"frame_id '{frame_id}'"
            if reason not in self.counts and len(self.counts) >= MAX_COUNTED_REASONS:
                reason = 'many further frame_ids'
            self.counts[reason] += 1
            return False
        self._orientation_cov = None
        return True

    def _update_covariances(self, data: bytes) -> None:
        """Compute the covariances of corrected readings from those in a message."""
        self._cov_revision = self.revision
        stated_force, stated_rate = self._message.covariances(data)
        self._no_force = bool(stated_force[0, 0] == ABSENT_MARK)
        self._no_rate = bool(stated_rate[0, 0] == ABSENT_MARK)
        self._is_one_absent = self._no_force or self._no_rate
        # All zero states no covariance and is valid.
        is_force_invalid = (
            np.any(stated_force) and not self._no_force and not is_known(stated_force)
        )
        is_rate_invalid = np.any(stated_rate) and not self._no_rate and not is_known(stated_rate)
        self._has_invalid_cov = bool(is_force_invalid or is_rate_invalid)

        force_cov = stated_force
        rate_cov = stated_rate
        if self._convert:
            force_cov = self.readings.accelerometer.convert_covariance(stated_force)
            rate_cov = self.readings.gyroscope.convert_covariance(stated_rate)
        new_force, new_rate = self.covariances(
            None if self._no_force else force_cov, None if self._no_rate else rate_cov
        )
        if self.watch is not None:
            new_rate = new_rate + self.watch.rate_cov
        # The mark of an absent sensor is published unchanged.
        self._force_cov = self._message.packed(stated_force if self._no_force else new_force)
        self._rate_cov = self._message.packed(stated_rate if self._no_rate else new_rate)

    def _readings_by_sensor(self, of_absent: tuple, of_present: tuple) -> tuple:
        """
        Return (rate, force), six floats, from two such tuples.

        Those of an absent sensor are from the first tuple, those of a present one from the second.
        """
        rate = of_absent[:3] if self._no_rate else of_present[:3]
        force = of_absent[3:] if self._no_force else of_present[3:]
        return rate + force

    def _covariances_with_saturation(self, readings: tuple) -> tuple[bytes, bytes]:
        """
        Return the packed covariances of (rate, force) of a message.

        Where a sensor is saturated the variance is the square of the range, the only information on
        the true value.
        """
        force_level, rate_level = self.levels
        is_rate_saturated = max(map(abs, readings[:3])) >= rate_level
        is_force_saturated = max(map(abs, readings[3:])) >= force_level
        if is_rate_saturated or is_force_saturated:
            self.counts['saturated'] += 1
        return (
            self._range_covariance(rate_level) if is_rate_saturated else self._rate_cov,
            self._range_covariance(force_level) if is_force_saturated else self._force_cov,
        )

    def _range_covariance(self, level: float) -> bytes:
        """Return the packed covariance ``level^2 I``."""
        return self._message.packed(np.eye(3) * level**2)

    def _orientation(self, data: bytes) -> tuple[Any, bytes]:
        """Return (quaternion, packed covariance) of the orientation in the target frame."""
        # Called only with a transfer.
        assert self.transfer is not None
        quaternion, packed_cov = self._message.orientation(data)
        if packed_cov != self._orientation_cov:
            covariance = self._message.unpacked(packed_cov)
            self._orientation_cov = packed_cov
            self._turned_orientation_cov = packed_cov
            self._no_orientation = covariance[0, 0] == ABSENT_MARK
            if not self._no_orientation:
                turned = self.transfer.turned_covariance(covariance)
                self._turned_orientation_cov = self._message.packed(turned)
        if not self._no_orientation:
            quaternion = self.transfer.turned_quaternion(quaternion)
        return quaternion, self._turned_orientation_cov
