"""
Windows from streams.

Static, spinning and dynamic windows with the joints' motion, and samples with their reference.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.readings import RawReadings
from imu_calibration.core.samples import ImuSamples, JointSamples, SampleBlock
from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.kinematics.rotations import Reference
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.rest_detection import QuietFloor
from imu_calibration.preprocessing.stream_alignment import JOINT_WAIT, MotionChunks
from imu_calibration.preprocessing.stream_cleaning import (
    NO_RANGES,
    STREAMS,
    BlockCleaner,
    CleanedBlock,
    Watcher,
)
from imu_calibration.preprocessing.window import (
    PhasedSamples,
    UnusedReason,
    Window,
    WindowKind,
    WindowSettings,
    all_samples,
)
from imu_calibration.preprocessing.window_cutter import WindowCutter


class MotionGatherer:
    """
    Converts streams to windows, in bounded memory.

    The result does not depend on the division of the streams into blocks.

    Cleaning is done by the `BlockCleaner`; `stream_alignment.MotionChunks` interpolates the joints
    at the IMU's stamps; `WindowCutter` makes the windows. After a clock reset the first two
    restart. Streams may differ in delay by a minute (temperature: five seconds); later samples are
    not used.

    Parameters
    ----------
    table : Table
        Names of the joints and their noise.
    settings : WindowSettings
    keep_unused : bool
        Also return windows of kind 'unused', so that every accepted sample is in exactly one
        window, in order.
    nominal, watchers, without, unusable
        As for the `BlockCleaner`.

    """

    def __init__(
        self,
        table: Table,
        settings: WindowSettings = WindowSettings(),
        keep_unused: bool = False,
        *,
        nominal: RawReadings | None = None,
        watchers: Sequence[Watcher] = (),
        without: np.ndarray = NO_RANGES,
        unusable: Sequence[str] = (),
    ):
        self.cleaner = BlockCleaner(
            table.joint_names,
            nominal,
            watchers,
            one_sensor=True,
            without=without,
            unusable=unusable,
        )
        self._settings = settings
        self._noise_rad = table.joint_noise_rad
        # Present epoch of the session: number of resets of the clock of IMU or joints. Stream ->
        # cleaned (epoch, samples) that are not processed, and the epoch of the session minus that
        # of the cleaner, because a clock may continue while another one is reset.
        self._epoch = 0
        self._queue = {name: [] for name in STREAMS}
        self._epoch_shift = dict.fromkeys(STREAMS, 0)
        # Reason -> samples dropped in earlier epochs.
        self._lost_counts = Counter()
        self._turns = _Unwrapper()
        self._floors = QuietFloor(), QuietFloor()
        self._chunks = MotionChunks(settings, self._noise_rad, self._floors)
        self._cutter = WindowCutter(settings, self._chunks.short_rest, keep_unused)

    @property
    def n_buffered(self) -> int:
        """Number of buffered samples; bounded for a session of any length."""
        n_queued = sum(len(part) for _, part in chain.from_iterable(self._queue.values()))
        n_buffered = self.cleaner.n_buffered + self._chunks.n_buffered + self._cutter.n_buffered
        return n_queued + n_buffered

    @property
    def counts(self) -> dict[str | UnusedReason | WindowKind, int]:
        """
        Return reason -> number of samples.

        'static', 'spin', 'dynamic': in windows. 'settling', 'not quiet', 'turn-on', 'too short',
        'rest too short': accepted, but in no window. 'edge of joints': just before the first or
        after the last joint state, in motion. 'no joint state', 'late IMU sample', 'imu not
        finite', 'joints repeated stamp', ...: dropped; 'imu clock reset': jumps. Drops reported by
        blocks are not included.
        """
        counts: Counter[str | UnusedReason | WindowKind] = Counter(self.cleaner.counts)
        for source in (self._lost_counts, self._chunks.counts, self._cutter.counts):
            counts.update(source)
        return dict(counts)

    def push(self, block: SampleBlock) -> list[Window]:
        """
        Add a block and return the windows that are complete now.

        Raises
        ------
        InputError
            When the joints of the block differ from the table's.

        """
        cleaned = self.cleaner.push(block)
        self._enqueue(cleaned)
        return self._work() if cleaned else []

    def finish(self) -> list[Window]:
        """Return the remaining windows; no block may be added after this."""
        self._enqueue(self.cleaner.finish())
        windows = self._work()
        while self._has_later_epoch():
            windows += self._next_epoch() + self._work()
        return windows + self._end_epoch() + self._cutter.push(None, final=True)

    def _has_later_epoch(self) -> bool:
        """Return whether samples of a later epoch are in a queue."""
        queued = chain.from_iterable(self._queue.values())
        return any(epoch > self._epoch for epoch, _ in queued)

    def change(self, settings: WindowSettings) -> None:
        """
        Use other settings from now on.

        Raises
        ------
        InputError
            When the pieces of joint smoothing, or the excluded time at the start, would change.

        """
        for name in ('chunk', 'overlap', 'turn_on'):
            if getattr(settings, name) != getattr(self._settings, name):
                raise InputError(
                    f"setting '{name}' must not change during a session; restart with it"
                )
        self._settings = settings
        self._chunks.change(settings)
        self._cutter.change(settings, self._chunks.short_rest)

    def all_of(self, blocks: Iterable[SampleBlock]) -> list[Window]:
        """Return the windows of a recording."""
        windows = []
        for block in blocks:
            windows += self.push(block)
        return windows + self.finish()

    def _enqueue(self, cleaned: CleanedBlock) -> None:
        """Append cleaned samples to the queues of their streams."""
        for name in STREAMS:
            for epoch, samples in getattr(cleaned, name):
                if name == 'joints':
                    samples = self._turns.unwrap(samples)
                self._queue[name].append((epoch + self._epoch_shift[name], samples))

    def _work(self) -> list[Window]:
        """
        Return the windows that the queued samples of this epoch complete.

        When the clocks of the streams were reset, also those of the next epoch.
        """
        windows = []
        while True:
            for name in STREAMS:
                self._add_queued(name)
            windows += self._cut(self._chunks.take())
            if not self._epoch_is_over():
                # Temperatures of an epoch that the other streams do not begin are bounded.
                queue = self._queue['temperature']
                while len(queue) > 1 and _span(queue) > JOINT_WAIT:
                    del queue[0]
                return windows
            windows += self._next_epoch()

    def _add_queued(self, stream: str) -> None:
        """
        Add the queued samples of this epoch to its chunks; those of later epochs remain queued.

        Samples of an earlier epoch are dropped: temperatures that arrived after its end.
        """
        later = []
        for epoch, part in self._queue[stream]:
            if epoch == self._epoch:
                self._chunks.add(**{stream: part})
            elif epoch > self._epoch:
                later.append((epoch, part))
        self._queue[stream] = later

    def _epoch_is_over(self) -> bool:
        """
        Return whether the clocks of IMU and joints were both reset, or one of them for good.

        One for good: `JOINT_WAIT` after its reset the other one has not been reset.
        """
        queues = [self._queue['imu'], self._queue['joints']]
        return all(queues) or any(queue and _span(queue) > JOINT_WAIT for queue in queues)

    def _next_epoch(self) -> list[Window]:
        """Return the remaining windows of this epoch, and begin the next one."""
        windows = self._end_epoch()
        old = self._chunks
        self._chunks = MotionChunks(self._settings, self._noise_rad, self._floors)
        self._chunks.time_origin = old.end_time + self._settings.gap
        self._lost_counts.update(old.counts)
        self._epoch += 1
        if not (self._queue['imu'] and self._queue['joints']):
            self._continue_streams(old)
        return windows

    def _continue_streams(self, old: MotionChunks) -> None:
        """
        Move the streams whose clocks were not reset to the new epoch.

        They are those without samples in the queue, which waits for the next epoch. `old`: the
        `MotionChunks` of the epoch before.
        """
        # The joints at the end of the epoch are still needed: the next samples of the IMU are
        # interpolated between them and later ones. Those of the IMU were used up.
        if not self._queue['joints']:
            self._chunks.add(joints=old.remaining_joints())
        for name in STREAMS:
            if not self._queue[name]:
                self._epoch_shift[name] = self._epoch - self.cleaner.epoch(name)

    def _end_epoch(self) -> list[Window]:
        """Return the windows of all remaining chunks of this epoch."""
        return self._cut(self._chunks.take(final=True))

    def _cut(self, chunks: Iterable[PhasedSamples]) -> list[Window]:
        """Return the windows that are complete with these `PhasedSamples`."""
        windows = []
        for chunk in chunks:
            windows += self._cutter.push(chunk)
        return windows


class _Unwrapper:
    """Removes jumps of joint angles by full turns, sample by sample."""

    def __init__(self) -> None:
        # Last position as read, rad, shape (1, n_joints); None before the first.
        self._last_position: np.ndarray | None = None
        # Full turns that are subtracted from it, shape (n_joints,).
        self._turns: Any = 0

    def unwrap(self, joints: JointSamples) -> JointSamples:
        """Return the joints without jumps of more than half a turn."""
        if not len(joints):
            return joints
        before = joints.position[:1] if self._last_position is None else self._last_position
        step = np.diff(np.concatenate([before, joints.position]), axis=0)
        self._last_position = joints.position[-1:].copy()
        # Turns of each reading: those before, and the steps rounded to full turns, (n, n_joints).
        turns = self._turns + np.cumsum(np.rint(step / (2 * np.pi)).astype(np.int64), axis=0)
        self._turns = turns[-1]
        if not turns.any():
            return joints
        return JointSamples(
            joints.stamp_ns, joints.position - 2 * np.pi * turns, joints.velocity, joints.names
        )


def _span(queue: list[tuple[int, Any]]) -> float:
    """Return the time from the first to the last sample in a queue, s."""
    first = queue[0][1].stamp_ns[0]
    last = queue[-1][1].stamp_ns[-1]
    return abs(int(last) - int(first)) / 1e9


def session_truth(blocks: Iterable[SampleBlock], table: Table) -> tuple[ImuSamples, Reference]:
    """
    Return the samples of a session with their reference from the table.

    Where joints and IMU are both present.
    """
    windows = MotionGatherer(table, WindowSettings(), keep_unused=True).all_of(blocks)
    samples = ImuSamples(
        np.concatenate([window.stamp_ns for window in windows]),
        np.concatenate([window.force_s for window in windows]),
        np.concatenate([window.rate_s for window in windows]),
    )
    motion, _, rows = all_samples(windows)
    reference = reference_motion(table, motion).select(rows)
    return samples, replace(reference, time=np.concatenate([window.time for window in windows]))
