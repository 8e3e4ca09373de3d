"""
The residual after the test of every effect.

Its size, its correlation, and its regimes in the session.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from imu_calibration.core.distributions import f_sf
from imu_calibration.effects.base import AXES, Role
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.selection.bias_courses import relative_temperature, temperature_courses
from imu_calibration.selection.regimes import RestRegime

LEAST_OF_AXIS = 0.1
"""Share of the strongest axis' squares from which another axis has an excess too."""
SIGNIFICANT_SDS = 5.0
"""Standard deviations above noise from which a rest is significant."""
MIN_EXPLAINED_WINDOWS = 12
"""Least number of windows; with fewer the model hardly predicts held-out windows."""
ALPHA = 1e-4
"""Significance that a correlation must have."""
MIN_CORRELATED_SHARE = 0.15
"""Adjusted share of the variance above which a significant variable is named as a likely cause."""
WINDOWS_PER_COLUMN = 3
"""Windows for each column of a variable, at least, in addition to `SPARE_WINDOWS`."""
SPARE_WINDOWS = 6
"""Windows that a variable of few columns needs in addition."""
IN_MOTION = 'motion (moving windows against windows at rest)'
"""Name of the variable that separates moving windows from windows at rest."""
CURVES_IN_TIME = 'time'
"""Name of the variable for a polynomial of the time and for steps."""


@dataclass(frozen=True, eq=False)
class Unexplained:
    """Structure of one sensor's residual that no effect explains."""

    significant: bool
    """Whether it is significant against noise and plausible bias processes."""
    rms: float
    """
    Rms beyond noise, m/s^2 or rad/s (but see `unit`): of the windows' means, or within windows
    where only that is significant.
    """
    sigma: float
    """Standard deviations by which it exceeds noise."""
    correlates_with: str | None
    """Variable that explains most of the variance of the windows' means, or None."""
    share: float
    """Share of that variance that the variable explains."""
    residual: np.ndarray
    """Residual of the windows' means, shape (k, 3)."""
    noise_sd: np.ndarray
    """Expected sd from noise, shape (k, 3)."""
    unit: str | None = None
    """
    Unit of `rms` where it is not the sensor's: 'rad/turn' where turns by hand have the largest
    residual.
    """
    axes: tuple = ()
    """Axes of the sensor that carry it, the strongest first."""
    regimes: tuple[RestRegime, ...] = ()
    """Conditions under which it appears, at most one for each axis."""
    proposal: Any = None
    """Formula that it follows (`Proposal`), or None."""
    tones: tuple = ()
    """Fixed frequencies and fixed multiples of a joint's speed in it (`Tone`), the surest first."""

    @property
    def by_structure(self) -> bool:
        """Whether it is significant by a formula, a place, a tone or scatter, not by its size."""
        return self.significant and self.sigma < SIGNIFICANT_SDS

    @property
    def entry(self) -> dict[str, Any]:
        """Entry of a calibration document."""
        entry: dict[str, Any] = {'rms': self.rms, 'axes': list(self.axes)}
        if self.unit:
            entry['unit'] = self.unit
        return entry


def biases_off(model: SensorModel, rests: Mapping[str, Unexplained]) -> list[dict[str, float]]:
    """
    Return bias -> its possible error, for each axis with a significant residual.

    A different offset in half of the windows scatters their means by as much as it shifts the bias.
    Which half is correct is unknown, for any number of windows.
    """
    errors = []
    for sensor, rest in rests.items():
        if not rest.significant:
            continue
        names = model.param_names[model.part(sensor, Role.OFFSET)]
        excess = np.mean(rest.residual**2 - rest.noise_sd**2, axis=0)
        scatter = np.sqrt(np.maximum(excess, 0.0))
        for axis in rest.axes:
            k = AXES.index(axis)
            errors.append({names[k]: float(scatter[k])})
    return errors


