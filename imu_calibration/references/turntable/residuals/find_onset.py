"""
Search for parameters that change at one moment (an onset).

A moment is first the number of the last window before it, then a time.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window
from imu_calibration.references.turntable.residuals.residual_blocks import residuals
from imu_calibration.references.turntable.selection.changes_in_time import (
    ChangeFit,
    ChangingColumns,
    WindowRows,
)
from imu_calibration.references.turntable.selection.linearised_problem import LinearisedProblem
from imu_calibration.references.turntable.selection.window_evidence import MIN_FOLD_WINDOWS
from imu_calibration.selection.explained_share import MIN_EXPLAINED_SHARE
from imu_calibration.selection.onset import Onset
from imu_calibration.selection.questions import Question
from imu_calibration.selection.unexplained import largest_axes

MIN_ONSET_WINDOWS = MIN_FOLD_WINDOWS + 1
"""
Least number of moving windows before and after an onset: the longer part, without the window of the
onset, can be searched.
"""
SUDDEN = 1e-3
"""
Least share of its gain by which an onset exceeds the gain of a gradual change of the same
parameters; a gradual change has five times as many parameters and gains more.
"""
GRADUAL = 5
"""Degree of the polynomial in time of a gradual change."""
COARSE = 40
"""Number of moments that are tried first; then all between the neighbours of the best."""
MOST_LIMITS = 100
"""Largest number of temperatures at which a step is tried."""
LIKELY = 16.0
"""
A moment between two windows is refined if its loss is at most the least one and this (a likelihood
ratio of 3e-4).
"""
SIMPLER = 1.25
"""
A group of fewer parameters is preferred if its excess is at most this many times the least one.
"""


def find_onset(
    problem: LinearisedProblem,
    chosen: Sequence[Question],
    *,
    windows: Sequence[Window],
    table: Table,
) -> Onset | None:
    """
    Return the Onset that explains the residual of a choice, None without one.

    For each group of parameters and each moment between two windows, the model ``columns @ values +
    after * columns[:, group] @ change`` is fitted with the noise at rest. The onset must remove
    `MIN_EXPLAINED_SHARE` of the significant excess, and more than a gradual change of the same
    parameters removes (a polynomial in time of degree `GRADUAL`). The moment is then refined to
    the sample at which the residuals of both states are least.
    """
    used = problem.search.indices(chosen)
    space = problem.evidence.space
    groups = _groups(problem.recording.model, problem.recording.sensors)

    # The parameters of the fits: the chosen ones first, then all that may change.
    parameters = list(used)
    for group in groups:
        parameters += [k for k in group.parameters.tolist() if k not in parameters]
    rows = WindowRows.of(space.restricted(np.array(parameters)), problem.explained.floor.noise)

    # Both parts must contain enough moving windows for a separate search.
    n_moving = np.cumsum(space.recording.moving)
    allowed = np.flatnonzero(
        (n_moving >= MIN_ONSET_WINDOWS) & (n_moving[-1] - n_moving >= MIN_ONSET_WINDOWS)
    )
    if not len(allowed):
        return None
    candidates = []
    for group in groups:
        candidate = _candidate(
            rows, group, np.array(parameters), n_chosen=len(used), allowed=allowed
        )
        if candidate is not None:
            candidates.append(candidate)
    if not candidates:
        return None

    # The fewest parameters that explain as much as the best, then the least excess. An excess that
    # noise could cause is not preferred to another one.
    limit = SIMPLER * min(max(candidate.excess, candidate.noise) for candidate in candidates)
    sufficient = [candidate for candidate in candidates if candidate.excess <= limit]
    best = min(
        sufficient, key=lambda candidate: (len(candidate.group.parameters), candidate.excess)
    )
    return _onset_of(best, problem, windows=windows, table=table)


@dataclass(frozen=True, eq=False)
class _Group:
    """Parameters that may change together."""

    name: str
    """Name of the effect of the reference, or the sensors of which biases or matrices change."""
    parameters: np.ndarray
    """Numbers of the parameters in the model, in order."""
    role: Role | None
    """Role of the parameters: bias or matrix; None for an effect of the reference."""


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A group of parameters that changes, at the moment at which this fits best."""

    group: _Group
    parameters: np.ndarray
    """Parameters of the fit: chosen ones and the group, numbers in the parameter space."""
    ends: tuple[int, int]
    """Windows between which the moment lies."""
    excess: float
    """Remaining squares beyond noise, without the windows about the moment."""
    noise: float
    """Largest `excess` that is not significant."""
    share: float
    """Share of the excess that the change removes."""
    fit: ChangeFit
    """The first state and the change."""
    temperature_c: float | None
    """Temperature that separates the windows before and after the moment; None without one."""


