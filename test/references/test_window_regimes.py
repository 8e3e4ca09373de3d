"""Regimes of the residual of windows: a step, a larger scatter, and what is none."""

from types import SimpleNamespace

import numpy as np
import pytest

from imu_calibration.references.turntable.residuals import window_regimes
from imu_calibration.selection.regime_variables import ranged

from worlds.rest_blocks import EACH, STARTS, TIME, WINDOWS, blocks_of


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