def correlate(
    explanations: Iterator,
    residual: np.ndarray,
    noise_sd: np.ndarray,
    *,
    fitted: Sequence[np.ndarray] | None = None,
) -> tuple[str | None, float]:
    """
    Return (name, adjusted share of the variance) of the variable that explains most, or (None, 0).

    The residual of axis i is fitted with the columns of a variable, and with those of the fit whose
    residual it is::

        residual_i = bias_i + fitted_i @ a_i + columns @ b_i + noise_i

    With the weighted squares S and degrees of freedom of all axes, with and without the variable::

        share = 1 - (S_with / dof_with) / (S_without / dof_without)

    Parameters
    ----------
    explanations : iterator
        (name, columns (k, m), mask of the windows where they are known) of each variable.
    residual : ndarray, shape (k, n)
        Of k windows and n axes.
    noise_sd : ndarray, shape (k, n)
        Its expected sd from noise.
    fitted : list of ndarray, shape (k, q_i)
        Columns of the fit of each axis, without its bias; default: none.

    """
    best = (None, 0.0)
    if fitted is None:
        fitted = [np.zeros((len(residual), 0))] * residual.shape[1]
    bias = np.ones((len(residual), 1))
    for name, columns, known in explanations:
        # A variable with nearly as many columns as windows would fit any residual.
        if known.sum() < WINDOWS_PER_COLUMN * columns.shape[1] + SPARE_WINDOWS:
            continue
        # (sum of squares, degrees of freedom) of the fits to all axes.
        without_variable = np.zeros(2)
        with_variable = np.zeros(2)
        for axis, fitted_columns in enumerate(fitted):
            weight = 1 / noise_sd[known, axis, None]
            design = weight * np.column_stack([bias, fitted_columns, columns])[known]
            values = weight[:, 0] * residual[known, axis]
            n_fitted = 1 + fitted_columns.shape[1]
            without_variable += _residual_squares(design[:, :n_fitted], values)
            with_variable += _residual_squares(design, values)
        # F test of the fall of the sum over all axes.
        squares_without, dof_without = without_variable
        squares_with, dof_with = with_variable
        n_added = dof_without - dof_with
        if min(n_added, dof_with) <= 0:
            continue
        share = 1 - (squares_with / dof_with) / (squares_without / dof_without)
        variance = max(squares_with / dof_with, 1e-300)
        p_value = f_sf((squares_without - squares_with) / n_added / variance, n_added, dof_with)
        if p_value < ALPHA and share > max(best[1], MIN_CORRELATED_SHARE):
            best = (name, float(share))
    return best


def _residual_squares(design: np.ndarray, values: np.ndarray) -> tuple[float, int]:
    """Return the residual sum of squares of a least-squares fit, and its degrees of freedom."""
    solution, _, rank, _ = np.linalg.lstsq(design, values, rcond=1e-9)
    return float(((values - design @ solution) ** 2).sum()), len(values) - int(rank)


def curves_in_time(time: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the columns of a polynomial of the time and of steps, each shape (k, m)."""
    share = (time - time.mean()) / max(np.ptp(time), 1e-9)
    yield np.stack([share, share**2, share**3], axis=1)
    levels = np.quantile(share, (0.2, 0.35, 0.5, 0.65, 0.8))
    yield np.stack([share > level for level in levels], axis=1).astype(float)


def slow_explanations(
    time: np.ndarray, temperature: np.ndarray
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """
    Yield (name, columns, mask) of time, steps in time, temperature, its rate and its past.

    Temperature is given where it is known and changes: a sensor is warmer or colder than its
    thermometer as long as heat flows.

    Parameters
    ----------
    time, temperature : array, shape (k,)
        s, in order, and degrees Celsius.

    """
    every = np.ones(len(time), bool)
    for curves in curves_in_time(time):
        yield CURVES_IN_TIME, curves, every
    warm = relative_temperature(temperature)
    if warm is None:
        return
    yield 'temperature', np.stack([warm, warm**2], axis=1), every
    for course in temperature_courses(time, temperature):
        yield course.name, course.values[:, None], course.known


def largest_axes(squares: np.ndarray, least: float = LEAST_OF_AXIS) -> tuple[str, ...]:
    """
    Return the axes whose squares exceed the share `least` of the largest, the largest first.

    The squares have the shape (3,).
    """
    return tuple(AXES[k] for k in np.argsort(-squares) if squares[k] > least * squares.max())
