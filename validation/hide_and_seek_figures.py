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
    kinds = {row['kind'] for row in rows} - {beyond_catalogue.NOTHING}
    noises = ', '.join(sorted({row['noise'] for row in rows}))
    lines = [
        f'{len(rows)} worlds of {len(kinds)} kinds, {noises} noise, seeds {seeds[0]} to'
        f' {seeds[-1]}, {date.today().isoformat()}:',
        '',
        _line('what', 'required', 'measured'),
        '| --- | --- | --- |',
    ]
    return '\n'.join(lines + [_line(*figures) for figures in beyond_catalogue.figures(rows)])


def _count(values):
    values = list(values)
    return f'{sum(values)} of {len(values)}'


def _percent(values):
    values = list(values)
    return f'{_count(values)} ({100 * np.mean(values):.1f} %)'


def _table(rows, parts):
    """Return the table of requirements and measured figures; `parts`: name -> rows of a part."""
    effects = parts.get('effects', [])
    separating = parts.get('separating', [])
    seeds = [row['seed'] for row in rows if 'seed' in row]
    lines = [
        f'{len(seeds)} sessions, seeds {min(seeds, default=0)} to {max(seeds, default=0)},'
        f' {date.today().isoformat()}, made and counted by `make hide-and-seek`:',
        '',
        _line('what', 'required', 'measured'),
        '| --- | --- | --- |',
        *_lines_by_noise(effects),
        *_lines_by_effect(effects),
    ]
    if separating:
        correct = _count(map(strictly_first, separating))
        lines.append(
            _line('sessions made to separate a class: strictly first', 'as often', correct)
        )
    lines += [
        *_lines_on_parameters(effects, separating),
        *_lines_without_effect(parts.get('none', []), parts.get('outside', [])),
        *_lines_on_pairs(parts.get('pairs', [])),
        *_lines_by_size(parts.get('sizes', [])),
    ]
    if 'traps' in parts:
        n_found = _count(bool(row['found']) for row in parts['traps'])
        lines.append(_line('traps that give a finding', 'none', n_found))
    ratios = [row['oracle_ratio'] for row in effects if row.get('oracle_ratio') is not None]
    if ratios:
        lines.append(
            _line(
                'held-out rms over that of a fit with the right effect alone, median (1 where'
                ' nothing else is named)',
                '1.02',
                f'{np.median(ratios):.4f} ({len(ratios)} sessions)',
            )
        )
    if 'failed' in parts:
        what = 'tasks or worlds that failed and are counted nowhere'
        lines.append(_line(what, 'none', len(parts['failed'])))
    seconds = [row['seconds'] for row in rows if 'seconds' in row] or [np.nan]
    lines.append(
        _line(
            'processor time per diagnosis, five minutes at 100 Hz',
            '5 s, 95 % 10 s',
            f'median {np.median(seconds):.1f} s, 95 % below {np.quantile(seconds, 0.95):.1f} s,'
            f' largest {np.max(seconds):.1f} s',
        )
    )
    return '\n'.join(lines)


def _line(what, required, measured):
    """Return one line of a table in Markdown."""
    return f'| {what} | {required} | {measured} |'


def _lines_by_noise(effects):
    """Return the lines on single effects: by grade and noise, then over all grades."""
    lines = []
    for grade, noise, group in by_grade(effects):
        alone = _count(len(row['found']) == 1 for row in group)
        lines.append(
            _line(
                'hidden effect first, or in the class of the first finding,'
                f' {grade} grade, {noise} noise',
                BARS[noise],
                f'{_percent(map(first_is_right, group))} (strictly first'
                f' {_count(map(strictly_first, group))}; nothing else named {alone})',
            )
        )
    for noise in BARS:
        group = []
        for _, group_noise, group_rows in by_grade(effects):
            if group_noise == noise:
                group += group_rows
        if not group:
            continue
        measured = _percent(map(first_is_right, group))
        kinds = sorted(set(map(kind_of, group)))
        if len(kinds) > 1:
            counts = []
            for kind in kinds:
                correct = _count(first_is_right(row) for row in group if kind_of(row) == kind)
                counts.append(f'{kind} {correct}')
            measured += f': {"; ".join(counts)}'
        lines.append(_line(f'the same, all grades, {noise} noise', BARS[noise], measured))
    return lines


