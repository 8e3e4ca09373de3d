"""Candidate effects of a search, and repeated linearisation at their estimates."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.effects.base import SENSORS, Effect, Role
from imu_calibration.effects.sensor_model import SensorModel

TEMPERATURE_SPAN = 1.0
"""Least span of temperature that can show a thermal effect, K."""
N_TIME_CONSTANTS = 12
"""Number of time constants in the bank of warm-ups."""


@dataclass(frozen=True, eq=False)
class Question:
    """One effect under test; a warm-up is tested at each time constant of a bank."""

    effect: Effect
    """The effect under test."""
    parameters: tuple[int, ...]
    """Indices in the parameter space."""
    penalty: int
    """Number of parameters that it is charged for."""
    label: str
    """Effect name, for a warm-up with the number of the time constant."""

    @property
    def name(self) -> str:
        """Published name of the effect."""
        return self.effect.name

    @property
    def sensor(self) -> str:
        """'accelerometer', 'gyroscope' or 'reference'."""
        return self.effect.sensor


def with_exchanged(chosen: Sequence[Question], place: int, other: Question) -> list[Question]:
    """Return a choice with the effect `other` in place of its effect number `place`."""
    return [*chosen[:place], other, *chosen[place + 1 :]]


def smooth_parameters(questions: Sequence[Question]) -> dict[str, list[tuple[int, ...]]]:
    """Return sensor -> the parameters of each of its effects that is smooth in time."""
    parameters: dict[str, list[tuple[int, ...]]] = {sensor: [] for sensor in SENSORS}
    for question in questions:
        if question.effect.smooth and question.sensor in parameters:
            parameters[question.sensor].append(question.parameters)
    return parameters


def sort_effects(
    model: SensorModel,
    why_not: Callable[[Effect], tuple[str, str] | None],
    sensors: Sequence[str] = SENSORS,
) -> tuple[list[Effect], list[dict]]:
    """
    Return (testable effects, list of {'effect', 'why', 'needs'} of untestable ones).

    Both are candidates of the catalogue that the model lacks and that act on `sensors`, those with
    readings. ``why_not(effect)`` gives (why, needs), or None for a testable effect.
    """
    testable = []
    untestable = []
    in_model = {e.key for e in model.effects}
    for key, effect in model.catalogue.effects(model.joint_names).items():
        acted_on = tuple(sensor for sensor in effect.sensors if sensor in sensors)
        if key in in_model or not acted_on or not model.catalogue.is_candidate(effect):
            continue
        # An effect of table or clock shows in the present sensors only.
        if acted_on != effect.sensors:
            effect = replace(effect, acts_on=acted_on)
        reason = why_not(effect)
        if reason is None:
            testable.append(effect)
        else:
            why, needs = reason
            untestable.append({'effect': effect.name, 'why': why, 'needs': needs})
    return testable, untestable


def lacking_temperature(effect: Effect, span: float | None) -> tuple[str, str] | None:
    """
    Return (why, needs) of an effect for which the temperature of a recording does not suffice.

    None for all other effects. `span`: range of the temperature, K; None where it is not known
    throughout.
    """
    if 'temperature' not in effect.needs:
        return None
    if span is None:
        return 'the temperature is not known throughout', 'record imu/temperature'
    if span < TEMPERATURE_SPAN:
        return (
            f'the temperature changed by {span:.2f} K only',
            'record while the sensor warms up by at least some kelvins',
        )
    return None


def time_constants(duration: float, number: int = N_TIME_CONSTANTS) -> np.ndarray:
    """
    Return time constants of warm-ups that a recording of `duration` s determines, s.

    Shape (number,); default the ones of the bank.
    """
    return np.geomspace(max(duration / 30, 5.0), 2.0 * duration, number)


def special(effect: Effect) -> bool:
    """
    Return whether an effect has no columns before its time is known, or none at all.

    Saturation (censoring), warm-up (bank of time constants), step (its time).
    """
    return effect.role is Role.LIMIT or effect.timed


STARTS = 6
"""
Number of start values of the time constant, with a ratio of 2.3: the iteration converges from a
start within this factor.
"""


def at_time_constants(model: SensorModel, effect: Effect, duration: float) -> list[SensorModel]:
    """
    Return the model with the columns of a warm-up at several time constants.

    A recording of `duration` s can show each of these time constants.
    """
    return [
        replace(model, point={**model.point, effect.name: effect.at_time_constant(constant)})
        for constant in time_constants(duration, STARTS)
    ]


def without_weakest(
    chosen: Sequence[Question], weakest: Callable[[list[Question]], int | None]
) -> list[Question]:
    """
    Return a choice by backward elimination: without its weakest effect, until none is weak.

    `weakest` returns the place of the effect that is removed next, None where all remain.
    """
    kept = list(chosen)
    while kept:
        place = weakest(kept)
        if place is None:
            break
        del kept[place]
    return kept