def _groups(model: SensorModel, sensors: Sequence[str]) -> list[_Group]:
    """Return the groups of parameters that may change suddenly."""
    numbers = np.arange(len(model.param_names))
    groups = []
    for effect in model.effects:
        if effect.sudden:
            groups.append(_Group(effect.name, numbers[model.slices[effect.key]], role=None))
    # A shock or a new start of a sensor changes its biases, a displaced mount its matrix.
    for prefix, role in (('bias of ', Role.OFFSET), ('', Role.LINEAR)):
        parts = [numbers[model.part(sensor, role)] for sensor in sensors]
        for sensor, part in zip(sensors, parts):
            groups.append(_Group(prefix + sensor, part, role))
        if len(parts) > 1:
            name = prefix + ' and '.join(sensors)
            groups.append(_Group(name, np.concatenate(parts), role))
    return groups


def _candidate(
    rows: WindowRows,
    group: _Group,
    parameters: np.ndarray,
    *,
    n_chosen: int,
    allowed: np.ndarray,
) -> _Candidate | None:
    """
    Return the _Candidate of a group, None where its change does not explain the excess.

    Parameters
    ----------
    rows : WindowRows
    group : _Group
    parameters : ndarray
        Parameters of the columns of `rows`, numbers in the parameter space.
    n_chosen : int
        Number of chosen parameters, which are the first of these.
    allowed : ndarray
        Windows after which the moment may lie.

    """
    # Places of the columns: chosen, changing, and all of the fit.
    chosen = np.arange(n_chosen)
    of_group = np.flatnonzero(np.isin(parameters, group.parameters))
    fitted = np.union1d(chosen, of_group)

    # The best moment.
    changing = rows.changing(of_group)
    losses = _losses_of_moments(rows, fitted, changing, allowed)
    last = min(losses, key=losses.__getitem__)
    least = losses[last]
    # Biases that change above a temperature, passed several times, are no onset.
    temperature_passed = None
    if group.role is Role.OFFSET:
        temperature = rows.space.recording.describe['temperature']
        temperature_passed = _passed_once(temperature, last)
        if temperature_passed is None and _follows_temperature(rows, fitted, changing, least):
            return None

    # The change lies within one of the windows about the moment, which hold both states: all
    # models are compared without them.
    clear = ~np.isin(np.arange(rows.count), (last, last + 1))
    compared = rows.selected(clear)
    changing = compared.changing(of_group)
    step_columns = changing.changes_along(_after(rows, last))
    constant = compared.fit(chosen)
    step = compared.fit(fitted, step_columns)
    gradual = compared.fit(fitted, changing.changes_along(_curves(rows.space.recording.time)))
    before = compared.excess(chosen, constant)
    after = compared.excess(fitted, step, step_columns)
    if after.squares >= (1 - MIN_EXPLAINED_SHARE) * before.squares:
        return None
    if gradual.loss - step.loss <= SUDDEN * (constant.loss - step.loss):
        return None
    # The moment is after the first of the likely windows, and before the one after the last.
    likely = [k for k, loss in losses.items() if loss < least + LIKELY]
    return _Candidate(
        group=group,
        parameters=parameters[fitted],
        ends=(min(likely), max(likely) + 1),
        excess=after.squares,
        noise=after.limit,
        share=1 - after.squares / before.squares,
        fit=step,
        temperature_c=temperature_passed,
    )


