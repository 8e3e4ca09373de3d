"""Noise of the recording as the richest model sees it, so that no hidden effect passes for noise and no noise for an effect."""

from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg

from imu_calibration.diagnosis.wander_search import NATURAL_WANDER, WanderSearch
from imu_calibration.effects.base import SENSORS

KINDS = ('spin', 'dynamic')


@dataclass(frozen=True, eq=False)
class SensorNoise:
    """Noise of one sensor: white noise of samples, its excess at low frequency, window offsets, a wandering bias."""

    white: np.ndarray
    """Variance of single samples at rest, shape (3,)."""
    inflation: np.ndarray
    """Variance at low frequency over that of white noise, shape (3,)."""
    within: dict = field(default_factory=dict)
    """Kind -> factor on the variance of centred rows, shape (3,)."""
    bend: dict = field(default_factory=dict)
    """Kind -> part of that factor that serial correlation adds, at least 1."""
    offset_sd: float = 0.0
    """Standard deviation of an independent offset of each window."""
    wander_sd: float = 0.0
    """Standard deviation of the wandering bias."""
    wander_time: float = 100.0
    """Its correlation time, s."""

    def mean_variance(self, kind, count):
        """Return the variance of window means by the noise within, shape (k, 3)."""
        factor = np.stack([np.maximum(self.inflation, self.within.get(name, self.inflation)) for name in kind])
        return self.white * factor / count[:, None]

    def row_variance(self, name):
        """Return the variance of centred rows of windows of a kind, shape (3,)."""
        return self.white * self.within.get(name, np.maximum(self.inflation, 1.0))


def white_noise(lifted, sensor):
    """Return (variance, inflation) pooled over static windows near the median, each (3,), or None without static windows."""
    variance, inflation = lifted.noise[sensor]
    rest = np.all(np.isfinite(variance), axis=1)
    if not rest.any():
        return None
    variance, inflation, count = variance[rest], inflation[rest], lifted.count[rest]
    median = np.median(variance, axis=0)
    near = (variance <= 2 * median) & (variance >= 0.5 * median)
    weight = np.where(near, count[:, None], 0.0) + 1e-9
    pooled = (variance * weight).sum(axis=0) / weight.sum(axis=0)
    factor = (inflation * weight).sum(axis=0) / weight.sum(axis=0)
    # The factor comes from few batches; it is drawn towards one by what a white sequence of that length would scatter.
    trust = 1.0 / (1.0 + 4.0 / rest.sum())
    return np.maximum(pooled, 1e-30), np.maximum(1.0 + trust * (factor.mean() - 1.0), 0.8) * np.ones(3)


def normal_matrix(space, noise, select=None):
    """Return the sum of ``[design | residual]' weight [design | residual]`` over windows, shape (q + 1, q + 1)."""
    return within_matrix(space, noise, select) + mean_matrix(space, noise, select)


def within_matrix(space, noise, select=None, sensors=SENSORS):
    """Return the part of the normal matrix that comes from within the windows."""
    total = np.zeros((space.size + 1, space.size + 1))
    kind = space.lifted.kind
    chosen = np.ones(len(kind), bool) if select is None else select
    for sensor in sensors:
        for axis in range(3):
            block = 0.0
            for name in KINDS:
                rows = chosen & (kind == name)
                if rows.any():
                    block = block + space.within[sensor][axis][rows].sum(axis=0) / noise[sensor].row_variance(name)[axis]
            if np.ndim(block):
                _scatter(total, space.index[sensor][axis], block)
    return total


def mean_matrix(space, noise, select=None):
    """Return the part of the normal matrix that comes from the means of the windows."""
    total = np.zeros((space.size + 1, space.size + 1))
    for sensor in SENSORS:
        for axis, rows in enumerate(white_means(space, noise, sensor)):
            rows = rows if select is None else rows[select]
            _scatter(total, space.index[sensor][axis], rows.T @ rows)
    return total


def white_means(space, noise, sensor):
    """Return for each axis the mean rows, turned into independent rows of unit variance."""
    of_sensor, lifted = noise[sensor], space.lifted
    variance = of_sensor.mean_variance(lifted.kind, lifted.count) + of_sensor.offset_sd**2
    return [_whiten(space.mean[sensor][axis], variance[:, axis], lifted, of_sensor) for axis in range(3)]


