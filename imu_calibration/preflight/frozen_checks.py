"""Checks of frozen outputs: an axis, a sensor, or the joints, for a time or throughout."""

from collections.abc import Iterator

import numpy as np

from imu_calibration.preflight.evidence import RecordingEvidence
from imu_calibration.preflight.finding import REFUSE, WARNING, CheckFinding
from imu_calibration.preflight.frozen_parts import SENSOR_COLUMNS, long_runs

MOVING = 50.0
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
            moving = np.delete(range_[:, part], axis, axis=1) > MOVING * np.delete(evidence.resolution[part], axis)
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
