"""
Sections of hide and seek.

Grades and kinds of noise, all pairs of effects at once, and effects from the smallest detectable
size to a hundred times it.
"""

import numpy as np


def share_of(values):
    """Return how many of some truths hold, as text."""
    values = list(values)
    return f'{sum(values)}/{len(values)} ({100 * np.mean(values):.1f} %)' if values else 'none'


def grade_of(row):
    """Return the grade of the sensors of a row."""
    return row['noise'].partition('@')[2] or 'industrial'


def kind_of(row):
    """Return the kind of noise of a row, without the grade."""
    return row['noise'].partition('@')[0]


def by_grade(rows):
    """
    Yield (grade, 'white' or 'realistic', rows), the largest noise first.

    Every kind but white is realistic.
    """
    order = ('consumer', 'industrial', 'tactical', 'navigation')
    for white in (True, False):
        for grade in order:
            some = [
                row for row in rows if grade_of(row) == grade and (kind_of(row) == 'white') == white
            ]
            if some:
                yield grade, 'white' if white else 'realistic', some


def both_found(row):
    """Return whether each hidden effect has a finding of its own, by name or in its class."""
    return len(_owners(row)) == len(row['hidden'])


def wrong_names(row):
    """
    Return the findings that are no hidden effect, and stand for none by their class.

    The class of each holds no hidden effect that lacks a finding of its own.
    """
    owned = set(_owners(row).values())
    return [
        name for k, name in enumerate(row['found']) if k not in owned and name not in row['hidden']
    ]


def _owners(row):
    """
    Return hidden effect -> number of its finding, as many as can be had with one each.

    By name first, then by class.
    """
    owners = {name: row['found'].index(name) for name in row['hidden'] if name in row['found']}
    for name in row['hidden']:
        free = [
            k
            for k, mates in enumerate(row['classes'])
            if name in mates and k not in owners.values()
        ]
        if name not in owners and free:
            owners[name] = free[0]
    return owners


def separable(row):
    """
    Return whether the session shows each of the two where the other one may take any value.

    At least its smallest detectable size is left.
    """
    return min(row.get('beside', {}).values(), default=np.inf) >= 1.0


def print_pairs(rows):
    """
    Print how many pairs were found, which not, and which no search can find in these sessions.
    """
    if not rows:
        return
    asked, excepted = (
        [row for row in rows if separable(row)],
        [row for row in rows if not separable(row)],
    )
    print(
        '\nall pairs at five times the smallest detectable size: both named'
        f' {share_of(map(both_found, asked))}; a wrong name'
        f' {share_of(bool(wrong_names(row)) for row in asked)}'
    )
    for row in asked:
        if not both_found(row) or wrong_names(row):
            print(f'  {row["hidden"]} seed {row["seed"]}: {row["found"]} {row["classes"]}')
    if excepted:
        print(
            'excepted, for less than the smallest detectable size of a member is left beside the'
            f' other: {len(excepted)}, of which both named {share_of(map(both_found, excepted))}; a'
            f' wrong name {share_of(bool(wrong_names(row)) for row in excepted)}'
        )
        for row in excepted:
            print(
                f'  {" + ".join(row["hidden"])}: '
                + ', '.join(
                    f'{name} {left:.2f}'
                    for name, left in row['beside'].items()
                    if np.isfinite(left)
                )
            )


def print_sizes(rows):
    """
    Print by size how often the first finding is right.

    Also print how often it carries the mark of an implausible size.
    """
    if not rows:
        return
    print(
        '\nsize (in smallest detectable sizes): first finding right or in its class, of these with'
        ' the mark, a wrong name'
    )
    for factor in sorted({row['factor'] for row in rows}):
        some = [row for row in rows if row['factor'] == factor]
        right = [
            bool(row['found']) and row['hidden'][0] in [row['found'][0], *row['classes'][0]]
            for row in some
        ]
        marked = sum(good and row['implausible'][0] for good, row in zip(right, some))
        print(
            f'  {factor:5g}: {share_of(right)}, {marked} marked,'
            f' {share_of(bool(wrong_names(row)) for row in some)}'
        )
        for row, good in zip(some, right):
            if not good and factor > 1:
                print(f'         {row["hidden"][0]} seed {row["seed"]}: {row["found"]}')
