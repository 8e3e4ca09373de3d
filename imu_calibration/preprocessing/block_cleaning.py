"""Blocks of a recording or of live topics, cleaned once for all consumers: checks, windows, statistics of the streams."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples, JointSamples, NominalScaling, SampleBlock, TemperatureSamples
from imu_calibration.preprocessing.stamping import StampLine
from imu_calibration.preprocessing.stream_cleaning import StreamCheck, StreamStatistics

STREAMS = ('imu', 'joints', 'temperature')
MESSAGES = {'imu': 'Imu', 'joints': 'JointState', 'temperature': 'Temperature'}
"""Stream -> message type; names of reasons for lost messages begin with it."""
BATCH = 200
"""Samples that are cleaned together: cleaning has a fixed cost per call."""
_KINDS: dict[str, Any] = {'imu': ImuSamples, 'joints': JointSamples, 'temperature': TemperatureSamples}


@dataclass(frozen=True, eq=False)
class CleanedBlock:
    """Usable samples of one or several blocks: per stream (epoch of the clock, samples), ... in order."""

    imu: Sequence[tuple[int, ImuSamples]] = ()
    """SI."""
    joints: Sequence[tuple[int, JointSamples]] = ()
    """In the requested order of names."""
    temperature: Sequence[tuple[int, TemperatureSamples]] = ()
    """Degrees Celsius."""

    def __bool__(self) -> bool:
        return bool(self.imu or self.joints or self.temperature)


class Watcher(Protocol):
    """Observer of a stream of cleaned blocks."""

    def push(self, cleaned: CleanedBlock) -> object:
        """Process the next block."""

    def finish(self, cleaner: 'BlockCleaner') -> object:
        """Process the end of the streams; may raise when they cannot be used."""


class BlockCleaner:
    """
    Converts the streams of a session to SI and one order of joints, and drops unusable samples (see `StreamCheck`).

    Parameters
    ----------
    joint_names : sequence of str
        Order of the joints; by default unchanged.
    nominal : NominalScaling, optional
        For recordings in volts or counts.
    watchers : sequence of Watcher
        Receivers of each cleaned block.

    """

    def __init__(self, joint_names: Sequence[str] = (), nominal: NominalScaling | None = None, watchers: Sequence[Watcher] = ()):
        self._names, self._nominal, self._watchers = tuple(joint_names), nominal, watchers
        self._checks = {name: StreamCheck() for name in STREAMS}
        self._raw: dict[str, list] = {name: [] for name in STREAMS}
        self._ready: dict[str, list[tuple[int, Any]]] = {name: [] for name in STREAMS}
        self.lost: dict[str, int] = {}
        """Messages that could not be converted to samples: reason -> count."""
        self.notes: dict[str, int] = {}
        """Messages that were used with a modification: reason -> count."""

    @property
    def n_buffered(self) -> int:
        """Samples held at the moment."""
        return sum(len(part) for parts in self._raw.values() for part in parts) + sum(len(part) for parts in self._ready.values() for _,
                                                                                      part in parts)

    @property
    def counts(self) -> dict[str, int]:
        """Return the dropped samples per stream: 'imu not finite', 'joints repeated stamp', ... -> number of samples."""
        self._clean()
        return {f'{name} {reason}': count for name, check in self._checks.items() for reason, count in check.counts.items()}

    def epoch(self, stream: str) -> int:
        """Return how often the clock of a stream was reset."""
        return self._checks[stream].epoch

    def statistics(self, gap: float = 0.1) -> dict[str, StreamStatistics]:
        """Return stream name -> `StreamStatistics`; `gap` as for `StreamCheck.statistics`."""
        self._clean()
        return {name: replace(check.statistics(gap), unstamped=self.notes.get(f'{MESSAGES[name]} zero stamp', 0))
                for name, check in self._checks.items()}

    @property
    def stamping(self) -> StampLine | None:
        """Regularity of the IMU stamps; None until enough stamps have been received."""
        return self._checks['imu'].line

    def push(self, block: SampleBlock) -> CleanedBlock:
        """
        Add a block and return the samples usable now; small blocks are collected up to `BATCH` samples.

        Raises
        ------
        InputError
            When the joints of the block differ from the requested ones.

        """
        for found, total in ((block.dropped, self.lost), (block.notes, self.notes)):
            for reason, count in (found or {}).items():
                total[reason] = total.get(reason, 0) + count
        for name in STREAMS:
            samples = getattr(block, name)
            if samples is not None and len(samples):
                self._raw[name].append(self._in_our_terms(name, samples))
        if self.n_buffered < BATCH:
            return CleanedBlock()
        self._clean()
        return self._hand_on()

    def finish(self) -> CleanedBlock:
        """Return the buffered samples; no block may be added after this."""
        self._clean()
        for name, check in self._checks.items():
            self._ready[name] += check.finish()
        cleaned = self._hand_on()
        for watcher in self._watchers:
            watcher.finish(self)
        return cleaned

    def all_of(self, blocks: Iterable[SampleBlock]) -> Iterator[CleanedBlock]:
        """Yield the usable samples of a recording."""
        for block in blocks:
            yield self.push(block)
        yield self.finish()

    def _clean(self) -> None:
        for name, parts in self._raw.items():
            if parts:
                self._ready[name] += self._checks[name].push(parts[0] if len(parts) == 1 else _KINDS[name].concatenate(parts))
                self._raw[name] = []

    def _hand_on(self):
        cleaned = CleanedBlock(**{name: [(epoch, part) for epoch, part in parts if len(part)] for name, parts in self._ready.items()})
        self._ready = {name: [] for name in STREAMS}
        for watcher in self._watchers:
            watcher.push(cleaned)
        return cleaned

    def _in_our_terms(self, name, samples):
        if name == 'joints':
            return self._in_order(samples)
        return samples if name != 'imu' or self._nominal is None else self._nominal.apply(samples)

    def _in_order(self, joints):
        if not self._names or not joints.names or tuple(joints.names) == self._names:
            return joints
        missing = [name for name in self._names if name not in joints.names]
        if missing:
            raise InputError(f"joint states must hold the table's joints {', '.join(self._names)}, got {', '.join(joints.names)}; "
                             'correct the names in the table or choose another joint topic', code='joint_names')
        order = [joints.names.index(name) for name in self._names]
        return JointSamples(joints.stamp_ns, joints.position[:, order], joints.velocity[:, order], self._names)
