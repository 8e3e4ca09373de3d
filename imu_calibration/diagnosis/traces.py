"""Residuals before and after as a person looks at them: averaged over short blocks, and dead reckoning with both models."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.effects.columns import INPUT_OF, warped_reference
from imu_calibration.effects.forward_equations import predict
from imu_calibration.estimation.solution import Solution
from imu_calibration.navigation import drift_over
from imu_calibration.reference.table import Table
from imu_calibration.segmentation.window import Window, all_samples, chunks

BLOCK = 0.25
"""Residuals are averaged over this time for plots, s."""


DEAD_RECKONING = 50.0
"""Length of dead reckoning, s."""


@dataclass(frozen=True, eq=False)
class Traces:
    """Residuals averaged over short blocks, before and after, with what they may be drawn against."""

    time: np.ndarray
    """Middle of each block, s, shape (n,)."""
    kind: np.ndarray
    """Kind of the window it comes from, shape (n,)."""
    position: np.ndarray
    """Joint angles, rad, shape (n, n_joints)."""
    force_s: np.ndarray
    """Reference specific force, m/s^2, shape (n, 3)."""
    rate_s: np.ndarray
    """Reference rate, rad/s, shape (n, 3)."""
    temperature_c: np.ndarray | None
    """Temperature, shape (n,), or None."""
    before: dict
    """Sensor -> measured minus predicted by the baseline, shape (n, 3)."""
    after: dict
    """Sensor -> measured minus predicted by the extended model, shape (n, 3)."""
    samples: np.ndarray
    """Samples in each block, shape (n,)."""
    dead_reckoning: dict | None
    """{'seconds', 'position_before', 'position_after', 'velocity_before', 'velocity_after', 'stretches'}: medians, m and m/s, or None when
    no stretch of the recording is long enough."""


def residual_traces(windows: Sequence[Window], table: Table, before: Solution, *, after: Solution) -> Traces:
    """
    Return the Traces of two solutions.

    Parameters
    ----------
    windows : sequence of Window
        May include those of kind 'unused', which make dead reckoning possible.
    before, after : Solution

    """
    solutions = before, after
    warm = all(window.temperature_c is not None for window in windows)
    parts = [_errors(group, table, solutions, warm) for group in chunks(windows)]
    errors = [{s: np.concatenate([part[k][s] for part, _ in parts]) for s in SENSORS} for k in range(len(solutions))]
    time = np.concatenate([w.time for w in windows])
    navigation = _dead_reckoning(time, windows, table, solutions=solutions, errors=errors)
    known = np.concatenate([np.full(len(w.time), w.kind != 'unused') for w in windows])
    block, number = _blocks(windows)

    def mean(values):
        return _block_mean(np.asarray(values, float)[known], block, number)
    position, force_s, rate_s = (mean(np.concatenate([beside[k] for _, beside in parts])) for k in range(3))
    temperature = mean(np.concatenate([beside[3] for _, beside in parts])) if warm else None
    kind = np.concatenate([np.full(len(w.time), w.kind) for w in windows])[known]
    return Traces(mean(time), kind[np.searchsorted(block, np.arange(len(number)))], position, force_s, rate_s, temperature,
                  {s: mean(errors[0][s]) for s in SENSORS}, {s: mean(errors[1][s]) for s in SENSORS}, number, navigation)


def _errors(windows, table, solutions, warm):
    """Return (measured minus predicted of each solution by sensor, (position, force, rate, temperature) to draw it against)."""
    motion, temperature, rows = all_samples(windows)
    temperature = temperature if warm else None
    outputs = {'accelerometer': np.concatenate([w.force_s for w in windows]), 'gyroscope': np.concatenate([w.rate_s for w in windows])}
    found = []
    for solution in solutions:
        predicted = predict(solution.model.at(solution.values), solution.values, table, motion=motion, temperature_c=temperature)
        found.append({s: outputs[s] - predicted[k][rows] for k, s in enumerate(SENSORS)})
    first = _references(solutions[0], table, motion, temperature)
    return found, (motion.position[rows], first['accelerometer'].force_s[rows], first['gyroscope'].rate_s[rows],
                   None if temperature is None else temperature[rows])


def _references(solution, table, motion, temperature):
    """Return sensor -> the Reference of its samples at a solution."""
    return {s: warped_reference(solution.model.at(solution.values), s, table, motion=motion, temperature_c=temperature) for s in SENSORS}


def _blocks(windows):
    """Return the block number of each known sample and the size of each block; blocks end with their window."""
    numbers, last = [], 0
    for window in windows:
        if window.kind == 'unused':
            continue
        number = ((window.time - window.time[0]) / BLOCK).astype(int)
        numbers.append(last + number)
        last += int(number[-1]) + 1
    unique, block = np.unique(np.concatenate(numbers), return_inverse=True)
    return block, np.bincount(block, minlength=len(unique))


def _block_mean(values, block, number):
    columns = values.reshape(len(values), -1)
    means = np.stack([np.bincount(block, column, len(number)) / number for column in columns.T], axis=1)
    return means[:, 0] if values.ndim == 1 else means


def _dead_reckoning(time, windows, table, *, solutions, errors):
    """Return medians over stretches of 50 s without gaps, or None."""
    edges = np.flatnonzero(np.diff(time) > 0.1)
    starts, stops = np.r_[0, edges + 1], np.r_[edges + 1, len(time)]
    pieces = [slice(a, b) for a, b in zip(starts, stops) if time[b - 1] - time[a] >= DEAD_RECKONING and np.all(np.diff(time[a:b]) > 0)]
    if not pieces:
        return None
    motion, temperature, rows = all_samples(windows)
    found = []
    for solution, error in zip(solutions, errors):
        references = _references(solution, table, motion, temperature)
        ends = [_drifts(piece, time, solution, error, references, rows) for piece in pieces]
        found.append((np.median(np.concatenate([e.position for e in ends])), np.median(np.concatenate([e.velocity for e in ends])),
                      sum(len(e.position) for e in ends)))
    return {'seconds': DEAD_RECKONING, 'position_before': float(found[0][0]), 'position_after': float(found[1][0]),
            'velocity_before': float(found[0][1]), 'velocity_after': float(found[1][1]), 'stretches': int(found[0][2])}


def _drifts(piece, time, solution, error, reference, rows):
    at = rows[piece]
    felt = {}
    for sensor in SENSORS:
        matrix = solution.model.value(sensor, Role.LINEAR, solution.values)
        felt[sensor] = getattr(reference[sensor], INPUT_OF[sensor])[at] + np.linalg.solve(matrix, error[sensor][piece].T).T
    base = reference['accelerometer'].select(at)
    true = replace(base, time=time[piece], rate_s=reference['gyroscope'].rate_s[at])
    return drift_over(true, felt['accelerometer'], felt['gyroscope'], seconds=DEAD_RECKONING)
