"""Search for parameters that change at one moment."""

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
from imu_calibration.references.turntable.selection.explained_windows import ExplainedWindows
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
"""Moments that are tried first; then all about the best of them."""


MOST_LIMITS = 100
"""Temperatures at which a step is tried."""


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
    explained: ExplainedWindows,
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

    # The chosen parameters and those that may change, the chosen ones first.
    parameters = list(used)
    for group in groups:
        parameters += [k for k in group.parameters.tolist() if k not in parameters]
    kept = np.array(parameters)
    rows = WindowRows.of(space.restricted(kept), explained.floor.noise)

    # Both parts must hold enough moving windows for a search of their own.
    moving = np.cumsum(space.recording.moving)
    allowed = np.flatnonzero(
        (moving >= MIN_ONSET_WINDOWS) & (moving[-1] - moving >= MIN_ONSET_WINDOWS)
    )
    if not len(allowed):
        return None
    found = []
    for group in groups:
        candidate = _candidate(rows, group, kept, n_base=len(used), allowed=allowed)
        if candidate is not None:
            found.append(candidate)
    if not found:
        return None

    # The fewest parameters that explain as much as the best, then the least excess.
    most = SIMPLER * min(max(entry.excess, entry.noise) for entry in found)
    good = [entry for entry in found if entry.excess <= most]
    best = min(good, key=lambda entry: (len(entry.group.parameters), entry.excess))
    return _onset_of(best, problem, windows=windows, table=table)


