"""
Biases that move otherwise than the simulator's: fast or slow, as flicker, as a walk, in steps.

In units of the data sheet's instability.
"""

import numpy as np

from worlds.noise_worlds import flicker, gauss_markov, random_walk

SIZE = 3.0
"""
Standard deviation of a wander over a session, in data sheet instabilities; 2 for that of 100 s.
"""
STEPS_EVERY = 60.0
"""Mean time between the steps of a bias, s."""


def _steps(n, period, instability, rng):
    """A bias that jumps by twice its instability, on average every minute."""
    jumps = rng.random(n) < period / STEPS_EVERY
    return np.cumsum(jumps * rng.normal(0.0, 2.0 * instability, n))


def _two_times(n, period, instability, rng):
    return gauss_markov(n, period, SIZE * instability, 15.0, rng) + gauss_markov(
        n, period, SIZE * instability, 300.0, rng
    )


WANDERS = {
    'wander_15': lambda n, period, instability, rng: gauss_markov(
        n, period, SIZE * instability, 15.0, rng
    ),
    'wander_100': lambda n, period, instability, rng: gauss_markov(
        n, period, 2.0 * instability, 100.0, rng
    ),
    'wander_1000': lambda n, period, instability, rng: gauss_markov(
        n, period, SIZE * instability, 1000.0, rng
    ),
    'two_times': _two_times,
    'flicker': lambda n, period, instability, rng: flicker(
        n, period, SIZE * instability / 1.5, rng
    ),
    'walk': lambda n, period, instability, rng: random_walk(
        n, period, SIZE * instability / np.sqrt(150.0), rng
    ),
    'steps': _steps,
}
"""
Name -> ``draw(n, period, instability, rng)`` of one axis; all but the name of the wander is
realistic noise.
"""


def add_wander(outputs, kind, model, period, rng):
    """
    Return the outputs of accelerometer and gyroscope with biases that move this way.

    The biases have the noise model's instabilities.
    """
    return tuple(
        out
        + np.stack([WANDERS[kind](len(out), period, instability, rng) for _ in range(3)], axis=1)
        for out, instability in zip(outputs, (model.accel_instability, model.gyro_instability))
    )
