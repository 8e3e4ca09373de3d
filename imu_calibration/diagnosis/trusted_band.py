"""The band in which table and sensor can be compared: moving windows by their slow part, where the fast part fits no effect at all."""

from dataclasses import replace

import numpy as np

from imu_calibration.diagnosis.noise import white_noise
from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.band_misfit import band_misfit

STRONG = 1e-9
"""Directions of scaled columns with less than this share of the largest eigenvalue do not count."""


def in_trusted_band(space):
    """
    Return the Space whose centred rows are compared by their slow part alone on axes whose fast part stays wrong beside every effect.

    Joint states at 100 Hz do not show a motor's ripple at 47 Hz, and no effect of the catalogue makes up for it; judged sample by sample,
    such a recording shows whatever makes the ripple smaller. In the place of the fast part stands white noise of the slow part's
    variance, so that all counts of samples hold.
    """
    lifted = space.lifted
    moving = lifted.kind != 'static'
    within, slow_only = {}, {}
    n_slow = np.maximum(lifted.slow_rows - 1.0, 0.0)
    for sensor in SENSORS:
        rest = white_noise(lifted, sensor)
        at_rest = np.zeros(3) if rest is None else rest[0] * np.maximum(rest[1], 1.0)
        chosen, parts = np.zeros(3, bool), list(space.within[sensor])
        for axis in range(3):
            totals = [part[moving].sum(axis=0) for part in (space.within[sensor][axis], space.slow[sensor][axis])]
            (left, rank), (left_slow, rank_slow) = (_misfit(total) for total in totals)
            dofs = (lifted.count[moving] - 1).sum() - rank, n_slow[moving].sum() - rank_slow
            found = band_misfit(np.full(3, left), dofs[0], np.full(3, left_slow), dofs[1])
            if not found.apart[0] or found.fast[0] < 2.0 * at_rest[axis]:
                continue
            chosen[axis], parts[axis] = True, space.slow[sensor][axis].copy()
            parts[axis][moving, -1, -1] += (lifted.count - 1 - n_slow)[moving] * found.slow[axis]
        within[sensor], slow_only[sensor] = parts, chosen
    return replace(space, within=within, slow_only=slow_only)


def _misfit(products):
    """Return (squares that the best fit of all columns leaves, number of columns that count) of ``[design | residual]`` products."""
    scale = 1 / np.sqrt(np.maximum(np.diag(products), 1e-300))
    scaled = products * np.outer(scale, scale)
    eigenvalues, vectors = np.linalg.eigh(scaled[:-1, :-1])
    strong = eigenvalues > STRONG * max(eigenvalues[-1], 1e-300)
    along = (vectors.T @ scaled[:-1, -1])[strong]
    return max(scaled[-1, -1] - (along**2 / eigenvalues[strong]).sum(), 0.0) / scale[-1]**2, int(strong.sum())
