"""
The figures of hide and seek as text.

The table in docs/hide-and-seek.md and the sentence in docs/evidence.md, written from the record.
"""

import re
from datetime import date

import numpy as np

from validation.hide_and_seek_report import class_sizes, first_is_right, strictly_first
from validation.hide_and_seek_sections import both_found, by_grade, kind_of, separable, wrong_names

from worlds import beyond_catalogue

BARS = {'white': '97 %', 'realistic': '95 %'}
"""Share of single effects that is to be named first."""

LEAST = 0.85
"""Share below which no single effect shall be."""
MARKS = ('<!-- {}: begin -->', '<!-- {}: end -->')


def write_figures(rows, docs):
    """
    Put the figures of a record between the marks in docs/hide-and-seek.md and docs/evidence.md.

    Other text stays.
    """
    parts = {}
    for row in rows:
        parts.setdefault(row['part'], []).append(row)
    _replace(docs / 'hide-and-seek.md', _table(rows, parts))
    if {'effects', 'none', 'pairs'} & set(parts):
        _replace(docs / 'hide-and-seek.md', missed(parts), 'missed')
    if 'beyond' in parts:
        _replace(docs / 'hide-and-seek.md', beyond_table(parts['beyond']), 'beyond')
    _replace(docs / 'evidence.md', _sentence(rows, parts))


def _replace(path, text, what='figures'):
    begin, end = (mark.format(what) for mark in MARKS)
    if path.exists() and begin in path.read_text():
        whole = re.sub(
            f'{begin}.*{end}',
            lambda match: f'{begin}\n{text}\n{end}',
            path.read_text(),
            flags=re.DOTALL,
        )
        beside = path.with_suffix('.new')
        beside.write_text(whole)
        beside.replace(path)


def beyond_table(rows):
    """Return the table of the worlds beyond the catalogue."""
    seeds = sorted({row['seed'] for row in rows})
    lines = [
        (
            f'{len(rows)} worlds of'
            f' {len({row["kind"] for row in rows} - {beyond_catalogue.NOTHING})} kinds,'
            f' {", ".join(sorted({row["noise"] for row in rows}))} noise, seeds {seeds[0]} to'
            f' {seeds[-1]}, {date.today().isoformat()}:'
        ),
        '',
        '| what | required | measured |',
        '| --- | --- | --- |',
    ]
    return '\n'.join(
        lines
        + [
            f'| {what} | {required} | {measured} |'
            for what, required, measured in beyond_catalogue.figures(rows)
        ]
    )


def _count(values):
    values = list(values)
    return f'{sum(values)} of {len(values)}'


def _percent(values):
    values = list(values)
    return f'{_count(values)} ({100 * np.mean(values):.1f} %)'


def _table(rows, parts):
    effects = parts.get('effects', [])
    seeds = [row['seed'] for row in rows if 'seed' in row]
    lines = [
        (
            f'{len(seeds)} sessions, seeds {min(seeds, default=0)} to {max(seeds, default=0)},'
            f' {date.today().isoformat()}, made and counted by `make hide-and-seek`:'
        ),
        '',
        '| what | required | measured |',
        '| --- | --- | --- |',
    ]
    for grade, noise, some in by_grade(effects):
        lines.append(
            f'| hidden effect first, or in the class of the first finding, {grade} grade, {noise}'
            f' noise | {BARS[noise]} | {_percent(map(first_is_right, some))} (strictly first'
            f' {_count(map(strictly_first, some))}; nothing else named'
            f' {_count(len(row["found"]) == 1 for row in some)}) |'
        )
    for noise in BARS:
        some = [row for _, kind, part in by_grade(effects) for row in part if kind == noise]
        if some:
            kinds = sorted(set(map(kind_of, some)))
            each = (
                '; '.join(
                    f'{kind} {_count(first_is_right(row) for row in some if kind_of(row) == kind)}'
                    for kind in kinds
                )
                if len(kinds) > 1
                else ''
            )
            lines.append(
                f'| the same, all grades, {noise} noise | {BARS[noise]} |'
                f' {_percent(map(first_is_right, some))}{": " + each if each else ""} |'
            )
    if effects:
        sizes = class_sizes(effects)
        lines.append(
            '| of the right ones, told with mates that the recording cannot tell apart |  |'
            f' {_count(sizes > 1)} |'
        )
        names = sorted({row['hidden'][0] for row in effects})
        shares = {
            name: np.mean([first_is_right(row) for row in effects if row['hidden'][0] == name])
            for name in names
        }
        low = [name for name in sorted(names, key=shares.__getitem__) if shares[name] < LEAST]
        lines.append(
            f'| the same for each of the {len(names)} effects, all grades and noises together, the'
            f' worst | 85 % | {100 * min(shares.values()):.0f} %'
            + (
                f'; below 85 %: {", ".join(f"{name} {100 * shares[name]:.0f} %" for name in low)}'
                if low
                else ''
            )
            + ' |'
        )
    separating = parts.get('separating', [])
    if separating:
        lines.append(
            '| sessions made to separate a class: strictly first | as often |'
            f' {_count(map(strictly_first, separating))} |'
        )
    errors = np.abs(
        [
            e
            for row in effects + separating
            for values in row['errors_in_sd'].values()
            for e in values
        ]
    )
    if len(errors):
        lines.append(
            f'| parameters within three sd of the truth | 97 % | {100 * np.mean(errors < 3):.1f} %'
            f' of {len(errors)}; rms error {np.sqrt(np.mean(np.minimum(errors, 10) ** 2)):.2f} sd |'
        )
    levels = [row['level_error'] for row in effects if 'level_error' in row]
    if levels:
        lines.append(
            f'| saturation level within 1 % | all | {_count(level < 0.01 for level in levels)} |'
        )
    for what, told in (
        ('a finding', 'found'),
        ('"unexplained"', 'unexplained'),
        ('a formula', 'formulas'),
    ):
        each = [
            (grade, noise, [bool(row[told]) for row in some])
            for grade, noise, some in by_grade(parts.get('none', []))
        ]
        if each:
            lines.append(
                f'| nothing hidden: {what} | at most 2 % |'
                f' {_percent(value for *_, some in each for value in some)} '
                f'({"; ".join(f"{grade} {noise} {_count(some)}" for grade, noise, some in each)}) |'
            )
    outside = parts.get('outside', [])
    if outside:
        lines.append(
            '| cause outside the catalogue: the rest is significant | 95 % |'
            f' {_count(row["unexplained"] for row in outside)} |'
        )
        lines.append(
            '| cause outside the catalogue: nothing named | 80 % |'
            f' {_count(not row["found"] for row in outside)} |'
        )
    pairs = [row for row in parts.get('pairs', []) if separable(row)]
    if pairs:
        lines.append(
            f'| two effects at once, all pairs but {len(parts["pairs"]) - len(pairs)} that these'
            f' sessions cannot separate: both named | 90 % | {_percent(map(both_found, pairs))} |'
        )
        lines.append(
            '| the same: a wrong name | at most 2 % |'
            f' {_percent(bool(wrong_names(row)) for row in pairs)} |'
        )
    for factor in sorted({row['factor'] for row in parts.get('sizes', [])}):
        some = [row for row in parts['sizes'] if row['factor'] == factor]
        marked = sum(first_is_right(row) and row['implausible'][0] for row in some)
        lines.append(
            f'| {factor:g} times the smallest detectable size: first right |'
            f' {"95 %" if factor > 5 else ""} | {_percent(map(first_is_right, some))}, {marked} of'
            ' them with the mark |'
        )
    if 'traps' in parts:
        lines.append(
            '| traps that give a finding | none |'
            f' {_count(bool(row["found"]) for row in parts["traps"])} |'
        )
    ratios = [row['oracle_ratio'] for row in effects if row.get('oracle_ratio') is not None]
    if ratios:
        lines.append(
            '| held-out rms over that of a fit with the right effect alone, median (1 where'
            f' nothing else is named) | 1.02 | {np.median(ratios):.4f} ({len(ratios)} sessions) |'
        )
    if 'failed' in parts:
        lines.append(
            '| tasks or worlds that failed and are counted nowhere | none |'
            f' {len(parts["failed"])} |'
        )
    seconds = [row['seconds'] for row in rows if 'seconds' in row] or [np.nan]
    lines.append(
        '| processor time per diagnosis, five minutes at 100 Hz | 5 s, 95 % 10 s | median'
        f' {np.median(seconds):.1f} s, 95 % below {np.quantile(seconds, 0.95):.1f} s, largest'
        f' {np.max(seconds):.1f} s |'
    )
    return '\n'.join(lines)


