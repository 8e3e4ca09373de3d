"""A stretch of joint readings without gaps: phases between the readings, and a smooth curve through them."""

import numpy as np

from imu_calibration.reference.encoder import encoder_step
from imu_calibration.reference.joint_curve import fit_joint_curve
from imu_calibration.reference.joint_motion import JointMotion
from imu_calibration.segmentation.joint_phases import MOVING, STILL, joint_phases
from imu_calibration.segmentation.window_settings import WindowSettings

LEAST_READINGS = 4
"""Fewest readings for an estimate of the motion."""


class JointRun:
    """Joint readings without gaps."""

    def __init__(self, time: np.ndarray, position: np.ndarray, velocity: np.ndarray, *, settings: WindowSettings, noise_rad: float | None):
        self.time, self.position, self.velocity = time, position, velocity
        self.phase, self.level = joint_phases(time, position, settings, noise_rad=noise_rad)
        self._moving = time[self.phase != STILL]
        self.step = np.array([encoder_step(column) for column in position.T])

    def covered(self, time: np.ndarray, before: bool, after: bool) -> np.ndarray:
        """Return a mask of the instants between the readings or, where the joints rest, within two periods of the first or last."""
        reach = 2 * np.median(np.diff(self.time))
        low = self.time[0] - (reach if before and self.phase[0] == STILL else 0.0)
        high = self.time[-1] + (reach if after and self.phase[-1] == STILL else 0.0)
        return (time >= low) & (time <= high)

    def at(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the phase (if equal at both neighbours, otherwise moving) and the level at instants."""
        right = np.minimum(np.searchsorted(self.time, time), len(self.time) - 1)
        left = np.maximum(right - 1, 0)
        phase = np.where(self.phase[left] == self.phase[right], self.phase[right], MOVING)
        level = np.stack([np.interp(time, self.time, column) for column in self.level.T], axis=1)
        return phase.astype(np.int8), level

    def near_motion(self, time: np.ndarray, distance: float) -> np.ndarray:
        """Return a mask of the instants between the readings that are within `distance` of one with moving joints."""
        if not len(self._moving):
            return np.zeros(len(time), bool)
        right = np.searchsorted(self._moving, time)
        ahead = self._moving[np.minimum(right, len(self._moving) - 1)]
        behind = self._moving[np.maximum(right - 1, 0)]
        near = np.minimum(np.abs(ahead - time), np.abs(time - behind)) <= distance
        return near & (time >= self.time[0]) & (time <= self.time[-1])

    def curve(self, time: np.ndarray, overlap: float, noise_rad: float | None) -> JointMotion:
        """Return the `JointMotion` of a smooth curve at instants."""
        first, stop = np.searchsorted(self.time, [time[0] - overlap, time[-1] + overlap])
        first, stop = max(0, min(first, len(self.time) - LEAST_READINGS)), min(len(self.time), max(stop, LEAST_READINGS))
        piece = slice(first, stop)
        velocity = None if np.isnan(self.velocity[piece]).all() else self.velocity[piece]
        return fit_joint_curve(self.time[piece], self.position[piece], velocity, noise_sd=noise_rad).at(time)
