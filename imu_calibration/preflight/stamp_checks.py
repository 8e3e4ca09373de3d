"""Checks of the stamps: dropped samples, gaps, rates, clocks."""

from collections.abc import Iterator

from imu_calibration.preflight.evidence import RecordingEvidence
from imu_calibration.preflight.finding import GOOD, NOTE, REFUSE, WARNING, CheckFinding
from imu_calibration.segmentation.block_cleaning import MESSAGES as NAMES
from imu_calibration.segmentation.stamping import IRREGULAR

FAST = ('imu', 'joints')
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
IRREGULAR_SHARE = 0.05


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
                               f'{NAMES[name]} must hold finite samples whose header stamps advance, of {total} only {found.count} do '
                          f'({reasons}); correct the driver and record again')
            continue
        if found.unstamped:
            yield CheckFinding('stamps', WARNING,
                               f'{NAMES[name]}: {found.unstamped} of {total} stamps are zero: the time of arrival '
                               'is used; the driver should stamp each sample at its measurement')
        for reason, count in found.dropped.items():
            severity = NOTE if reason == 'spike' and count < SPIKE_SHARE * total else WARNING
            yield CheckFinding('stamps', severity, f'{NAMES[name]}: {count} of {total} samples {_phrase(reason)}: {ADVICE[reason]}'
                          if reason != 'clock reset' else f'{NAMES[name]}: the stamps jump {_times(count)}: {ADVICE[reason]}')
        clean += [] if found.dropped else [NAMES[name]]
    if clean:
        yield CheckFinding('stamps', GOOD, f'{" and ".join(clean)}: all stamps advance')


def _phrase(reason):
    return {'not finite': 'are not finite', 'repeated stamp': 'repeat the stamp before', 'backward stamp': 'step back in time',
            'stray stamp': 'have a stray stamp', 'spike': 'are spikes'}[reason]


def _times(count):
    return 'once' if count == 1 else f'{count} times'


def gaps(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """The streams have no gaps."""
    for name in FAST:
        if name in evidence.streams:
            found = evidence.streams[name].statistics
            if found.n_gaps:
                severity = WARNING if found.gap_total > GAP_SHARE * found.duration else NOTE
                yield CheckFinding('gaps', severity,
                                   f'{NAMES[name]}: {found.n_gaps} gap{"s" if found.n_gaps > 1 else ""}, '
                                   f'{found.gap_total:.2f} s of {found.duration:.0f} s, '
                              f'the longest {found.longest_step:.2f} s; motion within a gap is not used')


def sampling(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """The samples per second agree with the step between stamps."""
    for name in FAST:
        if name in evidence.streams:
            stream = evidence.streams[name]
            nominal, real = stream.statistics.rate, stream.real_rate
            if nominal and abs(real / nominal - 1) > RATE_SHARE:
                yield CheckFinding('sampling', WARNING,
                                   f'{NAMES[name]}: the usual step between stamps is that of {nominal:.2f} Hz, the rate is {real:.2f} Hz: '
                              'samples were lost, or stamps are made when messages arrive; '
                              'check the driver and the load of the recorder')
            elif nominal:
                yield CheckFinding('sampling', GOOD, f'{NAMES[name]}: {real:.2f} Hz, as the steps between stamps promise')


def jitter(evidence: RecordingEvidence) -> Iterator[CheckFinding]:
    """Samples are evenly spaced, and stamps finer than their spacing."""
    for name in FAST:
        if name in evidence.streams:
            stream = evidence.streams[name]
            if (line := stream.statistics.stamping) is not None:
                yield CheckFinding('jitter', WARNING if line.word == IRREGULAR else NOTE,
                                   f"{NAMES[name]}: {line}; stamps by the sensor's own clock "
                                   'would be better')
            period, step_ns = stream.statistics.period, stream.statistics.stamp_step_ns
            whole_ms = bool(step_ns) and step_ns % WHOLE_MS == 0 and step_ns < 0.5e9 * period
            if not whole_ms and stream.irregular <= IRREGULAR_SHARE:
                continue
            came = f'all stamps are multiples of {step_ns // WHOLE_MS} ms' if whole_ms else ''
            if stream.irregular > IRREGULAR_SHARE:
                off = f'{100 * stream.irregular:.0f} % of the steps are off the usual {period * 1e3:.4g} ms by more than a tenth'
                came = f'{came}, {off}' if came else off
            yield CheckFinding('jitter', NOTE, f"{NAMES[name]}: {came}; stamps by the sensor's own clock would be better")


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
