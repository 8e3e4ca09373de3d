"""
Parameters that change at one moment.

Biases after a shock, exchanged axes, a displaced mount, a belt that slipped, a clock that was set.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.estimation.noise_model import NoiseModel
from imu_calibration.estimation.whitening import Whitening
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window
from imu_calibration.selection.evidence import MIN_FOLD_WINDOWS
from imu_calibration.selection.explained_share import (
    MIN_EXPLAINED_SHARE,
    SIGNIFICANT_REST,
    ExplainedWindows,
)
from imu_calibration.selection.linearised_problem import LinearisedProblem
from imu_calibration.selection.parameter_space import ParameterSpace, mean_whitening
from imu_calibration.selection.questions import Question
from imu_calibration.selection.residual_blocks import largest_axes, residuals

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
NO_WEIGHT = 1e8
"""Factor on the variance of the mean of a window that does not count."""
LIKELY = 16.0
"""
A moment between two windows is refined if its loss is at most the least one and this (a likelihood
ratio of 3e-4).
"""
BIAS_OF = 'bias of '
"""Begin of the name of a group of biases."""
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
    """Name of the effect of the reference, or the sensors of which biases or matrices change."""
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
    Axes of which the biases or rows of the matrices change, the largest change first; empty for an
    effect of the reference.
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
    `MIN_EXPLAINED_SHARE` of the significant excess, and more than a gradual change of the same
    parameters removes (a polynomial in time of degree `GRADUAL`). The moment is then refined to
    the sample at which the residuals of both states are least.
    """
    used, space, groups = (
        problem.search.indices(chosen),
        problem.evidence.space,
        _groups(problem.recording.model),
    )
    every = np.array(list(dict.fromkeys([*used, *(k for group in groups.values() for k in group)])))
    small, time = space.restricted(every), space.recording.time
    rows = _Rows(small, explained.floor.noise)
    base = np.arange(len(used))
    moving = np.cumsum(space.recording.moving)
    allowed = np.flatnonzero(
        (moving >= MIN_ONSET_WINDOWS) & (moving[-1] - moving >= MIN_ONSET_WINDOWS)
    )
    if not len(allowed):
        return None
    found = []
    for name, group in groups.items():
        at = np.flatnonzero(np.isin(every, group))
        own = np.union1d(base, at)
        losses = _losses_of_moments(rows, own, at, allowed)
        last = min(losses, key=losses.__getitem__)
        if name.startswith(BIAS_OF) and _follows_temperature(rows, own, at, losses[last]):
            continue
        likely = sorted(k for k, loss in losses.items() if loss < losses[last] + LIKELY)
        # The change lies within one of the windows about the moment, which hold both states: all
        # models are compared without them.
        clear = ~np.isin(np.arange(len(time)), (last, last + 1))
        apart = _Rows(small, explained.floor.noise, clear)
        change = apart.changes(at, _after(last, len(time)))
        alone, step = apart.fit(base), apart.fit(own, change)
        gradual = apart.fit(own, apart.changes(at, _curves(time)))
        single, _ = apart.significant_excess(base, alone)
        excess, noise = apart.significant_excess(own, step, change)
        explains = excess < (1 - MIN_EXPLAINED_SHARE) * single
        if explains and gradual.loss - step.loss > SUDDEN * (alone.loss - step.loss):
            found.append(
                _Candidate(
                    name,
                    group,
                    every[own],
                    ends=(likely[0], likely[-1] + 1),
                    excess=excess,
                    noise=noise,
                    share=1 - excess / single,
                    fit=step,
                )
            )
    if not found:
        return None
    # The fewest parameters that do, then the least excess.
    most = SIMPLER * max(min(max(entry.excess, entry.noise) for entry in found), 0.0)
    good = [entry for entry in found if entry.excess <= most]
    chosen_one = min(good, key=lambda entry: (len(entry.group), entry.excess))
    name, group = chosen_one.name, chosen_one.group
    change, sd = chosen_one.fit.change, chosen_one.fit.change_sd
    full, changed = np.zeros(problem.space.size), np.zeros(problem.space.size)
    full[chosen_one.own], changed[group] = chosen_one.fit.values, change
    states = [problem.absolute(full), problem.absolute(full) + changed]
    model, names = problem.recording.model, [problem.space.names[k] for k in group]
    units = {
        label: effect.unit_of(k)
        for effect in model.effects
        for k, label in enumerate(effect.param_names())
    }
    moment, moment_sd = _refined(
        windows, table, model, states=states, between=time[list(chosen_one.ends)]
    )
    before, after = (dict(zip(names, state[group].tolist())) for state in states)
    axes = ()
    if name not in _of_reference(model):
        # Three biases or nine elements of a matrix, row by row, of each sensor of the group.
        excess_of_change = np.maximum(change**2 - sd**2, 0.0)
        per_row = 1 if name.startswith(BIAS_OF) else 3
        axes = largest_axes(excess_of_change.reshape(-1, 3, per_row).sum(axis=(0, 2)))
    return Onset(
        moment,
        moment_sd,
        name,
        before,
        after,
        dict(zip(names, sd.tolist())),
        {label: units[label] for label in names},
        chosen_one.share,
        axes,
    )


