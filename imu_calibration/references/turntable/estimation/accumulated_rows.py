"""
Rows of observations that an estimate of means and centred rows needs, of any reference.

A reference reduces groups of samples (the windows of a recording on a table) to the mean of their
rows ``[columns | output]``, and to triangular factors of the rows about these means: the mean has a
random offset of the group, the rows about it have none.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Protocol

import numpy as np

from imu_calibration.effects.base import Role
from imu_calibration.effects.sensor_model import SensorModel


class SensorRows(Protocol):
    """Rows of one sensor in one group."""

    @property
    def mean(self) -> np.ndarray:
        """Mean of the rows ``[columns | output]``, shape (n_columns + 3,)."""

    @property
    def noise_variance(self) -> np.ndarray:
        """Variance of the output about its mean at rest, else that of rounding, shape (3,)."""

    @property
    def inflation(self) -> np.ndarray:
        """Variance of means of parts over that of white noise, shape (3,); NaN in motion."""


class MeanRows(Protocol):
    """One group of samples."""

    @property
    def kind(self) -> str:
        """Kind of motion; 'static' at rest."""

    @property
    def session(self) -> int:
        """Recording of the group."""

    @property
    def time(self) -> float:
        """Middle, s."""

    @property
    def duration(self) -> float:
        """Length, s."""

    @property
    def count(self) -> int:
        """Number of samples."""

    @property
    def encoder_step(self) -> float:
        """Largest step of the reference that shows in the readings, rad; 0 where none does."""

    @property
    def sensors(self) -> Mapping[str, SensorRows]:
        """Sensor -> its rows."""


class CentredRows(Protocol):
    """Triangular factors of rows about the means of their groups."""

    @property
    def within(self) -> Mapping[tuple[str, str], np.ndarray]:
        """(sensor, kind) -> factor of the centred rows."""

    @property
    def slow(self) -> Mapping[tuple[str, str], np.ndarray]:
        """(sensor, kind) -> factor of the slow parts of the centred rows."""


class AccumulatedRows(CentredRows, Protocol):
    """All groups of some recordings."""

    @property
    def rows(self) -> Sequence[MeanRows]:
        """Groups in order of time."""

    @property
    def slow_rows(self) -> Mapping[str, int]:
        """Kind -> number of rows in `slow`."""

    @property
    def samples(self) -> Mapping[str, int]:
        """Kind -> number of samples."""

    @property
    def windows(self) -> Mapping[str, int]:
        """Kind -> number of groups."""

    @property
    def blocks(self) -> Sequence[CentredRows]:
        """The centred rows of consecutive groups, part by part in order of time."""

    def block_of(self, session: np.ndarray, time: np.ndarray) -> np.ndarray:
        """Return the number of the block in which groups of these recordings and middles lie."""


ONE_ATTITUDE = 0.02
"""
Specific forces have a single attitude if their rms across the main direction is below this share of
the rms along it, rad.
"""


def one_attitude(accumulators: Iterable[AccumulatedRows], model: SensorModel) -> bool:
    """
    Return whether the reference specific force has the same direction in all groups.

    Criterion: the second largest eigenvalue of ``sum f f^T`` over all samples is below
    `ONE_ATTITUDE` squared of the largest.

    Parameters
    ----------
    accumulators : iterable of AccumulatedRows
        Rows reduced with the columns of `model`.
    model : SensorModel

    """
    part, moment = model.columns_of('accelerometer', Role.LINEAR), np.zeros((3, 3))
    for accumulator in accumulators:
        for row in accumulator.rows:
            if 'accelerometer' in row.sensors:
                force = row.sensors['accelerometer'].mean[part]
                moment += row.count * np.outer(force, force)
        for (sensor, _), factor in accumulator.within.items():
            if sensor == 'accelerometer':
                moment += factor[:, part].T @ factor[:, part]
    sizes = np.linalg.eigvalsh(moment)
    return bool(sizes[-1] > 0 and sizes[-2] < ONE_ATTITUDE**2 * sizes[-1])


def not_separable(accumulator: AccumulatedRows, model: SensorModel) -> np.ndarray:
    """
    Return a mask of the parameters that a single attitude does not separate.

    Its windows do not separate them from bias and common arm. The mask has shape (n_params,).

    The product of the matrix and constant gravity is a bias, and its product with the accelerations
    at a lever arm is an arm of each axis.
    """
    mask = np.zeros(len(model.param_names), bool)
    if one_attitude([accumulator], model):
        for role in (Role.LINEAR, Role.ARMS):
            mask[model.part('accelerometer', role)] = True
    return mask
