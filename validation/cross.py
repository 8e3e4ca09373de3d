"""
Tests of one recording of hardware against another.

Halves, two parts of one trial, and recordings that are refused.
"""

from dataclasses import replace
from functools import cache

import numpy as np

from imu_calibration.api.calibrate import calibrate_recordings, check_recording
from imu_calibration.core.errors import ImuCalibrationError
from imu_calibration.core.samples import SampleBlock
from imu_calibration.document.decision import HELPS
from imu_calibration.effects.reference_effects import FAMILY, total_lags
from imu_calibration.kinematics.table import Table
from validation.section import Section, text
from validation.shaft import recording

RECORDINGS = (
    'shaft_pitch_slow',
    'shaft_yaw_medium',
    'shaft_yaw_slow_later',
    'shaft_roll_fast',
    'shaft_roll_fast_later',
)
ONE_UNIT = (('shaft_roll_fast', 'shaft_roll_fast_later'),)
"""Two parts of one trial: one unit, one mounting, one motion."""
WORSE = 1.05
"""No kind of motion may get worse by more."""


def halves(block):
    """Return the two halves of a recording."""
    start, end = block.imu.stamp_ns[[0, -1]]
    middle = start + (end - start) // 2
    return [
        SampleBlock(
            block.imu.select(side(block.imu.stamp_ns, middle)),
            block.joints.select(side(block.joints.stamp_ns, middle)),
        )
        for side in (np.less, np.greater_equal)
    ]


@cache
def _calibrated(folder, name, part):
    table, block = recording(folder, name)
    return calibrate_recordings(block if part is None else halves(block)[part], table)


def transfer(folder, made, used, parts=(None, None)):
    """
    Return (Calibrated or the refusal, CheckResult or None).

    Calibrated on one recording or half, checked on another.
    """
    table, block = recording(folder, used)
    try:
        found = _calibrated(folder, made, parts[0])
    except ImuCalibrationError as error:
        return error, None
    return found, check_recording(
        block if parts[1] is None else halves(block)[parts[1]], found.calibration, table
    )


def outcome(found, checked):
    """
    Return (outcome as text, whether it is correct).

    Each sensor helps without harm in a motion, or the recording is refused.
    """
    if checked is None:
        return f'refused: {found}', True
    words, claimed = [], []
    for sensor, entry in checked.proof.items():
        ratio, worst = (
            entry.after / entry.before,
            max(part.after / part.before for part in entry.regimes.values()),
        )
        words.append(
            f'{sensor} {found.verdict.decisions[sensor]}: {ratio:.2f}, at most {worst:.2f} in any'
            ' motion'
        )
        claimed.append(
            found.verdict.decisions[sensor] is not HELPS or ratio < 1.0 and worst <= WORSE
        )
    return '; '.join(words), bool(words) and all(claimed)


def spread(first, second):
    """
    Return the differences over combined standard deviations of the common parameters, by group.

    Delays and filters of a sensor are one group, because they are alternative descriptions of one
    cause; their sum is a separate group.
    """
    groups = {}
    theirs = dict(zip(second.param_names, zip(second.values, second.sd, second.status)))
    for name, value, sd, status in zip(first.param_names, first.values, first.sd, first.status):
        other = theirs.get(name)
        if other and 'held' not in (status, other[2]) and not name.startswith('reference'):
            group = name.rpartition('.')[0]
            of_lags = group.rpartition('.')[2] in FAMILY
            groups.setdefault(f'{group.partition(".")[0]}.lags' if of_lags else group, []).append(
                (value - other[0]) / np.hypot(sd, other[1])
            )
    lags = [total_lags(each.param_names, each.values, each.covariance) for each in (first, second)]
    for sensor in set(lags[0]) & set(lags[1]):
        (value, sd), (other, others) = (each[sensor] for each in lags)
        groups[f'lag of the {sensor} in all'] = [(value - other) / np.hypot(sd, others)]
    return groups


def rms(groups):
    """Return the rms of each group of numbers."""
    return {group: float(np.sqrt(np.mean(np.square(values)))) for group, values in groups.items()}


