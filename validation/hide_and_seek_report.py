"""Figures and pictures of hide and seek, from its record."""

from collections import Counter, defaultdict
from datetime import date

import numpy as np

from validation.hide_and_seek_sections import by_grade, kind_of, print_pairs, print_sizes, share_of

from worlds import beyond_catalogue


def report(rows, docs):
    """Print the figures of a record and draw its confusion matrix and power curves into `docs`."""
    parts = defaultdict(list)
    for row in rows:
        parts[row['part']].append(row)
    print(f'Hide and seek, {date.today().isoformat()}, {len(rows)} sessions')
    _effects(parts['effects'], 'five times the smallest detectable size')
    _parameters(parts['effects'] + parts['separating'])
    _separating(parts['separating'])
    _nothing(parts['none'], 'nothing hidden')
    _outside(parts['outside'])
    print_pairs(parts['pairs'])
    print_sizes(parts['sizes'])
    _traps(parts['traps'])
    _oracle(parts['effects'])
    _classes(parts['effects'])
    _beyond(parts['beyond'])
    _seconds(rows)
    for row in parts['failed']:
        print(f'FAILED {row["what"]}: {row["why"]}')
    docs.mkdir(parents=True, exist_ok=True)
    if parts['effects']:
        draw_confusion(parts['effects'], docs / 'hide_and_seek_confusion.png')
    if parts['power']:
        _power(parts['power'], docs / 'hide_and_seek_power.png')
    if parts['beyond']:
        beyond_catalogue.draw(parts['beyond'], docs / 'hide_and_seek_beyond.png')


def first_is_right(row):
    """Return whether the hidden effect is the first finding or in its class."""
    return bool(row['found']) and row['hidden'][0] in [row['found'][0]] + row['classes'][0]


def strictly_first(row):
    """Return whether the hidden effect is the first finding."""
    return bool(row['found']) and row['hidden'][0] == row['found'][0]


def _effects(rows, what):
    if not rows:
        return
    for grade, noise, some in by_grade(rows):
        print(
            f'\nfirst finding right or in its class, {what}, {grade} grade, {noise} noise:'
            f' {share_of(map(first_is_right, some))}; strictly first'
            f' {share_of(map(strictly_first, some))}; nothing else named'
            f' {share_of(len(row["found"]) == 1 for row in some)}'
        )
    for kind in sorted(set(map(kind_of, rows))):
        print(f'  {kind}: {share_of(first_is_right(row) for row in rows if kind_of(row) == kind)}')
    for row in rows:
        if not first_is_right(row):
            print(
                f'  {row["hidden"][0]} seed {row["seed"]} {row["noise"]}: {row["found"]}'
                f' {row["classes"]}, rest significant: {row["unexplained"]}'
            )
    names = sorted({row['hidden'][0] for row in rows})
    weak = [
        (name, [first_is_right(row) for row in rows if row['hidden'][0] == name]) for name in names
    ]
    for name, right in weak:
        if np.mean(right) < 1:
            print(f'  {name}: {share_of(right)}')
    print_confusion(rows)


def print_confusion(rows):
    """Print hidden effect against first finding, members of its class in brackets."""
    print('\nhidden -> first finding [classes]')
    for name in sorted({row['hidden'][0] for row in rows}):
        some = [row for row in rows if row['hidden'][0] == name]
        found = Counter(row['found'][0] if row['found'] else 'nothing' for row in some)
        mates = Counter(mate for row in some if row['found'] for mate in row['classes'][0])
        line = ', '.join(f'{effect} {count}' for effect, count in found.most_common())
        print(
            f'  {name:24s} {line}'
            + (
                f'   [{", ".join(f"{mate} {count}" for mate, count in mates.most_common())}]'
                if mates
                else ''
            )
        )


def _parameters(rows):
    errors = [error for row in rows for values in row['errors_in_sd'].values() for error in values]
    if errors:
        errors = np.abs(errors)
        rms = np.sqrt(np.mean(np.minimum(errors, 10) ** 2))
        print(
            f'\nparameters within 3 sd: {100 * np.mean(errors < 3):.1f} % of {len(errors)}; rms'
            f' error in sd {rms:.2f}'
        )
    levels = [row['level_error'] for row in rows if 'level_error' in row]
    if levels:
        print(f'saturation level within 1 %: {share_of(level < 0.01 for level in levels)}')


def _separating(rows):
    if rows:
        print(f'\nsessions made to separate: strictly first {share_of(map(strictly_first, rows))}')
        for row in rows:
            if not strictly_first(row):
                print(f'  {row["hidden"][0]} seed {row["seed"]}: {row["found"]} {row["classes"]}')


def _nothing(rows, what):
    for grade, noise, some in by_grade(rows):
        print(
            f'\n{what}, {grade} grade, {noise} noise: a finding in'
            f' {share_of(bool(row["found"]) for row in some)}; significant rest in'
            f' {share_of(row["unexplained"] for row in some)}; a formula in'
            f' {share_of(bool(row["formulas"]) for row in some)}'
        )
        for row in some:
            if row['found'] or row['unexplained'] or row['formulas']:
                print(
                    f'  seed {row["seed"]} {row["noise"]}: {row["found"]}, rest significant:'
                    f' {row["unexplained"]}, {row["formulas"]}'
                )


