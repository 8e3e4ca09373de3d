"""
Decision and truth.

Sensors that are calibrated on one session and judged on a second session of the same unit.
"""

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import beta

ROOT = Path(__file__).resolve().parents[1]
if __name__ == '__main__':
    sys.path[:0] = [str(ROOT), str(ROOT / 'test')]

from imu_calibration.api.calibrate import (
    calibrate_recordings,  # noqa: E402
    check_recording,  # noqa: E402
)
from imu_calibration.core.errors import ImuCalibrationError  # noqa: E402
from imu_calibration.core.samples import SampleBlock  # noqa: E402
from imu_calibration.core.units import DEG, MILLI_G  # noqa: E402
from imu_calibration.kinematics.table import Table  # noqa: E402
from validation.recordings import BY_HAND, data_folder, gravity_of, label, load  # noqa: E402
from validation.section import Section  # noqa: E402

SEEDS = range(36901, 36901 + 5)
"""Of the simulated sessions, five of each kind; drawn after the code was frozen."""
CLEARLY = 0.8
"""A ratio after / before below this is an improvement by more than 20 %."""
DECISIONS = ('helps', 'unproven', 'harms', 'refused')
SESSIONS = {'real': 'recordings of hardware', 'simulated': 'simulated sessions'}
"""Key of the command line -> title."""
GRAVITY = 9.81
"""Of the simulated sessions by hand, m/s^2."""


@dataclass(frozen=True)
class Outcome:
    """One sensor: what was decided, and what a second session shows."""

    case: str
    """Name of the pair."""
    sensor: str
    """'accelerometer' or 'gyroscope'."""
    decision: str
    """One of DECISIONS."""
    ratio: float
    """Error after / before on the second session; NaN where nothing was calibrated."""


def judged(case, first, second, table=None, **choices) -> Iterator[Outcome]:
    """
    Yield the Outcome of each sensor: calibrated on the first session, with the error on the second.
    """
    try:
        found = calibrate_recordings(first, table, **choices)
        proof = check_recording(second, found.calibration, table, **choices).proof
    except ImuCalibrationError:
        yield from (
            Outcome(case, sensor, 'refused', float('nan'))
            for sensor in ('accelerometer', 'gyroscope')
        )
        return
    for sensor, entry in proof.items():
        yield Outcome(
            case, sensor, str(found.calibration.decisions[sensor]), entry.after / entry.before
        )


def real(folder) -> Iterator[Outcome]:
    """
    Yield the outcomes of the recordings.

    Two parts of one trial, and halves, each calibrated on the one and judged on the other.
    """
    from validation.cross import ONE_UNIT, RECORDINGS, halves
    from validation.shaft import recording

    for first, second in ONE_UNIT:
        for made, used in ((first, second), (second, first)):
            yield from judged(
                f'{made}, {used}',
                recording(folder, made)[1],
                recording(folder, used)[1],
                recording(folder, used)[0],
            )
    for name in RECORDINGS:
        table, block = recording(folder, name)
        parts = halves(block)
        for made in (0, 1):
            yield from judged(f'{name}, half {made + 1}', parts[made], parts[1 - made], table)
    for name, topic in BY_HAND:
        imu = load(folder, name, topic)
        middle = len(imu) // 2
        parts = [SampleBlock(imu.select(part)) for part in (slice(0, middle), slice(middle, None))]
        for made in (0, 1):
            yield from judged(
                f'{label(name, topic)}, half {made + 1}',
                parts[made],
                parts[1 - made],
                gravity=gravity_of(folder, name),
            )


def _on_table(seed, *, cause=None, **options):
    from worlds.misfit_worlds import make_pair

    pair = make_pair(cause, seed, **options)
    return pair.first.block, pair.second.block, Table.from_mapping(pair.table)


def _other_profile(seed, profile):
    from worlds.physics import make_session

    first, second = (
        make_session(2 * seed + k, noise='realistic', unit=seed, profile=name)
        for k, name in enumerate((profile, 'quick'))
    )
    return first.block, second.block, Table.from_mapping(first.table)


def _short(seed):
    first, second, table = _on_table(seed)
    start = first.imu.stamp_ns[0]
    cut = {
        name: part.select(part.stamp_ns < start + 25 * 10**9)
        for name, part in (('imu', first.imu), ('joints', first.joints))
    }
    return replace(first, **cut), second, table


def _drifting(seed):
    """Both biases settle during the first session; the second begins when the sensor is warm."""
    first, second, table = _on_table(seed)
    rng = np.random.default_rng([seed, 5])
    size, time = (
        rng.normal(size=(2, 3)) * [[10 * MILLI_G], [0.3 * DEG]],
        1e-9 * (first.imu.stamp_ns - first.imu.stamp_ns[0]),
    )
    course = -np.expm1(-time / rng.uniform(30.0, 90.0))[:, None]
    return (
        _moved(first, course * size[0], course * size[1]),
        _moved(second, size[0], size[1]),
        table,
    )


def _moved(block, force, rate):
    return replace(
        block,
        imu=replace(block.imu, force_s=block.imu.force_s + force, rate_s=block.imu.rate_s + rate),
    )


def _coarse(seed):
    """Both sensors have steps far above their noise."""
    first, second, table = _on_table(seed)
    return (
        *(
            replace(
                block,
                imu=replace(
                    block.imu,
                    force_s=0.08 * np.round(block.imu.force_s / 0.08),
                    rate_s=0.02 * np.round(block.imu.rate_s / 0.02),
                ),
            )
            for block in (first, second)
        ),
        table,
    )