def halves_together(folder):
    """Return the rms by group over the halves of all recordings."""
    together = {}
    for name in RECORDINGS:
        pair = [transfer(folder, name, name, (part, part))[0] for part in (0, 1)]
        if not any(isinstance(found, Exception) for found in pair):
            for group, values in spread(*(found.calibration for found in pair)).items():
                together.setdefault(group, []).extend(values)
    return rms(together)


def must_be_refused(folder):
    """Yield (fault, outcome as text, whether it was detected)."""
    table, block = recording(folder, 'shaft_yaw_medium')
    yield (
        'the IMU on the bench beside the shaft (wrong topic)',
        *_attempt(folder / 'shaft_yaw_medium', table, imu_topic='/imu_fixed/data_raw'),
    )
    yield (
        'stamps of the IMU one second late',
        *_attempt(
            replace(block, imu=replace(block.imu, stamp_ns=block.imu.stamp_ns + 10**9)), table
        ),
    )
    yield (
        'stamps of the IMU 2.14 s late, a period of its sweeps',
        *_attempt(
            replace(block, imu=replace(block.imu, stamp_ns=block.imu.stamp_ns + 2_140_000_000)),
            table,
        ),
    )
    turned = replace(block.joints, position=-block.joints.position, velocity=-block.joints.velocity)
    yield 'the encoder counts the other way round', *_attempt(replace(block, joints=turned), table)
    rate = block.imu.rate_s.copy()
    rate[len(rate) // 3 : 2 * len(rate) // 3] = rate[len(rate) // 3]
    yield (
        'the gyroscope is frozen for a third of the time',
        *_attempt(replace(block, imu=replace(block.imu, rate_s=rate)), table),
    )


def _attempt(source, table: Table, **choices):
    try:
        found = calibrate_recordings(source, table, **choices)
    except ImuCalibrationError as error:
        return f'refused: {error}', True
    warned = [
        item['text']
        for item in found.calibration.statistics['preflight']
        if item['check'] == 'frozen'
    ]
    return (
        found.verdict.text + ''.join(f'; {text}' for text in warned[:1]),
        bool(warned) or HELPS not in found.verdict.decisions.values(),
    )


def run(folder, plots):
    """Return the section."""
    section = Section('Recordings of hardware predict one another')
    for first, second in ONE_UNIT:
        for made, used in ((first, second), (second, first)):
            found, holds = outcome(*transfer(folder, made, used))
            section.claim(
                f'calibrated on {made}, compensated on {used}: error after / before',
                'below 1, in no motion above 1.05, or refused with a sentence',
                found,
                holds,
                headline=True,
            )
        pair = [transfer(folder, name, name)[0] for name in (first, second)]
        if not any(isinstance(found, Exception) for found in pair):
            groups = rms(spread(*(found.calibration for found in pair)))
            section.claim(
                f'{first} and {second}: differences over combined sds, rms by group',
                'at most 1.5 in every group',
                ', '.join(f'{group} {value:.1f}' for group, value in groups.items()),
                max(groups.values()) <= 1.5,
                headline=True,
            )
    for name in RECORDINGS:
        for made, used in ((0, 1), (1, 0)):
            found, holds = outcome(*transfer(folder, name, name, (made, used)))
            section.claim(
                f'{name}: half {made + 1} calibrates, half {used + 1} is compensated: error after /'
                ' before',
                'below 1, in no motion above 1.05, or refused',
                found,
                holds,
                headline=made == 0,
            )
    groups = halves_together(folder)
    section.claim(
        'halves of the five recordings, 240 s each: differences over combined sds, rms by group',
        'at most 1.5 in every group',
        ', '.join(f'{group} {value:.2f}' for group, value in groups.items()),
        max(groups.values()) <= 1.5,
        headline=True,
    )
    for what, found, noticed in must_be_refused(folder):
        section.claim(
            f'shaft_yaw_medium, {what}', 'refused, or said', found, noticed, headline=True
        )
    section.say(text('cross'))
    return section
