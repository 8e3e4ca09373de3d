"""Ranges of a variable: cyclic ones, open ends, and blocks that lie in two of them."""

import numpy as np

from imu_calibration.selection.regime_variables import Variable, ranged

TIME = np.arange(240.0)
STARTS = np.arange(len(TIME))


def test_an_angle_may_begin_beyond_where_it_ends_and_the_ends_of_all_values_are_open():
    turn = Variable(
        'angle',
        np.arange(24),
        np.linspace(0, 360, 25),
        True,
        None,
        np.arange(24) * 15.0,
        np.arange(24),
    )
    assert np.flatnonzero(turn.inside(345.0, 15.0)).tolist() == [0, 23] and turn.chosen(
        np.isin(np.arange(24), [22, 23, 0])
    ) == [22, 23, 0]
    (line,) = ranged('time', TIME, 's', starts=STARTS)
    assert (
        line.inside(line.edges[0] + 1e-4 - 1e-4, 100.0).sum() == 100
        and line.inside(200.0, line.edges[-1]).sum() == 40
    )
    assert line.near([0, 1], 0) == [] and all(9 < place < 30 for place in line.near([0, 1], 1))


def test_a_block_counts_by_the_share_of_its_rows_inside():
    (line,) = ranged('time', TIME, 's', starts=STARTS[::4])
    assert line.inside(0.0, 2.0)[:2].tolist() == [0.5, 0.0] and line.marks.sum() == len(TIME) / 4
