"""A complete plan of poses and turns by hand, by the planner of the next pose (`advice`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from imu_calibration.calibration.advice import foretold, knowledge_at_first
from imu_calibration.calibration.hand_step import HOLD_TIME, TURN_RATE, HandStep
from imu_calibration.estimation.noise_model import NoiseModel
from imu_calibration.references.gravity.hand_parameters import HandModel


@dataclass(frozen=True, eq=False)
class HandPlan:
    """A sequence of poses and turns, with its predicted standard deviations."""

    steps: tuple[HandStep, ...]
    """In the order of time."""
    seconds: float
    """Duration, s."""
    param_names: tuple[str, ...]
    """Parameters, in the order of the standard deviations."""
    sd: np.ndarray
    """Predicted standard deviations, SI."""
    tolerances: np.ndarray
    """SI."""
    history: np.ndarray
    """Standard deviations in tolerances before the first step and after each, shape (n_steps + 1, n)."""

    @property
    def missing(self) -> tuple[str, ...]:
        """Parameters that remain outside their tolerance."""
        return tuple(name for name, sd, tolerance in zip(self.param_names, self.sd, self.tolerances, strict=True) if sd > tolerance)


def plan_by_hand(model: HandModel, *, tolerances: np.ndarray, noise: Mapping[str, NoiseModel], rate: float) -> HandPlan:
    """
    Return the poses and turns that bring every parameter within its tolerance, each the best per second at its time.

    Parameters
    ----------
    model : HandModel
    tolerances : ndarray, shape (n,)
    noise : mapping
        Sensor -> NoiseModel of single samples.
    rate : float
        Samples per second.

    """
    force_sd, rate_sd = (float(np.sqrt(noise[s].low_variance.mean() / (HOLD_TIME * rate) + sum(p.sd**2 for p in noise[s].bias_processes)))
                         for s in ('accelerometer', 'gyroscope'))
    turn_sd = float(np.sqrt(noise['gyroscope'].low_variance.mean() * (np.pi / TURN_RATE) / rate))
    knowledge = knowledge_at_first(model, tolerances, noise=(force_sd, rate_sd, turn_sd))
    steps = foretold(knowledge)
    history = [knowledge.sd(knowledge.information)]
    for step in steps:
        knowledge = knowledge.then(step)
        history.append(knowledge.sd(knowledge.information))
    names, free = np.array(model.model.param_names)[~model.fixed].tolist(), np.array(history)[:, ~model.fixed]
    return HandPlan(tuple(steps), sum(step.seconds for step in steps), tuple(names), free[-1], tolerances[~model.fixed],
                    free / tolerances[~model.fixed])


def hand_plan_to_mapping(plan: HandPlan, provenance: dict[str, Any]) -> dict[str, Any]:
    """Return the contents of plan.yaml for a plan by hand: plain data, SI."""
    return {'format': 'imu_calibration/plan/1', 'seconds': round(plan.seconds, 3), 'lower_bound_seconds': None,
            'motions': [_step(step) for step in plan.steps],
            'parameters': {name: {'sd': float(f'{sd:.6g}'), 'tolerance': float(f'{tolerance:.6g}'), 'met': bool(sd <= tolerance)}
                           for name, sd, tolerance in zip(plan.param_names, plan.sd, plan.tolerances, strict=True)},
            'missing': list(plan.missing), 'provenance': provenance}


def _step(step):
    found = {'kind': 'turn' if step.is_turn else 'pose', 'text': step.words, 'seconds': round(step.seconds, 3),
             'up': [float(f'{c:.6g}') for c in step.up]}
    if step.is_turn:
        found |= {'turn_axis': [float(f'{c:.6g}') for c in step.axis], 'turn_deg': round(float(np.degrees(step.angle)), 1)}
    return found
