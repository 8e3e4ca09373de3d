"""Candidate effects of a search, and repeated linearisation at their estimates."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.effects.base import SENSORS, Effect, Role
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import Solution

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
    """Return a choice with another question in a place."""
    return [*chosen[:place], other, *chosen[place + 1 :]]


def smooth_parameters(asked: Sequence[Question]) -> dict[str, list[tuple[int, ...]]]:
    """Return sensor -> list of the parameters of effects that are smooth in time."""
    found: dict[str, list[tuple[int, ...]]] = {sensor: [] for sensor in SENSORS}
    for question in asked:
        if question.effect.smooth and question.sensor in found:
            found[question.sensor].append(question.parameters)
    return found


def sort_effects(
    model: SensorModel, why_not: Callable, sensors: Sequence[str] = SENSORS
) -> tuple[list[Effect], list[dict]]:
    """
    Return (testable effects, list of {'effect', 'why', 'needs'}).

    Both refer to the catalogue's candidates on the `sensors` with readings that the model lacks.

    ``why_not(effect)`` gives (why, needs), or None for a testable effect.
    """
    known, lacking = [], []
    have = {e.key for e in model.effects}
    for key, effect in model.catalogue.effects(model.joint_names).items():
        acted_on = tuple(sensor for sensor in effect.sensors if sensor in sensors)
        if key in have or not acted_on or not model.catalogue.is_candidate(effect):
            continue
        # An effect of table or clock shows in the present sensors only.
        if acted_on != effect.sensors:
            effect = replace(effect, acts_on=acted_on)
        why = why_not(effect)
        if why is None:
            known.append(effect)
        else:
            lacking.append({'effect': effect.name, 'why': why[0], 'needs': why[1]})
    return known, lacking


def lacking_temperature(effect: Effect, span: float | None) -> tuple[str, str] | None:
    """
    Return (why, needs) of an effect that the temperature of a recording does not show.

    `span`: range of the temperature, K; None where it is not known throughout.
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


def extended_model(model: SensorModel, effects: Sequence[Effect]) -> SensorModel:
    """
    Return the model with all these effects, except the ones tested differently.

    The exceptions are warm-ups and saturation.
    """
    kept = [e for e in effects if e.warp is not None or not special(e)]
    for effect in kept:
        model = model.with_effect(effect.sensor, effect.name)
    return model


def point_with(
    model: SensorModel, effects: Sequence[Effect], values: dict[str, float]
) -> tuple[SensorModel, np.ndarray]:
    """
    Return (the model with all these effects linearised there, its parameters).

    The linearisation is at the given values, else at the prior.
    """
    wide = extended_model(model, effects)
    start = np.array(
        [values.get(name, known) for name, known in zip(wide.param_names, wide.start())]
    )
    start = np.where(np.isfinite(start), start, 0.0)
    return wide.at(start), start


def without_saturation(effects: Sequence[Effect]) -> list[Effect]:
    """Return the effects that are tested by columns; a step has columns only at a known time."""
    return [effect for effect in effects if effect.role is not Role.LIMIT and not effect.located]


def special(effect: Effect) -> bool:
    """
    Return whether an effect has no columns of its own.

    Saturation (censoring), warm-up (bank of time constants), step (its time).
    """
    return effect.role is Role.LIMIT or effect.timed


MAX_TABLE_PASSES = 6
"""Most passes over a recording with repeated linearisation."""
STARTS = 6
"""
Number of start values of the time constant, with a ratio of 2.3: the iteration converges from a
start within this factor.
"""
LINEAR_STEPS = 25
"""
Steps of a numerical derivative (5 ms of a delay) up to which a linearisation is valid in weakly
determined directions.
"""


LEAST_TIME_CONSTANT = 0.3
"""Least time constant after a step, as a share of that before it."""


def linearise_again(model: SensorModel, solution: Solution) -> SensorModel | None:
    """
    Return the model linearised at a solution outside the validity of its linearisation, else None.
    """
    for effect in model.relinearised:
        if effect.key in solution.model.slices:
            part = solution.model.slices[effect.key]
            moved = np.abs(solution.values[part] - model.point_of(effect))
            if np.any(moved > np.maximum(3 * solution.sd[part], 5 * effect.step)):
                return model.at(model.start_from(solution.model, _cautious(solution)))
    return None


def at_time_constants(model: SensorModel, effect: Effect, duration: float) -> list[SensorModel]:
    """
    Return the model with the columns of a warm-up at several time constants.

    A recording of `duration` s can show each of these time constants.
    """
    return [
        replace(model, point={**model.point, effect.name: effect.at_time_constant(constant)})
        for constant in time_constants(duration, STARTS)
    ]


def _cautious(solution: Solution) -> np.ndarray:
    """
    Return values to linearise at: those of the solution, except along weakly determined directions.

    At zero, lag and delay have the same first derivative. They are separable only at a point where
    both are nonzero; a full step along their difference would be arbitrary. The step is therefore
    regularised with LINEAR_STEPS towards the point. A time constant is positive: its step ends at
    the share `LEAST_TIME_CONSTANT` of the point at the latest.
    """
    model, values = solution.model, solution.values.copy()
    for effect in model.relinearised:
        if effect.time_constant:
            last = model.slices[effect.key].stop - 1
            values[last] = max(values[last], LEAST_TIME_CONSTANT * model.point_of(effect)[-1])
    move, pull = np.zeros(len(values)), np.zeros(len(values))
    for effect in model.relinearised:
        if effect.warp is not None:
            part = model.slices[effect.key]
            move[part], pull[part] = (
                values[part] - model.point_of(effect),
                (LINEAR_STEPS * effect.step) ** -2,
            )
    moving = np.flatnonzero(pull)
    if not len(moving):
        return values
    known = np.linalg.inv(solution.covariance[np.ix_(moving, moving)])
    kept = values.copy()
    kept[moving] -= np.linalg.solve(known + np.diag(pull[moving]), pull[moving] * move[moving])
    return kept
