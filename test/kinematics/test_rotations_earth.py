"""Normal gravity against published values, Earth rate by its geometry."""

import numpy as np
import pytest

from imu_calibration.kinematics.rotations import EARTH_RATE, earth_rate_n, normal_gravity


@pytest.mark.parametrize(
    ('latitude', 'gravity'), [(0.0, 9.7803253359), (45.0, 9.8061977693), (90.0, 9.8321849379)]
)
def test_normal_gravity_on_the_ellipsoid(latitude, gravity):
    """
    Equator and pole are defining or derived constants of WGS 84 (TR8350.2, table 3.4).

    45 deg follows by Somigliana's form.
    """
    assert normal_gravity(latitude) == pytest.approx(gravity, abs=2e-9)
    assert normal_gravity(-latitude) == normal_gravity(latitude)


def test_normal_gravity_is_the_gradient_of_the_potential_above_the_equator():
    """
    In the plane of the equator the ellipsoid's field is known term by term.

    GM, J2 to J6 and the centrifugal part.
    """
    semi_major, gm, j2, j4, j6 = (
        6378137.0,
        3.986004418e14,
        1.08262982131e-3,
        -2.37091120e-6,
        6.08347e-9,
    )
    for height in (0.0, 1000.0, 10000.0):
        radius = semi_major + height
        ratio = (semi_major / radius) ** 2
        pull = (
            gm
            / radius**2
            * (1 + 1.5 * j2 * ratio - 15 / 8 * j4 * ratio**2 + 35 / 16 * j6 * ratio**3)
        )
        # The height correction leaves out the square of the flattening, 1e-10 m/s^2 per metre.
        assert normal_gravity(0.0, height) == pytest.approx(
            pull - EARTH_RATE**2 * radius, abs=1e-9 + 1.2e-10 * height
        )


def test_normal_gravity_takes_arrays():
    latitude, height = np.array([10.0, 60.0]), np.array([0.0, 500.0])
    np.testing.assert_array_equal(
        normal_gravity(latitude, height), [normal_gravity(10.0), normal_gravity(60.0, 500.0)]
    )


def test_earth_rate_points_north_and_up():
    assert np.linalg.norm(earth_rate_n(37.0, 123.0)) == pytest.approx(EARTH_RATE, rel=1e-15)
    np.testing.assert_allclose(earth_rate_n(0.0, 0.0), [EARTH_RATE, 0, 0], atol=1e-20)
    np.testing.assert_allclose(earth_rate_n(90.0, 50.0), [0, 0, EARTH_RATE], atol=1e-20)
    # x points east: north is to its left, which is y.
    np.testing.assert_allclose(earth_rate_n(0.0, 90.0), [0, EARTH_RATE, 0], atol=1e-20)
    # South of the equator the Earth turns clockwise seen from above.
    assert earth_rate_n(-30.0, 0.0)[2] == pytest.approx(-EARTH_RATE / 2)
