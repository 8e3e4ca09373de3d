"""
Check whether a motion planned to separate causes yields the correct name.

Run ``PYTHONPATH=test python -m validation.separating_worlds``.

A physical cause is hidden in a unit on a table, and a short recording is made with the usual
motions: the faces, one spin about each axis, a swing. If its diagnosis names a class of confounded
effects, the planner makes at most three minutes of motion for the same unit, and both recordings
are diagnosed together; if a class remains, the planner makes another motion in the remaining time.
The result is correct if the hidden effect is then named, without alternatives. Effects that the
plan reports as confounded in any motion of that table of three minutes, mainly lags of one sensor
within a tenth of a millisecond, are one cause: a class of these with the hidden effect is counted
separately.
"""

from __future__ import annotations

import time
from argparse import ArgumentParser
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, count, islice
from typing import Any

import numpy as np

from imu_calibration.api.diagnose import Diagnosed, diagnose
from imu_calibration.api.plan import LONGEST_SEPARATION, plan
from imu_calibration.core.errors import ImuCalibrationError
from imu_calibration.core.samples import SampleBlock, joined_stream
from imu_calibration.kinematics.table import Table
from imu_calibration.planning.planner import Plan
from imu_calibration.preprocessing.window_finder import MotionGatherer
from imu_calibration.simulation.motion_builder import MotionBuilder, Profile
from imu_calibration.simulation.motion_primitives import FACES, pose, pose_deg, swing
from tools.smallest import add_smallest

from worlds.hiding import Recording, Sizes
from worlds.physics import Session, make_session
from worlds.physics_draw import generator, to_ns

HIDDEN = (
    'accel_quadratic',
    'gyro_bandwidth',
    'accel_scale_asymmetry',
    'gyro_quadratic',
    'time_offset',
    'gyro_scale_asymmetry',
    'accel_bandwidth',
)
"""Effects that depend on motion and are often confounded with others in a short recording."""
FACTORS = (2.5, 4.0)
"""
Sizes, as multiples of the smallest detectable size in the first recording; a larger one is less
often in a class.
"""
PAUSE = 30.0
"""Seconds between one recording and the next."""
SEPARATIONS = 2
"""Motions planned in the three minutes, as in `planner_node` (its parameter `separations`)."""


@dataclass(frozen=True, eq=False)
class World:
    """One hidden cause, and the motion of the first recording."""

    seed: int
    effect: str
    factor: float
    noise: str = 'realistic'

    def round(self) -> Profile:
        """
        Return the first motion.

        The six faces, a spin in one sense and at one speed about each axis, a swing.
        """
        rng, builder = generator(self.seed, 'round'), MotionBuilder(3)
        builder.rest(5.0)
        tasks = [pose(up + rng.normal(0.0, 0.03, 3), rng.uniform(-180, 180), 2.6) for up in FACES]
        speed = rng.choice([-1.0, 1.0]) * rng.uniform(60, 180)
        tasks += [partial(_spin_one_way, up=up, speed=speed) for up in np.eye(3)]
        tasks += [swing(int(rng.integers(3)), 15.0, rng.uniform(0.5, 1.0), duration=4.0)]
        for place in rng.permutation(len(tasks)):
            tasks[place](builder)
        builder.move([0.0, 0.0, 0.0])
        builder.rest(4.0)
        return Profile('round', tuple(builder.segments), ('outer', 'middle', 'inner'))

    def hidden(self) -> dict:
        """Return the hidden effect: name -> value."""
        empty = make_session(self.seed, noise=self.noise, profile=self.round())
        table = Table.from_mapping(empty.table)
        gatherer = MotionGatherer(table)
        sizes = Sizes(Recording(table, [*gatherer.push(empty.block), *gatherer.finish()], {}))
        return {self.effect: sizes.hidden(self.effect, self.seed, self.factor)}

    def session(self, number: int, motion: Profile, hidden: dict) -> Session:
        """Return one of the recordings: of the same unit, with other noise."""
        return make_session(
            self.seed + 100_000 * number, hidden, self.noise, profile=motion, unit=self.seed
        )


def _spin_one_way(builder, up, speed):
    builder.move(pose_deg(up, np.nan))
    builder.spin([speed, 0.0, 0.0], 2.5)


def appended(first: SampleBlock, second: SampleBlock) -> SampleBlock:
    """Return two recordings as one, the second some time after the first."""
    assert first.imu, 'simulated sessions have all three'
    assert second.imu and second.joints and second.temperature, 'simulated sessions have all three'
    shift = first.imu.stamp_ns[-1] + to_ns(PAUSE) - second.imu.stamp_ns[0]
    later = SampleBlock(
        replace(second.imu, stamp_ns=second.imu.stamp_ns + shift),
        replace(second.joints, stamp_ns=second.joints.stamp_ns + shift),
        replace(second.temperature, stamp_ns=second.temperature.stamp_ns + shift),
    )
    streams = ('imu', 'joints', 'temperature')
    return SampleBlock(*(joined_stream([first, later], stream) for stream in streams))


