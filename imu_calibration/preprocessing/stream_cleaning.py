"""Streams without unusable samples, in SI units, as a whole or block by block."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.readings import RawReadings
from imu_calibration.core.samples import ImuSamples, JointSamples, SampleBlock, TemperatureSamples
from imu_calibration.effects.base import SENSORS
from imu_calibration.preprocessing.absent_sensor import (
    SensorPresence,
    missing_sensors,
    without_sensor,
)
from imu_calibration.preprocessing.counter_overflow import OverflowSearch
from imu_calibration.preprocessing.spike_filter import SpikeFilter
from imu_calibration.preprocessing.stamping import SampleTimes, StampLine
from imu_calibration.preprocessing.two_sources import TwoSourceSearch
from imu_calibration.preprocessing.wrap_filter import WrapFilter
from imu_calibration.preprocessing.zero_filter import ZeroFilter

_SECOND = 1_000_000_000
BACKWARD_RESET_NS = _SECOND
"""A larger backward step is a reset of the clock, a smaller one a late sample."""
FORWARD_RESET_NS = 3600 * _SECOND
"""
A larger forward step is a reset of the clock as well (a computer that receives the date after
start-up).
"""
NEVER_NS = 1 << 62
"""Later than all stamps, ns; with a minus, earlier."""
_NEEDED = {
    ImuSamples: ('force_s', 'rate_s'),
    JointSamples: ('position',),
    TemperatureSamples: ('temperature_c',),
}
"""Type of samples -> fields that must be finite."""


class DropCounts(Counter):
    """Reason -> number of samples dropped."""

    def add(self, reason: str, number: int | np.integer) -> None:
        """Add to the number of a reason; a reason without samples is not listed."""
        if number:
            self[reason] += int(number)


class StreamCheck:
    """
    Cleans one stream; the result does not depend on its division into pieces.

    Dropped, and counted in `counts`: 'not finite', 'repeated stamp' (the first of equal stamps is
    kept), 'backward stamp' (a late sample), 'stray stamp' (one sample far from both neighbours), of
    an IMU also 'zero' (`zero_filter`), 'spike' (`spike_filter`) and 'wrapped' (`wrap_filter`).
    'clock reset' counts the jumps, each of which starts a new epoch; overflows of the counter from
    which stamps are made are removed. Where the stamps of an IMU follow a clock only loosely
    (packets, times of arrival, milliseconds, jitter), the times of its samples are computed first
    (`stamping.SampleTimes`).

    Parameters
    ----------
    one_sensor : bool
        Whether an IMU with one sensor is accepted (`absent_sensor`); otherwise its samples are not
        finite.

    """

    def __init__(self, *, one_sensor: bool = False) -> None:
        self.counts = DropCounts()
        """Reason -> number of samples dropped; 'clock reset' -> number of jumps."""
        self.presence = SensorPresence() if one_sensor else None
        """Which sensors an IMU stream has; None where both are required."""
        self.sources = TwoSourceSearch()
        """Whether an IMU stream holds the readings of two sensors."""
        self.epoch = 0
        """Number of clock resets so far."""
        # Sensors without a finite reading in any piece that has samples which are not finite.
        self._never_read = set(SENSORS)

        # Statistics of the accepted samples: their number, the time from the first to the last one
        # summed over the epochs, the smallest and the largest stamp.
        self._steps = StepHistogram()
        self._n_accepted = 0
        self._span_ns = 0
        self._first_ns = NEVER_NS
        self._last_ns = -NEVER_NS

        # Stray stamps: the newest sample, while it may be one, and the stamp before it.
        self._possible_stray: Any = None
        self._stamp_before_ns: int | None = None
        # Largest stamp of this epoch as recorded, and after the times were computed.
        self._newest_recorded_ns: int | None = None
        self._newest_ns: int | None = None

        self._overflows = OverflowSearch()
        self._times: SampleTimes | None = None
        self._wraps = WrapFilter()
        self._spikes = SpikeFilter()
        self._zeros = ZeroFilter()
        self._filters = EpochFilters(self._wraps, self._spikes)

    @property
    def line(self) -> StampLine | None:
        """
        Regularity of the IMU stamps (`stamping.StampLine`).

        None for other streams, and until enough stamps have been received.
        """
        return None if self._times is None else self._times.line

    def push(self, samples: Any) -> list[tuple[int, Any]]:
        """
        Return a list of (epoch, samples) that are accepted.

        A few are buffered until their times are determined.
        """
        if samples is None or not len(samples):
            return []
        if self.presence is not None and isinstance(samples, ImuSamples):
            samples = self.presence.push(samples)
        return self._checked(samples)

    def _checked(self, samples: Any) -> list[tuple[int, Any]]:
        """Return the accepted samples of a piece whose sensors are known, as `push` does."""
        if not len(samples):
            return []
        samples = self._finite(samples)
        if isinstance(samples, ImuSamples) and len(samples) and not samples.absent:
            n_before = self._zeros.n_dropped
            samples = self._zeros.push(samples)
            self.counts.add('zero', self._zeros.n_dropped - n_before)
        if len(samples):
            samples = replace(samples, stamp_ns=self._overflows.removed(samples.stamp_ns))
        if isinstance(samples, ImuSamples):
            self.sources.push(samples)
        return self._without_spikes(self._accept(self._without_strays(samples)))

    def finish(self) -> list[tuple[int, Any]]:
        """Return the buffered samples, as `push` does."""
        accepted = []
        buffered = None if self.presence is None else self.presence.finish()
        if buffered is not None:
            accepted += self._checked(buffered)
        self.counts.add('zero', self._zeros.finish())
        last = []
        if self._possible_stray is not None:
            last += self._accept(self._possible_stray)
            self._possible_stray = None
        last += self._end_epoch()
        return accepted + self._without_spikes(last, ended=True)

    def statistics(self, gap: float = 0.1) -> 'StreamStatistics':
        """
        Return the `StreamStatistics` of the accepted samples.

        Parameters
        ----------
        gap : float
            Steps longer than this, and than five median periods, are counted as gaps, s.

        """
        return StreamStatistics(
            **vars(self._steps.statistics(gap)),
            count=self._n_accepted,
            dropped=dict(self.counts),
            duration=self._span_ns / 1e9,
            first_ns=self._first_ns,
            last_ns=self._last_ns,
            stamping=None if self._times is None else self._times.odd_line(self._n_accepted),
            two_sources=self.sources.requirement if self.sources.found else '',
            absent=self._absent(),
            n_late=0 if self.presence is None else self.presence.n_late,
            overflows=self._overflows.count,
            counter_size_ns=self._overflows.size_ns,
        )

    def _absent(self) -> tuple[str, ...]:
        """Return the sensor without any reading; an accepted sample has readings of both."""
        if self.presence is not None:
            return self.presence.absent
        if self._n_accepted or len(self._never_read) == len(SENSORS):
            return ()
        return tuple(self._never_read)

    def _without_spikes(
        self, accepted: list[tuple[int, Any]], ended: bool = False
    ) -> list[tuple[int, Any]]:
        """
        Return (epoch, samples) that pass the filters of an IMU, and count the dropped samples.

        Each epoch of the clock is one stream; with `ended` also the buffered samples are returned.
        """
        passed = []
        for epoch, samples in accepted:
            if not isinstance(samples, ImuSamples):
                passed.append((epoch, samples))
                continue
            passed += self._filters.push(epoch, samples)
        if ended:
            passed += self._filters.finish()
        if self._spikes.dropped:
            self.counts['spike'] = self._spikes.dropped
        if self._wraps.dropped:
            self.counts['wrapped'] = self._wraps.dropped
        return passed

    def _finite(self, samples: Any) -> Any:
        """Return the samples with finite readings."""
        columns = [
            getattr(samples, name).reshape(len(samples), -1) for name in _NEEDED[type(samples)]
        ]
        if all(np.isfinite(column).all() for column in columns):
            return samples
        finite = np.logical_and.reduce([np.isfinite(column).all(axis=1) for column in columns])
        if isinstance(samples, ImuSamples):
            self._never_read.intersection_update(missing_sensors(samples))
        self.counts.add('not finite', len(finite) - np.count_nonzero(finite))
        return samples.select(finite)

    def _without_strays(self, samples: Any) -> Any:
        """
        Return samples without stray stamps: single ones that are more than a second off.

        After a reset of the clock the neighbours are not close to each other. A last sample far
        from the one before is buffered until the next one is received.
        """
        samples = samples.after(self._possible_stray)
        self._possible_stray = None
        if not len(samples):
            return samples
        # `stamps`: of the samples, after the one before them if there is one.
        if self._stamp_before_ns is None:
            stamps = samples.stamp_ns
            is_stray = _strays(stamps)
            # The first sample of the stream has one neighbour only.
            is_stray[0] = len(stamps) > 1 and _is_reset(stamps[1] - stamps[0])
        else:
            stamps = np.append(self._stamp_before_ns, samples.stamp_ns)
            is_stray = _strays(stamps)[1:]

        # The last sample has no later neighbour yet: it waits if it is far from the one before.
        if len(stamps) == 1 or abs(stamps[-1] - stamps[-2]) > BACKWARD_RESET_NS:
            n_decided = len(samples) - 1
            self._possible_stray = samples.select(slice(n_decided, None))
            samples = samples.select(slice(0, n_decided))
            is_stray = is_stray[:-1]
        if len(samples):
            self._stamp_before_ns = samples.stamp_ns[-1]
        self.counts.add('stray stamp', np.count_nonzero(is_stray))
        return samples.select(~is_stray) if is_stray.any() else samples

    def _accept(self, samples: Any) -> list[tuple[int, Any]]:
        """Return the (epoch, samples) in order with their times; a reset begins an epoch."""
        if self._times is None and isinstance(samples, ImuSamples):
            self._times = SampleTimes()
        accepted = []
        while len(samples):
            # The samples up to the first reset of the clock are of this epoch.
            stamps = samples.stamp_ns
            newest_before = _newest_before(stamps, self._newest_recorded_ns)
            is_reset = _is_reset(stamps - newest_before)
            end = int(np.argmax(is_reset)) if is_reset.any() else len(stamps)
            if end:
                self._newest_recorded_ns = max(newest_before[end - 1], stamps[end - 1])
                accepted += self._in_order(self._timed(samples.select(slice(0, end))))
            if end < len(stamps):
                accepted += self._end_epoch()
                self.counts.add('clock reset', 1)
                self.epoch += 1
                self._newest_ns = None
                self._newest_recorded_ns = None
            samples = samples.select(slice(end, None))
        return accepted

    def _timed(self, samples: Any) -> Any:
        """Return the samples whose times are determined now, None for none."""
        if self._times is None:
            return samples
        n_before = self._times.n_repeated
        samples = self._times.push(samples)
        self.counts.add('repeated stamp', self._times.n_repeated - n_before)
        return samples

    def _end_epoch(self) -> list[tuple[int, Any]]:
        """Return the (epoch, samples) whose times were not determined before."""
        return [] if self._times is None else self._in_order(self._times.finish())

    def _in_order(self, samples: Any) -> list[tuple[int, Any]]:
        """Return [(epoch, samples)] without repeated and backward stamps, [] for none."""
        if samples is None or not len(samples):
            return []
        stamps = samples.stamp_ns
        newest_before = _newest_before(stamps, self._newest_ns)
        self.counts.add('repeated stamp', np.count_nonzero(stamps == newest_before))
        self.counts.add('backward stamp', np.count_nonzero(stamps < newest_before))
        is_later = stamps > newest_before
        samples = samples if is_later.all() else samples.select(is_later)
        if len(samples):
            self._add_statistics(samples.stamp_ns)
        return [(self.epoch, samples)]

    def _add_statistics(self, stamps: np.ndarray) -> None:
        """Add accepted stamps, increasing, ns, to the statistics of the stream."""
        self._n_accepted += len(stamps)
        self._first_ns = min(self._first_ns, int(stamps[0]))
        self._last_ns = max(self._last_ns, int(stamps[-1]))
        if self._newest_ns is not None:
            stamps = np.append(self._newest_ns, stamps)
        self._steps.add(np.diff(stamps))
        self._span_ns += int(stamps[-1] - stamps[0])
        self._newest_ns = stamps[-1]


class ImuFilter(Protocol):
    """Removes samples from a stream of an IMU; its result does not depend on the pieces."""

    def push(self, samples: ImuSamples) -> list[ImuSamples]:
        """Return the samples with a decision."""

    def finish(self) -> list[ImuSamples]:
        """Return the buffered samples, and begin a new stream."""


class EpochFilters:
    """Passes the samples of an IMU through filters; each epoch of the clock is one stream."""

    def __init__(self, *filters: ImuFilter) -> None:
        self._filters = filters
        # Epoch of the samples in the filters.
        self._epoch = 0

    def push(self, epoch: int, samples: ImuSamples) -> list[tuple[int, ImuSamples]]:
        """Return the (epoch, samples) with a decision."""
        passed = []
        if epoch != self._epoch:
            passed += self.finish()
            self._epoch = epoch
        passed += [(epoch, part) for part in self._through(self._filters, [samples])]
        return passed

    def finish(self) -> list[tuple[int, ImuSamples]]:
        """Return the buffered (epoch, samples)."""
        passed = []
        # The buffered samples of a filter pass through the later filters, before these end.
        for number, imu_filter in enumerate(self._filters):
            passed += self._through(self._filters[number + 1 :], imu_filter.finish())
        return [(self._epoch, part) for part in passed]

    @staticmethod
    def _through(filters: Sequence[ImuFilter], parts: list[ImuSamples]) -> list[ImuSamples]:
        """Return the samples that pass all given filters, in their order."""
        for imu_filter in filters:
            passed = []
            for part in parts:
                passed += imu_filter.push(part)
            parts = passed
        return parts


def _newest_before(stamps: np.ndarray, newest: int | None) -> np.ndarray:
    """Return the largest stamp before each one, shape (n,); `newest`: of earlier samples."""
    first = stamps[0] - 1 if newest is None else newest
    return np.maximum.accumulate(np.append(first, stamps))[:-1]


def _strays(stamps: np.ndarray) -> np.ndarray:
    """
    Return which stamps, ns, are far from both neighbours while these are closer to each other.

    Shape (n,); the first and the last one are not.
    """
    step = np.diff(stamps)
    size = np.abs(step)
    nearer = np.minimum(size[:-1], size[1:])
    is_stray = np.zeros(len(stamps), bool)
    is_stray[1:-1] = (nearer > BACKWARD_RESET_NS) & (np.abs(step[:-1] + step[1:]) < nearer)
    return is_stray


def _is_reset(step: np.ndarray) -> np.ndarray:
    """Return which steps of stamps, ns, are resets of the clock."""
    return (step < -BACKWARD_RESET_NS) | (step > FORWARD_RESET_NS)


@dataclass(frozen=True, eq=False)
class StepStatistics:
    """Statistics of the steps between stamps."""

    period: float
    """Median step, s; 0 with fewer than two samples."""
    stamp_step_ns: int
    """Greatest common divisor of the steps, ns (1000000: milliseconds); 0 when unknown."""
    n_gaps: int
    """Number of gaps."""
    gap_total: float
    """Their total length, s."""
    longest_step: float
    """Longest step, a gap or not, s."""
    irregular: float
    """Share of the steps that are off the median by more than a tenth."""


@dataclass(frozen=True, eq=False)
class StreamStatistics(StepStatistics):
    """Statistics of the stamps of one stream."""

    count: int
    """Samples accepted."""
    dropped: dict
    """Reason -> number of samples dropped ('clock reset': number of jumps, which drop nothing)."""
    duration: float
    """From the first to the last accepted sample, epochs added, s."""
    first_ns: int
    """Smallest stamp; larger than `last_ns` without samples."""
    last_ns: int
    """Largest stamp."""
    stamping: StampLine | None = None
    """Regularity of the stamps of an IMU; None if they are regular, and for other streams."""
    unstamped: int = 0
    """Samples with stamp zero, for which the time of arrival was used."""
    two_sources: str = ''
    """Refusal of an IMU with the readings of two sensors (`TwoSourceSearch`); '' for one sensor."""
    absent: tuple[str, ...] = ()
    """Sensors without readings."""
    n_late: int = 0
    """Samples with readings of a sensor that had none at first; they are not used."""
    overflows: int = 0
    """Overflows of the counter from which the stamps are made; the stamps are without them."""
    counter_size_ns: int = 0
    """Size of that counter, ns; 0 where it does not overflow."""

    @property
    def rate(self) -> float:
        """Samples per second between gaps, 0 when unknown."""
        return 1.0 / self.period if self.period > 0 else 0.0

    @property
    def real_rate(self) -> float:
        """Samples per second, gaps excluded; 0 when unknown."""
        time = self.duration - self.gap_total + self.n_gaps * self.period
        return (self.count - 1) / time if self.count > 1 and time > 0 else 0.0


_BINS_PER_E = 100
"""Bins of the histogram of steps per factor e: each is one per cent wide."""
_N_BINS = 4500
"""They reach to the longest step that 64 bits of nanoseconds hold."""
_FINE_STEP_NS = 100
"""A common divisor of the steps of at most this is not refined: the stamps are not rounded."""
MAX_STEP_DEVIATION = 0.1
"""Steps farther than this share from the median count as irregular."""


class StepHistogram:
    """
    Numbers and sums of steps in bins of equal ratio.

    Adding pieces in any order gives the same numbers.
    """

    def __init__(self) -> None:
        # Greatest common divisor of the steps, while it is not fine, ns; 0 before the first.
        self._common_step_ns = 0
        # Of each bin: number of steps, and their sum.
        self._number = np.zeros(_N_BINS, np.int64)
        self._sum_ns = np.zeros(_N_BINS, np.int64)
        self._longest_ns = 0

    def add(self, step_ns: np.ndarray) -> None:
        """Add steps, int64, ns, all positive."""
        if not len(step_ns):
            return
        index = (np.log(step_ns) * _BINS_PER_E).astype(np.int64)
        np.add.at(self._number, index, 1)
        np.add.at(self._sum_ns, index, step_ns)
        self._longest_ns = max(self._longest_ns, int(step_ns.max()))
        if self._common_step_ns == 0 or self._common_step_ns > _FINE_STEP_NS:
            self._common_step_ns = int(np.gcd(self._common_step_ns, np.gcd.reduce(step_ns)))

    def statistics(self, gap: float) -> StepStatistics:
        """
        Return the statistics; gaps are longer than `gap` s and than five median steps.

        The median is exact to one per cent, and exactly when the steps are equal; all steps of a
        bin count alike.
        """
        mean_ns = self._sum_ns / np.maximum(self._number, 1)
        total = int(self._number.sum())
        median_ns = mean_ns[np.searchsorted(np.cumsum(self._number), (total + 1) // 2)]
        is_gap = mean_ns > max(gap * 1e9, 5 * median_ns)
        is_irregular = np.abs(mean_ns - median_ns) > MAX_STEP_DEVIATION * median_ns
        return StepStatistics(
            period=float(median_ns / 1e9),
            stamp_step_ns=self._common_step_ns,
            n_gaps=int(self._number[is_gap].sum()),
            gap_total=float(self._sum_ns[is_gap].sum() / 1e9),
            longest_step=self._longest_ns / 1e9,
            irregular=float(self._number[is_irregular].sum() / max(total, 1)),
        )


STREAMS = ('imu', 'joints', 'temperature')
RESET_PAUSE_NS = 10 * _SECOND
"""Pause inserted at a clock reset: the true one is unknown; no turn is used across it."""
MESSAGES = {'imu': 'Imu', 'joints': 'JointState', 'temperature': 'Temperature'}
"""Stream -> message type; names of reasons for lost messages begin with it."""
NO_RANGES = np.zeros((0, 2), np.int64)
"""Nothing to leave out."""
CLEANING_BATCH = 200
"""Samples that are cleaned together: cleaning has a fixed cost per call."""


def samples_outside(ranges: np.ndarray, imu: ImuSamples, first: int = 0) -> ImuSamples:
    """
    Return the samples whose numbers are in none of the half open ranges.

    Parameters
    ----------
    ranges : ndarray, shape (k, 2)
        In order, without overlap.
    imu : ImuSamples
    first : int
        Number of the first sample.

    """
    number = np.arange(first, first + len(imu))
    # An odd number of bounds lies at or below a number within a range.
    is_outside = np.searchsorted(ranges.ravel(), number, side='right') % 2 == 0
    return imu if is_outside.all() else imu.select(is_outside)


@dataclass(frozen=True, eq=False)
class CleanedBlock:
    """
    Usable samples of one or several blocks: of each stream (epoch of the clock, samples), in order.
    """

    imu: Sequence[tuple[int, ImuSamples]] = ()
    """SI."""
    joints: Sequence[tuple[int, JointSamples]] = ()
    """In the requested order of names."""
    temperature: Sequence[tuple[int, TemperatureSamples]] = ()
    """Degrees Celsius."""

    def __bool__(self) -> bool:
        return bool(self.imu or self.joints or self.temperature)


class ContinuedStamps:
    """
    Moves the samples of each epoch of the clock behind those of the one before.

    Parameters
    ----------
    pause_ns : int
        Time between the last sample of an epoch and the first of the next, ns.

    """

    def __init__(self, pause_ns: int = RESET_PAUSE_NS):
        self._pause_ns = pause_ns
        # Epoch and moved stamp of the last sample; None before the first.
        self._epoch = 0
        self._last_ns: int | None = None
        self.shift_ns = 0
        """Shift of the present epoch, ns."""

    def continue_after(self, last_ns: int) -> None:
        """Continue after samples of an earlier run: the next epoch is a new one."""
        self._epoch, self._last_ns = -1, last_ns

    def moved(self, epoch: int, samples: Any) -> Any:
        """Return samples of an epoch, in order, with stamps that continue to increase."""
        if epoch != self._epoch and self._last_ns is not None:
            self.shift_ns = self._last_ns + self._pause_ns - int(samples.stamp_ns[0])
        self._epoch = epoch
        if self.shift_ns:
            samples = replace(samples, stamp_ns=samples.stamp_ns + self.shift_ns)
        self._last_ns = int(samples.stamp_ns[-1])
        return samples


class Watcher(Protocol):
    """Observer of a stream of cleaned blocks."""

    def push(self, cleaned: CleanedBlock) -> object:
        """Process the next block."""

    def finish(self, cleaner: 'BlockCleaner') -> object:
        """Process the end of the streams; may raise when they cannot be used."""


class BlockCleaner:
    """
    Converts the streams of a session to SI and one order of joints.

    It drops unusable samples (see `StreamCheck`).

    Parameters
    ----------
    joint_names : sequence of str
        Order of the joints; by default unchanged.
    nominal : RawReadings, optional
        For recordings in volts or counts.
    watchers : sequence of Watcher
        Receivers of each cleaned block.
    one_sensor : bool
        Whether an IMU with one sensor is accepted, as for `StreamCheck`.
    without : array, shape (n, 2)
        Ranges of cleaned samples of the IMU to leave out, from an earlier pass
        (`checks.without_readings`).
    unusable : sequence of str
        Sensor with readings that cannot be used, one at most: it is marked as absent.

    """

    def __init__(
        self,
        joint_names: Sequence[str] = (),
        nominal: RawReadings | None = None,
        watchers: Sequence[Watcher] = (),
        *,
        one_sensor: bool = False,
        without: np.ndarray = NO_RANGES,
        unusable: Sequence[str] = (),
    ):
        self._without = without
        # Number of cleaned samples of the IMU until now, in which `without` counts.
        self._n_imu = 0
        self._unusable = unusable
        self._names = tuple(joint_names)
        self._nominal = nominal
        self._watchers = watchers
        self._checks = {name: StreamCheck(one_sensor=one_sensor) for name in STREAMS}
        # Samples that are not cleaned yet, and (epoch, samples) that are not returned yet.
        self._collected: dict[str, list] = {name: [] for name in STREAMS}
        self._cleaned: dict[str, list[tuple[int, Any]]] = {name: [] for name in STREAMS}
        self.lost: Counter[str] = Counter()
        """Messages that could not be converted to samples: reason -> count."""
        self.notes: Counter[str] = Counter()
        """Messages that were used with a modification: reason -> count."""

    @property
    def readings(self) -> RawReadings:
        """Stated units of the readings."""
        return self._nominal or RawReadings()

    @property
    def n_buffered(self) -> int:
        """Number of samples that were added and not returned."""
        n_buffered = 0
        for stream in STREAMS:
            n_buffered += sum(len(part) for _, part in self._cleaned[stream])
            n_buffered += sum(len(part) for part in self._collected[stream])
        return n_buffered

    @property
    def counts(self) -> dict[str, int]:
        """
        Return the dropped samples per stream.

        'imu not finite', 'joints repeated stamp', ... -> number of samples.
        """
        self._clean()
        counts = {}
        for name, check in self._checks.items():
            for reason, count in check.counts.items():
                counts[f'{name} {reason}'] = count
        return counts

    def epoch(self, stream: str) -> int:
        """Return how often the clock of a stream was reset."""
        return self._checks[stream].epoch

    def statistics(self, gap: float = 0.1) -> dict[str, StreamStatistics]:
        """Return stream name -> `StreamStatistics`; `gap` as for `StreamCheck.statistics`."""
        self._clean()
        statistics = {}
        for name, check in self._checks.items():
            unstamped = self.notes.get(f'{MESSAGES[name]} zero stamp', 0)
            statistics[name] = replace(check.statistics(gap), unstamped=unstamped)
        return statistics

    @property
    def sources(self) -> TwoSourceSearch:
        """Whether the IMU stream holds the readings of two sensors."""
        return self._checks['imu'].sources

    @property
    def stamping(self) -> StampLine | None:
        """Regularity of the IMU stamps; None until enough stamps have been received."""
        return self._checks['imu'].line

    def push(self, block: SampleBlock) -> CleanedBlock:
        """
        Add a block and return the samples usable now.

        Small blocks are collected up to `CLEANING_BATCH` samples.

        Raises
        ------
        InputError
            When the joints of the block differ from the requested ones.

        """
        self.lost.update(block.dropped or {})
        self.notes.update(block.notes or {})
        for name in STREAMS:
            samples: Any = getattr(block, name)
            if samples is not None and len(samples):
                if name == 'imu' and self._nominal is not None:
                    samples = self._nominal.apply(samples)
                if name == 'joints':
                    samples = self._in_requested_order(samples)
                self._collected[name].append(samples)
        if self.n_buffered < CLEANING_BATCH:
            return CleanedBlock()
        self._clean()
        return self._take_ready()

    def finish(self) -> CleanedBlock:
        """Return the buffered samples; no block may be added after this."""
        self._clean()
        for name, check in self._checks.items():
            self._cleaned[name] += check.finish()
        cleaned = self._take_ready()
        for watcher in self._watchers:
            watcher.finish(self)
        return cleaned

    def all_of(self, blocks: Iterable[SampleBlock]) -> Iterator[CleanedBlock]:
        """Yield the usable samples of a recording."""
        for block in blocks:
            yield self.push(block)
        yield self.finish()

    def _clean(self) -> None:
        """Clean the samples that were collected."""
        for name, parts in self._collected.items():
            if parts:
                samples = parts[0] if len(parts) == 1 else type(parts[0]).concatenate(parts)
                self._cleaned[name] += self._checks[name].push(samples)
                self._collected[name] = []

    def _take_ready(self) -> CleanedBlock:
        """Return the cleaned samples, without those to leave out, and pass them to the watchers."""
        filled = {}
        for name, parts in self._cleaned.items():
            filled[name] = [(epoch, part) for epoch, part in parts if len(part)]
        cleaned = CleanedBlock(**filled)
        self._cleaned = {name: [] for name in STREAMS}
        if len(self._without):
            cleaned = replace(cleaned, imu=self._without_ranges(cleaned.imu))
        for sensor in self._unusable:
            parts = [(epoch, without_sensor(imu, sensor)) for epoch, imu in cleaned.imu]
            cleaned = replace(cleaned, imu=parts)
        for watcher in self._watchers:
            watcher.push(cleaned)
        return cleaned

    def _without_ranges(
        self, parts: Sequence[tuple[int, ImuSamples]]
    ) -> list[tuple[int, ImuSamples]]:
        """Return the (epoch, samples) without the ranges to leave out."""
        used_parts = []
        for epoch, imu in parts:
            used = samples_outside(self._without, imu, self._n_imu)
            self._n_imu += len(imu)
            if len(used):
                used_parts.append((epoch, used))
        return used_parts

    def _in_requested_order(self, joints: JointSamples) -> JointSamples:
        """Return joint samples with their columns in the requested order of names."""
        if not self._names or not joints.names or tuple(joints.names) == self._names:
            return joints
        missing = [name for name in self._names if name not in joints.names]
        if missing:
            raise InputError(
                f"joint states must hold the table's joints {', '.join(self._names)}, got"
                f' {", ".join(joints.names)}; correct the names in the table or choose another'
                ' joint topic',
                code='joint_names',
            )
        order = [joints.names.index(name) for name in self._names]
        return JointSamples(
            joints.stamp_ns, joints.position[:, order], joints.velocity[:, order], self._names
        )
