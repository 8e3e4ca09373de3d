"""A finding is withdrawn when a regime of motion or the temperature's past takes its place."""

from types import SimpleNamespace

import numpy as np
import pytest

from imu_calibration.references.turntable.residuals.residual_analysis import (
    ResidualAnalysis,
    superseded,
)

PLACE = np.arange(8) < 3
"""Blocks of the regime, shape (b,)."""


class Fits:
    """Fits that leave `excess` without further columns, and `beside` with those of the regime."""

    def __init__(self, excess, beside=0.0):
        self.excess, self.beside = excess, beside

    def fit(self, columns=None):
        if columns is None:
            return SimpleNamespace(excess=self.excess)
        np.testing.assert_array_equal(columns[:, 0, 1], PLACE)
        assert columns.shape == (8, 1, 3) and not columns[:, 0, [0, 2]].any()
        return SimpleNamespace(excess=self.beside)


@pytest.mark.parametrize(
    ('offset', 'beside', 'withdrawn'), ((True, 0.4, True), (True, 0.6, False), (False, 0.4, False))
)
def test_an_offset_in_a_regime_replaces_a_finding_that_is_needless_beside_it(
    offset, beside, withdrawn
):
    # The finding reduces the excess by 10, and beside the regime by `beside`: less than 5 % of it.
    question = SimpleNamespace(
        effect=SimpleNamespace(sensors=('gyroscope',), needs=(), smooth=False),
        name='gyro_quadratic',
    )
    fits = {True: Fits(2.0, 2.0), False: Fits(12.0, 2.0 + beside)}
    found = SimpleNamespace(
        named=[question],
        residual_of={'gyroscope': SimpleNamespace(significant=True)},
        proposals={'gyroscope': None},
        blocks={'gyroscope': SimpleNamespace(time=np.arange(8.0))},
        fits=lambda sensor, chosen: fits[bool(chosen)],
        columns=lambda sensor, formula: None,
        proposed=lambda sensor, fits: None,
        regimes=lambda sensor, chosen: [SimpleNamespace(axis='y', inside=PLACE, offset=offset)],
    )
    assert superseded(found) == ([question] if withdrawn else [])


@pytest.mark.parametrize(
    ('drift', 'sessions', 'withdrawn'), ((12.0, 1, True), (8.0, 1, False), (12.0, 2, False))
)
def test_a_course_of_the_temperature_that_predicts_better_replaces_a_drift(
    drift, sessions, withdrawn
):
    # The best course leaves an excess of 5, to which twice the logarithm of their number is added.
    time = np.linspace(0.0, 400.0, 60)
    warm = 25 + 8 * (1 - np.exp(-time / 150))

    class Fits:
        def __init__(self, excess):
            self.excess = excess

        def fit(self, columns=None):
            return SimpleNamespace(excess=self.excess if columns is None else 5.0)

    question = SimpleNamespace(
        effect=SimpleNamespace(sensors=('gyroscope',), needs=('time',), smooth=True),
        name='gyro_bias_drift',
    )
    fits = {True: Fits(drift), False: Fits(900.0)}
    found = SimpleNamespace(
        named=[question],
        residual_of={'gyroscope': SimpleNamespace(significant=False)},
        proposals={'gyroscope': None},
        problem=SimpleNamespace(recording=SimpleNamespace(session=np.arange(sessions))),
        blocks={
            'gyroscope': SimpleNamespace(
                time=time, ref=SimpleNamespace(temperature_c=warm), means=lambda rows: rows
            )
        },
        fits=lambda sensor, chosen: fits[bool(chosen)],
    )
    found._excess_with_courses = lambda *given: ResidualAnalysis._excess_with_courses(found, *given)
    found.better_course = lambda *given: ResidualAnalysis.better_course(found, *given)
    assert superseded(found) == ([question] if withdrawn else [])
