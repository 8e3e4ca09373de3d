"""A random reference motion, for equations of effects."""

import numpy as np

from imu_calibration.kinematics.rotations import Reference


def random_reference(n_samples, *, seed):
    """Return a Reference of 400 s at 30 degrees Celsius, level, with random force and turns."""
    rng = np.random.default_rng(seed)
    vectors = [rng.normal(0.0, size, (n_samples, 3)) for size in (8.0, 2.0, 5.0)]
    return Reference(
        np.linspace(0.0, 400.0, n_samples),
        np.broadcast_to(np.eye(3), (n_samples, 3, 3)),
        *vectors,
        9.8,
        np.full(n_samples, 30.0),
    )
