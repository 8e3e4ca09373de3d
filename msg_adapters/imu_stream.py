"""
Parse and rewrite serialized Imu messages of one stream.

Repeated parts are parsed only when their bytes change.
"""

import struct
from collections import Counter
from collections.abc import Sequence

import numpy as np

from imu_calibration.preprocessing.recording_evidence import MESSAGE_QUANTITIES, MessageEvidence
from msg_adapters.imu import find_imu_layout
from msg_adapters.layout import (
    ENCAPSULATION_SIZE,
    FRAME_OFFSET,
    NS_PER_S,
    MessageError,
    frame_head,
)

VECTOR_SIZE = 24
"""Bytes of a rate or a force, which its covariance follows."""
COVARIANCE_SIZE = 72
"""Bytes of a covariance."""


class ImuStream:
    """
    Positions of the parts of a stream's messages.

    Parameters
    ----------
    frame_id : str, optional
        Frame of the written messages; default the frame of the read ones.
    late_ns : int
        By how much stamps are moved back.

    """

    def __init__(self, frame_id: str | None = None, late_ns: int = 0):
        self._frame_out = frame_id
        self._late_ns = late_ns
        # Of the last opened message; a message with other bytes must be opened.
        self._size = -1
        """Bytes; -1: the next message must be opened in any case."""
        self._order = b''
        """First two bytes, which state the byte order."""
        self._head = b''
        """Length and text of the frame_id."""
        self._head_part = slice(FRAME_OFFSET, FRAME_OFFSET)
        """Its bytes."""
        self._head_out = b''
        """Frame of the written messages, with its padding."""
        self._body = 0
        """Offset of the orientation."""
        self._rate_at = 0
        """Offset of the angular velocity."""
        self._rate_cov_part = slice(0)
        """Bytes of its covariance."""
        self._force_cov_part = slice(0)
        """Bytes of the covariance of the acceleration, to the end of the message."""
        self._rate_cov = b''
        """Bytes of the covariance of the rate that `covariances` returned last."""
        self._force_cov = b''
        self._use('<')

    def _use(self, order: str) -> None:
        """Prepare the parsers of the parts of a message for a byte order, '<' or '>'."""
        self._stamp = struct.Struct(order + 'iI')
        # Rate, its covariance (72 bytes), force, its covariance.
        self._readings = struct.Struct(order + '3d72x3d')
        self._tail = struct.Struct(order + '3d72s3d72s')
        self._nine = struct.Struct(order + '9d')
        self._four = struct.Struct(order + '4d')

    def open(self, data: bytes) -> str:
        """
        Find the places in a message with a new head; return its frame_id.

        Raises
        ------
        MessageError
            When it is not an Imu message.

        """
        self.forget()
        layout = find_imu_layout(data)
        self._use(layout.order)
        self._order = data[:2]
        self._body = layout.offsets['orientation'][0]
        # The head is the frame_id with its length; the padding after it is arbitrary.
        (frame_size,) = struct.unpack_from(layout.order + 'I', data, FRAME_OFFSET)
        head_end = FRAME_OFFSET + 4 + frame_size
        self._head_part = slice(FRAME_OFFSET, head_end)
        self._head = data[self._head_part]
        self._rate_at = layout.offsets['rate_s'][0]
        rate_end = self._rate_at + VECTOR_SIZE
        self._rate_cov_part = slice(rate_end, rate_end + COVARIANCE_SIZE)
        self._force_cov_part = slice(layout.offsets['force_s'][0] + VECTOR_SIZE, None)
        frame_id = layout.names[0]
        frame_out = frame_id if self._frame_out is None else self._frame_out
        self._head_out = frame_head(frame_out, layout.order)
        self._size = len(data)
        return frame_id

    def take(self, data: bytes) -> tuple[int, tuple[float, ...]] | None:
        """
        Return (stamp in ns, readings: rate x, y, z, force x, y, z).

        None where the head differs from that of the last opened message, or the covariances from
        the last result of `covariances`.
        """
        if (
            len(data) != self._size
            or data[self._head_part] != self._head
            or data[:2] != self._order
            or data[self._rate_cov_part] != self._rate_cov
            or data[self._force_cov_part] != self._force_cov
        ):
            return None
        return self.read(data)

    def read(self, data: bytes) -> tuple[int, tuple[float, ...]]:
        """Return (stamp in ns, readings) of a message of known layout."""
        seconds, nanoseconds = self._stamp.unpack_from(data, ENCAPSULATION_SIZE)
        return seconds * NS_PER_S + nanoseconds, self._readings.unpack_from(data, self._rate_at)

    def heads(self, data: bytes) -> bool:
        """
        Return whether a message has the head of the last opened one, and thereby its positions.
        """
        return (
            len(data) == self._size
            and data[self._head_part] == self._head
            and data[:2] == self._order
        )

    def forget(self) -> None:
        """Have the next message opened in any case."""
        self._size = -1

    def covariances(self, data: bytes) -> tuple[np.ndarray, ...]:
        """Return the covariances of (force, rate), each (3, 3), and keep their bytes for `take`."""
        self._rate_cov = data[self._rate_cov_part]
        self._force_cov = data[self._force_cov_part]
        return self.unpacked(self._force_cov), self.unpacked(self._rate_cov)

    def orientation(self, data: bytes) -> tuple[tuple[float, ...], bytes]:
        """Return (quaternion x, y, z, w; its covariance as bytes)."""
        covariance_start = self._body + self._four.size
        return self._four.unpack_from(data, self._body), data[covariance_start : self._rate_at]

    def unpacked(self, covariance: bytes) -> np.ndarray:
        """Return the matrix at the begin of the bytes of a covariance, shape (3, 3)."""
        return np.array(self._nine.unpack_from(covariance)).reshape(3, 3)

    def packed(self, covariance: np.ndarray) -> bytes:
        """Return a covariance, (3, 3), as bytes."""
        return self._nine.pack(*covariance.ravel().tolist())

    def rewritten(
        self,
        data: bytes,
        stamp_ns: int,
        readings: Sequence[float],
        *,
        rate_cov: bytes,
        force_cov: bytes,
        orientation: tuple[Sequence[float], bytes] | None = None,
    ) -> bytes:
        """
        Return a message with new readings, otherwise unchanged.

        Parameters
        ----------
        stamp_ns : int
            As it was read.
        readings : sequence of 6 floats
            Rate x, y, z, force x, y, z.
        rate_cov, force_cov : bytes
            From `packed`.
        orientation : (sequence of 4 floats, bytes), optional
            Quaternion and the bytes of its covariance; the frame is then replaced too.

        """
        tail = self._tail.pack(*readings[:3], rate_cov, *readings[3:], force_cov)
        if orientation is None and not self._late_ns:
            return data[: self._rate_at] + tail
        stamp = self._stamp.pack(*divmod(stamp_ns - self._late_ns, NS_PER_S))
        start = data[:ENCAPSULATION_SIZE] + stamp
        if orientation is None:
            return start + data[FRAME_OFFSET : self._rate_at] + tail
        return start + self._head_out + self._four.pack(*orientation[0]) + orientation[1] + tail


