"""
How hide and seek counts: who found what, which pairs no search can find, and what detectable means.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from validation.hide_and_seek_figures import missed
from validation.hide_and_seek_sections import (
    both_found,
    by_grade,
    print_pairs,
    print_sizes,
    separable,
    wrong_names,
)

from worlds.hide_and_seek_worlds import (
    GRADES,
    REALISTIC,
    _each,
    effects_of_seed,
    pairs_of_seed,
    run,
    tasks_of,
)
from worlds.hiding import passing, threshold_noncentrality


def row(hidden, found, classes=None, **more):
    return {
        'hidden': hidden,
        'found': found,
        'classes': classes or [[] for _ in found],
        'implausible': [False] * len(found),
        'seed': 1,
        **more,
    }


@pytest.mark.parametrize(
    ('hidden', 'found', 'classes', 'both', 'wrong'),
    (
        (['a', 'b'], ['b', 'a'], None, True, []),
        (['a', 'b'], ['c', 'a'], [['b'], []], True, []),
        (['a', 'b'], ['c'], [['a', 'b']], False, []),
        (['a', 'b'], ['a', 'c'], [['b'], []], False, ['c']),
        (['a', 'b'], ['a'], [['b']], False, []),
        (['a', 'b'], ['a', 'b', 'c'], [[], [], []], True, ['c']),
    ),
)
def test_each_hidden_effect_needs_a_finding_of_its_own(hidden, found, classes, both, wrong):
    assert (both_found(row(hidden, found, classes)), wrong_names(row(hidden, found, classes))) == (
        both,
        wrong,
    )


def test_pairs_that_hide_each_other_are_excepted_and_listed(capsys):
    rows = [
        row(['a', 'b'], ['a', 'b'], beside={'a': 4.0, 'b': np.inf}),
        row(['a', 'c'], ['a'], beside={'a': 4.0, 'c': 0.5}),
    ]
    assert [separable(each) for each in rows] == [True, False]
    print_pairs(rows)
    told = capsys.readouterr().out
    assert 'both named 1/1' in told and 'a + c: a 4.00, c 0.50' in told


def test_sizes_say_how_many_sessions_and_marks_a_point_has(capsys):
    print_sizes(
        [row(['a'], ['a'], factor=20.0) | {'implausible': [True]}, row(['b'], [], factor=20.0)]
    )
    assert '20: 1/2 (50.0 %), 1 marked' in capsys.readouterr().out


@pytest.mark.parametrize('n_parameters', (1, 9))
def test_detectable_is_what_passes_half_of_the_time(n_parameters):
    """
    More than the chi-square test alone asks for.

    The held-out gain has a least value and a cost for each parameter.
    """
    size = threshold_noncentrality(n_parameters, 50)
    assert 0.45 < passing(size, n_parameters, 50).mean() < 0.55
    assert (
        passing(0.5 * size, n_parameters, 50).mean() < 0.2
        and passing(4 * size, n_parameters, 50).mean() > 0.99
    )


def asked(**more):
    return tasks_of(
        SimpleNamespace(
            **{
                'seeds': 1,
                'first_seed': 1,
                'effects': None,
                'parts': ('effects', 'pairs'),
                'grades': GRADES,
                'noise': None,
                'pairs': None,
            }
            | more
        )
    )


def test_every_effect_is_hidden_once_at_each_grade_in_white_and_in_realistic_noise():
    singles = [
        (noise, name)
        for function, (_, noise, names) in asked()
        if function is effects_of_seed
        for name in names
    ]
    for grade in GRADES:
        of = {
            white: [
                name
                for noise, name in singles
                if noise.endswith(grade) and noise.startswith('white') == white
            ]
            for white in (True, False)
        }
        assert sorted(of[True]) == sorted(of[False]) and len(set(of[True])) == len(of[True]) > 30
    assert {noise.partition('@')[0] for noise, _ in singles} == {'white', *REALISTIC}


def test_sessions_have_seeds_of_their_own_and_a_run_cut_short_has_some_of_each_part():
    tasks = asked(pairs=80)
    assert len({arguments[0] for _, arguments in tasks}) == len(tasks)
    assert (
        sum(len(arguments[2]) for function, arguments in tasks if function is pairs_of_seed) == 80
    )
    assert {function for function, _ in tasks[:6]} == {effects_of_seed, pairs_of_seed}


def test_a_world_that_fails_is_a_row_and_costs_no_other():
    rows = _each([1, 0, 2], lambda case: {'part': 'x', 'value': 2 // case}, 'what')
    assert [row['part'] for row in rows] == ['x', 'failed', 'x'] and 'ZeroDivisionError' in rows[1][
        'why'
    ]
    (row,) = run((lambda seed, noise: 1 / 0, (1, 'white')))
    assert row['part'] == 'failed'


def test_rows_are_told_by_grade_and_what_was_missed_is_listed():
    rows = [
        row(['a'], ['a'], noise=noise, unexplained=False, formulas=[])
        for noise in ('white@navigation', 'steps@consumer', 'white', 'flicker@consumer')
    ]
    assert [(grade, noise, len(some)) for grade, noise, some in by_grade(rows)] == [
        ('industrial', 'white', 1),
        ('navigation', 'white', 1),
        ('consumer', 'realistic', 2),
    ]
    wrong = row(['a'], ['b'], [['c']], noise='steps@tactical', unexplained=True, formulas=[])
    text = missed(
        {'effects': [*rows, wrong], 'pairs': [wrong | {'hidden': ['a', 'd'], 'beside': {'a': 0.5}}]}
    )
    assert (
        '- a, steps@tactical, seed 1: b or c, rest unexplained' in text
        and text.count('- none') == 2
        and text.endswith('Excepted pairs: a + d.')
    )
