"""
Coverage and efficiency of identified noise.

Simulated records of four grades and three lengths, intervals and errors against the bound.

    make noise-coverage       # fresh seeds; writes the tables of docs/noise.md

Every axis draws its own densities and one of four forms of slow noise. Intervals include the choice
of the form. Errors are from the fit of the true form, relative to the Cramer-Rao bound for a given
form: exact Fisher information of block means, and of the spectrum within blocks.
"""

import argparse
import sys
import time
from datetime import date
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / 'test')]

from imu_calibration.allan.curve import averaging_factors  # noqa: E402
from imu_calibration.allan.moment_fit import Moments, Whitener  # noqa: E402
from imu_calibration.allan.processes import (  # noqa: E402
    ScaleCovariance,  # noqa: E402
    gauss_markov,
    mean_covariance,
)
from imu_calibration.allan.terms import (
    PROCESSES,
    TIME_KEY,
    fit_form,
    identify_axis,
)  # noqa: E402
from imu_calibration.effects.base import SENSORS  # noqa: E402
from imu_calibration.simulation.sensor_noise import GRADES  # noqa: E402
from tools.smallest import add_smallest  # noqa: E402

from worlds.noise_worlds import FORMS, RATE, draw_truth, overlapping_allan_variance  # noqa: E402

LENGTHS = {'10 min': 600.0, '1 h': 3600.0, '3 h': 10800.0}
NAMES = {
    'white_noise': 'white noise N',
    'random_walk': 'random walk K',
    'bias_instability': 'bias instability B',
    'gauss_markov': 'Gauss–Markov σ',
    TIME_KEY: 'correlation time τ',
    'quantisation': 'quantisation Q',
}
AXES = 6
"""Of a record: three of each sensor."""
BLOCKS = 500
"""Blocks of the Fisher information."""
BEGIN, END = '<!-- records: begin -->', '<!-- records: end -->'
"""Marks around the tables in the document."""
INFORMED = 0.3
"""
Errors are compared with the bound where the bound is below this share of the coefficient; elsewhere
the record does not determine it.
"""


def record_axes(length, grade, number, *, seed, axes):
    """Yield (truth, moments) of the first of the six axes of one record."""
    period = 1.0 / RATE
    n = int(length * RATE)
    factors = averaging_factors(n)
    scales = scales_of(n, period)
    for k, sensor in enumerate((3 * SENSORS[:1] + 3 * SENSORS[1:])[:axes]):
        rng = np.random.default_rng((seed, int(length), sorted(GRADES).index(grade), number, k))
        truth = draw_truth(grade, sensor, FORMS[rng.integers(len(FORMS))], rng)
        variance = overlapping_allan_variance(truth.draw(n, period, rng)[:, None], factors)[:, 0]
        yield truth, Moments(scales, variance, variance > 0)


_SCALES: dict = {}


def scales_of(n, period):
    """Return the covariances of a record of n samples, made once."""
    if n not in _SCALES:
        _SCALES[n] = ScaleCovariance(averaging_factors(n), [n], period)
    return _SCALES[n]


def judged(truth, moments):
    """
    Return the result of one axis.

    (name, truth, lower, upper, status) of every figure, and the errors of the fit of the true form.
    """
    found = identify_axis(moments)
    figures = []
    for name, value in truth.figures.items():
        term = found.alternatives.get(name) or found.terms.get(name)
        figures.append(
            (
                name,
                value,
                *(
                    (term.interval[0], term.interval[1], term.status)
                    if term
                    else (None, None, 'not asked')
                ),
            )
        )
    names = [name for name in ('quantisation', 'white_noise', *truth.form) if name in truth.figures]
    fit = fit_form(moments, truth.form, tuple(name for name in names if name == 'quantisation'))
    true, values = coefficients(truth, names), dict(zip(names, fit.coefficients))
    if 'gauss_markov' in names:
        values[TIME_KEY] = fit.processes[-1].time
    bounds, of_moments = bound(moments, truth, names), moment_bound(moments, truth, names)
    errors = [
        (name, float(values[name] / true[name] - 1), bounds[name], of_moments[name])
        for name in true
    ]
    return {
        'true': list(truth.form),
        'found': list(found.form),
        'rivals': [list(form) for form in found.others],
        'figures': figures,
        'errors': errors,
    }


def coefficients(truth, names):
    """Return the true coefficients, and the correlation time."""
    true = {name: truth.figures[name] ** 2 for name in names}
    if 'gauss_markov' in names:
        true[TIME_KEY] = truth.figures[TIME_KEY]
    return true


