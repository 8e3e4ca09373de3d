"""How hide and seek counts: who found what, which pairs no search can find, and what detectable means."""

import numpy as np
import pytest

from worlds.hide_and_seek_sections import both_found, print_pairs, print_sizes, separable, wrong_names
from worlds.hiding import passing, threshold_noncentrality


def row(hidden, found, classes=None, **more):
    return {'hidden': hidden, 'found': found, 'classes': classes or [[] for _ in found], 'implausible': [False] * len(found), 'seed': 1, **more}


@pytest.mark.parametrize(('hidden', 'found', 'classes', 'both', 'wrong'), (
    (['a', 'b'], ['b', 'a'], None, True, []),
    (['a', 'b'], ['c', 'a'], [['b'], []], True, []),
    (['a', 'b'], ['c'], [['a', 'b']], False, []),
    (['a', 'b'], ['a', 'c'], [['b'], []], False, ['c']),
    (['a', 'b'], ['a'], [['b']], False, []),
    (['a', 'b'], ['a', 'b', 'c'], [[], [], []], True, ['c']),
))
def test_each_hidden_effect_needs_a_finding_of_its_own(hidden, found, classes, both, wrong):
    assert (both_found(row(hidden, found, classes)), wrong_names(row(hidden, found, classes))) == (both, wrong)


def test_pairs_that_hide_each_other_are_excepted_and_listed(capsys):
    rows = [row(['a', 'b'], ['a', 'b'], beside={'a': 4.0, 'b': np.inf}), row(['a', 'c'], ['a'], beside={'a': 4.0, 'c': 0.5})]
    assert [separable(each) for each in rows] == [True, False]
    print_pairs(rows)
    told = capsys.readouterr().out
    assert 'both named 1/1' in told and 'a + c: a 4.00, c 0.50' in told


def test_sizes_say_how_many_sessions_and_marks_a_point_has(capsys):
    print_sizes([row(['a'], ['a'], factor=20.0) | {'implausible': [True]}, row(['b'], [], factor=20.0)])
    assert '20: 1/2 (50.0 %), 1 marked' in capsys.readouterr().out


@pytest.mark.parametrize('n_parameters', (1, 9))
def test_detectable_is_what_passes_half_of_the_time(n_parameters):
    """More than the chi-square test alone asks for: the held-out gain has a least value and a cost for each parameter."""
    size = threshold_noncentrality(n_parameters, 50)
    assert 0.45 < passing(size, n_parameters, 50).mean() < 0.55
    assert passing(0.5 * size, n_parameters, 50).mean() < 0.2 and passing(4 * size, n_parameters, 50).mean() > 0.99