@dataclass(frozen=True, eq=False)
class _Fit:
    """Least squares of some parameters, with changes of a group along functions of time."""

    loss: float
    """Sum of squares of the residual and the prior."""
    values: np.ndarray
    """Values of the parameters."""
    change: np.ndarray
    """Changes along the functions, all parameters of the group for each."""
    change_sd: np.ndarray
    """Their standard deviations."""


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A group of parameters that changes, at the moment at which this fits best."""

    name: str
    group: np.ndarray
    """Parameters that change."""
    own: np.ndarray
    """Parameters of the fit."""
    ends: tuple[int, int]
    """Windows between which the moment lies."""
    excess: float
    """Squares that remain beyond noise, without the windows about the moment."""
    noise: float
    """Limit of an excess that is significant, in the parts in which one remains."""
    share: float
    """Share of the excess that the second state removes."""
    fit: _Fit
    """The first state and the change."""


@dataclass(frozen=True, eq=False)
class _RowsOfAxis:
    """Rows ``[columns | residual]`` of one axis of a sensor."""

    places: np.ndarray
    """Places of the columns in the normal matrix, that of the residual last, shape (p + 1,)."""
    whitening: Whitening
    mean: np.ndarray
    """Means of the windows, shape (n, p + 1)."""
    white: np.ndarray
    """The same, independent and of unit variance."""
    within: np.ndarray
    """Products of the white rows within each window, shape (n, p + 1, p + 1)."""


@dataclass(frozen=True, eq=False)
class _Part:
    """Means of the windows of a sensor, or rows within them."""

    normal: np.ndarray
    """Normal matrix of the columns and the residual, shape (q + 1, q + 1)."""
    expected: float
    """Expectation of the squares from noise."""


class _Rows:
    """
    Rows of all windows, or of some, and their normal matrix.

    A change of a parameter along a function f of time has the column ``f * column``. It is made
    independent after the product: the bias processes connect the windows, so that the product with
    independent rows would be another one.

    Parameters
    ----------
    space : ParameterSpace
        The parameters that may be fitted.
    noise : dict
        Sensor -> NoiseModel.
    clear : ndarray, shape (n,), optional
        Windows that count; all where not given.

    """

    def __init__(
        self,
        space: ParameterSpace,
        noise: dict[str, NoiseModel],
        clear: np.ndarray | None = None,
    ):
        self.space, moving, kind = space, space.recording.moving, space.recording.kind
        clear = np.ones(len(kind), bool) if clear is None else clear
        counted = moving & clear
        self.axes, self._parts = [], []
        # A mean of a window with both states is one of no weight.
        scatter = np.where(clear, 1.0, NO_WEIGHT)[:, None] * np.ones(3)
        expected_means = 3.0 * clear.sum()
        expected_within = 3.0 * (space.recording.count - 1)[counted].sum()
        for sensor in SENSORS:
            of_means = _Part(np.zeros((space.size + 1,) * 2), expected_means)
            of_within = _Part(np.zeros((space.size + 1,) * 2), expected_within)
            self._parts += [of_means, of_within]
            whitenings = mean_whitening(space, noise, sensor, scatter=scatter)
            for axis, (whitening, mean) in enumerate(zip(whitenings, space.mean[sensor])):
                within = np.zeros((len(kind), mean.shape[1], mean.shape[1]))
                if counted.any():
                    variance = np.array(
                        [noise[sensor].row_variance(name)[axis] for name in kind[counted]]
                    )
                    products = np.concatenate(list(space.within_each(sensor, axis, counted)))
                    within[counted] = products / variance[:, None, None]
                white = whitening(mean[:, None])[:, 0]
                places = space.places(sensor, axis)
                of_means.normal[np.ix_(places, places)] += white.T @ white
                of_within.normal[np.ix_(places, places)] += within.sum(axis=0)
                self.axes.append(_RowsOfAxis(places, whitening, mean, white, within))
        self.normal = np.sum([part.normal for part in self._parts], axis=0)

    def significant_excess(self, own, fit, changes=None):
        """
        Return (squares beyond the expectation from noise, limit of a significant excess).

        Both of the parts (means of windows, within windows, each of one sensor) of which the
        excess is significant, at a _Fit of the parameters `own` and of changes.
        """
        residual = self.space.reduced(own, fit.values)
        excess, number = 0.0, 0.0
        for k, part in enumerate(self._parts):
            squares = residual @ part.normal @ residual
            if changes is not None:
                cross, own_squares = changes.cross[k], changes.squares[k]
                squares -= 2 * residual @ cross @ fit.change
                squares += fit.change @ own_squares @ fit.change
            beyond = squares - part.expected
            if beyond > SIGNIFICANT_REST * np.sqrt(2 * part.expected):
                excess, number = excess + beyond, number + part.expected
        return float(excess), float(SIGNIFICANT_REST * np.sqrt(2 * number))

    def changes(self, at, functions):
        """
        Return the _Changes of parameters along functions of time.

        Parameters
        ----------
        at : ndarray
            Places of the parameters.
        functions : ndarray, shape (n, m)
            Their values in each window.

        """
        count, m = len(at), functions.shape[1]
        cross = np.zeros((len(self._parts), len(self.normal), m * count))
        squares = np.zeros((len(self._parts), m * count, m * count))
        for number, rows in enumerate(self.axes):
            of_means = 2 * (number // 3)
            of_within = of_means + 1
            own = np.flatnonzero(np.isin(rows.places[:-1], at))
            if not len(own):
                continue
            order = np.searchsorted(at, rows.places[own])
            places = (np.arange(m)[:, None] * count + order).ravel()
            columns = functions[:, :, None] * rows.mean[:, None, own]
            white = rows.whitening(columns.reshape(len(columns), 1, -1))[:, 0]
            of_parameters = rows.within[:, :, own]
            along = np.einsum('wm,wpo->pmo', functions, of_parameters).reshape(len(rows.places), -1)
            both = np.einsum(
                'wm,wl,wqo->mqlo', functions, functions, of_parameters[:, own], optimize=True
            )
            at_cross, at_squares = np.ix_(rows.places, places), np.ix_(places, places)
            cross[of_means][at_cross] += rows.white.T @ white
            cross[of_within][at_cross] += along
            squares[of_means][at_squares] += white.T @ white
            squares[of_within][at_squares] += both.reshape(len(places), -1)
        return _Changes(cross, squares)

    def fit(self, own, changes=None):
        """
        Return the _Fit of the parameters `own`, with their priors, and of some changes.
        """
        known = 1 / self.space.prior_sd[own] ** 2
        prior = self.space.prior_mean[own]
        normal = self.normal[np.ix_(own, own)] + np.diag(known)
        right = self.normal[own, -1] + prior * known
        if changes is not None:
            cross = changes.cross.sum(axis=0)
            normal = np.block([[normal, cross[own]], [cross[own].T, changes.squares.sum(axis=0)]])
            right = np.concatenate([right, cross[-1]])
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        inverse = np.linalg.pinv(normal / np.outer(scale, scale), rcond=1e-12, hermitian=True)
        inverse /= np.outer(scale, scale)
        values = inverse @ right
        loss = self.normal[-1, -1] + (prior**2 * known).sum() - right @ values
        count = len(own)
        return _Fit(float(loss), values[:count], values[count:], np.sqrt(np.diag(inverse)[count:]))


@dataclass(frozen=True, eq=False)
class _Changes:
    """Normal matrices of changes of c parameters along m functions, the functions first."""

    cross: np.ndarray
    """With the columns of the parameters and the residual, of each part, (parts, q + 1, m c)."""
    squares: np.ndarray
    """With one another, shape (parts, m c, m c)."""


def _after(last, count):
    """Return 1 in each window after the window `last`, shape (count, 1)."""
    return (np.arange(count) > last).astype(float)[:, None]


def _follows_temperature(rows, own, at, loss):
    """
    Return whether a step where the temperature passes a value fits as well as one at a moment.

    An offset above a temperature is a place (`selection.regimes`), not an onset.
    """
    warmth = rows.space.recording.describe['temperature']
    if not np.all(np.isfinite(warmth)) or np.ptp(warmth) == 0:
        return False
    limits = np.sort(warmth)[MIN_ONSET_WINDOWS:-MIN_ONSET_WINDOWS]
    for limit in limits[:: max(len(limits) // MOST_LIMITS, 1)]:
        if rows.fit(own, rows.changes(at, (warmth > limit).astype(float)[:, None])).loss <= loss:
            return True
    return False


def _losses_of_moments(rows, own, at, allowed):
    """
    Return last window before a moment -> loss of the fit with a change there.

    Some moments first, then all near the best one.
    """
    count = len(rows.axes[0].mean)
    coarse = np.unique(np.linspace(0, len(allowed) - 1, min(COARSE, len(allowed))).astype(int))
    losses = {}
    for tried in ('coarse', 'near'):
        numbers = coarse
        if tried == 'near':
            best = min(losses, key=losses.__getitem__)
            place = int(np.searchsorted(allowed[coarse], best))
            numbers = np.arange(
                coarse[max(place - 1, 0)], coarse[min(place + 1, len(coarse) - 1)] + 1
            )
        for last in allowed[numbers].tolist():
            if last not in losses:
                losses[last] = rows.fit(own, rows.changes(at, _after(last, count))).loss
    return losses


def _groups(model):
    """Return name -> parameters of each group that may change suddenly."""
    numbers = np.arange(len(model.param_names))
    groups = {name: numbers[part] for name, part in _of_reference(model).items()}
    both = ' and '.join(SENSORS)
    # A shock or a new start of a sensor changes its biases, a displaced mount its matrix.
    for prefix, role in ((BIAS_OF, Role.OFFSET), ('', Role.LINEAR)):
        parts = {sensor: numbers[model.part(sensor, role)] for sensor in SENSORS}
        for sensor, part in parts.items():
            groups[prefix + sensor] = part
        groups[prefix + both] = np.concatenate(list(parts.values()))
    return groups


def _of_reference(model):
    return {effect.name: model.slices[effect.key] for effect in model.effects if effect.sudden}


def _curves(time):
    """Return the Legendre polynomials of degree 1 to `GRADUAL` over the times, shape (k, m)."""
    middle, half = 0.5 * (time[0] + time[-1]), max(0.5 * (time[-1] - time[0]), 1e-9)
    return np.polynomial.legendre.legvander((time - middle) / half, GRADUAL)[:, 1:]


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
