"""
Closed loop: diagnose a session, simulate the finding, diagnose it, compare.

The session has a hidden cause, and the simulation is on the same motion.

Usage: `python -m validation.closed_loop [--seed N] [--only NAME ...]` prints one line for each loop
and the table. Causes: each effect of the catalogue with a known size, one formula per template of
the grammar, and, for each pair in `indistinguishable_from`, the other member at the size that the
diagnosis estimated for it. In the second diagnosis the true size is that of the first finding, so
that z = (second size - first size) / (sd of the second) has a standard deviation of 1 where the
reported sds are correct.
"""

import argparse
import re
import time
from dataclasses import replace
from typing import Any

import numpy as np

from imu_calibration.api.calibrate import calibrate_recordings
from imu_calibration.api.choices import catalogue_of
from imu_calibration.api.diagnose import diagnose
from imu_calibration.api.simulate import replay, simulate
from imu_calibration.core.errors import ImuCalibrationError
from imu_calibration.effects.base import AXES
from tools.smallest import add_smallest
from validation.section import markdown_table

TEMPLATES = {
    'product': ('accelerometer', 'f_x * w_y', 'm/s^2/(m/s^2)/(rad/s)', 5e-3),
    'cube': ('accelerometer', 'w_z ** 3', 'm/s^2/(rad/s)^3', 5e-2),
    'angular acceleration': ('accelerometer', 'alpha_y * f_x', 'm/s^2/(m/s^2)/(rad/s^2)', 3e-2),
    'magnitude': ('gyroscope', 'abs(f_z)', 'rad/s/(m/s^2)', 1e-4),
    'sign': ('gyroscope', 'sign(f_y) * w_x', 'rad/s/(rad/s)', 2e-3),
    'sum of squares': ('gyroscope', 'f_x ** 2 + f_y ** 2', 'rad/s/(m/s^2)^2', 1e-5),
    'temperature': (
        'gyroscope',
        '(temperature_c - temperature_ref_c) * f_x * w_z',
        'rad/s/K/(m/s^2)/(rad/s)',
        1e-4,
    ),
    'time': ('accelerometer', 'time * f_y * w_x', 'm/s^2/s/(m/s^2)/(rad/s)', 5e-5),
    'order of a joint': ('accelerometer', 'cos(5 * angle_1)', 'm/s^2', 2e-2),
    'orders of two joints': ('gyroscope', 'cos(2 * angle_1) * sin(3 * angle_2)', 'rad/s', 2e-3),
    'order and joint rate': ('gyroscope', 'joint_rate_2 * sin(4 * angle_2)', 'rad/s/(rad/s)', 2e-3),
    'joint rate': ('accelerometer', 'joint_rate_1 * abs(joint_rate_1)', 'm/s^2/(rad/s)^2', 3e-2),
    'table vector and order': (
        'gyroscope',
        ['cos(2 * angle_1) * c_xx', 'cos(2 * angle_1) * c_yx', 'cos(2 * angle_1) * c_zx'],
        'rad/s',
        1e-3,
    ),
}
"""Template of the grammar -> (sensor, column, unit, size of each axis, SI)."""
PHASE, SAME_PHASE = re.compile(r' ([+-]) ([\d.e-]+)(?=\))'), 0.01
"""Phase in the column of a formula, and the largest difference of estimates of one phase, rad."""
SIZE = 1.0
"""Hidden size of a catalogue effect as a share of its largest plausible one."""


def measured_sessions(names, profile):
    """Yield (name, function of a seed that simulates the session) of each cause."""
    for effect in catalogue_of(None).effects().values():
        if (
            effect.plausible
            and effect.name not in ('bias', 'matrix')
            and (not names or effect.name in names)
        ):
            yield (
                effect.name,
                lambda seed, name=effect.name: simulate(
                    profile, effects=[name], size=SIZE, grade='tactical', seed=seed
                ),
            )
    for template, (sensor, column, unit, size) in TEMPLATES.items():
        if names and template not in names:
            continue
        definition = {
            'sensor': sensor,
            'column': column,
            'unit': unit,
            'tolerance': size / 100,
            'largest': size,
            'text': template,
        }
        yield (
            template,
            lambda seed, definition=definition, template=template: simulate(
                profile,
                effects=['hidden_formula'],
                size=1.0,
                grade='tactical',
                seed=seed,
                catalogue={'hidden_formula': definition},
                temperature='temperature' in template,
            ),
        )


def sizes_of(found):
    """
    Return {name: {parameter: (value, sd)}} of the findings and formulas.

    Implausible findings are excepted.
    """
    sizes = {
        finding.effect: {name: (value, sd) for name, (value, sd, _) in finding.parameters.items()}
        for finding in found.findings
        if not finding.implausible
    }
    for rest in found.result.diagnosis.unexplained.values():
        if rest.proposal:
            sizes |= {
                column: dict(zip(AXES, zip(values, sds)))
                for column, values, sds in zip(
                    rest.proposal.columns, rest.proposal.values, rest.proposal.sds
                )
            }
    return sizes


def values_of(calibration):
    """Return {effect: {parameter: value}} of a calibration."""
    model, found = calibration.model, {}
    for effect in model.effects:
        part = model.slices[effect.key]
        found[effect.name] = dict(zip(model.param_names[part], calibration.values[part].tolist()))
    return found


def same_formula(column, known):
    """
    Return whether two columns differ in their estimated phases only, by less than `SAME_PHASE`.
    """
    one, other = (
        np.array([float(sign + phase) for sign, phase in PHASE.findall(text)])
        for text in (column, known)
    )
    turns = one.shape == other.shape and np.angle(np.exp(1j * (one - other)))
    return (
        PHASE.sub('', column) == PHASE.sub('', known)
        and turns is not False
        and bool(np.all(np.abs(turns) < SAME_PHASE))
    )