def run(world: World, longest: float = LONGEST_SEPARATION) -> dict:
    """
    Return one row: the hidden effect, the class, the planned motion, the final findings.

    The planned motions take `longest` seconds at most.
    """
    start = time.process_time()
    hidden = world.hidden()
    first = world.session(0, world.round(), hidden)
    table = Table.from_mapping(first.table)
    row: dict[str, Any] = {'seed': world.seed, 'hidden': world.effect, 'factor': world.factor}
    diagnosis = diagnose(first.block, table)
    row['before'] = names(diagnosis)
    if not is_class(row['before']):
        return row

    # Plan a motion, append its recording and diagnose both, until one cause remains.
    block = first.block
    plans: list[Plan] = []
    while len(plans) < SEPARATIONS:
        try:
            planned = plan(
                table,
                calibration=diagnosis.calibration,
                diagnosis=diagnosis.document,
                longest=longest - sum(earlier.seconds for earlier in plans),
                with_bound=False,
            ).plan
        except ImuCalibrationError as error:
            if not plans:
                return row | {'refused': str(error), 'right': False}
            break
        plans.append(planned)
        if planned.motions:
            segments = tuple(chain.from_iterable(planned.segments))
            motion = Profile('separating', segments, first.truth['profile'].joint_names)
            block = appended(block, world.session(len(plans), motion, hidden).block)
            diagnosis = diagnose(block, table)
        findings = names(diagnosis)
        row |= judged(findings, world.effect, plans)
        if not planned.motions or row['right'] or row['one_cause'] or not is_class(findings):
            break
    return row | {'processor': time.process_time() - start}


def is_class(found: list) -> bool:
    """Return whether a finding has alternatives that fit as well."""
    return any(mates for _, mates in found)


def judged(findings: list, hidden: str, plans: Sequence[Plan]) -> dict:
    """
    Return the predictions of the plans, and whether the finding is correct.

    It is correct when it is only the hidden effect, or a class that the first plan reported as one
    cause.
    """
    # Effects that all three minutes of motion do not separate from the hidden one.
    missing = plans[0].missing
    alike = {hidden}
    for pair in missing:
        effects = pair.split(' and ')
        if hidden in effects:
            alike.update(effects)
    named: set[str] = set()
    for effect, mates in findings:
        named.update((effect, *mates))
    return {
        'after': findings,
        'seconds': sum(planned.seconds for planned in plans),
        'motions': sum(len(planned.motions) for planned in plans),
        'rounds': len(plans),
        'missing': missing,
        'right': findings == [(hidden, ())],
        'one_cause': len(findings) == 1 and hidden in named and named <= alike,
    }


def names(diagnosed: Diagnosed) -> list:
    """Return (effect, mates) of each finding."""
    return [
        (finding.effect, tuple(finding.indistinguishable_from)) for finding in diagnosed.findings
    ]


def worlds(first_seed: int, effects: Sequence[str] = HIDDEN) -> Iterator[World]:
    """Yield worlds without end: the effects by turns, in either size."""
    for number in count():
        yield World(
            first_seed + number,
            effects[number % len(effects)],
            FACTORS[number // len(effects) % len(FACTORS)],
        )


def main() -> None:
    """Simulate worlds until the requested number is ambiguous; print a row for each."""
    parser = ArgumentParser(description=__doc__.split('\n', maxsplit=1)[0])
    parser.add_argument(
        '--worlds', type=int, default=60, help='worlds in which the first recording leaves a class'
    )
    parser.add_argument('--first-seed', type=int, default=0)
    parser.add_argument('--effects', type=lambda text: text.split(','), default=HIDDEN)
    parser.add_argument('--most', type=int, default=400, help='worlds that are tried at most')
    parser.add_argument(
        '--longest', type=float, default=LONGEST_SEPARATION, help='of the planned motions, s'
    )
    add_smallest(parser, worlds=1, most=1, first_seed=1, longest=60.0)
    options = parser.parse_args()
    rows, tried = [], 0
    for world in islice(worlds(options.first_seed, options.effects), options.most):
        row = run(world, options.longest)
        tried += 1
        if 'right' not in row:
            continue
        rows.append(row)
        print(
            f'{row["seed"]:6d} {row["hidden"]:<24} x{row["factor"]:<4g} {row["before"]} ->'
            f' {row.get("after", row.get("refused"))} {row.get("seconds", 0.0):.0f} s'
            f' {"right" if row["right"] else "one cause" if row.get("one_cause") else "WRONG"}'
            f' {row.get("missing") or ""}',
            flush=True,
        )
        if len(rows) == options.worlds:
            break
    right = sum(row['right'] for row in rows)
    one_cause = sum(row.get('one_cause', False) and not row['right'] for row in rows)
    print(
        f'{tried} worlds, {len(rows)} with a class; a single, right name in {right}, one cause by'
        f" the plan's own word in {one_cause}"
    )
    seconds = [row['seconds'] for row in rows if 'seconds' in row]
    if seconds:
        print(f'motion median {np.median(seconds):.0f} s, largest {max(seconds):.0f} s')


if __name__ == '__main__':
    main()
