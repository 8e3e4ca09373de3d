"""
The joints' motion a moment earlier.

Between stamps exact to high order, beyond them a Taylor series.
"""

import numpy as np
import pytest

from imu_calibration.kinematics.joint_motion import JointMotion, shifted

NAMES = ('position', 'rate', 'acceleration', 'jerk')


def oscillation(time, frequency=12.0):
    """Two joints that swing at a frequency, amplitude one."""
    w = 2 * np.pi * frequency
    phase = w * time[:, None] + np.array([0.3, 1.2])
    return JointMotion(
        time, np.sin(phase), w * np.cos(phase), -(w**2) * np.sin(phase), -(w**3) * np.cos(phase)
    )


@pytest.mark.parametrize('delay', [0.0123, 0.061, -0.0077])
def test_ripple_at_an_eighth_of_the_stamps_frequency_is_shifted_whole(delay):
    """
    The Taylor series from the own stamp errs by 7 % after 8 ms.

    It errs by many times the ripple after 60 ms.
    """
    time = np.cumsum(np.random.default_rng(0).uniform(0.009, 0.011, 200))
    late, true = shifted(oscillation(time), delay), oscillation(time - delay)
    inside = (time - delay > time[0]) & (time - delay < time[-1])
    for name, bound in zip(NAMES, (1e-7, 1e-6, 3e-5, 1e-3)):
        unit = np.abs(getattr(true, name)).max()
        np.testing.assert_allclose(
            getattr(late, name)[inside], getattr(true, name)[inside], atol=bound * unit
        )
    np.testing.assert_array_equal(late.time, time)


def test_before_the_first_stamp_the_series_goes_from_there():
    """Of delay^4 / 24 times the fourth derivative."""
    time = 5.0 + 0.01 * np.arange(20)
    late, true = shifted(oscillation(time, 2.0), 0.004), oscillation(time - 0.004, 2.0)
    np.testing.assert_allclose(
        late.position[0], true.position[0], atol=0.004**4 / 24 * (4 * np.pi) ** 4
    )
    early, ahead = shifted(oscillation(time, 2.0), -0.004), oscillation(time + 0.004, 2.0)
    np.testing.assert_allclose(
        early.position[-1], ahead.position[-1], atol=0.004**4 / 24 * (4 * np.pi) ** 4
    )


def test_nothing_is_drawn_across_a_hole():
    """After a hole the motion is another one, and a rest is a single row."""
    time = np.concatenate([0.01 * np.arange(10), 3.0 + 0.01 * np.arange(10), [7.0]])
    motion = oscillation(time, 1.0)
    resting = (time > 6.0)[:, None]
    rest = JointMotion(
        time,
        *(
            np.where(resting, 0.5 if name == 'position' else 0.0, getattr(motion, name))
            for name in NAMES
        ),
    )
    for delay in (0.013, -0.013):
        late, true = shifted(rest, delay), oscillation(time - delay, 1.0)
        np.testing.assert_allclose(late.position[:-1], true.position[:-1], atol=1e-5)
        assert np.all(late.position[-1] == 0.5) and np.all(late.rate[-1] == 0.0)


def test_the_shift_is_smooth_in_the_delay():
    """
    Derivatives by the delay are formed by small differences.

    They cross the instants at which stamps pass one another.
    """
    motion = oscillation(0.01 * np.arange(100))
    step = 1e-5
    for delay in (0.01, 0.0100001, 0.015, 0.02):
        slope = (shifted(motion, delay + step).rate - shifted(motion, delay - step).rate)[10:] / (
            2 * step
        )
        np.testing.assert_allclose(
            slope,
            -oscillation(motion.time - delay).acceleration[10:],
            atol=1e-4 * np.abs(motion.acceleration).max(),
        )


def test_one_row_and_rows_out_of_order_take_the_series_of_their_own():
    time = np.array([0.0, 0.02, 0.01])
    late, true = shifted(oscillation(time, 1.0), 1e-3), oscillation(time - 1e-3, 1.0)
    np.testing.assert_allclose(late.position, true.position, atol=1e-9)
    alone = shifted(oscillation(time[:1], 1.0), 1e-3)
    np.testing.assert_array_equal(alone.position, late.position[:1])


def test_each_stamp_may_have_its_own_delay():
    """
    Where delays of a step are constant the motion is that of either.

    Of one sample only the own delay counts.
    """
    time = np.cumsum(np.random.default_rng(1).uniform(0.009, 0.011, 100))
    motion, delay = oscillation(time, 2.0), np.where(time > time[60], 0.012, -0.004)
    late, parts = shifted(motion, delay), [shifted(motion, value) for value in (0.012, -0.004)]
    for name in NAMES:
        np.testing.assert_array_equal(
            getattr(late, name),
            np.where((delay > 0)[:, None], *(getattr(part, name) for part in parts)),
        )
    alone = oscillation(time[:1], 2.0)
    np.testing.assert_array_equal(
        shifted(alone, delay[:1]).position, shifted(alone, -0.004).position
    )
