"""Windows with the readings of a sensor of given parameters, and their solution."""

from dataclasses import replace

import numpy as np

from imu_calibration.effects.forward_equations import predict
from imu_calibration.references.turntable.accumulator import Accumulator
from imu_calibration.references.turntable.estimation.solver import solve
from imu_calibration.references.turntable.window_statistics import reduce_windows


def solved(windows, model, table):
    """Return the Solution."""
    accumulator = Accumulator()
    for row in reduce_windows(windows, model, table):
        accumulator.add(row)
    return solve(accumulator, model)


def read(windows, table, model, values, *, ripple=0.0, seed=1):
    """
    Return the windows with the readings of a sensor of these parameters.

    They have noise, and a force on x in turns, as no effect has it.
    """
    rng, made = np.random.default_rng(seed), []
    for window in windows:
        force, rate = predict(model, values, table, motion=window.motion)
        moves, turns = (
            np.broadcast_to(part[:, 0], len(window.time))
            for part in (window.motion.position, window.motion.rate)
        )
        force = force + ripple * np.outer(
            (np.abs(turns) > 1.0) * (1.0 + np.sin(7 * moves)), [1.0, 0.0, 0.0]
        )
        made.append(
            replace(
                window,
                force_s=force + rng.normal(0, 0.02, (len(window.time), 3)),
                rate_s=rate + rng.normal(0, 2e-3, (len(window.time), 3)),
            )
        )
    return made