def _outside(rows):
    if not rows:
        return
    print(
        '\ncauses outside the catalogue: unexplained significant in'
        f' {share_of(row["unexplained"] for row in rows)}, nothing named in'
        f' {share_of(not row["found"] for row in rows)}'
    )
    for name in sorted({row['hidden'][0] for row in rows}):
        some = [row for row in rows if row['hidden'][0] == name]
        print(
            f'  {name}: unexplained {share_of(row["unexplained"] for row in some)}, nothing named'
            f' {share_of(not row["found"] for row in some)}'
            f' {[row["found"] for row in some if row["found"]]}'
        )


def _traps(rows):
    if rows:
        print(f'\ntraps: a finding in {share_of(bool(row["found"]) for row in rows)}')
        for row in rows:
            if row['found']:
                print(f'  {row["trap"]} seed {row["seed"]}: {row["found"]}')


def class_sizes(rows):
    """Return how many effects each right first finding is told to be one of, shape (n,)."""
    return np.array([1 + len(row['classes'][0]) for row in rows if first_is_right(row)])


def _classes(rows):
    sizes = class_sizes(rows)
    if len(sizes):
        print(
            f'\nright first findings told with mates: {share_of(sizes > 1)}, of these with two:'
            f' {share_of(sizes[sizes > 1] > 2)}'
        )


def _beyond(rows):
    if rows:
        print(
            f'\ncauses outside the catalogue, {len({row["kind"] for row in rows}) - 1} kinds,'
            f' {len(rows)} worlds'
        )
        for what, required, measured in beyond_catalogue.figures(rows):
            print(f'  {what}: {measured} (required: {required})')
        print(*beyond_catalogue.missed(rows), sep='\n')


def _oracle(rows):
    ratios = [row['oracle_ratio'] for row in rows if row.get('oracle_ratio') is not None]
    if ratios:
        print(
            f'\nheld-out rms over that of an oracle: median {np.median(ratios):.4f}, largest'
            f' {np.max(ratios):.4f} ({len(ratios)} sessions)'
        )


def _seconds(rows):
    seconds = [row['seconds'] for row in rows if 'seconds' in row]
    if seconds:
        print(
            f'\nprocessor time per diagnosis: median {np.median(seconds):.1f} s, largest'
            f' {np.max(seconds):.1f} s'
        )


def draw_confusion(rows, path):
    """Draw hidden effects against first findings."""
    from matplotlib.figure import Figure

    names = sorted({row['hidden'][0] for row in rows})
    found = (
        names + sorted({row['found'][0] for row in rows if row['found']} - set(names)) + ['nothing']
    )
    table = np.zeros((len(names), len(found)))
    for row in rows:
        table[
            names.index(row['hidden'][0]),
            found.index(row['found'][0] if row['found'] else 'nothing'),
        ] += 1
    figure = Figure(figsize=(11, 9.5), layout='constrained')
    axes = figure.add_subplot()
    axes.imshow(
        table / np.maximum(table.sum(axis=1, keepdims=True), 1), cmap='Blues', vmin=0, vmax=1
    )
    for (i, j), count in np.ndenumerate(table):
        if count:
            colour = 'white' if count > 0.6 * table[i].sum() else 'black'
            axes.text(j, i, f'{count:.0f}', ha='center', va='center', fontsize=7, color=colour)
    axes.set_xticks(range(len(found)), found, rotation=90, fontsize=8)
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.set_xlabel('first finding')
    axes.set_ylabel('hidden')
    right = np.mean([first_is_right(row) for row in rows])
    axes.set_title(
        f'Hide and seek at five times the smallest detectable size: {100 * right:.1f} % of'
        f' {len(rows)} sessions right or in the declared class',
        fontsize=10,
    )
    figure.savefig(path, dpi=110)


def _power(rows, path):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5), layout='constrained')
    axes = figure.add_subplot()
    print('\ndetection power against size (in smallest detectable sizes)')
    for effect in sorted({row['hidden'][0] for row in rows}):
        some = [row for row in rows if row['hidden'][0] == effect]
        factors = sorted({row['factor'] for row in some})
        power = [
            np.mean([first_is_right(row) for row in some if row['factor'] == factor])
            for factor in factors
        ]
        axes.plot(
            factors, power, 'o-', label=f'{effect} ({len(some) // len(factors)} sessions a point)'
        )
        print(
            f'  {effect:24s} '
            + ', '.join(f'{factor:g}: {value:.2f}' for factor, value in zip(factors, power))
        )
    axes.axhline(0.5, color='grey', lw=0.8)
    axes.set_xlabel('size / smallest detectable size')
    axes.set_ylabel('share of sessions in which it is found')
    axes.set_ylim(-0.03, 1.03)
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
