"""
Serialized Imu message in, corrected serialized message out, with one calibration.

Independent of ROS.
"""

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
        self.watch, self.gate = watch, gate
        self.readings, self._convert = readings, not readings.is_si
        self.frame_id = calibration.frame_id if check_frame else ''
        self.received = 0
        self._message = ImuStream(
            None if transfer is None else transfer.frame_id, late_ns(calibration, correct_stamps)
        )
        self._taken = -1
        self._rate_cov = b''
        self._force_cov = b''
        self._no_rate = self._no_force = self._absent = self._odd = False
        self._orientation_in: bytes | None = None
        self._orientation_out, self._no_orientation = b'', False
        self._can_saturate = any(np.isfinite(self.levels))

    def follow(self, before: 'LiveCompensation') -> None:  # type: ignore[override]
        """Continue from the state of another compensation."""
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
        taken = message.take(data) if self._taken == self.revision else None
        if taken is None:
            if not message.heads(data) and not self._open(data):
                return None
            self._take_covariances(data)
            taken = message.read(data)
        stamp_ns, readings = taken
        if self._convert:
            readings = self.readings.convert_message(readings)
        if self.gate is not None and not (
            self._no_force or self.gate.passes(stamp_ns or sent_ns, readings[3:])
        ):
            self.counts[WITHHELD] += 1
            return None
        if self._absent:
            # Does not disturb the other sensor.
            readings = self._mixed(
                self.at_zero['gyroscope'] + self.at_zero['accelerometer'], readings
            )
        if not stamp_ns:
            self.counts['zero stamp'] += 1
        corrected = self.correct(stamp_ns or sent_ns, *readings)
        if corrected is None:
            return None
        if self._taken != self.revision:
            self._take_covariances(data)
        if self.watch is not None:
            corrected = self.watch.follow(stamp_ns or sent_ns, readings, corrected)
        if self._odd:
            self.counts['covariance not finite'] += 1
        rate_cov, force_cov = (
            self._marked(readings) if self._can_saturate else (self._rate_cov, self._force_cov)
        )
        if self._absent:
            corrected = self._mixed(taken[1], corrected)
        orientation = None if self.transfer is None else self._orientation(data)
        return message.rewritten(
            data,
            stamp_ns,
            corrected,
            rate_cov=rate_cov,
            force_cov=force_cov,
            orientation=orientation,
        )

    def _open(self, data):
        """Return whether a message with a new head can be corrected."""
        try:
            frame_id = self._message.open(data)
        except MessageError:
            self.counts['not an Imu message'] += 1
            return False
        if self.frame_id and frame_id != self.frame_id:
            self._message.forget()
            known = (
                len(self.counts) < MAX_COUNTED_REASONS or f"frame_id '{frame_id}'" in self.counts
            )
            self.counts[f"frame_id '{frame_id}'" if known else 'many further frame_ids'] += 1
            return False
        self._orientation_in = None
        return True

    def _take_covariances(self, data):
        """Propagate covariances that differ from the previous message's."""
        self._taken = self.revision
        given = self._message.covariances(data)
        received = given
        self._no_force, self._no_rate = absent = [bool(cov[0, 0] == ABSENT_MARK) for cov in given]
        self._absent = any(absent)
        self._odd = any(
            np.any(cov) and not missing and not is_known(cov) for cov, missing in zip(given, absent)
        )
        if self._convert:
            # Rows without a measurement (first element -1) are unchanged below.
            given = (
                self.readings.accelerometer.convert_covariance(given[0]),
                self.readings.gyroscope.convert_covariance(given[1]),
            )
        found = list(
            self.covariances(*(None if missing else cov for cov, missing in zip(given, absent)))
        )
        if self.watch is not None:
            found[1] = found[1] + self.watch.rate_cov
        self._force_cov, self._rate_cov = (
            self._message.packed(cov if missing else new)
            for cov, new, missing in zip(received, found, absent)
        )

    def _mixed(self, of_absent, of_present):
        """
        Return six readings.

        Of an absent sensor from the first, of the present sensor from the second.
        """
        return (of_absent if self._no_rate else of_present)[:3] + (
            of_absent if self._no_force else of_present
        )[3:]

    def _marked(self, readings):
        """
        Return the covariances, of the size of the range where a sensor is saturated.

        The true value is not known better.
        """
        force_level, rate_level = self.levels
        rate = max(map(abs, readings[:3])) >= rate_level
        force = max(map(abs, readings[3:])) >= force_level
        if rate or force:
            self.counts['saturated'] += 1
        return self._mark(rate_level) if rate else self._rate_cov, self._mark(
            force_level
        ) if force else self._force_cov

    def _mark(self, level):
        return self._message.packed(np.eye(3) * level**2)

    def _orientation(self, data):
        """
        Return the orientation turned into the target frame: quaternion and bytes of the covariance.
        """
        # Called only with a transfer.
        assert self.transfer is not None
        quaternion, covariance = self._message.orientation(data)
        if covariance != self._orientation_in:
            given = self._message.unpacked(covariance)
            self._no_orientation = given[0, 0] == ABSENT_MARK
            self._orientation_in = covariance
            self._orientation_out = (
                covariance
                if self._no_orientation
                else self._message.packed(self.transfer.turned_covariance(given))
            )
        return quaternion if self._no_orientation else self.transfer.turned_quaternion(
            quaternion
        ), self._orientation_out