@dataclass(frozen=True, eq=False)
class _Group:
    """Parameters that may change together."""

    name: str
    """Name of the effect of the reference, or the sensors of which biases or matrices change."""
    parameters: np.ndarray
    """Their numbers in the model, in order."""
    role: Role | None
    """Place in the equation of the sensors; None for an effect of the reference."""


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A group of parameters that changes, at the moment at which this fits best."""

    group: _Group
    own: np.ndarray
    """Parameters of the fit, numbers in the parameter space."""
    ends: tuple[int, int]
    """Windows between which the moment lies."""
    excess: float
    """Squares that remain beyond noise, without the windows about the moment."""
    noise: float
    """Limit of an excess that is significant, in the parts in which one remains."""
    share: float
    """Share of the excess that the second state removes."""
    fit: ChangeFit
    """The first state and the change."""
    temperature_c: float | None
    """Temperature that is passed at the moment only; None without one."""


def _groups(model: SensorModel, sensors: Sequence[str]) -> list[_Group]:
    """Return the groups of parameters that may change suddenly."""
    numbers = np.arange(len(model.param_names))
    groups = []
    for effect in model.effects:
        if effect.sudden:
            groups.append(_Group(effect.name, numbers[model.slices[effect.key]], None))
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
    rows: WindowRows, group: _Group, kept: np.ndarray, *, n_base: int, allowed: np.ndarray
) -> _Candidate | None:
    """
    Return the _Candidate of a group, None where its change does not explain the excess.

    Parameters
    ----------
    rows : WindowRows
    group : _Group
    kept : ndarray
        Parameters of the rows, numbers in the parameter space.
    n_base : int
        Number of chosen parameters, which are the first of them.
    allowed : ndarray
        Windows after which a moment may lie.

    """
    base = np.arange(n_base)
    at = np.flatnonzero(np.isin(kept, group.parameters))
    own = np.union1d(base, at)
    changing = rows.changing(at)
    losses = _losses_of_moments(rows, own, changing, allowed)
    last = min(losses, key=losses.__getitem__)
    least = losses[last]
    warmth = rows.space.recording.describe['temperature']
    passed = None
    if group.role is Role.OFFSET:
        passed = _passed_once(warmth, last)
        if passed is None and _follows_temperature(rows, own, changing, least):
            return None

    # The change lies within one of the windows about the moment, which hold both states: all
    # models are compared without them.
    clear = ~np.isin(np.arange(rows.count), (last, last + 1))
    apart = rows.selected(clear)
    changing = apart.changing(at)
    change = changing.along(_after(rows, last))
    alone = apart.fit(base)
    step = apart.fit(own, change)
    gradual = apart.fit(own, changing.along(_curves(rows.space.recording.time)))
    before = apart.excess(base, alone)
    after = apart.excess(own, step, change)
    if after.squares >= (1 - MIN_EXPLAINED_SHARE) * before.squares:
        return None
    if gradual.loss - step.loss <= SUDDEN * (alone.loss - step.loss):
        return None
    likely = [k for k, loss in losses.items() if loss < least + LIKELY]
    return _Candidate(
        group,
        kept[own],
        ends=(min(likely), max(likely) + 1),
        excess=after.squares,
        noise=after.limit,
        share=1 - after.squares / before.squares,
        fit=step,
        temperature_c=passed,
    )


def _losses_of_moments(
    rows: WindowRows, own: np.ndarray, changing: ChangingColumns, allowed: np.ndarray
) -> dict[int, float]:
    """Return last window before a moment -> loss of the fit with a change there."""
    coarse = np.unique(np.linspace(0, len(allowed) - 1, min(COARSE, len(allowed))).astype(int))
    losses = {}
    for last in allowed[coarse].tolist():
        losses[last] = _loss_of_step(rows, own, changing, _after(rows, last))
    # All moments between the neighbours of the best one.
    place = int(np.searchsorted(allowed[coarse], min(losses, key=losses.__getitem__)))
    first = coarse[max(place - 1, 0)]
    end = coarse[min(place + 1, len(coarse) - 1)]
    for last in allowed[first:end].tolist():
        if last not in losses:
            losses[last] = _loss_of_step(rows, own, changing, _after(rows, last))
    return losses


def _loss_of_step(
    rows: WindowRows, own: np.ndarray, changing: ChangingColumns, second: np.ndarray
) -> float:
    """Return the loss with another value of some parameters where `second` (n, 1) is one."""
    return rows.fit(own, changing.along(second)).loss


def _follows_temperature(
    rows: WindowRows, own: np.ndarray, changing: ChangingColumns, loss: float
) -> bool:
    """
    Return whether a step where the temperature passes a value fits as well as one at a moment.

    An offset above a temperature is a place (`selection.regimes`), not an onset.
    """
    warmth = rows.space.recording.describe['temperature']
    if not np.all(np.isfinite(warmth)) or np.ptp(warmth) == 0:
        return False
    limits = np.sort(warmth)[MIN_ONSET_WINDOWS:-MIN_ONSET_WINDOWS]
    for limit in limits[:: max(len(limits) // MOST_LIMITS, 1)]:
        warm = (warmth > limit).astype(float)[:, None]
        if _loss_of_step(rows, own, changing, warm) <= loss:
            return True
    return False


def _passed_once(warmth: np.ndarray, last: int) -> float | None:
    """Return a temperature on different sides of which the windows up to and after `last` are."""
    first = warmth[: last + 1]
    second = warmth[last + 1 :]
    for lower, upper in ((first, second), (second, first)):
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
    """Return the Onset of a _Candidate, with its moment refined to a sample."""
    model = problem.recording.model
    group = candidate.group
    change = candidate.fit.change
    sd = candidate.fit.change_sd

    # Both states of all parameters; the change is added to the first.
    values = np.zeros(problem.space.size)
    values[candidate.own] = candidate.fit.values
    changed = np.zeros(problem.space.size)
    changed[group.parameters] = change
    first_state = problem.absolute(values)
    states = [first_state, first_state + changed]
    ends = problem.evidence.space.recording.time[list(candidate.ends)]
    moment, moment_sd = _refined(windows, table, model, states=states, between=(ends[0], ends[1]))

    names = [problem.space.names[k] for k in group.parameters]
    units = {}
    for effect in model.effects:
        for k, label in enumerate(effect.param_names()):
            units[label] = effect.unit_of(k)
    before = dict(zip(names, states[0][group.parameters].tolist()))
    after = dict(zip(names, states[1][group.parameters].tolist()))
    sensor_axes: dict[str, tuple[str, ...]] = {}
    if group.role is not None:
        # Of each sensor of the group three biases, or the nine elements of a matrix row by row.
        per_row = 1 if group.role is Role.OFFSET else 3
        # Biases of the two sensors have different units: they are compared in standard deviations.
        unit = sd if group.role is Role.OFFSET else 1.0
        squares = np.maximum((change / unit) ** 2 - (sd / unit) ** 2, 0.0)
        squares = squares.reshape(-1, 3, per_row).sum(axis=2)
        sensors = dict.fromkeys(name.partition('.')[0] for name in names)
        for sensor, squares_of_axes in zip(sensors, squares, strict=True):
            sensor_axes[sensor] = largest_axes(squares_of_axes)
    return Onset(
        moment,
        moment_sd,
        group.name,
        before,
        after,
        dict(zip(names, sd.tolist())),
        {label: units[label] for label in names},
        candidate.share,
        sensor_axes,
        candidate.temperature_c,
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
    squares = []  # of each state, at each sample
    for state in states:
        residual_of = residuals(near, table, model, values=state[: len(model.param_names)])
        squares.append(
            sum(((rest / noise[sensor]) ** 2).sum(axis=1) for sensor, rest in residual_of.items())
        )

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
