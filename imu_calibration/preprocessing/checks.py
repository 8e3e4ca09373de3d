"""
Checks of a recording before the estimate.

Their registry, and the checks of frozen outputs and of stamps.

`CHECKS` is the registry: a check is a function of the `RecordingEvidence` that yields
`CheckFinding` objects; adding one is adding an entry. The docstring of a check is the requirement
on the recording, and its findings are the violations, or one of severity GOOD.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import any_within, runs_of
from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.preprocessing import two_sources, value_checks
from imu_calibration.preprocessing.counter_overflow import longer_gaps
from imu_calibration.preprocessing.recording_evidence import (
    GOOD,
    NOTE,
    REFUSE,
    WARNING,
    CheckFinding,
    EvidenceGatherer,
    RecordingEvidence,
)
from imu_calibration.preprocessing.scan import SENSOR_COLUMNS, FrozenPart
from imu_calibration.preprocessing.stamping import IRREGULAR, MAX_IRREGULAR_SHARE
from imu_calibration.preprocessing.stream_cleaning import (
    MESSAGES,
    NO_RANGES,
    BlockCleaner,
    StreamStatistics,
)


def one_source(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """The readings are those of one sensor."""
    imu = evidence.streams.get('imu')
    if imu is not None and imu.two_sources:
        yield CheckFinding(two_sources.CHECK, REFUSE, imu.two_sources, key=two_sources.KEY)


def both_sensors(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """Both sensors have readings, from the beginning."""
    imu = evidence.streams.get('imu')
    if imu is None or not imu.absent:
        return
    sensor = imu.absent[0]
    if imu.n_late:
        yield CheckFinding(
            'absent',
            WARNING,
            f'the {sensor} must measure from the beginning, it has no readings at first and'
            f' {imu.n_late} later, which are not used; cut the beginning of the recording',
        )
        return
    yield CheckFinding(
        'absent',
        NOTE,
        f'the recording has no readings of the {sensor}: only the other sensor is processed',
    )


def frozen_text(sensor: str, n_samples: int, *, is_zero: bool) -> str:
    """Return the text of a finding: the outputs of a sensor never change."""
    band = ' (always 0: a dead band, or no sensor)' if is_zero else ''
    return (
        f'the {sensor} must measure something, its outputs never change in {n_samples}'
        f' samples{band}; check the sensor and its driver'
    )


def frozen(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """No output is constant while other axes move."""
    chunks = evidence.chunks
    if not len(chunks):
        return
    for sensor, part in SENSOR_COLUMNS.items():
        if sensor in evidence.absent:
            continue
        has_noise = evidence.quiet_range[part] > 0
        constant = evidence.n_changed[part] == 0
        if constant.all():
            zero = not chunks.mean[:, part].any()
            yield CheckFinding(
                'frozen',
                REFUSE,
                frozen_text(sensor, evidence.n_samples, is_zero=zero),
                sensor=sensor,
            )
            continue
        # An axis without any change is a fault if another one has noise: the steps are fine enough.
        for axis in np.flatnonzero(constant):
            if has_noise.any():
                yield CheckFinding(
                    'frozen',
                    REFUSE,
                    f'every axis must measure something, {sensor} {"xyz"[axis]} never changes while'
                    ' the remaining axes do; check the sensor and its driver',
                    sensor=sensor,
                )
        # An axis that is constant for a time only.
        for axis in np.flatnonzero(~constant):
            stuck = evidence.stuck[:, part][:, axis]
            if stuck.any():
                seconds = stuck.sum() * float(np.median(chunks.duration))
                yield CheckFinding(
                    'frozen',
                    WARNING,
                    f'{sensor} {"xyz"[axis]} is constant for {seconds:.1f} s while different axes'
                    ' move: that time is left out; check its connection',
                    samples=int(stuck.sum() * chunks.size),
                )


def without_readings(evidence: RecordingEvidence) -> np.ndarray:
    """
    Return the ranges of samples that are no readings, half open, shape (n, 2).

    A sensor or an axis is frozen there, or the joints are while the IMU turns. The places are among
    the cleaned samples; one chunk on both sides is included, because its readings may be mixed.
    """
    chunks = evidence.chunks
    # An axis that never changes is no reason: that is a finding of the complete recording.
    is_unusable = np.logical_or(*evidence.frozen.values())
    is_unusable |= evidence.stuck[:, evidence.n_changed > 0].any(axis=1)
    for part in evidence.frozen_parts:
        half = 0.5 * chunks.duration
        is_unusable |= (chunks.time - half >= part.start) & (chunks.time + half <= part.stop)
    if not len(is_unusable):
        return NO_RANGES
    runs = runs_of(any_within(is_unusable, 1, 1))
    ranges = runs * chunks.size
    # The samples after the last full chunk are those of the last one.
    ranges[runs[:, 1] == len(chunks), 1] = evidence.n_samples
    return ranges


JOINT_STATES = 'joints'
"""`CheckFinding.sensor` of joint states that are constant for a time."""


def frozen_for_a_time(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """Every sensor and every joint measures until the end."""
    joint_parts = [part for part in evidence.frozen_parts if part.who == 'joints']
    for part in _sensor_parts(evidence.frozen_parts):
        yield CheckFinding(
            'frozen',
            WARNING,
            f'the {part.who} must measure all the time, it repeats one reading'
            f' {span_words([(part.start, part.stop)])}, which its noise does not allow; check the'
            ' sensor and its driver; that time is left out',
            samples=part.samples,
        )
    if joint_parts:
        yield CheckFinding(
            'frozen',
            WARNING,
            'joint states must follow the table, they are constant while the IMU turns,'
            f' {span_words([(part.start, part.stop) for part in joint_parts])}; check the driver'
            ' of the table, or whether the IMU was carried; that time is left out',
            sensor=JOINT_STATES,
            samples=sum(part.samples for part in joint_parts),
        )


def _sensor_parts(parts: Sequence[FrozenPart]) -> list[FrozenPart]:
    """Return the `FrozenPart` of sensors, joined as 'IMU' where both are frozen at one time."""
    by_span: dict[tuple[float, float], FrozenPart] = {}
    for part in parts:
        span = (part.start, part.stop)
        if part.who == 'joints':
            continue
        if span in by_span:
            part = replace(by_span[span], who='IMU')
        by_span[span] = part
    return list(by_span.values())


def frozen_lines(parts: Sequence[FrozenPart], consequence: str) -> list[str]:
    """Return a line for each time in which a sensor is frozen, with the consequence."""
    return [
        f'the {part.who} repeats one reading {span_words([(part.start, part.stop)])}: {consequence}'
        for part in _sensor_parts(parts)
    ]


def span_words(spans: Sequence[tuple[float, float]]) -> str:
    """Return (start, stop), s, in words as `first_of`."""
    return first_of([f'from {start:.1f} s to {stop:.1f} s' for start, stop in spans])


def first_of(times: Sequence[str]) -> str:
    """Return three times in words, and the number of further ones."""
    return ', '.join(times[:3]) + (f' and {len(times) - 3} times more' if len(times) > 3 else '')


WHOLE_MS = 1_000_000
"""A millisecond, ns."""
STAMP_FAULTS = {
    'not finite': 'are not finite: the driver sends them; they are left out',
    'zero': (
        'are zero on all axes of both sensors for less than a second: the bus did not answer; they'
        ' are left out; check its wires and its clock rate'
    ),
    'repeated stamp': (
        'repeat the stamp before: stamp each sample when it is measured; the second of equal stamps'
        ' is left out'
    ),
    'backward stamp': 'step back in time: samples that arrive late are left out; publish in order',
    'stray stamp': 'have a stray stamp: a single outlying stamp is excluded',
    'spike': (
        'are spikes: readings that differ from their neighbours beyond any motion are excluded; if'
        ' they are many, check the bus and the driver'
    ),
    'wrapped': (
        'are in motions whose readings wrap around at the end of the range of the converter: these'
        ' motions are left out; move less fast or choose a wider range'
    ),
}
"""Reason for which samples were dropped -> what they do, and the remedy."""
SPIKE_SHARE = 5e-3
"""
Occasional knocks resemble spikes, and 1 % of spikes do not degrade a calibration; a larger share
has a cause.
"""
MOST_REPEATED_STAMPS = 0.9
"""Share of repeated stamps above which a recording has no times."""
GAP_SHARE = 0.01
"""Share of the duration above which gaps are a warning."""
RATE_SHARE = 0.02
"""Relative difference of the rate from that of the median step above which it is a warning."""


def is_one_stamp(n_repeated: int, total: int) -> bool:
    """Return whether nearly all of `total` samples repeat the stamp before them."""
    return n_repeated > MOST_REPEATED_STAMPS * total


def one_stamp_text(name: str, n_repeated: int, total: int) -> str:
    """Return the text of a finding: the stamps of a message type do not advance."""
    return (
        f'{name} must have header stamps that advance, {n_repeated} of {total} repeat the stamp'
        ' before: written with too few digits, or set only once?; stamp each sample at its'
        ' measurement'
    )


def stamps(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """Every sample has a stamp of its own, later than the one before, and finite readings."""
    for name, stream in evidence.streams.items():
        yield from _stamps_of(MESSAGES[name], stream)
    faultless = [MESSAGES[name] for name, stream in evidence.streams.items() if not stream.dropped]
    if faultless:
        yield CheckFinding('stamps', GOOD, f'{" and ".join(faultless)}: all stamps advance')


def _stamps_of(message: str, stream: StreamStatistics) -> Iterator[CheckFinding]:
    """Yield the findings of the stamps of one stream; `message`: type of its messages."""
    # Spikes and wrapped readings have accepted stamps, and a clock reset drops no sample.
    total = stream.count
    for reason, count in stream.dropped.items():
        if reason not in ('clock reset', 'spike', 'wrapped'):
            total += count
    n_repeated = stream.dropped.get('repeated stamp', 0)
    if is_one_stamp(n_repeated, total):
        yield CheckFinding('stamps_equal', REFUSE, one_stamp_text(message, n_repeated, total))
        return
    if stream.count < 0.1 * total:
        reasons = ', '.join(f'{count} {reason}' for reason, count in stream.dropped.items())
        yield CheckFinding(
            'stamps',
            REFUSE,
            f'{message} must hold finite samples whose header stamps advance, of {total}'
            f' only {stream.count} do ({reasons}); correct the driver and record again',
        )
        return
    if stream.unstamped:
        yield CheckFinding(
            'stamps',
            WARNING,
            f'{message}: {stream.unstamped} of {total} stamps are zero: the time of'
            ' arrival is used; the driver should stamp each sample at its measurement',
        )
    if stream.overflows:
        yield CheckFinding(
            'stamps',
            NOTE,
            f'{message}: the counter of the stamps overflows {_times(stream.overflows)}: undone'
            f'{longer_gaps(stream.counter_size_ns, stream.n_gaps)}',
        )
    for reason, count in stream.dropped.items():
        severity = NOTE if reason == 'spike' and count < SPIKE_SHARE * total else WARNING
        if reason == 'clock reset':
            text = (
                f'the stamps jump {_times(count)}: the clock was'
                ' set while recording; the parts are processed separately'
            )
        else:
            text = f'{count} of {total} samples {STAMP_FAULTS[reason]}'
        yield CheckFinding('stamps', severity, f'{message}: {text}')


def _times(count: int) -> str:
    """Return a number of events in words."""
    return 'once' if count == 1 else f'{count} times'


def _fast_streams(evidence: RecordingEvidence) -> list[tuple[str, StreamStatistics]]:
    """Return (message type, StreamStatistics) of the IMU and the joints."""
    streams = []
    for name in ('imu', 'joints'):
        if name in evidence.streams:
            streams.append((MESSAGES[name], evidence.streams[name]))
    return streams


def gaps(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """The streams have no gaps."""
    for name, stream in _fast_streams(evidence):
        if stream.n_gaps:
            severity = WARNING if stream.gap_total > GAP_SHARE * stream.duration else NOTE
            yield CheckFinding(
                'gaps',
                severity,
                f'{name}: {stream.n_gaps} gap{"s" if stream.n_gaps > 1 else ""},'
                f' {stream.gap_total:.2f} s of {stream.duration:.0f} s, the longest'
                f' {stream.longest_step:.2f} s; motion within a gap is not used',
            )


def sampling(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """The samples per second agree with the step between stamps."""
    for name, stream in _fast_streams(evidence):
        nominal = stream.rate
        real = stream.real_rate
        if nominal and abs(real / nominal - 1) > RATE_SHARE:
            yield CheckFinding(
                'sampling',
                WARNING,
                f'{name}: the usual step between stamps is that of {nominal:.2f} Hz, the rate is'
                f' {real:.2f} Hz: samples were lost, or stamps are made when messages arrive; check'
                ' the driver and the load of the recorder',
            )
        elif nominal:
            yield CheckFinding(
                'sampling', GOOD, f'{name}: {real:.2f} Hz, as the steps between stamps promise'
            )


def jitter(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """Samples are evenly spaced, and stamps finer than their spacing."""
    for name, stream in _fast_streams(evidence):
        faults = []
        if stream.stamping is not None:
            yield CheckFinding(
                'jitter',
                WARNING if stream.stamping.word == IRREGULAR else NOTE,
                f"{name}: {stream.stamping}; stamps by the sensor's own clock would be better",
            )
        if (
            stream.stamp_step_ns
            and stream.stamp_step_ns % WHOLE_MS == 0
            and stream.stamp_step_ns < 0.5e9 * stream.period
        ):
            faults.append(f'all stamps are multiples of {stream.stamp_step_ns // WHOLE_MS} ms')
        if stream.irregular > MAX_IRREGULAR_SHARE:
            faults.append(
                f'{100 * stream.irregular:.0f} % of the steps are off the usual'
                f' {stream.period * 1e3:.4g} ms by more than a tenth'
            )
        if faults:
            yield CheckFinding(
                'jitter',
                NOTE,
                f"{name}: {', '.join(faults)}; stamps by the sensor's own clock would be better",
            )


def clocks(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """IMU and joints are stamped by one clock."""
    if not {'imu', 'joints'} <= evidence.streams.keys():
        return
    imu = evidence.streams['imu']
    joints = evidence.streams['joints']
    if any('clock reset' in stream.dropped for stream in (imu, joints)):
        return
    # All in s.
    overlap = (min(imu.last_ns, joints.last_ns) - max(imu.first_ns, joints.first_ns)) * 1e-9
    shorter = min(imu.duration, joints.duration)
    late = (joints.first_ns - imu.first_ns) * 1e-9
    if overlap <= 0 and shorter > 0:
        yield CheckFinding(
            'clocks',
            REFUSE,
            f'Imu and JointState must be stamped by one clock, the joints begin {abs(late):.6g} s'
            f' {"after" if late > 0 else "before"} the Imu and they never overlap; synchronise the'
            ' clocks or stamp both on one computer',
        )
    elif overlap < 0.9 * shorter:
        yield CheckFinding(
            'clocks',
            WARNING,
            f'Imu and JointState overlap for {overlap:.1f} s of {shorter:.1f} s only, the joints'
            f' begin {abs(late):.1f} s {"after" if late > 0 else "before"} the Imu: only the'
            ' overlap is used; are both stamped by one clock?',
        )


CHECKS = (
    one_source,
    both_sensors,
    value_checks.increments,
    value_checks.force_unit,
    stamps,
    clocks,
    frozen,
    frozen_for_a_time,
    value_checks.rate_unit,
    value_checks.full_scale,
    value_checks.handedness,
    value_checks.bias,
    value_checks.gravity,
    value_checks.clipping,
    value_checks.dead_band,
    value_checks.repeated_readings,
    value_checks.resolution,
    value_checks.temperature,
    sampling,
    gaps,
    jitter,
)
"""In the order in which they refuse: a wrong unit causes failures of later checks as well."""


class Preflight(EvidenceGatherer):
    """
    Watches a recording while it is read (a `Watcher`).

    Parameters
    ----------
    gravity : float, optional
        Local gravity, m/s^2; default standard gravity.
    strict : bool
        Whether `finish` raises when a finding implies a wrong result.
    one_sensor : bool
        Whether one sensor that cannot be used is a warning: the other one is processed.

    """

    def __init__(
        self, gravity: float | None = None, *, strict: bool = True, one_sensor: bool = False
    ):
        super().__init__(STANDARD_GRAVITY if gravity is None else gravity)
        self._strict = strict
        self._one_sensor = one_sensor
        self.unusable: dict[str, str] = {}
        """Sensor that cannot be used, one at most -> why; for `one_sensor`."""
        # Complete after `finish`.
        self.findings: tuple[CheckFinding, ...] = ()
        """Findings of all checks."""
        self.streams: dict[str, StreamStatistics] = {}
        """Name -> StreamStatistics."""
        self.lost: dict[str, int] = {}
        """Reason -> number of unreadable messages."""
        self.without_readings = NO_RANGES
        """Ranges of cleaned samples that are no readings, shape (n, 2)."""
        self.resolution = np.zeros(6)
        """Smallest step between readings of each column."""

    def finish(self, cleaner: BlockCleaner) -> None:
        """
        Check the streams that the BlockCleaner cleaned.

        Raises
        ------
        InputError
            When a finding implies a wrong result, unless `strict` is off.

        """
        self.streams, self.lost = cleaner.statistics(), cleaner.lost
        evidence = self.evidence(self.streams, cleaner.readings)
        if 'imu' in evidence.streams:
            self.findings = tuple(chain.from_iterable(check(evidence) for check in CHECKS))
            self.without_readings = without_readings(evidence)
            self.resolution = evidence.resolution
        if self._one_sensor:
            self.unusable = unusable_sensor(self.findings, evidence.absent)
            findings = []
            for finding in self.findings:
                if finding.sensor in self.unusable:
                    finding = replace(finding, severity=WARNING)
                findings.append(finding)
            self.findings = tuple(findings)
        if self._strict:
            refuse(self.findings)


def unusable_sensor(findings: Sequence[CheckFinding], absent: Sequence[str] = ()) -> dict[str, str]:
    """
    Return the sensor that cannot be used -> why, where the other one can be used.

    Empty where both can be used, or none; `absent` are sensors without readings.
    """
    reason_of: dict[str, str] = {}
    for finding in findings:
        if finding.severity == REFUSE and finding.sensor:
            reason_of.setdefault(finding.sensor, finding.text)
    return reason_of if len({*reason_of, *absent}) == 1 else {}


def refuse(findings: tuple[CheckFinding, ...]) -> None:
    """Raise the first finding that makes the result wrong as an InputError."""
    for finding in findings:
        if finding.severity == REFUSE:
            raise InputError(finding.text, key=finding.key, code=finding.check, value=finding.value)


def warnings(findings: Sequence[CheckFinding]) -> list[CheckFinding]:
    """Return the findings that degrade a result."""
    return [finding for finding in findings if finding.severity in (REFUSE, WARNING)]


DESCRIPTIVE = frozenset({'jitter', 'resolution'})
"""
Checks of which a note only describes the recording. All other notes state which readings are used,
and how, or what a result contains.
"""


def visible_findings(findings: Sequence[CheckFinding]) -> list[CheckFinding]:
    """Return the findings that a user must see with a result of the recording."""
    visible = warnings(findings)
    for finding in findings:
        if finding.severity == NOTE and finding.check not in DESCRIPTIVE:
            visible.append(finding)
    return visible


def unusable(findings: Sequence[CheckFinding]) -> int:
    """Return the number of samples that findings make unusable, not counted elsewhere."""
    return sum(finding.samples for finding in findings)
