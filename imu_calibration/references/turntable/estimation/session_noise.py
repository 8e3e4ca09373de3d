"""
Noise of the rows of a session, at rest and in the slow and fast parts of moving windows.

The slow part of the centred rows of a kind of window are the means of short pieces, the fast part
the deviations of the samples from these.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.effects.forward_equations import coefficient_jacobian
from imu_calibration.estimation.prior import fixed_parameters
from imu_calibration.estimation.sensor_noise import BiasProcess
from imu_calibration.references.turntable.estimation.noise_search import estimate_offsets
from imu_calibration.references.turntable.estimation.weighted_system import WeightedSystem
from imu_calibration.references.turntable.noise_model import (
    MovingFactors,
    NoiseModel,
    ReferenceNoise,
)
from imu_calibration.references.turntable.window_statistics import WindowStatistics

MIN_VARIANCE_RATIO = 2.0
"""
Residual variance of the fast part over that of the slow part above which they have separate
weights; below it all samples have the same weight.
"""
CAUTIOUS_SDS = 2.0
"""
Standard deviations by which the residual variance of a slow part with a separate weight is raised.
"""
SURE_SDS = 4.0
"""Standard deviations by which a slow part must exceed that of white noise to show structure."""
DESIGN_EIGENVALUE_SHARE = 1e-6
"""
Directions of a scaled design with less than this share of the largest eigenvalue do not count.
"""
RESIDUAL_EIGENVALUE_SHARE = 1e-9
"""As `DESIGN_EIGENVALUE_SHARE`, for the residual of the best fit."""
WEIGHTLESS = 1e6
"""Factor on a variance that makes the weight negligible."""


@dataclass(frozen=True, eq=False)
class BandMisfit:
    """
    Residual variance per row of the centred rows of one kind of window, and of their parts.

    For white noise the three variances are equal.
    """

    overall: np.ndarray
    """Of all rows, shape (3,)."""
    slow: np.ndarray
    """
    Of the means of short pieces, times the root of their length, shape (3,); zero when there are
    none.
    """
    fast: np.ndarray
    """Of the fast part, shape (3,)."""
    apart: np.ndarray
    """Mask of the axes of which slow and fast part have separate weights, shape (3,)."""
    dof_slow: float = 0.0
    """Degrees of freedom of the slow part."""

    def slow_over_fast(self, inflation: np.ndarray) -> float:
        """
        Return the residual variance of the slow part over the largest one by chance.

        That is the residual variance of the fast part, raised by `SURE_SDS` standard deviations for
        the few degrees of freedom of the slow part. The ratio is that of the axis with the largest
        one, at most 1 for white noise. A residual with structure is correlated in time, so that its
        slow part exceeds that of white noise; louder white noise raises both parts by the same
        factor.

        Parameters
        ----------
        inflation : ndarray, shape (3,)
            Variance of the noise at low frequency over that of white noise (`NoiseModel`).

        """
        if self.dof_slow < 1:
            return 0.0
        largest_chance = 1 + SURE_SDS * np.sqrt(2 / self.dof_slow)
        noise = np.maximum(self.fast, np.finfo(float).tiny) * np.maximum(inflation, 1.0)
        return float(np.max(self.slow / (noise * largest_chance)))

    def factors(self, noise: NoiseModel) -> MovingFactors:
        """
        Return the excess variance of moving windows with this residual over the noise at rest.
        """
        # Rows: with separate weights the excess of the fast part, otherwise the larger one of all
        # samples and of the slow part; at least the noise at rest.
        samples = np.where(self.apart, self.fast, self.overall)
        pieces = np.where(self.apart, 0.0, self.slow)
        of_samples = samples / noise.white_variance
        of_pieces = pieces / noise.low_variance
        centred = np.maximum.reduce([of_samples, of_pieces, np.ones(3)])

        # Slow part: its own excess with separate weights, otherwise that of all rows.
        slow = np.minimum(np.maximum(self.slow / noise.low_variance, 1.0), centred)
        return MovingFactors(centred, slow=np.where(self.apart, slow, centred))

    def without_fast(self) -> 'BandMisfit':
        """Return the misfit with a variance of the fast part so large that its weight is zero."""
        return replace(self, fast=np.where(self.apart, WEIGHTLESS * self.fast, self.fast))

    @property
    def noise(self) -> np.ndarray:
        """
        Variance of white noise for a session without rest, shape (3,).
        """
        return np.where(self.apart, self.slow, self.overall)


def band_misfit(
    total: np.ndarray, dof_total: float, slow: np.ndarray, *, dof_slow: float
) -> BandMisfit:
    """
    Return the `BandMisfit` of centred rows.

    A reference with errors at high frequency (ripple beyond the band of the joint states, an
    unmodelled low-pass) raises the residual of the fast part. Where the slow part fits worse, its
    residual variance applies to all rows, because the residual is correlated in time.

    Parameters
    ----------
    total, slow : array, shape (3,)
        Sums of squares of all rows, and of the slow ones among them.
    dof_total, dof_slow : int
        Degrees of freedom of both.

    """
    # Variances of all rows and of both parts.
    overall = total / max(dof_total, 1)
    if dof_slow < 1:
        return BandMisfit(overall, np.zeros(3), overall, np.zeros(3, bool))
    of_slow = slow / dof_slow
    of_fast = np.maximum(total - slow, 0.0) / max(dof_total - dof_slow, 1)

    # Separate weights where the fast part exceeds the slow one, which few degrees of freedom may
    # underestimate: a variance of n degrees of freedom has the relative sd sqrt(2 / n).
    cautious = of_slow * (1 + CAUTIOUS_SDS * np.sqrt(2 / dof_slow))
    apart = of_fast > MIN_VARIANCE_RATIO * cautious
    return BandMisfit(overall, np.where(apart, cautious, of_slow), of_fast, apart, dof_slow)


def own_misfit(rows: np.ndarray) -> np.ndarray:
    """
    Return the residuals of the least-squares fit of each axis to rows ``[columns | output]``.

    Shape (k, 3).
    """
    columns = rows[:, :-3]
    output = rows[:, -3:]
    scale = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(scale > 0, scale, 1.0)
    if not len(rows):
        return output
    return output - columns @ np.linalg.lstsq(columns, output, rcond=1e-10)[0]


def misfit_along(products: np.ndarray) -> tuple[float, int]:
    """
    Return the sum of squares of projected residuals, and the number of dimensions.

    The residuals are projected on the columns of designs.

    For residual e and design A: ``e' A (A'A)^+ A' e`` and the rank of A, summed over designs. Their
    ratio is the variance of e when e is white noise. It grows with the number of samples when the
    best-fit parameters differ from the given ones.

    Parameters
    ----------
    products : array, shape (k, q + 1, q + 1)
        Products of ``[design | residual]``.

    """
    gram = products[:, :-1, :-1]
    gradient = products[:, :-1, -1]
    scale = _unit_length_scales(np.einsum('kii->ki', gram))
    eigenvalues, vectors = np.linalg.eigh(gram * scale[:, :, None] * scale[:, None, :])
    along_vectors = np.einsum('kij,ki->kj', vectors, gradient * scale)
    strong = eigenvalues > DESIGN_EIGENVALUE_SHARE * eigenvalues[:, -1:]
    squares = along_vectors**2 * strong / np.where(strong, eigenvalues, 1.0)
    return float(squares.sum()), int(strong.sum())


def least_misfit(products: np.ndarray) -> tuple[float, int]:
    """
    Return the residual sum of squares of a least-squares fit, and the rank of its design.

    For output y and design A with the eigenvectors v_j and eigenvalues l_j of A'A, columns scaled
    to unit length: ``y'y - sum_j (v_j' A'y)^2 / l_j``, over the l_j above rounding.

    Parameters
    ----------
    products : array, shape (q + 1, q + 1)
        Products of ``[design | output]``.

    """
    output_scale = 1 / np.sqrt(max(products[-1, -1], 1e-300))
    scale = np.append(_unit_length_scales(np.diag(products)[:-1]), output_scale)
    scaled = products * np.outer(scale, scale)
    eigenvalues, vectors = np.linalg.eigh(scaled[:-1, :-1])
    above_rounding = eigenvalues > RESIDUAL_EIGENVALUE_SHARE * max(eigenvalues[-1], 1e-300)
    along_vectors = (vectors.T @ scaled[:-1, -1])[above_rounding]
    explained = (along_vectors**2 / eigenvalues[above_rounding]).sum()
    residual = max(scaled[-1, -1] - explained, 0.0)
    return residual / output_scale**2, int(above_rounding.sum())


def _unit_length_scales(squares: np.ndarray) -> np.ndarray:
    """
    Return the factors that give columns unit length, from their sums of squares, same shape.

    The factor is 0 where the sum is zero, or negative through rounding.
    """
    return np.where(squares > 0, 1 / np.sqrt(np.where(squares > 0, squares, 1.0)), 0.0)


MIN_INFLATION, MIN_SHAKEN_INFLATION = 0.8, 0.01
"""
Least noise at low frequency as a share of white noise of the same variance, at rest and under
vibration.
"""
LEAST_NOISE = {'accelerometer': 1e-6, 'gyroscope': 1e-7}
"""
Least noise of a sample, m/s^2 and rad/s: readings of a noise-free simulator are exact except for
stamps in integer ns.
"""
VIBRATES = 4.0
"""Variance of a window over the quiet level above which the table vibrates."""
MIN_INFLATION_SAMPLES = 32
"""Samples of a static window from which its noise at low frequency is estimated."""
LEAST_MOVING_VARIANCE = 1e-30
"""Least variance of the noise from moving windows, above zero."""


def white_noise(
    rows: Sequence[WindowStatistics], sensor: str
) -> tuple[np.ndarray, np.ndarray] | None:
    """
    Return (white_variance, inflation) pooled over static windows, each shape (3,), None without.

    Windows whose variance differs from the median by more than a factor of two (clipped, knocked)
    are excluded. If vibration varies, the reference is the quietest level instead of the median,
    because vibration changes the means little.

    Parameters
    ----------
    rows : sequence of WindowStatistics

    """
    static = _rests(rows, sensor)
    if not static:
        return None

    # A code may be constant at rest: the noise is at least the least positive variance of moving
    # windows, that of rounding.
    moving = [row.sensors[sensor].noise_variance for row in rows if row.kind != 'static']
    in_motion = np.array(moving).reshape(-1, 3)
    in_motion = np.where(in_motion > 0, in_motion, np.inf)
    floor = np.min(in_motion, axis=0, initial=np.inf)
    floor = np.where(np.isfinite(floor), floor, 0.0)

    # Variances, inflations and numbers of samples of the static windows.
    variances = np.maximum([row.sensors[sensor].noise_variance for row in static], floor)
    inflations = np.array([row.sensors[sensor].inflation for row in static])
    counts = np.array([row.count for row in static], float)

    # Means over the windows near the usual variance, weighted by their samples.
    white_variance = np.empty(3)
    inflation = np.empty(3)
    for axis in range(3):
        usual, shaken = _usual(variances[:, axis], inflations[:, axis])
        near = (variances[:, axis] <= 2 * usual) & (variances[:, axis] >= 0.5 * usual)
        weight = counts * near
        white_variance[axis] = usual
        if weight.sum():
            white_variance[axis] = np.average(variances[:, axis], weights=weight)
        # Short windows have no means of pieces, and hence no inflation.
        weight = (counts >= MIN_INFLATION_SAMPLES) * near
        inflation[axis] = 1.0
        if weight.sum():
            inflation[axis] = np.average(inflations[:, axis], weights=weight)
        inflation[axis] = max(inflation[axis], MIN_SHAKEN_INFLATION if shaken else MIN_INFLATION)
    return np.maximum(white_variance, LEAST_NOISE[sensor] ** 2), inflation


def _rests(rows: Sequence[WindowStatistics], sensor: str) -> list[WindowStatistics]:
    """Return the static windows of which the variance of a sensor is known."""
    static = [row for row in rows if row.kind == 'static']
    return [row for row in static if np.isfinite(row.sensors[sensor].noise_variance).all()]


def _usual(variances: np.ndarray, inflations: np.ndarray) -> tuple[float, bool]:
    """
    Return (usual variance of rests on one axis, whether most of them vibrate).

    It is the median of the `variances`. If most rests vibrate, above the band of the means, it is
    the second least: the quiet level, but not a single rest with less noise than all others.
    """
    median = float(np.median(variances))
    quiet = float(np.partition(variances, 1)[1]) if len(variances) > 3 else median
    if not 0.0 < VIBRATES * quiet < median:
        return median, False

    # Vibration above the band of the means raises the variance of samples, not that of the means:
    # the means of pieces then scatter less than white noise of this variance would.
    louder = variances > VIBRATES * quiet
    if float(np.median(inflations[louder])) < MIN_INFLATION:
        return quiet, True
    return median, False


def shaken_means(
    rows: Sequence[WindowStatistics], sensor: str
) -> dict[tuple[int, float], np.ndarray]:
    """
    Return `NoiseModel.shaken` of a sensor, for each rest whose vibration exceeds the quiet level.
    """
    static = _rests(rows, sensor)
    if not static:
        return {}
    variances = np.array([row.sensors[sensor].noise_variance for row in static])
    inflations = np.array([row.sensors[sensor].inflation for row in static])

    # Variance at low frequency of the vibrating rests; zero for the others.
    low_variances = np.zeros(variances.shape)
    for axis in range(3):
        quiet, shaken = _usual(variances[:, axis], inflations[:, axis])
        loud = (variances[:, axis] > VIBRATES * quiet) & shaken
        low_variances[loud, axis] = variances[loud, axis] * inflations[loud, axis]
    shaken_variance = {}
    for row, variance in zip(static, low_variances):
        if variance.any():
            shaken_variance[row.session, row.time] = variance / row.count
    return shaken_variance


def first_noise(
    system: WeightedSystem, values: np.ndarray, known: dict[str, tuple[BiasProcess, ...]]
) -> dict[str, NoiseModel]:
    """
    Return the initial noise without residuals.

    Fast parts have weight zero where slow parts can be fitted better.
    """
    found = {}
    for sensor in system.sensors:
        noise = replace(_at_rest(system, sensor, values), known=known.get(sensor, ()))
        found[sensor] = _with_bands(system, sensor, noise)
    return found


def _at_rest(system: WeightedSystem, sensor: str, values: np.ndarray) -> NoiseModel:
    """Return the noise from static windows; without one, from the residuals of moving windows."""
    rows = system.accumulator.rows
    reference = ReferenceNoise.of_steps(system.encoder_step, sensor)
    white = white_noise(rows, sensor)
    if white is not None:
        return NoiseModel(*white, reference=reference, shaken=shaken_means(rows, sensor))
    variance = np.full(3, LEAST_MOVING_VARIANCE)
    for kind in system.within[sensor]:
        variance = np.maximum(variance, moving_misfit(system, sensor, kind, values=values).noise)
    return NoiseModel(variance, np.ones(3), reference=reference)


def _with_bands(system: WeightedSystem, sensor: str, noise: NoiseModel) -> NoiseModel:
    """
    Return the noise with weight zero for the fast parts where slow parts fit better.

    The slow parts, fitted separately, have a smaller residual variance there.
    """
    moving = {}
    for kind in system.within[sensor]:
        misfit = moving_misfit(system, sensor, kind)
        if misfit.apart.any():
            moving[kind] = misfit.without_fast().factors(noise)
    return replace(noise, moving=moving)


def updated_noise(
    system: WeightedSystem, sensor: str, values: np.ndarray, *, noise: NoiseModel
) -> NoiseModel:
    """
    Return the noise of a sensor estimated from the residuals at `values`, starting from `noise`.
    """
    if white_noise(system.accumulator.rows, sensor) is None:
        # Without rests the noise of the samples is that of the residuals.
        of_residuals = _at_rest(system, sensor, values)
        noise = replace(of_residuals, known=noise.known, left_out=noise.left_out)

    # Centred rows: the excess over the noise at rest.
    moving = {}
    for kind in system.within[sensor]:
        misfit = _misfit_with_correlation(system, sensor, kind, values)
        moving[kind] = misfit.factors(noise)
    noise = replace(noise, moving=moving)

    # Means: offsets of windows and bias processes.
    rows = system.without_offsets(system.linearised(sensor, values, noise), noise)
    return replace(noise, **estimate_offsets(rows))


def _misfit_with_correlation(
    system: WeightedSystem, sensor: str, kind: str, values: np.ndarray
) -> BandMisfit:
    """
    Return the misfit of the centred rows of one kind of window at the estimate `values`.

    Where the two bands differ, the misfit of the fast one is at least that along the parameters
    (`misfit_along`).
    """
    misfit = moving_misfit(system, sensor, kind, values=values)
    if not misfit.apart.any():
        return misfit
    slopes = coefficient_jacobian(system.model, sensor, values)
    slopes = slopes[:, :, ~fixed_parameters(system.model)]

    def products(rows: np.ndarray, axis: int) -> np.ndarray:
        """Return the products of ``[design | residual]`` of one axis."""
        design = rows[:, :-3] @ slopes[:, axis]
        residual = system.misfit(sensor, rows, values)[:, axis]
        joined = np.column_stack([design, residual])
        return joined.T @ joined

    # Products of the fast part: those of all rows less those of the slow ones among them.
    all_rows = system.within[sensor][kind]
    slow_rows = system.accumulator.slow[sensor, kind]
    along_parameters = np.zeros(3)
    for axis in range(3):
        fast_products = products(all_rows, axis) - products(slow_rows, axis)
        squares, rank = misfit_along(fast_products[None])
        along_parameters[axis] = squares / max(rank, 1)
    larger = np.maximum(misfit.fast, along_parameters)
    return replace(misfit, fast=np.where(misfit.apart, larger, misfit.fast))


def moving_misfit(
    system: WeightedSystem, sensor: str, kind: str, *, values: np.ndarray | None = None
) -> BandMisfit:
    """
    Return the misfit of the centred rows of one kind of window at the parameters `values`.

    Without values, the misfit of all rows and that of the slow rows are each at their best fit.
    """
    accumulator = system.accumulator
    rows = system.within[sensor][kind]
    # Each window loses one slow row to its mean.
    n_slow = accumulator.slow_rows.get(kind, 0) - accumulator.windows[kind]
    slow_rows = rows[:0]
    if n_slow > 0:
        slow_rows = accumulator.slow[sensor, kind]

    def squares(part: np.ndarray) -> np.ndarray:
        """Return the sums of squares of the residuals of a part, shape (3,)."""
        if values is None:
            residual = own_misfit(part)
        else:
            residual = system.misfit(sensor, part, values)
        return (residual**2).sum(axis=0)

    return band_misfit(squares(rows), system.dof_within[kind], squares(slow_rows), dof_slow=n_slow)
