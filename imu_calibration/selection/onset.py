"""
Parameters that change at one moment.

Exchanged axes, a displaced mount, a belt that slipped, a clock that was set.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window
from imu_calibration.selection.evidence import MIN_FOLD_WINDOWS
from imu_calibration.selection.explained_share import (
    MIN_EXPLAINED_SHARE,
    SIGNIFICANT_REST,
    ExplainedWindows,
)
from imu_calibration.selection.linearised_problem import LinearisedProblem
from imu_calibration.selection.parameter_space import matrix_of_each
from imu_calibration.selection.questions import Question
from imu_calibration.selection.residual_blocks import largest_axes, residuals

MIN_ONSET_WINDOWS = MIN_FOLD_WINDOWS + 1
"""
Least number of moving windows before and after an onset: the longer part, without the window of the
onset, can be searched.
"""
SUDDEN = 0.5
"""
Largest share of the excess of a gradual change that an onset may have: above it the change may be
gradual.
"""
GRADUAL = 5
"""
Degree of the polynomial in time of a gradual change. A step keeps a tenth of its variance beside
such a polynomial, a clock that bends with the temperature hardly anything.
"""
LIKELY = 16.0
"""
A moment between two windows is refined if its loss is at most the least one and this (a likelihood
ratio of 3e-4).
"""
SIMPLER = 1.25
"""
A group of fewer parameters is preferred if its excess is at most this many times the least one.
"""


@dataclass(frozen=True, eq=False)
class Onset:
    """A group of parameters with one value before and another value after a moment."""

    time: float
    """Moment of the change, s since the first sample."""
    time_sd: float
    """Its standard deviation, s."""
    what: str
    """Name of the effect of the reference, or the sensors whose matrices change."""
    before: dict[str, float]
    """Parameter -> value before the moment."""
    after: dict[str, float]
    """Parameter -> value after it."""
    sd: dict[str, float]
    """Parameter -> standard deviation of the difference."""
    units: dict[str, str]
    """Parameter -> unit."""
    share: float
    """Share of the excess over noise that the second state removes."""
    axes: tuple[str, ...] = ()
    """
    Axes whose rows of the matrices change, the largest change first; empty for an effect of the
    reference.
    """

    def to_mapping(self) -> dict:
        """Return the onset as plain data."""
        return {
            'time': self.time,
            'time_sd': self.time_sd,
            'what': self.what,
            'share': self.share,
            'axes': list(self.axes),
            'parameters': {
                name: {
                    'before': value,
                    'after': self.after[name],
                    'sd': self.sd[name],
                    'unit': self.units[name],
                }
                for name, value in self.before.items()
            },
        }


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
    `MIN_EXPLAINED_SHARE` of the excess, and its excess must be at most half that of a gradual
    change of the same parameters (a polynomial in time of degree `GRADUAL`). The moment is then
    refined to the sample at which the residuals of both states are least.
    """
    used, space, groups = (
        problem.search.indices(chosen),
        problem.evidence.space,
        _groups(problem.recording.model),
    )
    every = np.array(list(dict.fromkeys([*used, *(k for group in groups.values() for k in group)])))
    small, time = space.restricted(every), space.recording.time
    each = matrix_of_each(small, explained.floor.noise)
    total, count = each.sum(axis=0), explained.n_means + explained.n_within
    base, noise = np.arange(len(used)), SIGNIFICANT_REST * np.sqrt(2 * count)
    moving = np.cumsum(space.recording.moving)
    allowed = np.flatnonzero(
        (moving >= MIN_ONSET_WINDOWS) & (moving[-1] - moving >= MIN_ONSET_WINDOWS)
    )
    single = _fit(total, base, small)[0] - count
    if single < noise or not len(allowed):
        return None
    after = total - np.cumsum(each, axis=0)[allowed]
    curves = _curves(time)
    along = np.tensordot(curves, each, (0, 0))
    between = np.tensordot(curves[:, :, None] * curves[:, None, :], each, (0, 0))
    found = []
    for name, group in groups.items():
        at = np.flatnonzero(np.isin(every, group))
        own = np.union1d(base, at)
        fits = [
            _fit(total, own, small, _Change(at, part[None], part[None, None])) for part in after
        ]
        losses = np.array([loss for loss, *_ in fits])
        best, likely = int(np.argmin(losses)), allowed[losses < losses.min() + LIKELY]
        excess, gradual = (
            fits[best][0] - count,
            _fit(total, own, small, _Change(at, along, between))[0] - count,
        )
        if excess < (1 - MIN_EXPLAINED_SHARE) * single and excess < SUDDEN * gradual:
            found.append(
                (
                    len(group),
                    excess,
                    name,
                    likely[[0, -1]] + (0, 1),
                    group,
                    every[own],
                    fits[best][1:],
                )
            )
    if not found:
        return None
    most = SIMPLER * max(min(excess for _, excess, *_ in found), noise)
    _, excess, name, ends, group, own, (values, change, sd) = min(
        entry for entry in found if entry[1] <= most
    )
    full, changed = np.zeros(problem.space.size), np.zeros(problem.space.size)
    full[own], changed[group] = values, change
    states = [problem.absolute(full), problem.absolute(full) + changed]
    model, names = problem.recording.model, [problem.space.names[k] for k in group]
    units = {
        label: effect.unit_of(k)
        for effect in model.effects
        for k, label in enumerate(effect.param_names())
    }
    moment, moment_sd = _refined(
        windows, table, model, states=states, between=space.recording.time[ends]
    )
    before, after = (dict(zip(names, state[group].tolist())) for state in states)
    axes = (
        ()
        if name in _of_reference(model)
        else largest_axes(np.maximum(change**2 - sd**2, 0.0).reshape(-1, 3, 3).sum(axis=(0, 2)))
    )
    return Onset(
        moment,
        moment_sd,
        name,
        before,
        after,
        dict(zip(names, sd.tolist())),
        {label: units[label] for label in names},
        1 - max(excess, 0.0) / single,
        axes,
    )


