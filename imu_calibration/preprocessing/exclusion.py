"""Times of a recording that its user excludes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.core.errors import InputError, shortened
from imu_calibration.core.samples import BlockSource, SampleBlock

EXCLUDED = 'imu excluded'
"""Reason under which the samples are counted."""


@dataclass(frozen=True)
class Exclusion:
    """A time that is not used."""

    start: float
    """s since the first stamp of the IMU."""
    stop: float
    """The same, of its end, which is not included."""
    recording: str = ''
    """Name of the recording; '' for the only one."""

    def __str__(self):
        span = f'{self.start:g}:{self.stop:g}'
        return f'{self.recording}={span}' if self.recording else span


def parse_exclusions(text: str) -> tuple[Exclusion, ...]:
    """
    Return the times in a text ``A:B,...`` or ``NAME=A:B,...``, s since the first stamp of the IMU.

    Raises
    ------
    InputError
        When a part has another form, or does not end after its start.

    """
    exclusions = []
    for part in text.split(','):
        name, _, span = part.strip().rpartition('=')
        start, _, stop = span.partition(':')
        try:
            exclusion = Exclusion(float(start), float(stop), name)
        except ValueError:  # no numbers: refused below
            exclusion = Exclusion(np.nan, np.nan)
        if not 0.0 <= exclusion.start < exclusion.stop:
            raise InputError(
                'an excluded time must be A:B or NAME=A:B in seconds since the first stamp of the'
                f" IMU, with B after A, got '{part}'; write for example 40:55",
                key='exclude',
                code='exclude_form',
            )
        exclusions.append(exclusion)
    return tuple(exclusions)


def exclusions_by_recording(
    exclusions: Sequence[Exclusion], names: Sequence[str]
) -> list[list[Exclusion]]:
    """
    Return the excluded times of each recording.

    Raises
    ------
    InputError
        When a time names no recording, or none although there are several.

    """
    for exclusion in exclusions:
        known = exclusion.recording in names if exclusion.recording else len(names) == 1
        if not known:
            raise InputError(
                f'an excluded time must name one of the recordings {", ".join(names)}, got'
                f" '{exclusion}'; write NAME=A:B",
                key='exclude',
                code='exclude_recording',
            )
    times_of_recordings = []
    for name in names:
        times_of_recordings.append([each for each in exclusions if each.recording in ('', name)])
    return times_of_recordings


def exclusions_of_units(
    exclusions: Sequence[Exclusion], recordings_of: Mapping[str, Sequence[str]]
) -> dict[str, list[list[Exclusion]]]:
    """
    Return the excluded times of each recording of several units: unit -> a list per recording.

    A time without a name is excluded in all recordings; the name is that of a recording or of a
    unit, for all its recordings.

    Raises
    ------
    InputError
        When a time names neither.

    """
    known = set(recordings_of)
    for recordings in recordings_of.values():
        known.update(recordings)
    for exclusion in exclusions:
        if exclusion.recording and exclusion.recording not in known:
            raise InputError(
                'an excluded time must name a unit or a recording of one'
                f" ({shortened(', '.join(sorted(known)), 200)}), got '{exclusion}'; write NAME=A:B,"
                ' or A:B for all',
                key='exclude',
                code='exclude_recording',
            )
    times_of_units: dict[str, list[list[Exclusion]]] = {}
    for unit, recordings in recordings_of.items():
        times_of_units[unit] = []
        for recording in recordings:
            names = ('', unit, recording)
            times_of_units[unit].append([each for each in exclusions if each.recording in names])
    return times_of_units


class ExclusionMask:
    """Marks the samples of one IMU stream that lie in excluded times."""

    def __init__(self, exclusions: Sequence[Exclusion]):
        self._exclusions = exclusions
        self._first_ns: int | None = None
        # Whether each exclusion contains a sample, and the time of the last sample, s.
        self._is_used = np.zeros(len(exclusions), bool)
        self._last = 0.0

    def kept(self, stamp_ns: np.ndarray) -> np.ndarray:
        """Return which of the next samples are not in an excluded time, bool, shape (n,)."""
        kept = np.ones(len(stamp_ns), bool)
        if not len(stamp_ns):
            return kept
        if self._first_ns is None:
            self._first_ns = int(stamp_ns[0])
        time = (stamp_ns - self._first_ns) * 1e-9
        self._last = max(self._last, float(time.max()))
        for number, exclusion in enumerate(self._exclusions):
            inside = (time >= exclusion.start) & (time < exclusion.stop)
            self._is_used[number] |= inside.any()
            kept &= ~inside
        return kept

    def require_used(self) -> None:
        """Raise where an excluded time has no sample."""
        for exclusion, is_used in zip(self._exclusions, self._is_used, strict=True):
            if not is_used:
                raise InputError(
                    f'an excluded time must lie in the recording, which has {self._last:.1f} s, got'
                    f" '{exclusion}'; correct it",
                    key='exclude',
                    code='exclude_outside',
                )


@dataclass(frozen=True, eq=False)
class WithoutExcluded:
    """A recording without the excluded samples of the IMU, which are counted."""

    source: BlockSource
    """The whole recording."""
    exclusions: Sequence[Exclusion]
    """Times that are not used."""

    def __iter__(self) -> Iterator[SampleBlock]:
        """
        Yield the blocks.

        Raises
        ------
        InputError
            At the end, when no sample lies in an excluded time.

        """
        mask = ExclusionMask(self.exclusions)
        for block in self.source:
            if block.imu is None or not len(block.imu):
                yield block
                continue
            kept = mask.kept(block.imu.stamp_ns)
            if kept.all():
                yield block
                continue
            dropped = dict(block.dropped or {})
            dropped[EXCLUDED] = dropped.get(EXCLUDED, 0) + int(np.count_nonzero(~kept))
            imu = block.imu.select(kept) if kept.any() else None
            yield replace(block, imu=imu, dropped=dropped)
        mask.require_used()
