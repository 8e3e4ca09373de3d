"""Poses and turns of a hand, planned: the same gain per second as on a table, from the equations of a calibration by hand."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from imu_calibration.by_hand.advice import HandStep, pose_steps, turn_steps
from imu_calibration.by_hand.model import GYRO_BIAS, HandModel
from imu_calibration.estimation.noise_model import NoiseModel

POSE_SECONDS, TURN_SECONDS = 6.0, 9.0
"""What a person takes to bring the IMU to a pose and hold it still for three seconds; to turn it, still before and after."""
STILL = 3.0
"""Seconds for which a pose is held."""
LEVEL_SD = 2e-3
"""How well the direction of gravity closes a turn by hand, rad: what the poses before and after leave."""
MOST_STEPS = 80
LEAST_GAIN = 5e-3
"""A step must lower the sum of logarithms of excess over tolerance by so much."""


@dataclass(frozen=True, eq=False)
class HandPlan:
    """Poses and turns one after the other, and what they promise."""

    steps: tuple[HandStep, ...]
    """In the order of time."""
    seconds: float
    """Time that a person takes, s."""
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
        """Parameters that stay outside their tolerance."""
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
    information = np.diag(1 / model.priors**2)
    candidates = [(step, seconds, step.rows.T @ step.rows) for step, seconds in _candidates(model, noise, rate)]
    added = np.array([own for _, _, own in candidates])
    times = np.array([seconds for _, seconds, _ in candidates])
    chosen, history, total = [], [_excess(information, tolerances)], 0.0
    while len(chosen) < MOST_STEPS and history[-1].max() > 1.0:
        left = np.array([_left(_excess(information + own, tolerances)) for own in added])
        gain = _left(history[-1]) - left
        best = int(np.argmax(gain / times))
        if gain[best] < LEAST_GAIN:
            break
        information = information + added[best]
        chosen.append(candidates[best][0])
        history.append(_excess(information, tolerances))
        total += float(times[best])
    return HandPlan(tuple(chosen), total, model.param_names, history[-1] * tolerances, tolerances, np.array(history))


def _candidates(model, noise, rate) -> Iterator[tuple[HandStep, float]]:
    samples = STILL * rate
    force_sd, rate_sd = (float(np.sqrt(noise[s].low_variance.mean() / samples + sum(p.sd**2 for p in noise[s].bias_processes)))
                         for s in ('accelerometer', 'gyroscope'))
    resting = np.zeros((3, model.size))
    resting[:, GYRO_BIAS] = np.eye(3) / rate_sd
    for step in pose_steps(model, model.nominal, force_sd):
        yield HandStep(np.concatenate([step.rows, resting]), step.words, step.up), POSE_SECONDS
    angle_sd = float(np.hypot(LEVEL_SD / np.sqrt(2), np.sqrt(noise['gyroscope'].low_variance.mean() * TURN_SECONDS / rate)))
    for step in turn_steps(model, angle_sd):
        yield step, TURN_SECONDS


def _excess(information, tolerances):
    return np.sqrt(np.diag(np.linalg.inv(information))) / tolerances


def _left(excess):
    return float(np.maximum(np.log(excess), 0.0).sum())



def hand_plan_to_mapping(plan: HandPlan, provenance: dict[str, Any]) -> dict[str, Any]:
    """Return what plan.yaml holds of a plan by hand: plain data, SI."""
    return {'format': 'imu_calibration/plan/1', 'seconds': round(plan.seconds, 3), 'lower_bound_seconds': None,
            'motions': [{'kind': 'turn' if step.turn else 'pose', 'text': step.words, 'up': [float(f'{c:.6g}') for c in step.up]}
                        for step in plan.steps],
            'parameters': {name: {'sd': float(f'{sd:.6g}'), 'tolerance': float(f'{tolerance:.6g}'), 'met': bool(sd <= tolerance)}
                           for name, sd, tolerance in zip(plan.param_names, plan.sd, plan.tolerances, strict=True)},
            'missing': list(plan.missing), 'provenance': provenance}
