"""
The sample store of a live calibration by hand.

All samples up to a limit, then the least informative are discarded first.
"""

import io
from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import replace

import numpy as np

from imu_calibration.core.documents import load_arrays
from imu_calibration.core.errors import DocumentError, ImuCalibrationError, shortened
from imu_calibration.core.samples import ImuSamples
from imu_calibration.effects.base import SENSORS
from imu_calibration.preprocessing.stream_cleaning import ContinuedStamps

SAMPLES_FORMAT = 'imu_calibration/hand_samples/1'
INSERTED_PAUSE_NS = 3600 * 10**9
"""Pause that is inserted at a clock reset: no turn is used across it."""
REST_KEPT = 30.0
"""Of a rest that is discarded, this much is kept at its start and at its end, s."""
HELD_OUT = 1.0
"""Longest distance of two parts of one rest, s: the time excluded after a hole."""
SHARE_KEPT = 0.9
"""Share of the samples that is kept when some are discarded."""


class HandStore:
    """
    A bounded store of ImuSamples with increasing stamps.

    Parameters
    ----------
    most : int
        Largest number of samples.

    """

    def __init__(self, most: int):
        self.most = most
        # The samples in order of time, one part for each call of `add` since they were joined.
        self._parts: list[ImuSamples] = []
        # Shifts the stamps after a clock reset, so that they increase.
        self._stamps = ContinuedStamps(INSERTED_PAUSE_NS)
        # Number of samples that were discarded.
        self.forgotten = 0

    def __len__(self) -> int:
        return sum(len(part) for part in self._parts)

    def copy(self) -> 'HandStore':
        """Return a copy that shares the samples."""
        twin = HandStore(self.most)
        twin._parts = list(self._parts)
        twin._stamps = copy(self._stamps)
        twin.forgotten = self.forgotten
        return twin

    def add(self, accepted: Iterable[tuple[int, ImuSamples]]) -> None:
        """
        Add the output of a StreamCheck: (epoch of the clock, samples).

        At a clock reset a new epoch begins; stamps continue to increase.
        """
        for epoch, samples in accepted:
            if not len(samples):
                continue
            self._parts.append(replace(self._stamps.moved(epoch, samples), corrected=None))

    def samples(self) -> ImuSamples | None:
        """Return all samples, or None without any."""
        if not self._parts:
            return None
        if len(self._parts) > 1:  # joined once, not in every call
            self._parts = [ImuSamples.concatenate(self._parts)]
        return self._parts[0]

    def true_stamps(self, stamp_ns: np.ndarray) -> np.ndarray:
        """Return the header stamps of samples of the present epoch, given their stored stamps."""
        return stamp_ns - self._stamps.shift_ns

    def forget(self, rests: Sequence[slice], most_rests: int) -> bool:
        """
        Discard samples above the limit, and return whether any were discarded.

        They are the inside of the longest rest if that suffices, otherwise the oldest.

        Parameters
        ----------
        rests : list of slice
            Ranges at rest among `samples`.
        most_rests : int
            Largest number of rests; the oldest are discarded first.

        """
        imu = self.samples()
        if imu is None:
            return False
        # Below the limit by some, so that samples are not discarded at every call.
        if len(rests) > most_rests:
            first_kept = rests[len(rests) - int(SHARE_KEPT * most_rests)]
            self._discard(imu, slice(0, first_kept.start))
            return True
        if len(self) > self.most:
            count = len(imu) - int(SHARE_KEPT * self.most)
            self._discard(imu, self._least_informative(imu, rests, count))
            return True
        return False

    def _least_informative(self, imu: ImuSamples, rests: Sequence[slice], count: int) -> slice:
        """
        Return the range of `count` samples inside the longest rest, or of the oldest.

        The oldest are returned if `REST_KEPT` at both ends of the rest would not remain.
        """
        longest = max(
            _across_holes(imu.stamp_ns, rests),
            key=lambda rest: rest.stop - rest.start,
            default=slice(0, 0),
        )
        n_kept = int(REST_KEPT * 1e9 / max(np.median(np.diff(imu.stamp_ns)), 1))
        if longest.stop - longest.start < count + 2 * n_kept:
            return slice(0, count)
        return slice(longest.start + n_kept, longest.start + n_kept + count)

    def _discard(self, imu: ImuSamples, discarded: slice) -> None:
        """Store the samples without a range of them, and count it."""
        is_kept = np.ones(len(imu), bool)
        is_kept[discarded] = False
        self.forgotten += int(np.count_nonzero(~is_kept))
        self._parts = [imu.select(is_kept)]

    def to_bytes(self) -> bytes:
        """Return the samples as an npz archive."""
        target = io.BytesIO()
        imu = self.samples()
        if imu is None:
            imu = ImuSamples(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
        np.savez(
            target,
            format=np.array(SAMPLES_FORMAT),
            frame_id=np.array(imu.frame_id),
            absent=np.array(imu.absent, str),
            stamp_ns=imu.stamp_ns,
            force_s=imu.force_s,
            rate_s=imu.rate_s,
        )
        return target.getvalue()

    def load(self, data: bytes) -> None:
        """
        Replace the samples by saved ones; new samples follow after a pause.

        Raises
        ------
        DocumentError
            When the bytes are no such archive.

        """
        try:
            with load_arrays(data) as arrays:
                if str(arrays['format']) != SAMPLES_FORMAT:
                    raise DocumentError(
                        f"samples must have the format '{SAMPLES_FORMAT}', got"
                        f" '{arrays['format']}'; remove the file, or start without resume"
                    )
                absent: tuple[str, ...] = ()
                if 'absent' in arrays:
                    absent = tuple(str(sensor) for sensor in arrays['absent'])
                if not set(absent) <= set(SENSORS):
                    raise ValueError(f'its absent sensors are {absent}')
                imu = ImuSamples(
                    arrays['stamp_ns'],
                    arrays['force_s'],
                    arrays['rate_s'],
                    str(arrays['frame_id']),
                    absent=absent,
                )
            _check_array(imu.stamp_ns, 'i', shape=(imu.stamp_ns.size,))
            _check_array(imu.force_s, 'f', shape=(imu.stamp_ns.size, 3))
            _check_array(imu.rate_s, 'f', shape=(imu.stamp_ns.size, 3))
        except ImuCalibrationError:
            raise
        except Exception as error:  # damaged archives and arrays raise many kinds
            raise DocumentError(
                f'saved samples must be a whole file of {SAMPLES_FORMAT}, this is not'
                f' ({shortened(f"{type(error).__name__}: {error}", 200)}); remove it, or start'
                ' without resume',
                code='samples_damaged',
            ) from error
        if len(imu):
            self._parts = [imu]
            self._stamps.continue_after(int(imu.stamp_ns[-1]))


def _check_array(values: np.ndarray, kind: str, *, shape: tuple[int, ...]) -> None:
    """Raise ValueError where an array has another kind of number ('i', 'f') or shape."""
    if values.dtype.kind != kind or values.shape != shape:
        raise ValueError(f'it holds {values.dtype} of shape {values.shape}')


def _across_holes(stamp_ns: np.ndarray, rests: Sequence[slice]) -> list[slice]:
    """
    Return the ranges at rest, joined across holes of discarded samples.

    Two ranges are joined if a hole is between them, and otherwise less than `HELD_OUT`, the time
    that is excluded after a hole.
    """
    joined: list[slice] = []
    least_hole = 5 * np.median(np.diff(stamp_ns)) * 1e-9
    for rest in rests:
        if joined:
            # Steps of time from the end of the range before to the start of this one, s.
            steps = np.diff(stamp_ns[joined[-1].stop - 1 : rest.start + 1]) * 1e-9
            largest = steps.max(initial=0.0)
            if largest > least_hole and steps.sum() - largest < HELD_OUT:
                joined[-1] = slice(joined[-1].start, rest.stop)
                continue
        joined.append(rest)
    return joined
