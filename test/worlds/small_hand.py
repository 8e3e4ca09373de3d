"""
A short session by hand in plain numpy: rests in random attitudes, smooth turns between them.

It imports nothing of the package, and its sensors are ``bias + matrix @ true + white noise``.
"""

from dataclasses import dataclass

import numpy as np

GRAVITY = 9.80665


@dataclass(frozen=True, eq=False)
class HandMotion:
    """True motion in the sensor frame."""

    time: np.ndarray
    """s, shape (n,)."""
    force: np.ndarray
    """Specific force, m/s^2, shape (n, 3)."""
    rate: np.ndarray
    """rad/s, shape (n, 3)."""


@dataclass(frozen=True, eq=False)
class HandSensor:
    """One sensor."""

    bias: np.ndarray
    """SI, shape (3,)."""
    matrix: np.ndarray
    """Shape (3, 3)."""
    noise: float
    """Standard deviation of a reading, SI."""

    def read(self, true, generator):
        """Return readings of the true values, shape (n, 3)."""
        noise = self.noise * generator.standard_normal(true.shape)
        return self.bias + true @ self.matrix.T + noise


ACCELEROMETER = HandSensor(
    np.array([0.31, -0.12, 0.18]),
    np.array([[1.012, 0.0, 0.0], [0.006, 0.991, 0.0], [-0.004, 0.007, 1.021]]),
    0.012,
)
"""Lower triangular: x is the axis of the accelerometer, as in a calibration by hand."""
GYROSCOPE = HandSensor(
    np.array([0.011, -0.007, 0.004]),
    np.array([[0.988, 0.004, -0.003], [0.005, 1.017, 0.002], [-0.006, 0.003, 1.008]]),
    0.0012,
)


def rotation(vector):
    """Return the matrix of a rotation vector, by Rodrigues' formula."""
    angle = np.linalg.norm(vector)
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def hand_motion(*, hz=80.0, n_poses=16, rest=1.8, turn=1.2, seed=0):
    """Return a session: a rest in each attitude, and a turn about a random axis between them."""
    generator = np.random.default_rng(seed)
    n_turn = int(turn * hz)
    phase = (np.arange(n_turn) + 0.5) / n_turn
    speed = (1 - np.cos(2 * np.pi * phase)) * hz / n_turn  # integrates to 1
    rates = [np.zeros((int(rest * hz), 3))]
    for _ in range(n_poses - 1):
        axis = generator.standard_normal(3)
        axis /= np.linalg.norm(axis)
        rates.append(speed[:, None] * axis * generator.uniform(1.1, 2.2))
        rates.append(np.zeros((int(rest * generator.uniform(0.9, 1.2) * hz), 3)))
    rate = np.concatenate(rates)
    up, ups = np.array([0.0, 0.0, 1.0]), []
    for step in rate / hz:
        ups.append(up)
        up = rotation(-step) @ up
    return HandMotion(np.arange(len(rate)) / hz, GRAVITY * np.array(ups), rate)