def _losses_of_moments(
    rows: WindowRows, fitted: np.ndarray, changing: ChangingColumns, allowed: np.ndarray
) -> dict[int, float]:
    """
    Return last window before a moment -> loss of the fit with a change there.

    The fit has the columns `fitted`, of which the amplitudes of `changing` change after one of the
    windows `allowed`.
    """
    # Places in `allowed` of evenly spread moments.
    coarse = np.unique(np.linspace(0, len(allowed) - 1, min(COARSE, len(allowed))).astype(int))
    losses = {}
    for last in allowed[coarse].tolist():
        losses[last] = _loss_of_step(rows, fitted, changing, _after(rows, last))
    # All moments between the neighbours of the best one, which has this place in `coarse`.
    place = int(np.searchsorted(allowed[coarse], min(losses, key=losses.__getitem__)))
    first = coarse[max(place - 1, 0)]
    end = coarse[min(place + 1, len(coarse) - 1)]
    for last in allowed[first:end].tolist():
        if last not in losses:
            losses[last] = _loss_of_step(rows, fitted, changing, _after(rows, last))
    return losses


def _loss_of_step(
    rows: WindowRows, fitted: np.ndarray, changing: ChangingColumns, in_second_state: np.ndarray
) -> float:
    """
    Return the loss with other values of the changing columns in some windows.

    `in_second_state` is 1 in these windows and 0 in the other ones, shape (n, 1).
    """
    return rows.fit(fitted, changing.changes_along(in_second_state)).loss


