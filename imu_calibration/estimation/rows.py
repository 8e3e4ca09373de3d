"""
Rows of least squares of any reference: linearised equations, and what is known of their errors.

A reference writes its equations as `Rows`; the noise, the estimate and the evidence for effects
take nothing else. Few rows (poses, turns, blocks of a pose topic) and the means of windows are
explicit. The samples of windows about these means, millions at 1 kHz, enter as `products`: their
errors are independent, so that sums are all that is needed of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from imu_calibration.core.samples import AlignedArrays
from imu_calibration.estimation.sensor_noise import BiasProcess
from imu_calibration.estimation.whitening import Whitening

ArrayIfKnown = Any
"""Array, or None in rows that do without it; their users know which rows have it."""
NO_COMPONENT = -1
"""Component of rows without scatter beyond their known variance."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Rows(AlignedArrays):
    """
    Linearised equations ``residual = nuisances @ dn + columns @ dp + error``.

    A row has one equation per axis; the errors of different axes are independent. Those of the rows
    have the variance `variance` and that of `component`, and the bias processes in common.
    """

    unaligned: ClassVar[frozenset[str]] = frozenset({'places', 'products'})

    equations: np.ndarray
    """``[nuisances | columns | residual]``, shape (m, n_axes, d + n + 1)."""
    variance: np.ndarray
    """Known variance of the errors, shape (m, n_axes)."""
    processes: tuple[BiasProcess, ...] = ()
    """Bias processes that move the rows of an axis together."""
    session_variance: float = 0.0
    """Variance of an offset that the rows of a recording share."""
    component: ArrayIfKnown = None
    """Variance component that adds to `variance`, or `NO_COMPONENT`, shape (m,)."""
    time: ArrayIfKnown = None
    """Middle of each row, s, shape (m,)."""
    duration: np.ndarray | None = None
    """Length of each row, s, shape (m,)."""
    session: np.ndarray | None = None
    """Recording of each row, shape (m,); None: of one recording, in order of time."""
    group: ArrayIfKnown = None
    """
    Group of each row, shape (m,): rows of a group are held out together. By hand the pose, of a
    turn the pose before it.
    """
    end_group: ArrayIfKnown = None
    """Group at the end of each row, shape (m,): of a turn the pose after it."""
    drift: np.ndarray | None = None
    """Variance by the usual drift of a bias, shape (m, n_axes); None where no bias moves rows."""
    n_nuisances: int = 0
    """Number d of nuisances, whose columns are first."""
    places: ArrayIfKnown = None
    """
    Place of each column and of the residual among all parameters, shape (n + 1,); None: the rows
    have all of them, in order.
    """
    products: ArrayIfKnown = None
    """
    Normal matrix of further rows ``[columns | residual]`` and of a prior, shape (n + 1, n + 1).
    """
    name: str = ''
    """'poses', 'turns', 'means' or another kind."""
    sensor: str = ''
    """'accelerometer' or 'gyroscope'."""

    @property
    def residual(self) -> np.ndarray:
        """Measured minus predicted of each equation, shape (m n_axes,)."""
        return self.equations[:, :, -1].ravel()

    @property
    def columns(self) -> np.ndarray:
        """Columns of the parameters, shape (m n_axes, n)."""
        return flat(self.equations)[:, self.n_nuisances : -1]

    @property
    def floor(self) -> np.ndarray:
        """Known variance with the usual drift of a bias, shape (m, n_axes)."""
        return self.variance if self.drift is None else self.variance + self.drift

    @property
    def index_in_normal(self) -> Any:
        """Index of the normal matrix of the rows in one of all parameters."""
        return ... if self.places is None else np.ix_(self.places, self.places)

    @property
    def times(self) -> np.ndarray:
        """`time`, or zeros, which only bias processes distinguish, shape (m,)."""
        return np.zeros(len(self)) if self.time is None else self.time

    @property
    def sessions(self) -> list[np.ndarray]:
        """Indices of the rows of each recording, in order of time."""
        if self.session is None:
            return [np.arange(len(self))]
        sessions = []
        for number in np.unique(self.session):
            indices = np.flatnonzero(self.session == number)
            sessions.append(indices[np.argsort(self.times[indices], kind='stable')])
        return sessions

    def of_parameters(self, kept: np.ndarray) -> 'Rows':
        """Return the rows with the columns of the nuisances and of some parameters (mask)."""
        columns = np.concatenate([np.ones(self.n_nuisances, bool), kept, [True]])
        return replace(self, equations=self.equations[:, :, columns])

    def with_prior(self, distance: np.ndarray, root: np.ndarray) -> 'Rows':
        """
        Return the rows of one axis, and ``root @ distance = root @ dp + error`` of unit variance.

        Parameters
        ----------
        distance : array, shape (n,)
            Mean of the prior minus the parameters where the rows are linearised.
        root : array, shape (k, n)
            Root of the information of the prior.

        """
        prior = np.zeros((len(root), 1, self.equations.shape[2]))
        prior[:, 0, self.n_nuisances : -1] = root
        prior[:, 0, -1] = root @ distance
        component = self.component
        if component is not None:
            component = np.append(component, np.full(len(root), NO_COMPONENT))
        return Rows(
            equations=np.concatenate([self.equations, prior]),
            variance=np.concatenate([self.variance, np.ones((len(root), 1))]),
            component=component,
            n_nuisances=self.n_nuisances,
        )

    def of_axes(self, axes: np.ndarray) -> 'Rows':
        """Return the equations of some axes."""
        drift = None if self.drift is None else self.drift[:, axes]
        equations = self.equations[:, axes]
        return replace(self, equations=equations, variance=self.variance[:, axes], drift=drift)

    def with_scatter(self, components: np.ndarray) -> 'Rows':
        """Return the rows with the variances of the components added to the known ones."""
        added = np.append(components, 0.0)[self.component]
        return replace(self, variance=self.variance + added[:, None], component=None)

    def whitening(self, sessions: list[np.ndarray] | None = None) -> Whitening:
        """
        Return the operator that makes the errors independent and of unit variance.

        `sessions` are those of the rows, where they are known.
        """
        return Whitening(
            self.variance,
            self.times,
            self.sessions if sessions is None else sessions,
            processes=self.processes,
            session_variance=self.session_variance,
        )

    def white(self) -> np.ndarray:
        """Return the equations with independent errors of unit variance, (m, n_axes, d + n + 1)."""
        return self.whitening()(self.equations)

    def residuals_at(self, weights: np.ndarray) -> np.ndarray:
        """
        Return ``residual - columns @ parameters`` of each equation, shape (m, n_axes).

        Parameters
        ----------
        weights : array, shape (n_parameters + 1,) or (m, n_parameters + 1)
            Minus the parameters, then 1 (`weights_of`); the same for all rows, or of each row.

        """
        of_columns = weights if self.places is None else weights[..., self.places]
        return (self.equations @ of_columns[..., None])[..., 0]


def weights_of(used: Sequence[int], values: np.ndarray, size: int) -> np.ndarray:
    """
    Return ``[-parameters, 1]``, the weights of `Rows.residuals_at`, shape (size + 1,).

    The parameters `used` have the `values`, all other ones are zero.
    """
    weights = np.zeros(size + 1)
    weights[list(used)] = -values
    weights[-1] = 1.0
    return weights


def normal_of_rows(
    blocks: Sequence[Rows], size: int, select: np.ndarray | None = None
) -> np.ndarray:
    """
    Return the normal matrix of rows over `size` parameters and the residual.

    Shape (size + 1, size + 1). All rows are made independent and of unit variance; with `select`
    (mask) only some of the independent rows are summed.
    """
    total = np.zeros((size + 1, size + 1))
    for block in blocks:
        white = flat(block.white() if select is None else block.white()[select])
        total[block.index_in_normal] += white.T @ white
    return total


def flat(equations: np.ndarray) -> np.ndarray:
    """Return equations (m, n_axes, n) as rows of one matrix, shape (m n_axes, n)."""
    return equations.reshape(-1, equations.shape[2])
