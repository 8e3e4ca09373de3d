"""A session for joints that have ends: no further, no faster than each of them may."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from imu_calibration.simulation.motion_builder import MotionBuilder
from imu_calibration.simulation.motion_primitives import run, spin_joint

LARGEST_SWING = 0.5
"""Amplitude of a swing at most, rad or m."""


def within_limits(builder: MotionBuilder, rng: np.random.Generator, n_poses: int = 24, *, frequencies: Sequence[float] = (0.25, 0.5, 1.0),
                  swing_time: float = 5.0, n_other: int = 20) -> None:
    """Poses, swings of one joint and of two at once (with at most `n_other` other joints) and, where a joint has no end, spins."""
    limits, count = builder.limits, builder.n_joints
    lower, upper = np.where(limits.endless, -np.pi, limits.lower), np.where(limits.endless, np.pi, limits.upper)
    moving = np.flatnonzero(upper > lower)

    def places(n):
        """Spread positions over the range of every joint, each value once."""
        return lower + (upper - lower) * (rng.permuted(np.tile(np.arange(n), (count, 1)), axis=1).T + 0.5) / n

    def swing(at, frequency):
        """Swing the joints in which `frequency` is not zero, up to the limits of range, speed and acceleration."""
        omega = 2 * np.pi * np.maximum(frequency, 1e-9)
        reach = [0.3 * (upper - lower), limits.speed / omega, limits.acceleration / omega**2, np.full(count, LARGEST_SWING)]
        amplitude = np.where(frequency > 0, 0.7 * np.minimum.reduce(reach), 0.0)
        middle = np.where(limits.endless, at, np.clip(at, lower + 1.1 * amplitude, upper - 1.1 * amplitude))
        return partial(_swing, middle=middle, amplitude=amplitude, frequency=np.maximum(frequency, 0.1), duration=swing_time)

    tasks, only = [partial(_rest_at, position=position) for position in places(n_poses)], np.eye(count)
    for joint in moving:
        tasks += [swing(at, frequency * only[joint]) for at, frequency in zip(places(len(frequencies)), frequencies, strict=True)]
        others = moving[moving < joint][-n_other:]
        tasks += [swing(at, 0.3 * only[joint] + 0.45 * only[other]) for other, at in zip(others, places(max(len(others), 1)), strict=False)]
        if limits.endless[joint]:
            shares = 0.9 * np.linspace(0.3, 1.0, len(frequencies))
            speeds = shares * np.degrees(limits.speed[joint])
            tasks += [partial(spin_joint, joint=int(joint), at_deg=np.where(limits.turns, np.degrees(at), np.nan), dwell=4.0,
                              speeds_deg=speed)
                      for at, speed in zip(places(len(shares)), speeds, strict=True)]
    run(builder, rng, tasks)


within_limits_short = partial(within_limits, n_poses=10, frequencies=(0.5,), swing_time=4.0, n_other=1)


def _rest_at(builder, position):
    builder.move_to(position)
    builder.rest(4.0)


def _swing(builder, middle, amplitude, frequency, duration):
    builder.move_to(middle)
    builder.rest(1.0)
    builder.swing(amplitude, frequency, duration)
    builder.rest(1.0)