class ImuHeads:
    """
    Gathers the `MessageEvidence` of serialized Imu messages; memory grows by a number for each.
    """

    def __init__(self) -> None:
        self._stream = ImuStream()
        self._frame_ids = Counter[str]()
        """Frame -> messages."""
        self._last = b''
        """The last valid message."""
        self._frame_id = ''
        """Frame of the last message that was opened."""
        self._age: list[float] = []
        """Time of reception minus stamp of each message that has both, s."""

    def add(self, data: bytes, received_ns: int) -> None:
        """
        Add a message and its time of reception, ns since the epoch, 0 if meaningless.

        Invalid Imu messages are skipped.
        """
        if not self._stream.heads(data):
            try:
                self._frame_id = self._stream.open(data)
            except MessageError:
                return
        self._frame_ids[self._frame_id] += 1
        stamp_ns, _ = self._stream.read(data)
        if stamp_ns and received_ns:
            self._age.append((received_ns - stamp_ns) * 1e-9)
        self._last = data

    def evidence(self) -> MessageEvidence:
        """Return the evidence from the messages so far."""
        if not self._last:
            return MessageEvidence()
        quaternion, packed = self._stream.orientation(self._last)
        matrices = (*self._stream.covariances(self._last), self._stream.unpacked(packed))
        covariances = dict(zip(MESSAGE_QUANTITIES, matrices, strict=True))
        return MessageEvidence(
            dict(self._frame_ids), covariances, np.array(quaternion), np.array(self._age)
        )
