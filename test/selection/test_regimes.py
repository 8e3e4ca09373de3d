"""Regimes of a residual: its exchange between windows, and a formula that explains as much."""

import numpy as np

from imu_calibration.selection import regimes
from imu_calibration.selection.regime_variables import ranged

from worlds.rest_blocks import EACH, STARTS, TIME, WINDOW, WINDOWS


def test_a_formula_that_explains_as_much_is_no_place():
    step = 30.0 * (TIME >= 122)
    rows = np.stack(
        [np.ones(len(TIME)), step + np.random.default_rng(4).normal(size=len(TIME))], axis=1
    )
    exchange = regimes.exchanges(WINDOW, np.zeros(len(TIME)), np.ones(len(TIME)))
    search = regimes.RegimeSearch(
        'gyroscope', TIME, ranged('time', TIME, 's', starts=STARTS), exchange=exchange
    )
    rest = regimes.AxisResidual(rows, np.zeros(1), np.zeros(1))
    unit_noise = regimes.IndependentErrors(np.ones(len(TIME)))
    assert search.offsets('x', rest, unit_noise, level=0.05)
    assert not search.offsets('x', rest, unit_noise, level=0.05, formula=step[:, None])


def test_windows_exchange_their_residuals_within_kind_and_intensity():
    kind, speed = np.repeat(['static', 'swing'], 120), np.repeat(np.arange(WINDOWS) * 0.1, EACH)
    exchange = regimes.exchanges(WINDOW, kind, speed)
    assert (kind[exchange] == kind).all()
    third = np.arange(30) // 10
    assert (third[WINDOW[exchange[:, 120:]] - 30] == third[WINDOW[120:] - 30]).all()
    assert (np.sort(exchange, axis=1) == np.arange(len(TIME))).all() and (
        exchange != np.arange(len(TIME))
    ).mean() > 0.8