def _groups(model):
    """Return name -> parameters of each group that may change suddenly."""
    numbers = np.arange(len(model.param_names))
    matrices = {sensor: numbers[model.part(sensor, Role.LINEAR)] for sensor in SENSORS}
    of_reference = {name: numbers[part] for name, part in _of_reference(model).items()}
    return {
        **of_reference,
        **matrices,
        ' and '.join(SENSORS): np.concatenate(list(matrices.values())),
    }


def _of_reference(model):
    return {effect.name: model.slices[effect.key] for effect in model.effects if effect.sudden}


def _curves(time):
    """Return the Legendre polynomials of degree 1 to `GRADUAL` over the times, shape (k, m)."""
    middle, half = 0.5 * (time[0] + time[-1]), max(0.5 * (time[-1] - time[0]), 1e-9)
    return np.polynomial.legendre.legvander((time - middle) / half, GRADUAL)[:, 1:]


@dataclass(frozen=True, eq=False)
class _Change:
    """Changes of some parameters along m functions of time, of q parameters with the residual."""

    places: np.ndarray
    """Parameters that change, shape (n,)."""
    along: np.ndarray
    """Normal matrices of the windows weighted with each function, shape (m, q + 1, q + 1)."""
    between: np.ndarray
    """The same for the product of two functions, shape (m, m, q + 1, q + 1)."""


def _fit(total, own, small, change=None):
    """
    Return (loss, values, changes, sds of the changes) of the parameters `own`.

    The changes are in the order of the functions of `change`, all its parameters for each.
    """
    known = 1 / small.prior_sd[own] ** 2
    normal, right = (
        total[np.ix_(own, own)] + np.diag(known),
        total[own, -1] + small.prior_mean[own] * known,
    )
    if change is not None:
        at = change.places
        cross = np.concatenate([part[np.ix_(own, at)] for part in change.along], axis=1)
        squares = np.block([[part[np.ix_(at, at)] for part in row] for row in change.between])
        normal = np.block([[normal, cross], [cross.T, squares]])
        right = np.concatenate([right, *(part[at, -1] for part in change.along)])
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(
        normal / np.outer(scale, scale), rcond=1e-12, hermitian=True
    ) / np.outer(scale, scale)
    values, count = inverse @ right, len(own)
    loss = total[-1, -1] + (small.prior_mean[own] ** 2 * known).sum() - right @ values
    return float(loss), values[:count], values[count:], np.sqrt(np.diag(inverse)[count:])


def _refined(windows, table, model, *, states, between):
    """
    Return (mean, standard deviation) of the posterior of the moment between two times, s.

    With a flat prior, ``p(t) ~ exp(-S(t) / 2)``, S the sum of squares of the residuals of the first
    state before t and the second after it.
    """
    near = [w for w in windows if w.time[-1] >= between[0] and w.time[0] <= between[1]]
    noise = np.median([w.noise_sd for w in near], axis=0)
    found = [
        residuals(near, table, model, values=state[: len(model.param_names)]) for state in states
    ]
    squares = [
        sum(((rest[sensor] / sd) ** 2).sum(axis=1) for sensor, sd in zip(SENSORS, noise))
        for rest in found
    ]
    time, cost = np.concatenate([w.time for w in near]), np.cumsum(squares[0] - squares[1])[:-1]
    gap, weight = np.diff(time), np.exp((cost.min() - cost) / 2) * np.diff(time)
    middle = time[:-1] + gap / 2
    mean = weight @ middle / weight.sum()
    return float(mean), float(np.sqrt(weight @ ((middle - mean) ** 2 + gap**2 / 12) / weight.sum()))