def _by_hand(seed, *, poses, faces=False):
    from worlds.hand_sessions import FACES, simulate

    attitudes = (
        [Rotation.align_vectors([[0, 0, 1]], [face])[0] for face in FACES] if faces else None
    )
    imu, _, truth = simulate([seed, 1], n_poses=poses, attitudes=attitudes, pose_sd=0.005)
    return (
        SampleBlock(imu),
        SampleBlock(simulate([seed, 2], n_poses=30, truth=truth, pose_sd=0.005)[0]),
        None,
    )


KINDS: dict[str, Callable[..., Any]] = {
    'clean': _on_table,
    'flexible mount': partial(_on_table, cause='flexible_mount'),
    'late driver on a shaft': partial(
        _on_table, cause='driver_lag', table='shaft', profile='sweeps'
    ),
    'one shaft': partial(_on_table, table='shaft', profile='sweeps'),
    'two axes': partial(_on_table, table='two_axis'),
    'six faces on a table': partial(_other_profile, profile='six_faces'),
    'drift': _drifting,
    'coarse steps': _coarse,
    'short': _short,
    'by hand': partial(_by_hand, poses=20),
    'nine poses by hand': partial(_by_hand, poses=9),
    'six faces by hand': partial(_by_hand, poses=6, faces=True),
}


def simulated(seeds) -> Iterator[Outcome]:
    """Yield the outcomes of simulated sessions of every kind."""
    for name, make in KINDS.items():
        for seed in seeds:
            first, second, table = make(seed)
            yield from judged(
                f'{name}, seed {seed}',
                first,
                second,
                table,
                **({} if table is not None else {'gravity': GRAVITY}),
            )


def interval(count, total):
    """Return the 95 % interval of a share (Clopper and Pearson), in percent, as text."""
    if not total:
        return '-'
    low = 0.0 if count == 0 else beta.ppf(0.025, count, total - count + 1)
    high = 1.0 if count == total else beta.ppf(0.975, count + 1, total - count)
    return f'{count} of {total} ({100 * low:.0f} to {100 * high:.0f} %)'


def table_of(outcomes):
    """Return the table: a row for each decision, a column for each truth."""
    rows = []
    for word in DECISIONS:
        ratios = np.array([each.ratio for each in outcomes if each.decision == word])
        rows.append(
            (
                word,
                f'{(ratios < CLEARLY).sum()}',
                f'{((ratios >= CLEARLY) & (ratios < 1)).sum()}',
                f'{(ratios >= 1).sum()}',
                interval(int((ratios < 1).sum()), len(ratios)),
            )
        )
    return (
        'decision',
        'improves by more than 20 %',
        'by less',
        'worse',
        'improve, 95 % interval',
    ), rows


def add_claims(section, what, outcomes):
    """Add the table and the three targets."""
    section.say(f'**{what}**: {len(outcomes)} sensors.')
    section.table(*table_of(outcomes))
    helped = [each for each in outcomes if each.decision == 'helps']
    better = [each for each in outcomes if each.ratio < CLEARLY]
    for claim, target, count, total, holds in (
        (
            f'{what}: of `helps` improve the second session',
            'at least 97 %',
            sum(each.ratio < 1 for each in helped),
            len(helped),
            lambda s: s >= 0.97,
        ),
        (
            f'{what}: of sensors that improve by more than 20 % are called `harms`',
            'at most 5 %',
            sum(each.decision == 'harms' for each in better),
            len(better),
            lambda s: s <= 0.05,
        ),
        (
            f'{what}: of sensors that improve by more than 20 % are called `unproven`',
            'at most 25 %',
            sum(each.decision == 'unproven' for each in better),
            len(better),
            lambda s: s <= 0.25,
        ),
    ):
        section.claim(claim, target, interval(count, total), holds(count / max(total, 1)), True)
    exceptions = [
        each
        for each in outcomes
        if (each.decision == 'helps') != (each.ratio < 1) and not np.isnan(each.ratio)
    ]
    if exceptions:
        section.table(
            ('exception', 'sensor', 'decision', 'error after / before'),
            [(each.case, each.sensor, each.decision, f'{each.ratio:.2f}') for each in exceptions],
        )


def run(folder, plots):
    """Return the section."""
    section = Section('Decision and truth')
    section.say(
        'Each sensor is calibrated on one session and judged on a second session, or the other'
        ' half, of the same unit. Both halves of a recording and both sensors of an IMU are'
        ' counted, which are not independent.'
    )
    add_claims(section, SESSIONS['real'], list(real(folder)))
    add_claims(section, SESSIONS['simulated'], list(simulated(SEEDS)))
    return section


def main():
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, nargs='*', default=list(SEEDS))
    parser.add_argument('--only', choices=SESSIONS)
    options, section = parser.parse_args(), Section('Decision and truth')
    for name, outcomes in (
        ('real', lambda: real(data_folder())),
        ('simulated', lambda: simulated(options.seeds)),
    ):
        if options.only in (None, name):
            found = []
            for each in outcomes():
                print(f'{each.case}: {each.sensor} {each.decision} {each.ratio:.3f}', flush=True)
                found.append(each)
            add_claims(section, SESSIONS[name], found)
    print(section.markdown())


if __name__ == '__main__':
    main()