def _whiten(rows, variance, lifted, noise):
    if noise.wander_sd == 0:
        return rows / np.sqrt(variance)[:, None]
    white = np.empty_like(rows)
    for number in np.unique(lifted.session):
        at = np.flatnonzero(lifted.session == number)
        gap = np.abs(lifted.time[at][:, None] - lifted.time[at][None, :])
        cov = noise.wander_sd**2 * np.exp(-gap / noise.wander_time) + np.diag(variance[at])
        white[at] = scipy.linalg.solve_triangular(np.linalg.cholesky(cov), rows[at], lower=True)
    return white


def _scatter(total, index, block):
    at = np.r_[index, len(total) - 1]
    total[np.ix_(at, at)] += block


def solve_normal(normal, prior_sd, prior_shift, used=None):
    """Return the parameters that minimise the normal matrix's quadratic form plus the prior, shape (q,), zero where not used."""
    used = np.arange(len(normal) - 1) if used is None else np.asarray(used)
    values = np.zeros(len(normal) - 1)
    information = normal[np.ix_(used, used)] + np.diag(1 / prior_sd[used]**2)
    right = normal[used, -1] + prior_shift[used] / prior_sd[used]**2
    scale = 1 / np.sqrt(np.diag(information))
    scaled = information * np.outer(scale, scale)
    values[used] = scale * scipy.linalg.solve(scaled + 1e-13 * np.eye(len(scaled)), scale * right, assume_a='pos')
    return values


def saturated_noise(space, smooth):
    """
    Return sensor -> SensorNoise, estimated beside a model with every effect that is asked about.

    Windows' offsets and the wander come from restricted maximum likelihood on the means of the windows; the variance within moving
    windows from the residual, and its serial correlation from how far each window alone would like to bend the model.

    Parameters
    ----------
    space : Space
    smooth : dict
        Sensor -> list of tuples of parameters: effects that are smooth in time. Only the best choice among them, if any is needed, stays
        in the model beside which the wander is estimated.

    """
    noise = first_noise(space)
    for last in (False, True):
        normal = normal_matrix(space, noise)
        values = solve_normal(normal, space.prior_sd, space.prior_mean)
        noise = {sensor: _with_factors(space, sensor, noise[sensor], values, last) for sensor in SENSORS}
    return {sensor: with_wander(space, sensor, noise, smooth[sensor]) for sensor in SENSORS}


def with_wander(space, sensor, noise, smooth):
    """Return the noise of a sensor with window offsets and wander, estimated beside all effects but the superfluous smooth ones."""
    own = np.unique(np.concatenate(space.index[sensor]))
    place = {parameter: k for k, parameter in enumerate(own)}
    lifted = space.lifted
    rows = np.zeros((len(lifted.kind), 3, len(own) + 1))
    for axis in range(3):
        at = [place[parameter] for parameter in space.index[sensor][axis]]
        rows[:, axis, at + [len(own)]] = space.mean[sensor][axis]
    search = WanderSearch(rows, noise[sensor].mean_variance(lifted.kind, lifted.count), lifted.time, lifted.session,
                          _known_otherwise(space, sensor, noise, own), natural_wander(noise[sensor], lifted))
    options = [[place[k] for k in parameters] for parameters in smooth]
    structural = [k for k in range(len(own)) if k not in {k for option in options for k in option}]
    used = structural + _needed_smooth(search, structural, options)
    shape = search.polished(search.best(used)[0], used)
    return replace(noise[sensor], offset_sd=shape[0] * search.typical, wander_sd=shape[1] * search.typical, wander_time=shape[2])


def natural_wander(noise, lifted):
    """Return the standard deviation by which a bias wanders at least, by the white noise of the sensor."""
    rate = np.median(lifted.count / np.maximum(lifted.duration, 1e-3))
    return NATURAL_WANDER * float(np.sqrt(np.median(noise.white) / rate))


