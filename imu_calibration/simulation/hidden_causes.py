"""Faults of a simulated IMU beyond its model, by the physics of each cause; independent of the catalogue of effects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from imu_calibration.constants import DEG, DEG_H, STANDARD_GRAVITY
from imu_calibration.errors import InputError


class Felt(NamedTuple):
    """True motion of the housing, and the outputs of its sensing elements up to this cause; all shape (n, 3)."""

    true_force: np.ndarray
    """Specific force, m/s^2."""
    true_rate: np.ndarray
    """Rate, rad/s."""
    force: np.ndarray
    """Output of the accelerometers, m/s^2."""
    rate: np.ndarray
    """Output of the gyroscopes, rad/s."""


Cause = Callable[[Felt], Felt]


def _two_half_ranges(rng: np.random.Generator) -> Cause:
    """Each gyroscope's electrodes have different gains for the two senses of rotation, by 0.2 to 0.4 %."""
    gap = rng.uniform(2e-3, 4e-3, 3) * rng.choice([-1, 1], 3)

    def answer(felt: Felt) -> Felt:
        gain = np.where(felt.true_rate > 0, 0.5 * gap, -0.5 * gap)
        return felt._replace(rate=felt.rate + gain * felt.true_rate)
    return answer


def _unbalanced_mass(rng: np.random.Generator) -> Cause:
    """The gyroscopes' masses are off their axes: specific force turns them, 20 to 60 deg/h per g."""
    per_force = rng.uniform(20.0, 60.0, (3, 3)) * rng.choice([-1, 1], (3, 3)) * DEG_H / STANDARD_GRAVITY
    return lambda felt: felt._replace(rate=felt.rate + felt.true_force @ per_force.T)


def _soft_spring(rng: np.random.Generator) -> Cause:
    """The accelerometers' springs grow softer one way: a parabola in the force along each axis, 0.2 to 0.5 mg at 1 g."""
    per_square = rng.uniform(2e-4, 5e-4, 3) * rng.choice([-1, 1], 3) / STANDARD_GRAVITY
    return lambda felt: felt._replace(force=felt.force + per_square * felt.true_force**2)


def _gain_by_sense(rng: np.random.Generator) -> Cause:
    """Each accelerometer's amplifier has different gains for the two signs, by 0.05 to 0.1 %."""
    gap = rng.uniform(5e-4, 1e-3, 3) * rng.choice([-1, 1], 3)

    def answer(felt: Felt) -> Felt:
        return felt._replace(force=felt.force + np.where(felt.true_force > 0, 0.5 * gap, -0.5 * gap) * felt.true_force)
    return answer


def _narrow_range(rng: np.random.Generator) -> Cause:
    """The gyroscopes' converter ends at 100 to 120 deg/s."""
    most = rng.uniform(100.0, 120.0) * DEG
    return lambda felt: felt._replace(rate=np.clip(felt.rate, -most, most))


CAUSES: dict[str, Callable[[np.random.Generator], Cause]] = {
    'two_half_ranges': _two_half_ranges, 'unbalanced_mass': _unbalanced_mass, 'soft_spring': _soft_spring, 'gain_by_sense': _gain_by_sense,
    'narrow_range': _narrow_range}
"""Name -> function of a generator that draws the size and returns the cause; `narrow_range` belongs last."""


def hidden_causes(names: Sequence[str], seed: int, size: float = 1.0) -> list[Cause]:
    """
    Return the causes of those names, each drawn from a separate generator, `size` times as large as drawn.

    Raises
    ------
    InputError
        When a name is unknown.

    """
    for name in names:
        if name not in CAUSES:
            raise InputError(f"a hidden cause must be one of {', '.join(CAUSES)}, got '{name}'; name one of them", code='cause_unknown')
    return [_scaled(CAUSES[name](np.random.default_rng([seed, list(CAUSES).index(name)])), size) for name in CAUSES if name in names]


def _scaled(cause, size):
    def answer(felt):
        answered = cause(felt)
        return felt._replace(force=felt.force + size * (answered.force - felt.force), rate=felt.rate + size * (answered.rate - felt.rate))
    return cause if size == 1.0 else answer
