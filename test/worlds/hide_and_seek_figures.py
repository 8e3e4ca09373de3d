"""The figures of hide and seek as text: the table in docs/hide-and-seek.md and the sentence in the README, written from the record."""

import re
from datetime import date

import numpy as np

from worlds import beyond_catalogue
from worlds.hide_and_seek_report import class_sizes, first_is_right, strictly_first
from worlds.hide_and_seek_sections import both_found, separable, wrong_names

MARKS = ('<!-- {}: begin -->', '<!-- {}: end -->')


def write_figures(rows, docs):
    """Put the figures of a record between the marks in docs/hide-and-seek.md and README.md; other text stays."""
    parts = {}
    for row in rows:
        parts.setdefault(row['part'], []).append(row)
    _replace(docs / 'hide-and-seek.md', _table(rows, parts))
    if 'beyond' in parts:
        _replace(docs / 'hide-and-seek.md', beyond_table(parts['beyond']), 'beyond')
    _replace(docs.parent / 'README.md', _sentence(rows, parts))


def _replace(path, text, what='figures'):
    begin, end = (mark.format(what) for mark in MARKS)
    if path.exists() and begin in path.read_text():
        whole = re.sub(f'{begin}.*{end}', lambda match: f'{begin}\n{text}\n{end}', path.read_text(), flags=re.DOTALL)
        beside = path.with_suffix('.new')
        beside.write_text(whole)
        beside.replace(path)


def beyond_table(rows):
    """Return the table of the worlds beyond the catalogue."""
    seeds = sorted({row['seed'] for row in rows})
    lines = [f'{len(rows)} worlds of {len({row["kind"] for row in rows} - {beyond_catalogue.NOTHING})} kinds, {", ".join(sorted({row["noise"] for row in rows}))} noise, '
             f'seeds {seeds[0]} to {seeds[-1]}, {date.today().isoformat()}:', '', '| what | required | measured |', '| --- | --- | --- |']
    return '\n'.join(lines + [f'| {what} | {required} | {measured} |' for what, required, measured in beyond_catalogue.figures(rows)])


def _count(values):
    values = list(values)
    return f'{sum(values)} of {len(values)}'


def _table(rows, parts):
    effects = parts.get('effects', [])
    lines = [f'{len(rows)} sessions, {date.today().isoformat()}, made and counted by `make hide-and-seek`:', '', '| what | required | measured |', '| --- | --- | --- |']
    for noise in sorted({row['noise'] for row in effects}, reverse=True):
        some = [row for row in effects if row['noise'] == noise]
        lines.append(f'| hidden effect first, or in the class of the first finding, {noise} noise | 97 % | {_count(map(first_is_right, some))} '
                     f'(strictly first {_count(map(strictly_first, some))}; nothing else named {_count(len(row["found"]) == 1 for row in some)}) |')
    if effects:
        sizes = class_sizes(effects)
        lines.append(f'| of the right ones, told with mates that the recording cannot tell apart |  | {_count(sizes > 1)} |')
        names = sorted({row['hidden'][0] for row in effects})
        shares = {name: np.mean([first_is_right(row) for row in effects if row['hidden'][0] == name]) for name in names}
        worst = min(names, key=shares.get)
        lines.append(f'| the same for each of the {len(names)} effects, the worst | 85 % | {100 * shares[worst]:.0f} %'
                     + (f' ({worst})' if shares[worst] < 1 else '') + ' |')
    separating = parts.get('separating', [])
    if separating:
        lines.append(f'| sessions made to separate a class: strictly first | as often | {_count(map(strictly_first, separating))} |')
    errors = np.abs([e for row in effects + separating for values in row['errors_in_sd'].values() for e in values])
    if len(errors):
        lines.append(f'| parameters within three sd of the truth | 97 % | {100 * np.mean(errors < 3):.1f} % of {len(errors)}; '
                     f'rms error {np.sqrt(np.mean(np.minimum(errors, 10)**2)):.2f} sd |')
    levels = [row['level_error'] for row in effects if 'level_error' in row]
    if levels:
        lines.append(f'| saturation level within 1 % | all | {_count(level < 0.01 for level in levels)} |')
    for noise in sorted({row['noise'] for row in parts.get('none', [])}, reverse=True):
        lines.append(f'| a finding where nothing is hidden, {noise} noise | at most 2 of 60 | '
                     f'{_count(bool(row["found"]) for row in parts["none"] if row["noise"] == noise)} |')
    outside = parts.get('outside', [])
    if outside:
        lines.append(f'| cause outside the catalogue: the rest is significant | 95 % | {_count(row["unexplained"] for row in outside)} |')
        lines.append(f'| cause outside the catalogue: nothing named | 80 % | {_count(not row["found"] for row in outside)} |')
    pairs = [row for row in parts.get('pairs', []) if separable(row)]
    if pairs:
        lines.append(f'| two effects at once, all pairs but {len(parts["pairs"]) - len(pairs)} that these sessions cannot separate: both named | 90 % | {_count(map(both_found, pairs))} |')
        lines.append(f'| the same: a wrong name | 2 % | {_count(bool(wrong_names(row)) for row in pairs)} |')
    for factor in sorted({row['factor'] for row in parts.get('sizes', []) if row['factor'] > 5}):
        some = [row for row in parts['sizes'] if row['factor'] == factor]
        lines.append(f'| {factor:g} times the smallest detectable size: first right | 95 % | {_count(map(first_is_right, some))} |')
    if 'traps' in parts:
        lines.append(f'| traps that give a finding | none | {_count(bool(row["found"]) for row in parts["traps"])} |')
    ratios = [row['oracle_ratio'] for row in effects if row.get('oracle_ratio') is not None]
    if ratios:
        lines.append(f'| held-out rms over that of a fit with the right effect alone, median (1 where nothing else is named) | 1.02 | {np.median(ratios):.4f} ({len(ratios)} sessions) |')
    seconds = [row['seconds'] for row in rows if 'seconds' in row] or [np.nan]
    lines.append(f'| processor time per diagnosis, five minutes at 100 Hz | 5 s | median {np.median(seconds):.1f} s, 95 % below '
                 f'{np.quantile(seconds, 0.95):.1f} s, largest {np.max(seconds):.1f} s |')
    return '\n'.join(lines)


def _sentence(rows, parts):
    effects, outside = parts.get('effects', []), parts.get('outside', [])
    none = parts.get('none', [])
    return (f'Measured on {date.today().isoformat()} over {len(rows)} simulated sessions, each cause at five times its smallest detectable size: the hidden effect is named first, or in the '
            f'class of the first finding, in {_count(map(first_is_right, effects))}; nothing hidden gave a finding in {_count(bool(row["found"]) for row in none)}; a cause '
            f'that no catalogue holds was reported as unexplained in {_count(row["unexplained"] for row in outside)} and given a name in '
            f'{_count(bool(row["found"]) for row in outside)}; two effects at once were both found in {_count(map(both_found, parts.get("pairs", [])))}.')
