"""
Two other ways to calibrate by hand.

A plain fit of the gravity norm, and the Ferraris method of the PyPI package imucal.
"""

import importlib.util
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

FACES = ('x_p', 'x_a', 'y_p', 'y_a', 'z_p', 'z_a')
TURNS = ('x_rot', 'y_rot', 'z_rot')


def installed(name):
    """
    Return whether a package that only this comparison needs is there; `make validate` installs it.
    """
    return importlib.util.find_spec(name) is not None


@dataclass(frozen=True, eq=False)
class Forward:
    """``measured = bias + matrix @ true`` of a sensor."""

    bias: np.ndarray
    """m/s^2 or rad/s, shape (3,)."""
    matrix: np.ndarray
    """Shape (3, 3)."""

    def compensated(self, readings):
        """Return ``matrix^-1 @ (readings - bias)``, shape (n, 3)."""
        return np.linalg.solve(self.matrix, (readings - self.bias).T).T

    def norm_errors(self, force, gravity):
        """Return ``|compensated force| - gravity`` of readings at rest, shape (n,)."""
        return np.linalg.norm(self.compensated(np.asarray(force)), axis=1) - gravity

    def directions(self, force):
        """Return unit vectors along the compensated force, shape (n, 3)."""
        up = self.compensated(force)
        return up / np.linalg.norm(up, axis=1, keepdims=True)


def fit_norm(force, gravity, cross_axis=True, loss='linear'):
    """
    Fit biases and a lower triangular matrix to readings.

    The mean readings `force` (n, 3) get the length `gravity`.

    Nine parameters; without `cross_axis` six, which is what six faces can tell. `loss` is that of
    `scipy.optimize.least_squares`.
    """
    lower = np.tril_indices(3) if cross_axis else np.diag_indices(3)

    def model(values):
        matrix = np.zeros((3, 3))
        matrix[lower] = values[3:]
        return Forward(values[:3], matrix)

    start = np.concatenate([np.zeros(3), np.eye(3)[lower]])
    return model(
        least_squares(
            lambda values: model(values).norm_errors(force, gravity),
            start,
            x_scale='jac',
            loss=loss,
        ).x
    )


def cut(imu, sections):
    """Return {'acc_x_p': (n, 3), ..., 'gyr_z_rot': (n, 3)}: the samples of each section, SI."""
    names = (*FACES, *TURNS)
    readings = (('acc', imu.force_s), ('gyr', imu.rate_s))
    return {
        f'{sensor}_{name}': values[slice(*sections[name])]
        for name in names
        for sensor, values in readings
    }


def ferraris(imu, sections, rate_hz, gravity, angle):
    """
    Return imucal's calibration of the sections in SI.

    `angle` (rad) is the signed angle of all three turns. imucal's gyroscope works in deg/s by
    convention; given radians it stays in rad/s.
    """
    from imucal import FerrarisCalibration, FerrarisSignalRegions

    regions = FerrarisSignalRegions(**cut(imu, sections))
    return FerrarisCalibration(grav=gravity, expected_angle=angle).compute(
        regions, rate_hz, from_acc_unit='m/s^2', from_gyr_unit='rad/s'
    )


def accelerometer_of(info):
    """
    Return imucal's accelerometer as a forward model.

    Its ``true = R^-1 K^-1 (measured - b)`` turned round.
    """
    return Forward(info.b_a, info.K_a @ info.R_a)
