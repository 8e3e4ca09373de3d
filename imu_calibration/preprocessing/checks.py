"""
Checks of a recording before the estimate: their registry, and the checks of frozen outputs and of stamps.

`CHECKS` is the registry: a check is a function of the `Evidence` that yields `Finding` objects; adding one is adding an entry.
"""


from collections.abc import Iterator, Sequence

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.preprocessing import value_checks
from imu_calibration.preprocessing.recording_evidence import GOOD, NOTE, REFUSE, WARNING, CheckFinding, EvidenceGatherer, RecordingEvidence
from imu_calibration.preprocessing.scan import SENSOR_COLUMNS, long_runs
from imu_calibration.preprocessing.stamping import IRREGULAR, MAX_IRREGULAR_SHARE
from imu_calibration.preprocessing.stream_cleaning import MESSAGES, BlockCleaner, CleanedBlock, StreamStatistics

MIN_MOVING_STEPS = 50.0
"""A constant axis is frozen if another axis moves by this many steps of the converter."""


def frozen(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """No output is constant while other axes move."""
    chunks, range_ = evidence.chunks, evidence.chunks.range
    if not len(chunks):
        return
    for sensor, part in SENSOR_COLUMNS.items():
        noisy = evidence.quiet_range[part] > 0
        constant = evidence.n_changed[part] == 0
        if constant.all():
            yield CheckFinding('frozen', REFUSE,
                               f'the {sensor} must measure something, its outputs never change in {evidence.n_samples} samples; '
                          'check the sensor and its driver')
            continue
        for axis in np.flatnonzero(constant):
            if noisy.any():
                yield CheckFinding('frozen', REFUSE,
                                   f'every axis must measure something, {sensor} {"xyz"[axis]} never changes while the remaining axes do; '
                              'check the sensor and its driver')
        for axis in np.flatnonzero(~constant):
            moving = np.delete(range_[:, part], axis, axis=1) > MIN_MOVING_STEPS * np.delete(evidence.resolution[part], axis)
            same = (range_[:, part][:, axis] == 0) & ~_at_end(chunks.mean[:, part][:, axis], evidence.ends[part][axis])
            stuck = _in_long_runs(same & moving.any(axis=1)) if noisy[axis] else np.zeros(1, bool)
            if stuck.any():
                seconds = stuck.sum() * float(np.median(chunks.duration))
                yield CheckFinding('frozen', WARNING,
                                   f'{sensor} {"xyz"[axis]} is constant for {seconds:.1f} s while different axes move; '
                                   'check its connection, and exclude that time', samples=int(stuck.sum() * chunks.size))


def _at_end(values, ends):
    """Return which values are clipping limits of an output: clipped, not frozen."""
    return np.logical_or.reduce([np.isclose(values, sign * end.level, rtol=1e-9) & (end.n_clipped > 0) for sign, end in zip((1, -1), ends)])


def _in_long_runs(flags):
    kept = np.zeros(len(flags), bool)
    for start, end in long_runs(flags):
        kept[start:end] = True
    return kept


def frozen_for_a_time(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """Every sensor and every joint measures until the end."""
    parts = evidence.frozen_parts
    spans = {}
    for part in parts:
        spans.setdefault((part.start, part.stop) if part.who != 'joints' else 'joints', []).append(part)
    for together in spans.values():
        if together[0].who == 'joints':
            text = ('joint states must follow the table, they are constant while the IMU turns, '
                    f'{_spans(together)}; check the driver of the table, or exclude the time in which the IMU was carried')
        else:
            who = 'IMU' if len(together) > 1 else together[0].who
            text = (f'the {who} must measure all the time, it repeats one reading {_spans(together[:1])}, which its noise does not allow; '
                    'check the sensor and its driver, and exclude that time')
        samples = together[0].samples if together[0].who != 'joints' else sum(part.samples for part in together)
        yield CheckFinding('frozen', WARNING, text, samples=samples)


def _spans(parts):
    words = [f'from {part.start:.1f} s to {part.stop:.1f} s' for part in parts[:3]]
    return ', '.join(words) + (f' and {len(parts) - 3} times more' if len(parts) > 3 else '')


FAST_STREAMS = ('imu', 'joints')
WHOLE_MS = 1_000_000
ADVICE = {
    'not finite': 'the driver sends them; they are left out',
    'repeated stamp': 'stamp each sample when it is measured; the second of equal stamps is left out',
    'backward stamp': 'samples that arrive late are left out; publish in order',
    'stray stamp': 'a single outlying stamp is excluded',
    'spike': 'readings that differ from their neighbours beyond any motion are excluded; if they are many, check the bus and the driver',
    'clock reset': 'the clock was set while recording; the parts are processed separately',
}
SPIKE_SHARE = 5e-3
"""Occasional knocks resemble spikes, and 1 % of spikes do not degrade a calibration; a larger share has a cause."""
GAP_SHARE = 0.01
RATE_SHARE = 0.02


def stamps(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """Every sample has a stamp of its own, later than the one before, and finite readings."""
    clean = []
    for name, stream in evidence.streams.items():
        found = stream.statistics
        # Spikes are samples with accepted stamps, and a clock reset drops no sample.
        total = found.count + sum(count for reason, count in found.dropped.items() if reason not in ('clock reset', 'spike'))
        if found.count < 0.1 * total:
            reasons = ', '.join(f'{count} {reason}' for reason, count in found.dropped.items())
            yield CheckFinding('stamps', REFUSE,
                               f'{MESSAGES[name]} must hold finite samples whose header stamps advance, of {total} only {found.count} do '
                          f'({reasons}); correct the driver and record again')
            continue
        if found.unstamped:
            yield CheckFinding('stamps', WARNING,
                               f'{MESSAGES[name]}: {found.unstamped} of {total} stamps are zero: the time of arrival '
                               'is used; the driver should stamp each sample at its measurement')
        for reason, count in found.dropped.items():
            severity = NOTE if reason == 'spike' and count < SPIKE_SHARE * total else WARNING
            yield CheckFinding('stamps', severity, f'{MESSAGES[name]}: {count} of {total} samples {_phrase(reason)}: {ADVICE[reason]}'
                          if reason != 'clock reset' else f'{MESSAGES[name]}: the stamps jump {_times(count)}: {ADVICE[reason]}')
        clean += [] if found.dropped else [MESSAGES[name]]
    if clean:
        yield CheckFinding('stamps', GOOD, f'{" and ".join(clean)}: all stamps advance')


def _phrase(reason):
    return {'not finite': 'are not finite', 'repeated stamp': 'repeat the stamp before', 'backward stamp': 'step back in time',
            'stray stamp': 'have a stray stamp', 'spike': 'are spikes'}[reason]


def _times(count):
    return 'once' if count == 1 else f'{count} times'


def gaps(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """The streams have no gaps."""
    for name in FAST_STREAMS:
        if name in evidence.streams:
            found = evidence.streams[name].statistics
            if found.n_gaps:
                severity = WARNING if found.gap_total > GAP_SHARE * found.duration else NOTE
                yield CheckFinding('gaps', severity,
                                   f'{MESSAGES[name]}: {found.n_gaps} gap{"s" if found.n_gaps > 1 else ""}, '
                                   f'{found.gap_total:.2f} s of {found.duration:.0f} s, '
                              f'the longest {found.longest_step:.2f} s; motion within a gap is not used')


def sampling(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """The samples per second agree with the step between stamps."""
    for name in FAST_STREAMS:
        if name in evidence.streams:
            stream = evidence.streams[name]
            nominal, real = stream.statistics.rate, stream.real_rate
            if nominal and abs(real / nominal - 1) > RATE_SHARE:
                yield CheckFinding('sampling', WARNING,
                                   f'{MESSAGES[name]}: the usual step between stamps is that of {nominal:.2f} Hz, the rate is {real:.2f} Hz'
                              'samples were lost, or stamps are made when messages arrive; '
                              'check the driver and the load of the recorder')
            elif nominal:
                yield CheckFinding('sampling', GOOD, f'{MESSAGES[name]}: {real:.2f} Hz, as the steps between stamps promise')


def jitter(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """Samples are evenly spaced, and stamps finer than their spacing."""
    for name in FAST_STREAMS:
        if name in evidence.streams:
            stream = evidence.streams[name]
            if (line := stream.statistics.stamping) is not None:
                yield CheckFinding('jitter', WARNING if line.word == IRREGULAR else NOTE,
                                   f"{MESSAGES[name]}: {line}; stamps by the sensor's own clock "
                                   'would be better')
            period, step_ns = stream.statistics.period, stream.statistics.stamp_step_ns
            whole_ms = bool(step_ns) and step_ns % WHOLE_MS == 0 and step_ns < 0.5e9 * period
            if not whole_ms and stream.irregular <= MAX_IRREGULAR_SHARE:
                continue
            came = f'all stamps are multiples of {step_ns // WHOLE_MS} ms' if whole_ms else ''
            if stream.irregular > MAX_IRREGULAR_SHARE:
                off = f'{100 * stream.irregular:.0f} % of the steps are off the usual {period * 1e3:.4g} ms by more than a tenth'
                came = f'{came}, {off}' if came else off
            yield CheckFinding('jitter', NOTE, f"{MESSAGES[name]}: {came}; stamps by the sensor's own clock would be better")


def clocks(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """IMU and joints are stamped by one clock."""
    if not {'imu', 'joints'} <= evidence.streams.keys():
        return
    imu, joints = evidence.streams['imu'], evidence.streams['joints']
    if any('clock reset' in stream.statistics.dropped for stream in (imu, joints)):
        return
    overlap = (min(imu.last_ns, joints.last_ns) - max(imu.first_ns, joints.first_ns)) * 1e-9
    shorter = min(imu.statistics.duration, joints.statistics.duration)
    late = (joints.first_ns - imu.first_ns) * 1e-9
    if overlap <= 0 and shorter > 0:
        yield CheckFinding('clocks', REFUSE, f'Imu and JointState must be stamped by one clock, the joints begin {abs(late):.6g} s '
                      f'{"after" if late > 0 else "before"} the Imu and they never overlap; '
                      'synchronise the clocks or stamp both on one computer')
    elif overlap < 0.9 * shorter:
        yield CheckFinding('clocks', WARNING,
                           f'Imu and JointState overlap for {overlap:.1f} s of {shorter:.1f} s only, the joints begin {abs(late):.1f} s '
                      f'{"after" if late > 0 else "before"} the Imu: only the overlap is used; are both stamped by one clock?')


CHECKS = (
    value_checks.force_unit, stamps, clocks, frozen, frozen_for_a_time,
    value_checks.rate_unit, value_checks.full_scale, value_checks.handedness, value_checks.bias, value_checks.gravity,
    value_checks.clipping,
    value_checks.repeated_readings, value_checks.resolution, value_checks.temperature,
    sampling, gaps, jitter,
)
"""In the order in which they refuse: a wrong unit causes failures of later checks as well."""


class Preflight:
    """
    Watches a recording while it is read (a `Watcher`).

    Parameters
    ----------
    gravity : float, optional
        Local gravity, m/s^2; default standard gravity.
    strict : bool
        Whether `finish` raises when a finding implies a wrong result.

    """

    def __init__(self, gravity: float | None = None, *, strict: bool = True):
        self._gatherer, self._strict = EvidenceGatherer(STANDARD_GRAVITY if gravity is None else gravity), strict
        self.findings: tuple[CheckFinding, ...] = ()
        self.streams: dict[str, StreamStatistics] = {}
        self.lost: dict[str, int] = {}
        """PoseScan; name -> StreamStatistics; reason -> number of unreadable messages: complete after `finish`."""

    def push(self, cleaned: CleanedBlock) -> None:
        """Process a CleanedBlock."""
        self._gatherer.push(cleaned)

    def finish(self, cleaner: BlockCleaner) -> None:
        """
        Check the streams that the BlockCleaner cleaned.

        Raises
        ------
        InputError
            When a finding implies a wrong result, unless `strict` is off.

        """
        self.streams, self.lost = cleaner.statistics(), cleaner.lost
        evidence = self._gatherer.evidence(self.streams)
        self.findings = tuple(finding for check in CHECKS for finding in check(evidence)) if 'imu' in evidence.streams else ()
        if self._strict:
            refuse(self.findings)


def refuse(findings: tuple[CheckFinding, ...]) -> None:
    """Raise the first finding that makes the result wrong as an InputError."""
    for finding in findings:
        if finding.severity == REFUSE:
            raise InputError(finding.text, key=finding.key, code=finding.check)


def warnings(findings: Sequence[CheckFinding]) -> list[CheckFinding]:
    """Return the findings that a user must see."""
    return [finding for finding in findings if finding.severity in (REFUSE, WARNING)]


def unusable(findings: Sequence[CheckFinding]) -> int:
    """Return how many samples are unusable for reasons that no other count holds."""
    return sum(finding.samples for finding in findings)
