"""
The record of hide and seek is kept small and compared row by row; its figures count what they say.
"""

from worlds.beyond_catalogue import NOTHING, figures, missed
from worlds.hide_and_seek_record import KEPT, differences, keep, read

ROW = {
    'part': 'effects',
    'hidden': ['accel_cubic'],
    'seed': 1,
    'noise': 'white',
    'found': ['accel_cubic'],
    'classes': [[]],
    'seconds': 1.23456,
}
WORLD = {
    'part': 'beyond',
    'seed': 1,
    'noise': 'realistic',
    'seconds': 2.0,
    'found': [],
    'formulas': [],
}


def test_a_record_keeps_what_was_told_and_the_rows_of_other_runs(tmp_path):
    path = tmp_path / 'record.jsonl.gz'
    keep([ROW, {'part': 'failed', 'what': 'x', 'why': 'y'}], path)
    first = path.read_bytes()
    keep([ROW], path)
    assert path.read_bytes() == first and read(path) == [ROW | {'seconds': 1.23}]
    keep([ROW | {'seed': 2}, ROW | {'found': []}], path)
    assert [(row['seed'], row['found']) for row in read(path)] == [(1, []), (2, ['accel_cubic'])]


def test_only_what_is_told_otherwise_of_the_same_session_differs():
    assert differences([ROW | {'seconds': 9.0}, ROW | {'seed': 3, 'found': []}], [ROW]) == []
    (line,) = differences([ROW | {'found': ['accel_quadratic']}], [ROW])
    assert line == "effects ['accel_cubic'] 1 white: found ['accel_cubic'] -> ['accel_quadratic']"


def test_the_record_in_the_repository_can_be_read():
    rows = read()
    assert (
        rows
        and KEPT.stat().st_size < 200_000
        and {'part', 'seed', 'noise', 'found'} <= set(rows[0])
    )
    assert differences(rows, rows) == []


def test_figures_of_worlds_beyond_the_catalogue():
    good = WORLD | {
        'kind': 'cogging',
        'flagged': True,
        'axis': True,
        'family': True,
        'reduction': 0.8,
        'known_bias': 0.3,
    }
    bad = WORLD | {
        'kind': 'knock',
        'flagged': False,
        'axis': False,
        'f1': 0.5,
        'known_bias': 0.4,
        'found': ['accel_cubic'],
    }
    told = {what: measured for what, _, measured in figures([good, bad, WORLD | {'kind': NOTHING}])}
    assert (
        told['the rest is flagged'] == '1 of 2'
        and told['right family of regressor'] == '1 of 1'
        and told['a false name'] == '1 of 2'
    )
    assert (
        told['F1 of the place, mean'] == '0.50 of 1'
        and told['nothing hidden: a formula'] == '0 of 1'
    )
    assert told['what the cause moves biases and matrices by, rms'].startswith('0.354 sd')
    (line,) = missed([good, bad, WORLD | {'kind': NOTHING}])
    assert 'knock seed 1: not flagged, axis, place 0.50' in line