def bound(moments, truth, names):
    """Return the relative Cramer-Rao bounds of coefficients and correlation time."""
    period, n = moments.scales.period, round(moments.scales.longest / moments.scales.period)
    size = n // BLOCKS
    lag, seconds = (
        np.subtract.outer(np.arange(BLOCKS), np.arange(BLOCKS)) * size * period,
        size * period,
    )
    parts = _derivatives(truth, names, lambda process: mean_covariance(process, lag, seconds))
    basis = np.linalg.qr(np.column_stack([np.ones(BLOCKS), np.eye(BLOCKS)[:, 1:]]))[0][:, 1:]
    parts = [basis.T @ part @ basis for part in parts]
    inverse = np.linalg.inv(sum(parts[: len(names)]))
    inside = [inverse @ part for part in parts]
    information = np.array([[0.5 * np.einsum('ij,ji->', a, b) for b in inside] for a in inside])
    frequency = np.arange(BLOCKS // 2, n // 2 + 1) / (n * period)
    spectra = _derivatives(truth, names, lambda process: _spectrum(process, frequency, period))
    shares = np.array(spectra) / sum(spectra[: len(names)])
    information += shares @ shares.T
    sd = np.sqrt(np.diag(np.linalg.inv(information)))
    return _by_name(names, sd)


def _by_name(names, sd):
    """Return process, and the correlation time of a Gauss-Markov process -> its bound."""
    keys = [*names, TIME_KEY] if 'gauss_markov' in names else names
    return dict(zip(keys, sd.tolist()))


def moment_bound(moments, truth, names):
    """
    Return the relative bounds of the optimally weighted Allan variance estimator.

    The estimator works from Allan variances, weighted optimally (GMWM's bound).
    """
    design = np.column_stack(_derivatives(truth, names, moments.scales.expectation))
    processes = tuple(
        gauss_markov(truth.figures[TIME_KEY]) if name == 'gauss_markov' else PROCESSES[name]
        for name in names
    )
    squares = np.array([truth.figures[name] ** 2 for name in names])
    columns = Whitener(
        np.einsum('p,q,pqij->ij', squares, squares, moments.scales.tensor(processes))
    )(design)
    sd = np.sqrt(np.diag(np.linalg.inv(columns.T @ columns)))
    return _by_name(names, sd)


def _derivatives(truth, names, of):
    """
    Return the contribution of each process, and its change with correlation time.

    The change is the one with the logarithm of the correlation time.
    """
    parts = []
    for name in names:
        process = (
            gauss_markov(truth.figures[TIME_KEY]) if name == 'gauss_markov' else PROCESSES[name]
        )
        parts.append(truth.figures[name] ** 2 * of(process))
    if 'gauss_markov' in names:
        time, step = truth.figures[TIME_KEY], 0.01
        parts.append(
            truth.figures['gauss_markov'] ** 2
            * (of(gauss_markov(time * (1 + step))) - of(gauss_markov(time * (1 - step))))
            / (2 * step)
        )
    return parts


def _spectrum(process, frequency, period):
    """
    Return the two-sided density of a process of unit coefficient.

    For slow processes, it is the density well above the corner frequency.
    """
    angular = 2 * np.pi * frequency
    return {
        'white_noise': np.ones_like(frequency),
        'quantisation': (2 * np.sin(np.pi * frequency * period) / period) ** 2,
        'random_walk': angular**-2,
        'bias_instability': 1 / angular,
        'gauss_markov': 2 * process.time / (1 + (angular * process.time) ** 2),
    }[process.name]


def run(records, seed, *, lengths=tuple(LENGTHS), grades=tuple(GRADES), axes=AXES, progress=print):
    """
    Return the results of all axes: length -> list of `judged`; `records` for each grade and length.
    """
    found = {}
    for label in lengths:
        start = time.monotonic()
        found[label] = [
            judged(truth, moments)
            for grade in grades
            for number in range(records)
            for truth, moments in record_axes(LENGTHS[label], grade, number, seed=seed, axes=axes)
        ]
        progress(f'{label}: {len(found[label])} axes in {time.monotonic() - start:.0f} s')
    return found


def coverage(axes):
    """
    Return {name: (number, three shares of intervals)} of the figures in `NAMES`.

    The values are (number, share of intervals that hold the truth, share below, share above).
    """
    table = {}
    for name in NAMES:
        rows = [
            (value, lower, upper)
            for axis in axes
            for known, value, lower, upper, _ in axis['figures']
            if known == name and lower is not None
        ]
        if rows:
            value, lower, upper = np.array(rows, float).T
            table[name] = (
                len(rows),
                float(np.mean((lower <= value) & (value <= upper))),
                float(np.mean(upper < value)),
                float(np.mean(lower > value)),
            )
    return table


def sharpness(axes):
    """
    Return {name: (number, two ratios of rms errors)} of informed coefficients.

    The values are (number, rms error over the Cramer-Rao bound, over that of the moments). Only
    cases where the bound is below `INFORMED` count.
    """
    table = {}
    for name in NAMES:
        rows = [
            numbers
            for axis in axes
            for known, *numbers in axis['errors']
            if known == name and numbers[1] < INFORMED
        ]
        if len(rows) >= 10:
            error, *limits = np.array(rows).T
            table[name] = (
                len(rows),
                *(float(np.sqrt(np.mean((error / limit) ** 2))) for limit in limits),
            )
    return table


def statuses(axes):
    """Return {name: {status: number}}."""
    return {
        name: {
            status: sum(
                known == name and state == status
                for axis in axes
                for known, *_, state in axis['figures']
            )
            for status in ('determined', 'weak', 'held')
        }
        for name in NAMES
    }


def tables(found, axes=AXES):
    """Return the tables of docs/noise.md, of records with so many axes."""
    every = [axis for axes in found.values() for axis in axes]
    records = {label: len(of_label) // axes for label, of_label in found.items()}
    lines = [
        (
            f'{len(every) // axes} records of {axes} axes'
            f' ({", ".join(f"{count} of {label}" for label, count in records.items())};'
            f' {RATE:g} Hz).'
        ),
        '',
        '| figure | axes that have it | interval holds the truth | too low | too high | '
        + ' | '.join(found)
        + ' | determined / weak / held |',
        '| --- | ---: | ---: | ---: | ---: |' + ' ---: |' * len(found) + ' --- |',
    ]
    by_length, states = {label: coverage(axes) for label, axes in found.items()}, statuses(every)
    for name, (count, inside, low, high) in coverage(every).items():
        cells = [
            f'{by_length[label][name][1]:.1%}' if name in by_length[label] else ''
            for label in found
        ]
        lines.append(
            f'| {NAMES[name]} | {count} | {inside:.1%} | {low:.1%} | {high:.1%} | '
            + ' | '.join(cells)
            + ' | '
            + ' / '.join(str(states[name][s]) for s in ('determined', 'weak', 'held'))
            + ' |'
        )
    lines += [
        '',
        (
            '| figure | axes with a bound below 30 % | rms error over the Cramér–Rao bound | over'
            ' the bound of the moments |'
        ),
        '| --- | ---: | ---: | ---: |',
    ]
    lines += [
        f'| {NAMES[name]} | {count} | {ratio:.2f} | {moments:.2f} |'
        for name, (count, ratio, moments) in sharpness(every).items()
    ]
    right = sum(axis['true'] == axis['found'] for axis in every)
    part = sum(
        set(axis['found']) < set(axis['true'])
        or axis['found'] == ['random_walk']
        and axis['true'] == ['gauss_markov']
        for axis in every
    )
    rival = sum(axis['true'] in axis['rivals'] for axis in every)
    lines += [
        '',
        (
            f'The form of the slow noise: found as it was in {right} axes, a part or a limiting'
            f' case of it in {part}, named as explaining the curve as well in {rival}, of'
            f' {len(every)}.'
        ),
    ]
    return '\n'.join(lines)


def write(text, page=ROOT / 'docs/noise.md'):
    """Put the tables between their marks in the document."""
    before, _, rest = page.read_text().partition(BEGIN)
    head = f'Measured on {date.today().isoformat()} by `make noise-coverage`.'
    page.write_text(
        before + BEGIN + '\n' + head + '\n\n' + text + '\n' + END + rest.partition(END)[2]
    )


def main():
    """Run, print and, on request, write the documents."""
    parser = argparse.ArgumentParser(
        description='Intervals and errors of identified noise over simulated records.'
    )
    parser.add_argument(
        '--records',
        type=int,
        default=17,
        help='records for each grade and length, default 17: 204 in all',
    )
    parser.add_argument(
        '--seed', type=int, default=int(time.time()), help='default the time: unused seeds'
    )
    parser.add_argument('--lengths', nargs='+', choices=LENGTHS, default=list(LENGTHS))
    parser.add_argument('--grades', nargs='+', choices=GRADES, default=list(GRADES))
    parser.add_argument('--write', action='store_true', help='write the tables into docs/noise.md')
    parser.add_argument('--axes', type=int, default=AXES, help='axes of each record, default 6')
    add_smallest(parser, records=1, seed=1, lengths=['10 min'], grades=['tactical'], axes=2)
    options = parser.parse_args()
    found = run(
        options.records,
        options.seed,
        lengths=options.lengths,
        grades=options.grades,
        axes=options.axes,
        progress=lambda line: print(line, flush=True),
    )
    text = tables(found, options.axes)
    print(text)
    if options.write:
        write(text)


if __name__ == '__main__':
    main()