def _lines_by_effect(effects):
    """Return the lines on classes of collinear effects, and on the effect named least often."""
    if not effects:
        return []
    correct_by_name = {}
    for row in effects:
        correct_by_name.setdefault(row['hidden'][0], []).append(first_is_right(row))
    shares = {name: np.mean(correct_by_name[name]) for name in sorted(correct_by_name)}
    low = [
        f'{name} {100 * shares[name]:.0f} %'
        for name in sorted(shares, key=shares.__getitem__)
        if shares[name] < LEAST
    ]
    worst = f'{100 * min(shares.values()):.0f} %'
    if low:
        worst += f'; below 85 %: {", ".join(low)}'
    return [
        _line(
            'of the right ones, told with mates that the recording cannot tell apart',
            '',
            _count(class_sizes(effects) > 1),
        ),
        _line(
            f'the same for each of the {len(shares)} effects, all grades and noises together, the'
            ' worst',
            '85 %',
            worst,
        ),
    ]


def _lines_on_parameters(effects, separating):
    """Return the lines on the errors of estimated parameters."""
    errors = []
    for row in effects + separating:
        for values in row['errors_in_sd'].values():
            errors += values
    errors = np.abs(errors)
    lines = []
    if len(errors):
        rms = np.sqrt(np.mean(np.minimum(errors, 10) ** 2))
        lines.append(
            _line(
                'parameters within three sd of the truth',
                '97 %',
                f'{100 * np.mean(errors < 3):.1f} % of {len(errors)}; rms error {rms:.2f} sd',
            )
        )
    levels = [row['level_error'] for row in effects if 'level_error' in row]
    if levels:
        correct = _count(level < 0.01 for level in levels)
        lines.append(_line('saturation level within 1 %', 'all', correct))
    return lines


def _lines_without_effect(none, outside):
    """Return the lines on sessions without a hidden effect, and with a cause of no catalogue."""
    lines = []
    for what, key in (
        ('a finding', 'found'),
        ('"unexplained"', 'unexplained'),
        ('a formula', 'formulas'),
    ):
        false_alarms = []
        counts = []
        for grade, noise, group in by_grade(none):
            of_group = [bool(row[key]) for row in group]
            false_alarms += of_group
            counts.append(f'{grade} {noise} {_count(of_group)}')
        if counts:
            measured = f'{_percent(false_alarms)} ({"; ".join(counts)})'
            lines.append(_line(f'nothing hidden: {what}', 'at most 2 %', measured))
    if outside:
        cause = 'cause outside the catalogue:'
        significant = _count(row['unexplained'] for row in outside)
        unnamed = _count(not row['found'] for row in outside)
        lines.append(_line(f'{cause} the rest is significant', '95 %', significant))
        lines.append(_line(f'{cause} nothing named', '80 %', unnamed))
    return lines


def _lines_on_pairs(all_pairs):
    """Return the lines on two effects at once."""
    pairs = [row for row in all_pairs if separable(row)]
    if not pairs:
        return []
    return [
        _line(
            f'two effects at once, all pairs but {len(all_pairs) - len(pairs)} that these'
            ' sessions cannot separate: both named',
            '90 %',
            _percent(map(both_found, pairs)),
        ),
        _line(
            'the same: a wrong name',
            'at most 2 %',
            _percent(bool(wrong_names(row)) for row in pairs),
        ),
    ]


def _lines_by_size(sizes):
    """Return the lines on effects of several sizes."""
    lines = []
    for factor in sorted({row['factor'] for row in sizes}):
        group = [row for row in sizes if row['factor'] == factor]
        marked = sum(first_is_right(row) and row['implausible'][0] for row in group)
        lines.append(
            _line(
                f'{factor:g} times the smallest detectable size: first right',
                '95 %' if factor > 5 else '',
                f'{_percent(map(first_is_right, group))}, {marked} of them with the mark',
            )
        )
    return lines


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
