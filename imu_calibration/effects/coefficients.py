"""How the values of an effect multiply its columns: callables ``(values, point) -> {group name: (n_columns, 3)}`` that can be sent."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from imu_calibration.effects.regressors import LEVER


@dataclass(frozen=True)
class Amplitudes:
    """
    Values straight before the columns: ``output_i = sum_k value_ik column_k``.

    With three amplitudes and three columns each column may belong to one axis only. A last value that is a time constant is accompanied
    by the columns' derivatives by it.
    """

    effect: str
    """Name of the effect."""
    group: str
    """Name of its columns."""
    own_axis: bool = False
    """Whether column i acts on axis i only."""
    time_constant: bool = False
    """Whether the last value is a time constant."""

    def __call__(self, values: dict[str, np.ndarray], point: dict[str, Any]) -> dict[str, np.ndarray]:
        """Return the coefficients."""
        own = values[self.effect]
        amplitudes = own[:-1] if self.time_constant else own
        block = np.diag(amplitudes) if self.own_axis else amplitudes.reshape(3, -1).T
        if self.time_constant:
            block = np.concatenate([block, block * (own[-1] - point[self.effect][-1])])
        return {self.group: block}


@dataclass(frozen=True)
class AlongAxis:
    """
    Values before a function of the input along each element's own axis.

    ``function(input axes)`` gives the coefficients of one of each.
    """

    effect: str
    group: str
    function: Callable

    def __call__(self, values: dict[str, np.ndarray], point: dict[str, Any]) -> dict[str, np.ndarray]:
        """Return the coefficients."""
        return {self.group: self.function(input_axes(values)) * values[self.effect][None, :]}


@dataclass(frozen=True)
class Products:
    """Values before the last three of six products, which are of different components."""

    effect: str
    group: str

    def __call__(self, values: dict[str, np.ndarray], point: dict[str, Any]) -> dict[str, np.ndarray]:
        """Return the coefficients."""
        block = values[self.effect].reshape(3, 3).T
        return {self.group: np.concatenate([np.zeros((3, 3), block.dtype), block])}


@dataclass(frozen=True)
class OfOthers:
    """Two values for each axis, before the columns of the two other axes."""

    effect: str
    group: str

    def __call__(self, values: dict[str, np.ndarray], point: dict[str, Any]) -> dict[str, np.ndarray]:
        """Return the coefficients."""
        block = np.zeros((3, 3), values[self.effect].dtype)
        block[~np.eye(3, dtype=bool)] = values[self.effect]
        return {self.group: block.T}


@dataclass(frozen=True)
class OfMatrix:
    """The sensor's matrix, or its rows times one value per axis."""

    effect: str
    group: str

    def __call__(self, values: dict[str, np.ndarray], point: dict[str, Any]) -> dict[str, np.ndarray]:
        """Return the coefficients."""
        matrix = values['matrix'].reshape(3, 3)
        return {self.group: matrix.T if self.effect == 'matrix' else (matrix * values[self.effect][:, None]).T}


@dataclass(frozen=True)
class LeverArms:
    """Coefficients of the lever matrix W_jk for output i: m_ij r_ik (Zhang 2017, eq. 11-17 with the true inverse)."""

    effect: str

    def __call__(self, values: dict[str, np.ndarray], point: dict[str, Any]) -> dict[str, np.ndarray]:
        """Return the coefficients; one arm is repeated for three."""
        matrix, arms = values['matrix'].reshape(3, 3), np.broadcast_to(values[self.effect].reshape(-1, 3), (3, 3))
        return {LEVER.name: (matrix[:, :, None] * arms[:, None, :]).reshape(3, 9).T}


def input_axes(values: dict[str, np.ndarray]) -> np.ndarray:
    """Return the unit vectors along which the three sensing elements sense: rows of the matrix, normalised."""
    matrix = values['matrix'].reshape(3, 3)
    return matrix / np.sqrt((matrix**2).sum(axis=1))[:, None]