SMOOTH_PRICE = 7.0
"""Fall of minus twice the log likelihood per parameter that an effect smooth in time must win over wander."""


def _needed_smooth(search, structural, options):
    """Return the parameters of the smooth effects (none, one or two of them) that beat wander in likelihood."""
    trials = [[]] + [[k] for k in range(len(options))]
    costs = {(): search.best(structural, restricted=False)[1]}
    for (k,) in trials[1:]:
        costs[(k,)] = search.best(structural + options[k], restricted=False)[1] + SMOOTH_PRICE * len(options[k])
    best = min(costs, key=costs.get)
    return [k for number in best for k in options[number]]


def _known_otherwise(space, sensor, noise, own):
    """Return the normal matrix of what priors and the inside of windows tell about the parameters `own`."""
    at = np.r_[own, space.size]
    information = within_matrix(space, noise, sensors=(sensor,))[np.ix_(at, at)]
    prior = 1 / space.prior_sd[own]**2
    information[:-1, :-1] += np.diag(prior)
    information[:-1, -1] += space.prior_mean[own] * prior
    information[-1, :-1] = information[:-1, -1]
    return information


def first_noise(space):
    """Return sensor -> SensorNoise before anything is fitted: the noise at rest."""
    return {sensor: _first(space, sensor) for sensor in SENSORS}


def _first(space, sensor):
    found = white_noise(space.lifted, sensor)
    if found is None:
        variance = np.full(3, 1e-30)
        for axis in range(3):
            moving = space.lifted.kind != 'static'
            total = space.within[sensor][axis][moving].sum(axis=0)
            dof = max(space.lifted.count[moving].sum() - moving.sum(), 1)
            scale = 1 / np.sqrt(np.maximum(np.diag(total), 1e-300))
            scaled = total * np.outer(scale, scale)
            rest = scaled[-1, -1] - scaled[-1, :-1] @ np.linalg.lstsq(scaled[:-1, :-1], scaled[:-1, -1], rcond=1e-10)[0]
            variance[axis] = max(rest, 1e-12) / scale[-1]**2 / dof
        found = variance, np.ones(3)
    return SensorNoise(*found, within={name: np.ones(3) for name in KINDS})


def _with_factors(space, sensor, noise, values, look_along):
    """Return the noise with factors within windows: the residual's variance, and more where it lies along the columns."""
    factors, bends = {}, {}
    for name in KINDS:
        rows = space.lifted.kind == name
        if not rows.any():
            continue
        factor = np.ones(3)
        for axis in range(3):
            products = space.within[sensor][axis][rows]
            reduced = np.append(-values[space.index[sensor][axis]], 1.0)
            squares = np.einsum('kij,i,j->k', products, reduced, reduced)
            dof = (space.lifted.count[rows] - 1).sum()
            factor[axis] = squares.sum() / dof / noise.white[axis]
        bends[name] = float(np.clip(np.mean(_bend(space, sensor, rows, values) / (factor * noise.white)), 1.0, None)) if look_along else 1.0
        factors[name] = np.maximum(factor, 0.9) * bends[name]
    return replace(noise, within=factors, bend=bends)


def _bend(space, sensor, rows, values):
    """
    Return the variance of the residual along the columns of each window, per dimension, shape (3,).

    For residual e and columns X of a window: e' X (X'X)^+ X' e / rank. It is the variance of e when e is white, and more when
    e is smooth like the columns.
    """
    found = np.zeros(3)
    for axis in range(3):
        products = space.within[sensor][axis][rows]
        reduced = np.append(-values[space.index[sensor][axis]], 1.0)
        design, gradient = products[:, :-1, :-1], products[:, :-1] @ reduced
        scale = 1 / np.sqrt(np.maximum(np.einsum('kii->ki', design), 1e-300))
        eigenvalues, vectors = np.linalg.eigh(design * scale[:, :, None] * scale[:, None, :])
        along = np.einsum('kij,ki->kj', vectors, gradient * scale)
        strong = eigenvalues > 1e-6 * eigenvalues[:, -1:]
        found[axis] = (along**2 * strong / np.where(strong, eigenvalues, 1.0)).sum() / max(strong.sum(), 1)
    return found
