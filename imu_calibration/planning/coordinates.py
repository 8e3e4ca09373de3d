"""Parameters in units of their tolerances, without the directions that a gauge fixes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np
import scipy.linalg

from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.forward_equations import all_arms, coefficient_jacobian
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.prior import fixed_parameters, make_prior

EXACT = 1e-4
"""A parameter counts as known if its sd is below this share of its tolerance."""


class Coordinates:
    """
    A model at a point: ``values = point + units * (basis @ z)`` with z free of the gauge.

    Parameters
    ----------
    model : SensorModel
    tolerances : ndarray, shape (n_params,)
        Largest standard deviation that will do, SI.
    values : ndarray, optional
        Values at which the model is linearised; the prior mean for unknown parameters.

    """

    def __init__(self, model: SensorModel, tolerances: np.ndarray, values: np.ndarray | None = None):
        start = model.start() if values is None else np.asarray(values, float)
        self.values = np.where(np.isfinite(start), start, 0.0)
        self.model, self.tolerances = model.at(self.values), np.asarray(tolerances, float)
        # At a fixed point the derivative of a lag needs no columns for each arm: a third of the columns of an arm with seven joints.
        self.folded = replace(self.model, folded_arms=all_arms(self.model, self.values))
        prior = make_prior(model)
        self.prior_sd = prior.sd
        self.wanted = model.requested & ~fixed_parameters(model)
        self.units = np.where(self.wanted, self.tolerances, prior.sd)
        self.basis = _basis(prior.gauge * self.units)
        own = self.basis / (model.prior()[1] / self.units)[:, None]
        self.prior_information = own.T @ own
        """Of z, shape (n, n)."""

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return self.basis.shape[1]

    @cached_property
    def asked(self) -> np.ndarray:
        """Rows that map z to the requested parameters, in tolerances, shape (k, n)."""
        return self.basis[self.wanted]

    @cached_property
    def slopes(self) -> dict[str, np.ndarray]:
        """Sensor -> derivative of the coefficients of the columns by z, shape (n_columns, 3, n)."""
        return {sensor: np.einsum('cap,pq->caq', coefficient_jacobian(self.folded, sensor, self.values) * self.units, self.basis)
                for sensor in SENSORS}

    def sd(self, covariance: np.ndarray) -> np.ndarray:
        """Return standard deviations of all parameters, SI, from the covariance of z."""
        return self.units * np.sqrt(np.clip(np.einsum('pi,ij,pj->p', self.basis, covariance, self.basis), 0, None))

    def information_from(self, names: Mapping[str, int], covariance: np.ndarray) -> np.ndarray:
        """
        Return the information about z that a calibration holds beyond the prior, shape (n, n).

        Parameters
        ----------
        names : mapping
            Parameter name -> row of the covariance.
        covariance : ndarray
            Of all its parameters, SI; parameters that this model lacks are averaged over.

        """
        shared = [(k, names[name]) for k, name in enumerate(self.model.param_names) if name in names]
        if not shared:
            return np.zeros((self.size,) * 2)
        own, theirs = (np.array(part) for part in zip(*shared, strict=True))
        scaled = covariance[np.ix_(theirs, theirs)] / np.outer(self.units[own], self.units[own])
        basis = self.basis[own]
        values, vectors = scipy.linalg.eigh((scaled + scaled.T) / 2)
        # Directions that the gauge fixes have no variance and no component in the basis; EXACT is as good as certain.
        rows = (vectors.T @ basis) / np.sqrt(np.maximum(values, max(1e-13 * values.max(), EXACT**2)))[:, None]
        known = rows.T @ rows - self.prior_information
        weights, directions = scipy.linalg.eigh((known + known.T) / 2)
        return (directions * np.maximum(weights, 0.0)) @ directions.T


def _basis(gauge):
    """Return orthonormal directions that a gauge leaves free; unaffected parameters are separate coordinates."""
    concerned = np.any(gauge != 0, axis=0)
    inner = scipy.linalg.null_space(gauge[:, concerned] / np.abs(gauge).max()) if concerned.any() else np.zeros((0, 0))
    free = np.flatnonzero(~concerned)
    basis = np.zeros((len(concerned), len(free) + inner.shape[1]))
    basis[free, np.arange(len(free))] = 1.0
    basis[np.ix_(concerned, len(free) + np.arange(inner.shape[1]))] = inner
    return basis
