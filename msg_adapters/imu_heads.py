"""Contents of Imu messages other than their readings, from their bytes."""

from collections import Counter

import numpy as np

from imu_calibration.preflight.message_checks import QUANTITIES, MessageEvidence
from msg_adapters.imu_stream import ImuStream
from msg_adapters.stamps import MessageError


class ImuHeads:
    """Gathers the `MessageEvidence` of serialized Imu messages; memory grows by a number for each."""

    def __init__(self) -> None:
        self._stream, self._frame_ids = ImuStream(), Counter[str]()
        self._last, self._frame_id = b'', ''
        self._age: list[float] = []

    def add(self, data: bytes, received_ns: int) -> None:
        """Add a message and its time of reception, ns since the epoch, 0 if meaningless; invalid Imu messages are skipped."""
        if not self._stream.heads(data):
            try:
                self._frame_id = self._stream.open(data)
            except MessageError:
                return
        self._frame_ids[self._frame_id] += 1
        stamp_ns, _ = self._stream.read(data)
        self._age += [(received_ns - stamp_ns) * 1e-9] * bool(stamp_ns and received_ns)
        self._last = data

    def evidence(self) -> MessageEvidence:
        """Return the evidence from the messages so far."""
        if not self._last:
            return MessageEvidence()
        quaternion, packed = self._stream.orientation(self._last)
        matrices = (*self._stream.covariances(self._last), self._stream.unpacked(packed))
        covariances = dict(zip(QUANTITIES, matrices, strict=True))
        return MessageEvidence(dict(self._frame_ids), covariances, np.array(quaternion), np.array(self._age))
