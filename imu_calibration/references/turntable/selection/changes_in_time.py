"""Fits of the windows with parameters that change along functions of time."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from imu_calibration.estimation.rows import Rows, flat, weights_of
from imu_calibration.estimation.whitening import Whitening
from imu_calibration.references.turntable.noise_model import NoiseModel
from imu_calibration.references.turntable.selection.parameter_space import (
    ParameterSpace,
    mean_rows,
)
from imu_calibration.selection.explained_share import SIGNIFICANT_REST

NO_WEIGHT = 1e8
"""Factor on the variance of the mean of a window that does not count."""


@dataclass(frozen=True, eq=False)
class ChangeFit:
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
class Changes:
    """Normal matrices of changes of c parameters along m functions, the functions first."""

    cross: np.ndarray
    """
    Products of ``[columns of all parameters | residual]`` with the columns of the changes, of each
    part, shape (parts, q + 1, m c).
    """
    squares: np.ndarray
    """Products of the columns of the changes with one another, shape (parts, m c, m c)."""


@dataclass(frozen=True)
class SignificantExcess:
    """Excess over the expectation from noise, of the parts in which it is significant."""

    squares: float
    """Sum of squares minus its expectation, over these parts."""
    limit: float
    """Least significant excess of these parts together."""


@dataclass(frozen=True, eq=False)
class _RowsOfAxis:
    """Rows ``[columns | residual]`` of one axis of a sensor."""

    part: int
    """Number of the part that the means belong to; the rows within windows are the next one."""
    means: Rows
    """Means of the windows, of p columns."""
    within: np.ndarray
    """Products of the white rows within each window, shape (n, p + 1, p + 1)."""

    @property
    def places(self) -> np.ndarray:
        """Places of the columns in the normal matrix, that of the residual last, shape (p + 1,)."""
        return self.means.places

    @cached_property
    def whitening(self) -> Whitening:
        """Makes the means of the windows independent and of unit variance."""
        return self.means.whitening()

    @cached_property
    def white(self) -> np.ndarray:
        """Independent means of unit variance, shape (n, p + 1)."""
        return flat(self.whitening(self.means.equations))


@dataclass(frozen=True, eq=False)
class WindowRows:
    """
    Rows of the windows that count, in parts: means, and within windows, of each sensor.

    A change of a parameter along a function f of time has the column ``f * column``. It is made
    independent after the product: the bias processes connect the windows, so that the product with
    independent rows would be another one.
    """

    space: ParameterSpace
    """The parameters that may be fitted."""
    noise: dict[str, NoiseModel]
    """Sensor -> its noise."""
    clear: np.ndarray
    """Whether each window counts, shape (n,)."""
    axes: tuple[_RowsOfAxis, ...]
    """Rows of the axes of both sensors."""

    @classmethod
    def of(cls, space: ParameterSpace, noise: dict[str, NoiseModel]) -> 'WindowRows':
        """Return the rows of all windows."""
        moving = space.recording.moving
        kind = space.recording.kind
        axes = []
        for number, sensor in enumerate(space.sensors):
            for axis, means in enumerate(mean_rows(space, noise, sensor)):
                # Only moving windows have rows within, weighted by the variance of their kind.
                width = means.equations.shape[2]
                within = np.zeros((len(kind), width, width))
                if moving.any():
                    variances = [noise[sensor].row_variance(name)[axis] for name in kind[moving]]
                    variance = np.array(variances)
                    products = np.concatenate(list(space.within_each(sensor, axis, moving)))
                    within[moving] = products / variance[:, None, None]
                axes.append(_RowsOfAxis(2 * number, means, within))
        return cls(space, noise, np.ones(len(kind), bool), tuple(axes))

    def selected(self, clear: np.ndarray) -> 'WindowRows':
        """Return the rows with other windows that count (mask, shape (n,))."""
        # The means of the others have nearly no weight, and their rows within none.
        scatter = np.where(clear, 1.0, NO_WEIGHT)[:, None] * np.ones(3)
        means = []
        for sensor in self.space.sensors:
            means += mean_rows(self.space, self.noise, sensor, scatter=scatter)
        axes = []
        for rows, means_of_axis in zip(self.axes, means):
            within = np.where(clear[:, None, None], rows.within, 0.0)
            axes.append(replace(rows, means=means_of_axis, within=within))
        return replace(self, clear=clear, axes=tuple(axes))

    @property
    def count(self) -> int:
        """Number of windows."""
        return len(self.clear)

    @cached_property
    def expected(self) -> np.ndarray:
        """Expectation of the squares of each part from noise, shape (parts,)."""
        recording = self.space.recording
        of_means = 3.0 * self.clear.sum()
        within = 3.0 * (recording.count - 1)[recording.moving & self.clear].sum()
        return np.array([of_means, within] * len(self.space.sensors))

    @cached_property
    def part_normals(self) -> np.ndarray:
        """Normal matrices of the parts, shape (parts, q + 1, q + 1)."""
        size = self.space.size + 1
        normals = np.zeros((len(self.expected), size, size))
        for rows in self.axes:
            at = rows.means.index_in_normal
            normals[rows.part][at] += rows.white.T @ rows.white
            normals[rows.part + 1][at] += rows.within.sum(axis=0)
        return normals

    @cached_property
    def normal(self) -> np.ndarray:
        """Normal matrix of the columns and the residual, shape (q + 1, q + 1)."""
        return self.part_normals.sum(axis=0)

    def changing(self, at: np.ndarray) -> 'ChangingColumns':
        """
        Return the columns of parameters that may change.

        Parameters
        ----------
        at : ndarray, shape (c,)
            Places of the parameters, increasing.

        """
        axes = []
        for rows in self.axes:
            # Columns of the axis, without its residual, that belong to one of these parameters.
            columns = np.flatnonzero(np.isin(rows.places[:-1], at))
            if not len(columns):
                continue
            order = np.searchsorted(at, rows.places[columns])
            mean = rows.means.equations[:, :, columns]
            # Their products with all columns of the axis, and of these with one another.
            within = rows.within[:, :, columns]
            squares = within[:, columns]
            axes.append(_ChangingOfAxis(rows, order, mean, within, squares))
        return ChangingColumns(len(self.expected), self.space.size + 1, len(at), tuple(axes))

    def fit(self, parameters: np.ndarray, changes: Changes | None = None) -> ChangeFit:
        """
        Return the least squares fit of some parameters, with their priors, and of changes.

        With the columns A of the parameters, B of the changes and the residual r, all white, the
        prior mean m and its information W = diag(1 / sd^2)::

            [A'A + W  A'B] [x]   [A'r + W m]
            [B'A      B'B] [c] = [B'r      ]
            loss = r'r + m'W m - right' [x; c]

        Parameters
        ----------
        parameters : ndarray of int, shape (p,)
            Their places in the space.
        changes : Changes, optional
            Products with the columns, B'A, and with one another, B'B; no prior.

        """
        information = 1 / self.space.prior_sd[parameters] ** 2
        prior_mean = self.space.prior_mean[parameters]
        # The last row and column of `self.normal` belong to the residual.
        normal = self.normal[np.ix_(parameters, parameters)] + np.diag(information)
        right = self.normal[parameters, -1] + prior_mean * information
        if changes is not None:
            cross = changes.cross.sum(axis=0)
            squares = changes.squares.sum(axis=0)
            normal = np.block([[normal, cross[parameters]], [cross[parameters].T, squares]])
            right = np.concatenate([right, cross[-1]])

        # Scaled to a unit diagonal, because the units differ; collinear columns share their value.
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        scales = np.outer(scale, scale)
        covariance = np.linalg.pinv(normal / scales, rcond=1e-12, hermitian=True) / scales
        values = covariance @ right
        prior_squares = (prior_mean**2 * information).sum()
        loss = self.normal[-1, -1] + prior_squares - right @ values
        sd = np.sqrt(np.diag(covariance))
        count = len(parameters)
        return ChangeFit(float(loss), values[:count], values[count:], sd[count:])

    def excess(
        self, parameters: np.ndarray, fit: ChangeFit, changes: Changes | None = None
    ) -> SignificantExcess:
        """
        Return the SignificantExcess at a ChangeFit of some parameters and of changes.

        With the vector v = (-x, 1) of parameters and residual, and the changes c, in each part::

            squares = v'N v - 2 v'C c + c'S c,   expected = n, variance 2 n

        N is the normal matrix of a part, C and S are its `Changes.cross` and `Changes.squares`. An
        excess is significant from `SIGNIFICANT_REST` standard deviations on.
        """
        weights = weights_of(parameters.tolist(), fit.values, self.space.size)
        squares = np.einsum('i,kij,j->k', weights, self.part_normals, weights)
        if changes is not None:
            squares -= 2 * weights @ changes.cross @ fit.change
            squares += fit.change @ changes.squares @ fit.change
        excess = squares - self.expected
        significant = excess > SIGNIFICANT_REST * np.sqrt(2 * self.expected)
        limit = SIGNIFICANT_REST * np.sqrt(2 * self.expected[significant].sum())
        return SignificantExcess(float(excess[significant].sum()), float(limit))


@dataclass(frozen=True, eq=False)
class _ChangingOfAxis:
    """Columns of one axis of a sensor that belong to c of the parameters that may change."""

    rows: _RowsOfAxis
    """All rows of the axis."""
    order: np.ndarray
    """Numbers of the c parameters among those that may change, shape (c,)."""
    mean: np.ndarray
    """Means of the windows, shape (n, 1, c)."""
    within: np.ndarray
    """Products with all columns within each window, shape (n, p + 1, c)."""
    squares: np.ndarray
    """Products with one another within each window, shape (n, c, c)."""


@dataclass(frozen=True, eq=False)
class ChangingColumns:
    """Columns of parameters that may change, selected once for many functions of time."""

    n_parts: int
    """Number of parts."""
    size: int
    """Number of all columns, that of the residual included."""
    count: int
    """Number of parameters that may change."""
    axes: tuple[_ChangingOfAxis, ...]
    """The axes that have some of the columns."""

    def changes_along(self, functions: np.ndarray) -> Changes:
        """
        Return the Changes of the parameters along functions f of time.

        With all columns A of a part and those that may change, B, white::

            cross = A' (f B),   squares = (f B)' (g B)   for all functions f and g

        Parameters
        ----------
        functions : ndarray, shape (n, m)
            Their values in each window.

        """
        n_functions = functions.shape[1]
        n_changes = n_functions * self.count
        cross = np.zeros((self.n_parts, self.size, n_changes))
        squares = np.zeros((self.n_parts, n_changes, n_changes))
        products = functions[:, :, None] * functions[:, None]  # f g in each window, (n, m, m)
        for axis in self.axes:
            # Change of parameter j along function m: place m * count + j.
            rows = axis.rows
            places = (np.arange(n_functions)[:, None] * self.count + axis.order).ravel()
            at_cross = (rows.places[:, None], places)
            at_squares = (places[:, None], places)

            # Means: the product with the function first, then independent rows.
            columns = functions[:, :, None] * axis.mean
            white = rows.whitening(columns.reshape(len(columns), 1, -1))[:, 0]
            cross[rows.part][at_cross] += rows.white.T @ white
            squares[rows.part][at_squares] += white.T @ white

            # Within windows, where the function is constant: sum_w f_w P_w and sum_w f_w g_w P_w.
            # Shapes (p + 1, m, c) and (m, c, m, c), so that both reshape to the order of `places`.
            with_model = np.tensordot(axis.within, functions, (0, 0)).transpose(0, 2, 1)
            of_products = np.tensordot(products, axis.squares, (0, 0)).transpose(0, 2, 1, 3)
            cross[rows.part + 1][at_cross] += with_model.reshape(len(rows.places), -1)
            squares[rows.part + 1][at_squares] += of_products.reshape(len(places), -1)
        return Changes(cross, squares)