def _sentence(rows, parts):
    effects, none, beyond = (parts.get(name, []) for name in ('effects', 'none', 'beyond'))
    hidden = [row for row in beyond if row['kind'] != beyond_catalogue.NOTHING]
    pairs = [row for row in parts.get('pairs', []) if separable(row)]
    told = [
        (
            effects,
            (
                'each cause at five times its smallest detectable size and at four grades the'
                ' hidden effect is named first, or in the class of the first finding, in'
                f' {_count(map(first_is_right, effects))}'
            ),
        ),
        (none, f'nothing hidden gave a finding in {_count(bool(row["found"]) for row in none)}'),
        (
            hidden,
            (
                'a cause that no catalogue holds was reported as unexplained in'
                f' {_count(row["flagged"] for row in hidden)} and given a name in'
                f' {_count(bool(row["found"]) for row in hidden)}'
            ),
        ),
        (pairs, f'two effects at once were both found in {_count(map(both_found, pairs))}'),
    ]
    return (
        f'Measured on {date.today().isoformat()} over {len(rows)} simulated sessions: '
        + '; '.join(text for some, text in told if some)
        + '.'
    )


def missed(parts):
    """
    Return the list of failures.

    Single effects, sessions without an effect, pairs, and the excepted pairs.
    """
    lines = ['Single effects that were not named first:', '']
    lines += [
        f'- {row["hidden"][0]}, {row["noise"]}, seed {row["seed"]}: {_outcome(row)}'
        for row in parts.get('effects', [])
        if not first_is_right(row)
    ] or ['- none']
    lines += ['', 'Sessions without an effect, with a finding:', '']
    lines += [
        f'- {row["noise"]}, seed {row["seed"]}: {_outcome(row)}'
        for row in parts.get('none', [])
        if row['found'] or row['unexplained'] or row['formulas']
    ] or ['- none']
    pairs = parts.get('pairs', [])
    lines += ['', 'Pairs without both names, or with a third:', '']
    lines += [
        f'- {" + ".join(row["hidden"])}, seed {row["seed"]}: {_outcome(row)}'
        for row in pairs
        if separable(row) and (not both_found(row) or wrong_names(row))
    ] or ['- none']
    excepted = sorted(' + '.join(row['hidden']) for row in pairs if not separable(row))
    return '\n'.join([*lines, '', f'Excepted pairs: {", ".join(excepted) or "none"}.'])


def _outcome(row):
    names = [' or '.join([name, *mates]) for name, mates in zip(row['found'], row['classes'])] or [
        'no cause named'
    ]
    return (
        ', '.join(names)
        + (', rest unexplained' if row['unexplained'] else '')
        + (f', formula {" and ".join(row["formulas"])}' if row['formulas'] else '')
    )
