"""
Regimes of a residual.

Bounds between rows, the permutation test, smooth curves, and which of several regimes is reported.
"""

import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest

from imu_calibration.estimation.noise_model import BiasProcess
from imu_calibration.references.turntable.residuals import window_regimes
from imu_calibration.references.turntable.residuals.residual_blocks import BlockFits, RestBlocks
from imu_calibration.selection import regimes
from imu_calibration.selection.regime_variables import Variable, ranged
from imu_calibration.selection.stamp_jitter import StampJitter

WINDOWS, EACH = 60, 4
TIME = np.arange(WINDOWS * EACH, dtype=float)
WINDOW = np.repeat(np.arange(WINDOWS), EACH)
STARTS = np.arange(len(TIME))


def blocks_of(rest, rough, locked=np.zeros(len(TIME), bool)):
    """Return the blocks of a residual with a bias as the only parameter."""
    return RestBlocks(
        'gyroscope',
        SimpleNamespace(rate_s=np.ones((len(TIME), 3))),
        starts=STARTS,
        time=TIME,
        window=WINDOW,
        locked=locked,
        design=tuple(np.stack([np.ones(len(TIME)), column], axis=1) for column in rest.T),
        index=tuple(np.zeros((3, 1), int)),
        variance=np.ones((len(TIME), 3)),
        processes=(BiasProcess(0.5, 100.0),),
        rough=rough,
        freedom=np.full(len(TIME), 12.0),
        jitter=StampJitter(0.0, False),
    )


def found_in(monkeypatch, rest_of_x, rough_of_x=1.0):
    """
    Return the regimes by time of a residual of unit noise on three axes.

    With an addition to x, and of the variance within blocks.
    """
    rng = np.random.default_rng(4)
    rest = rng.normal(size=(len(TIME), 3))
    rest[:, 0] += rest_of_x
    rough = rng.chisquare(12.0, size=rest.shape) / 12.0
    rough[:, 0] *= rough_of_x
    blocks = blocks_of(rest, rough)
    monkeypatch.setattr(
        window_regimes,
        'variables_of',
        lambda blocks, names: ranged('time', TIME, 's', starts=STARTS),
    )
    problem = SimpleNamespace(
        space=SimpleNamespace(prior_sd=np.array([100.0]), prior_mean=np.zeros(1)),
        recording=SimpleNamespace(kind=np.array(['swing'] * WINDOWS)),
    )
    return window_regimes.find_regimes(blocks, problem, [0], joint_names=())


@pytest.mark.parametrize('first', [122, 127])
def test_a_step_is_found_to_the_block_whichever_window_it_is_in(monkeypatch, first):
    """
    Bins of ten blocks end at 119 and 129; one window on the wrong side leaves all of the step.
    """
    found = found_in(monkeypatch, 30.0 * (TIME >= first))
    assert found[0].offset and found[0].bounds[0] == first - 0.5 and found[0].share > 0.95
    assert found[0].size == pytest.approx(30.0, abs=2.0) and {regime.axis for regime in found} == {
        'x'
    }


def test_a_time_of_larger_scatter_is_found_with_its_size(monkeypatch):
    """Variances of 12 degrees of freedom scatter by 41 %."""
    (found,) = found_in(monkeypatch, 0.0, np.where((TIME >= 80) & (TIME < 140), 4.0, 1.0))
    assert (
        not found.offset
        and found.bounds == pytest.approx((80.0, 140.0), abs=10.0)
        and found.share > 0.8
    )
    assert found.size == pytest.approx(np.sqrt(3.0), rel=0.2)


def test_noise_has_no_regime(monkeypatch):
    assert not found_in(monkeypatch, 0.0)


def test_a_smooth_curve_is_no_place(monkeypatch):
    assert not found_in(monkeypatch, 30.0 * np.sin(TIME / 50.0))
    assert not found_in(monkeypatch, 0.0, np.exp(3.0 * TIME / len(TIME)))


def test_a_formula_that_explains_as_much_is_no_place(monkeypatch):
    step = 30.0 * (TIME >= 122)
    rows = np.stack(
        [np.ones(len(TIME)), step + np.random.default_rng(4).normal(size=len(TIME))], axis=1
    )
    exchange = regimes.exchanges(WINDOW, np.zeros(len(TIME)), np.ones(len(TIME)))
    search = regimes.RegimeSearch(
        'gyroscope', TIME, ranged('time', TIME, 's', starts=STARTS), exchange=exchange
    )
    rest = regimes.AxisResidual(rows, np.zeros(1), np.zeros(1))
    assert search.offsets('x', rest, np.asarray, level=0.05)
    assert not search.offsets('x', rest, np.asarray, level=0.05, formula=step[:, None])


def test_offsets_of_random_windows_are_no_place(monkeypatch):
    """
    Heavy-tailed residuals of whole windows.

    A few windows have most of it, and some range holds them.
    """
    rng = np.random.default_rng(7)
    found = [
        found_in(monkeypatch, 30.0 * np.repeat(rng.standard_t(2, WINDOWS), EACH)) for _ in range(10)
    ]
    assert sum(map(bool, found)) <= 1


def test_windows_exchange_their_residuals_within_kind_and_intensity():
    kind, speed = np.repeat(['static', 'swing'], 120), np.repeat(np.arange(WINDOWS) * 0.1, EACH)
    exchange = regimes.exchanges(WINDOW, kind, speed)
    assert (kind[exchange] == kind).all()
    third = np.arange(30) // 10
    assert (third[WINDOW[exchange[:, 120:]] - 30] == third[WINDOW[120:] - 30]).all()
    assert (np.sort(exchange, axis=1) == np.arange(len(TIME))).all() and (
        exchange != np.arange(len(TIME))
    ).mean() > 0.8


def test_of_what_scatters_the_shortest_part_that_holds_nearly_all_is_told():
    excess = np.array([0.0, 1.0, 30.0, 60.0, 8.0, 1.0, 500.0])
    assert regimes._tightened([1, 2, 3, 4, 5], excess) == [2, 3, 4]


@pytest.mark.parametrize(
    ('excess', 'axes'),
    [
        ((90.0, 309.0, 42.0), ('y',)),
        ((900.0, 309.0, 42.0), ('x', 'y')),
        ((20.0, 3.0, 0.0), ('x',)),
        ((0.0,) * 3, ()),
    ],
)
def test_an_axis_carries_a_rest_that_is_above_noise_or_the_strongest(excess, axes):
    fits = BlockFits.__new__(BlockFits)
    fits.blocks = SimpleNamespace(variance=np.ones((600, 3)), locked=np.zeros(600, bool))
    fits._excess = lambda: np.array(excess)
    assert fits.axes() == axes


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


def test_fits_of_all_choices_share_the_factors_of_the_noise():
    """A factor has the square of the number of blocks; every finding has a fit without it."""
    blocks = blocks_of(
        np.random.default_rng(4).normal(size=(len(TIME), 3)),
        np.ones((len(TIME), 3)),
        WINDOW % 4 == 0,
    )
    tracemalloc.start()
    try:
        fits = [
            BlockFits(blocks, used, prior_sd=np.array([100.0]), prior_mean=np.zeros(1))
            for used in ((), (0,), (), (0,), (), (0,))
        ]
        kept = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    square = 8 * sum(int(mask.sum()) ** 2 for mask in (blocks.locked, ~blocks.locked))
    assert square < kept < 2 * square
    assert (
        fits[1].fit().excess
        == BlockFits(blocks, (0,), prior_sd=np.array([100.0]), prior_mean=np.zeros(1)).fit().excess
    )