def compared(expected, calibration, measured, seed):
    """
    Simulate a calibration on the motion of a session, and diagnose the simulation.

    The result is compared with {name: {parameter: value}}.
    """
    second = diagnose(
        replay(measured.samples, calibration, measured.table, seed=seed).samples, measured.table
    )
    known = {
        column: next((name for name in expected if same_formula(column, name)), column)
        for column in sizes_of(second)
    }
    found = {known[name]: sizes for name, sizes in sizes_of(second).items()}
    classes = {
        finding.effect: {finding.effect, *finding.indistinguishable_from}
        for finding in second.findings
    }
    classes |= {
        known[column]: {known[column], *rest.proposal.alike}
        for rest in second.result.diagnosis.unexplained.values()
        if rest.proposal
        for column in rest.proposal.columns
    }
    again = [name for name in expected if any(name in members for members in classes.values())]
    z = [
        (value - expected[name][part]) / sd
        for name in expected.keys() & found.keys()
        for part, (value, sd) in found[name].items()
        if part in expected[name]
    ]
    return {
        'found': sorted(expected),
        'again': sorted(again),
        'new': sorted(name for name in found if not classes[name] & expected.keys()),
        'z': z,
    }


def exchanged(calibration, finding, mate, measured):
    """
    Return the calibration of a session with `mate` in the place of a finding.

    Or None where it is not determined.

    All parameters are estimated with it: a drift in place of a thermal bias needs another bias.
    """
    model, sensor = calibration.model, catalogue_of(None).owner_of(mate)
    less = replace(
        model,
        point={},
        **{
            finding.sensor: tuple(
                name for name in getattr(model, finding.sensor) if name != finding.effect
            )
        },
    )
    names: dict[str, Any] = {
        f'{part}_model': '+'.join(getattr(less.with_effect(sensor, mate), part)) or 'none'
        for part in ('accelerometer', 'gyroscope', 'reference')
    }
    other = calibrate_recordings(
        measured.samples, measured.table, model_as_asked=True, **names
    ).calibration
    return other if 'held' not in np.array(other.status)[other.model.slices[sensor, mate]] else None


def run(names, seed, profile='random'):
    """Print a line for each loop and return the rows."""
    rows = []
    for seed, (name, make) in enumerate(measured_sessions(names, profile), seed):
        start = time.process_time()
        found = []
        try:
            for row in _loops(name, make(seed), seed):
                found.append(row)
        except ImuCalibrationError as error:
            nothing = {'found': [], 'again': [], 'new': [], 'z': []}
            found.append({'cause': name, 'kind': 'refused', **nothing, 'why': str(error)})
        for row in found:
            print(
                f'{row["cause"]}: found {", ".join(row["found"]) or "-"}; again'
                f' {", ".join(row["again"]) or "-"}; new {", ".join(row["new"]) or "-"}; z'
                f' {" ".join(f"{z:.1f}" for z in row["z"])} {row.get("why", "")}'
                f' ({time.process_time() - start:.0f} s)',
                flush=True,
            )
        rows += found
    return rows


def _loops(name, measured, seed):
    """
    Yield the row of a session, and one of each effect that is collinear with a finding.

    The loop of such a mate begins with the calibration that has it in place of the finding.
    """
    first = diagnose(measured.samples, measured.table)
    sizes = {}  # effect -> parameter -> value
    for effect, sizes_of_effect in sizes_of(first).items():
        sizes[effect] = {part: value for part, (value, _) in sizes_of_effect.items()}
    yield {'cause': name, 'kind': 'formula' if name in TEMPLATES else 'effect'} | compared(
        sizes, first.proposed or first.calibration, measured, seed + 1000
    )
    for finding in first.findings:
        for mate in finding.indistinguishable_from:
            other = exchanged(first.calibration, finding, mate, measured)
            if other is None:
                continue
            expected = {
                effect: values
                for effect, values in values_of(other).items()
                if effect == mate or effect in sizes
            }
            yield {'cause': f'{mate} for {finding.effect}', 'kind': 'pair'} | compared(
                expected, other, measured, seed + 2000
            )


def table_of_rows(rows):
    """Return the summary as a Markdown table."""
    lines = []
    for kind in ('effect', 'formula', 'pair'):
        of_kind = [row for row in rows if row['kind'] == kind]
        named = [row for row in of_kind if row['found']]
        z = np.array([value for row in of_kind for value in row['z']])
        lines.append(
            (
                kind,
                str(len(of_kind)),
                str(len(named)),
                str(sum(row['again'] == row['found'] for row in named)),
                str(sum(bool(row['new']) for row in of_kind)),
                '–' if not z.size else f'{np.sqrt(np.mean(z**2)):.2f}',
                '–' if not z.size else f'{np.mean(np.abs(z) < 2):.2f} of {z.size}',
            )
        )
    return markdown_table(
        (
            'cause',
            'sessions',
            'with a finding',
            'same finding',
            'other names',
            'rms z',
            'share with |z| < 2',
        ),
        lines,
    )


def main():
    """Read the arguments, run, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--only', nargs='+', default=())
    parser.add_argument('--profile', default='random', help='motion of the sessions')
    add_smallest(parser, only=['gyro_g_sensitivity'], profile='quick')
    options = parser.parse_args()
    print(table_of_rows(run(set(options.only), options.seed, options.profile)))


if __name__ == '__main__':
    main()
