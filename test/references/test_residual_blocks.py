"""Fits to the blocks of a residual: the axes that carry it, and the factors that fits share."""

import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest

from imu_calibration.references.turntable.residuals.residual_blocks import BlockFits

from worlds.rest_blocks import TIME, WINDOW, blocks_of


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
