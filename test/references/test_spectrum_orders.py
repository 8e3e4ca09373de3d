"""Whole orders of a joint: what keeps its phase on the joint, and what does not."""

from types import SimpleNamespace

import numpy as np
import pytest

from imu_calibration.references.turntable.residuals.spectrum import (
    LEAST_ORDER_POWER,
    MIN_ORDER_SHARE,
    orders_of,
)

TIME = 0.01 * np.arange(1200)


def swings(rest_of, *, count=6, span=0.6):
    """Return (windows, rests) of swings over angles of their own, with white noise in the rest."""
    rng = np.random.default_rng(8)
    angles = [k + span * np.sin(2 * np.pi * (0.3 + 0.05 * k) * TIME) for k in range(count)]
    windows = [Window(time=TIME, motion=Motion(position=angle[:, None])) for angle in angles]
    return windows, [
        rng.normal(size=(len(TIME), 3)) + np.outer(rest_of(k, angle), [0, 0, 1])
        for k, angle in enumerate(angles)
    ]


class Motion(SimpleNamespace):
    """Angles of a joint."""

    def __len__(self):
        return len(self.position)


class Window(SimpleNamespace):
    """Times and motion."""

    def __len__(self):
        return len(self.time)


def seen(rest_of):
    orders = orders_of(*swings(rest_of), 0)
    return [
        (int(order), axis)
        for at, order in enumerate(orders.order)
        for axis in range(3)
        if orders.p_value[at, axis] < 1e-7
        and orders.power[at, axis] > LEAST_ORDER_POWER
        and orders.share[at, axis] > MIN_ORDER_SHARE
    ]


def test_what_is_fixed_to_the_joint_is_found_in_swings_with_its_amplitude():
    windows, rests = swings(lambda k, angle: 0.5 * np.sin(17 * angle + 0.3))
    orders = orders_of(windows, rests, 0)
    at = int(np.argmin(orders.p_value[:, 2]))
    assert (
        orders.order[at] == 17
        and orders.amplitude[at, 2] == pytest.approx(0.5, rel=0.1)
        and orders.share[at, 2] > 0.9
    )


@pytest.mark.parametrize(
    'rest_of',
    [
        lambda k, angle: 0.0,
        # In some of the swings only: what these motions do.
        lambda k, angle: 2.0 * np.sin(17 * angle) * (k < 4),
        lambda k, angle: 0.5 * np.sin(2 * np.pi * 9.3 * TIME + k),  # a hum
        lambda k, angle: 3.0 * (angle - k),  # a lag, in phase with the swing
        # A dent of the bearing: every order, none stands out.
        lambda k, angle: np.exp(-0.5 * ((angle - 2.0) / 0.02) ** 2) * 5,
    ],
)
def test_noise_hum_lags_and_dents_are_no_order(rest_of):
    assert not seen(rest_of)


def test_too_little_motion_tells_nothing():
    windows, rests = swings(lambda k, angle: 0.0, count=1, span=0.01)
    assert orders_of(windows, rests, 0) is None


@pytest.mark.parametrize('level', [0.0, 1e-4, 1.0])
def test_identical_swings_have_no_scatter_and_no_order(level):
    """Pieces that repeat sample by sample say nothing about the chance of their mean."""
    windows, rests = swings(lambda k, angle: 0.5 * np.sin(17 * angle + 0.3), count=1)
    rest = level * rests[0][:200]
    window = Window(time=TIME[:200], motion=Motion(position=windows[0].motion.position[:200]))
    orders = orders_of([window] * 10, [rest] * 10, 0)
    assert np.array_equal(orders.p_value, np.ones_like(orders.p_value))
