"""How well a parameter is known, in one word."""

from imu_calibration.estimation.solution import DETERMINED, HELD, WEAK, statuses


def test_a_parameter_is_determined_within_its_tolerance_weak_above_and_held_at_the_prior():
    assert statuses([0.9, 1.0, 1.1, 0.5], [False, False, False, True], [1.0] * 4) == (
        DETERMINED,
        DETERMINED,
        WEAK,
        HELD,
    )
