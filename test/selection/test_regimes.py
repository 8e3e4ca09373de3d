"""Where a rest sits: bounds between blocks, the shortest part of what scatters, and which of several places is told."""

from types import SimpleNamespace

import numpy as np
import pytest

from imu_calibration.estimation.noise_model import BiasProcess
from imu_calibration.selection import regimes
from imu_calibration.selection.regime_variables import Variable, ranged
from imu_calibration.selection.residual_blocks import RestBlocks
from imu_calibration.selection.residual_fit import BlockFits

WINDOWS, EACH = 60, 4
TIME = np.arange(WINDOWS * EACH, dtype=float)
WINDOW = np.repeat(np.arange(WINDOWS), EACH)


def found_in(monkeypatch, rest_of_x):
    """Return the regimes by time of a rest of unit noise on three axes, to which one is added on x."""
    rest = np.random.default_rng(4).normal(size=(len(TIME), 3))
    rest[:, 0] += rest_of_x
    blocks = RestBlocks('gyroscope', None, starts=np.arange(len(TIME)), time=TIME, window=WINDOW, locked=np.zeros(len(TIME), bool),
                        design=tuple(np.stack([np.ones(len(TIME)), column], axis=1) for column in rest.T), index=tuple(np.zeros((3, 1), int)),
                        variance=np.ones((len(TIME), 3)), processes=(BiasProcess(0.5, 100.0),))
    monkeypatch.setattr(regimes, 'variables_of', lambda blocks, names: ranged('time', TIME, 's'))
    attempt = SimpleNamespace(space=SimpleNamespace(prior_sd=np.array([100.0]), prior_mean=np.zeros(1)))
    return regimes.find_regimes(blocks, attempt, [0], joint_names=())


@pytest.mark.parametrize('first', [122, 127])
def test_a_step_is_found_to_the_block_whichever_window_it_is_in(monkeypatch, first):
    """Bins of ten blocks end at 119 and 129; one window on the wrong side leaves all of the step."""
    found = found_in(monkeypatch, 30.0 * (TIME >= first))
    assert found[0].offset and found[0].bounds[0] == first - 0.5 and found[0].share > 0.95
    assert {regime.axis for regime in found} == {'x'}


def test_noise_sits_nowhere(monkeypatch):
    assert not found_in(monkeypatch, 0.0)


def test_of_what_scatters_the_shortest_part_that_holds_nearly_all_is_told():
    excess = np.array([0.0, 1.0, 30.0, 60.0, 8.0, 1.0, 500.0])
    assert regimes._tightened([1, 2, 3, 4, 5], np.arange(7), excess) == [2, 3, 4]


@pytest.mark.parametrize(('excess', 'axes'), [((90.0, 309.0, 42.0), ('y',)), ((900.0, 309.0, 42.0), ('x', 'y')), ((20.0, 3.0, 0.0), ('x',)), ((0.0,) * 3, ())])
def test_an_axis_carries_a_rest_that_is_above_noise_or_the_strongest(excess, axes):
    fits = BlockFits.__new__(BlockFits)
    fits.blocks = SimpleNamespace(variance=np.ones((600, 3)), locked=np.zeros(600, bool))
    fits._excess = lambda: np.array(excess)
    assert fits.axes() == axes


def regime(name, cost, share=0.9, offset=True):
    return regimes.RestRegime('gyroscope', 'x', name, name, share, 1e-9, None, None, offset, cost, None)


def test_of_places_that_are_nearly_as_likely_the_first_that_was_asked_is_told_and_an_offset_before_what_scatters():
    angle, force, time, scatter = regime('angle', 110.0), regime('force', 100.0), regime('time', 150.0), regime('angle', 90.0, offset=False)
    assert regimes._likeliest_first([angle, scatter, force, time]) == [angle, force, time]
    few = regime('angle', 104.0, share=0.6)
    assert regimes._likeliest_first([few, scatter]) == [few, scatter], 'an offset that takes less than most says little of how'


def test_an_angle_may_begin_beyond_where_it_ends_and_the_ends_of_all_values_are_open():
    turn = Variable('angle', np.arange(24), np.linspace(0, 360, 25), True, None, np.arange(24) * 15.0)
    assert np.flatnonzero(turn.inside(345.0, 15.0)).tolist() == [0, 23]
    line, = ranged('time', TIME, 's')
    assert line.inside(line.edges[0] + 1e-4 - 1e-4, 100.0).sum() == 100 and line.inside(200.0, line.edges[-1]).sum() == 40
    assert line.near([0, 1], 0) == [] and all(9 < place < 30 for place in line.near([0, 1], 1))
