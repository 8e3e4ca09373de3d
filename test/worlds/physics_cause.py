"""
Where a world can do something beside the motion that was asked for.

In `worlds.misfit_worlds` it does.
"""

import numpy as np


class Cause:
    """
    What a world does beside the motion that was asked for.

    Each method is one place where it can act. `size` 1 is clearly visible.
    """

    oversampling = 1
    """Steps of the physics per sample."""

    def __init__(self, size=1.0, rng=None):
        self.size, self.rng = size, rng

    def moved(self, moves):
        """
        Return what the joints truly do (`at`, `duration`, `find`), given what they were told to do.
        """
        return moves

    def encoder_error(self, time, motion):
        """Return how much the encoders read too much, and its derivative, each (n, n_joints)."""
        return np.zeros_like(motion.position), np.zeros_like(motion.position)

    def carried(self, time, force_s, rate_s, alpha_s):
        """
        Return force and rate of the sensor's body, in s, each (n, 3).

        Force and rate of the table's plate are given.
        """
        return force_s, rate_s

    def added(self, world, temperature_c, force_s, rate_s, alpha_s):
        """
        Return the additions to the outputs of accelerometer and gyroscope.

        Each is (n, 3) or 0, given the world and the motion that the body feels.
        """
        return 0.0, 0.0

    def delivered(self, time, outputs, rate_s):
        """
        Return the two outputs (n, 3) as the driver hands them on, given the true rate of the body.
        """
        return outputs

    def stamped(self, time, rng):
        """Return by how much each IMU stamp is late, s, shape (n,)."""
        return np.zeros(len(time))


NO_CAUSE = Cause()
"""A world that does as it is told."""
