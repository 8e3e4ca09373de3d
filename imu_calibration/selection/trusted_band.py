"""The band in which table and sensor can be compared: moving windows by their slow part, where the fast part fits no effect at all."""

from dataclasses import replace

import numpy as np

from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.band_misfit import band_misfit, least_misfit
from imu_calibration.estimation.noise_at_rest import white_noise
from imu_calibration.selection.parameter_space import ParameterSpace


def in_trusted_band(space: ParameterSpace) -> ParameterSpace:
    """
    Return the space with only the slow part of the centred rows on axes with a fast part that no effect explains.

    Joint states at 100 Hz do not show a motor's ripple at 47 Hz, and no effect of the catalogue makes up for it; judged sample by sample,
    such a recording is evidence for any effect that reduces the ripple. The fast part is replaced by white noise of the slow part's
    variance, so that all counts of samples hold.
    """
    recording, moving = space.recording, space.recording.moving
    slow_only, slow_variance = {}, {}
    n_slow = np.maximum(recording.slow_rows - 1.0, 0.0)
    for sensor in SENSORS:
        rest = white_noise(recording.windows, sensor)
        at_rest = np.zeros(3) if rest is None else rest[0] * np.maximum(rest[1], 1.0)
        slow_only[sensor], slow_variance[sensor] = np.zeros(3, bool), np.zeros(3)
        for axis in range(3):
            (left, rank), (left_slow,
                           rank_slow) = (least_misfit(space.within_sum(sensor, axis, moving, part=part)) for part in ('within', 'slow'))
            dofs = (recording.count[moving] - 1).sum() - rank, n_slow[moving].sum() - rank_slow
            found = band_misfit(np.full(3, left), dofs[0], np.full(3, left_slow), dof_slow=dofs[1])
            if found.apart[0] and found.fast[0] >= 2.0 * at_rest[axis]:
                slow_only[sensor][axis], slow_variance[sensor][axis] = True, found.slow[axis]
    return replace(space, slow_only=slow_only, slow_variance=slow_variance)