def _follows_temperature(
    rows: WindowRows, fitted: np.ndarray, changing: ChangingColumns, loss: float
) -> bool:
    """
    Return whether a step above some temperature fits as well as one at a moment with a `loss`.

    An offset above a temperature is a place (`selection.regimes`), not an onset.
    """
    temperature = rows.space.recording.describe['temperature']
    if not np.all(np.isfinite(temperature)) or np.ptp(temperature) == 0:
        return False
    # As for onsets, at least `MIN_ONSET_WINDOWS` windows on either side.
    limits = np.sort(temperature)[MIN_ONSET_WINDOWS:-MIN_ONSET_WINDOWS]
    for limit in limits[:: max(len(limits) // MOST_LIMITS, 1)]:
        above = (temperature > limit).astype(float)[:, None]
        if _loss_of_step(rows, fitted, changing, above) <= loss:
            return True
    return False


def _passed_once(temperature: np.ndarray, last: int) -> float | None:
    """
    Return a temperature between all windows up to the window `last` and all later ones.

    None if the ranges of both parts overlap.
    """
    before = temperature[: last + 1]
    after = temperature[last + 1 :]
    for lower, upper in ((before, after), (after, before)):
        if lower.max() < upper.min():
            return float(0.5 * (lower.max() + upper.min()))
    return None


def _after(rows: WindowRows, last: int) -> np.ndarray:
    """Return 1 in each window after the window `last`, shape (n, 1)."""
    return (np.arange(rows.count) > last).astype(float)[:, None]


def _curves(time: np.ndarray) -> np.ndarray:
    """Return the Legendre polynomials of degree 1 to `GRADUAL` over the times, shape (n, m)."""
    middle = 0.5 * (time[0] + time[-1])
    half = max(0.5 * (time[-1] - time[0]), 1e-9)
    return np.polynomial.legendre.legvander((time - middle) / half, GRADUAL)[:, 1:]


def _onset_of(
    candidate: _Candidate, problem: LinearisedProblem, *, windows: Sequence[Window], table: Table
) -> Onset:
    """Return the Onset of a candidate, with its moment refined to a sample."""
    model = problem.recording.model
    group = candidate.group
    change = candidate.fit.change
    sd = candidate.fit.change_sd

    # All parameters before and after the moment.
    values = np.zeros(problem.space.size)
    values[candidate.parameters] = candidate.fit.values
    changed = np.zeros(problem.space.size)
    changed[group.parameters] = change
    first_state = problem.absolute(values)
    states = [first_state, first_state + changed]
    ends = problem.evidence.space.recording.time[list(candidate.ends)]
    moment, moment_sd = _refined(windows, table, model, states=states, between=(ends[0], ends[1]))

    # Names, units and both values of the parameters that change.
    names = [problem.space.names[k] for k in group.parameters]
    units = {}
    for effect in model.effects:
        for k, label in enumerate(effect.param_names()):
            units[label] = effect.unit_of(k)
    before = dict(zip(names, states[0][group.parameters].tolist()))
    after = dict(zip(names, states[1][group.parameters].tolist()))

    # Axes of each sensor by the squares of their changes above the expectation from noise, sd^2.
    sensor_axes: dict[str, tuple[str, ...]] = {}
    if group.role is not None:
        # Each axis of a sensor has one bias, or three elements in its row of the matrix.
        n_per_axis = 1 if group.role is Role.OFFSET else 3
        # Biases of the two sensors have different units: they are compared in standard deviations.
        unit = sd if group.role is Role.OFFSET else 1.0
        squares = np.maximum((change / unit) ** 2 - (sd / unit) ** 2, 0.0)
        squares = squares.reshape(-1, 3, n_per_axis).sum(axis=2)  # (n_sensors, 3)
        sensors = dict.fromkeys(name.partition('.')[0] for name in names)
        for sensor, squares_of_axes in zip(sensors, squares, strict=True):
            sensor_axes[sensor] = largest_axes(squares_of_axes)
    return Onset(
        time=moment,
        time_sd=moment_sd,
        what=group.name,
        before=before,
        after=after,
        sd=dict(zip(names, sd.tolist())),
        units={label: units[label] for label in names},
        share=candidate.share,
        sensor_axes=sensor_axes,
        temperature_c=candidate.temperature_c,
    )


def _refined(
    windows: Sequence[Window],
    table: Table,
    model: SensorModel,
    *,
    states: Sequence[np.ndarray],
    between: tuple[float, float],
) -> tuple[float, float]:
    """
    Return (mean, standard deviation) of the posterior of the moment between two times, s.

    With a flat prior, ``p(t) ~ exp(-S(t) / 2)``, S the sum of squares of the residuals of the first
    state before t and the second after it.
    """
    near = [w for w in windows if w.time[-1] >= between[0] and w.time[0] <= between[1]]
    noise = dict(zip(SENSORS, np.median([w.noise_sd for w in near], axis=0)))
    squares: list[np.ndarray] = []  # of each state, at each sample
    for state in states:
        residual_of = residuals(near, table, model, values=state[: len(model.param_names)])
        of_state = np.zeros(sum(len(window) for window in near))
        for sensor, residual in residual_of.items():
            of_state = of_state + ((residual / noise[sensor]) ** 2).sum(axis=1)
        squares.append(of_state)

    # S up to a constant, for a moment between each sample and the next one.
    cost = np.cumsum(squares[0] - squares[1])[:-1]
    time = np.concatenate([window.time for window in near])
    gap = np.diff(time)
    probability = np.exp((cost.min() - cost) / 2) * gap
    middle = time[:-1] + gap / 2
    mean = probability @ middle / probability.sum()
    # The moment is uniform within its gap: variance gap^2 / 12.
    squared_deviation = (middle - mean) ** 2 + gap**2 / 12
    variance = probability @ squared_deviation / probability.sum()
    return float(mean), float(np.sqrt(variance))
