"""The parameters of a calibration by hand: bias and matrix of both sensors, and further effects of the catalogue."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.effects.base import SENSORS, Effect
from imu_calibration.effects.forward_equations import effect_slopes
from imu_calibration.effects.sensor_model import SensorModel, linear_names
from imu_calibration.estimation.status import tolerances_of
from imu_calibration.kinematics.rotations import Reference

LOWER = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))
"""Free entries of the accelerometer matrix under the gauge."""
UPPER = tuple(linear_names('accelerometer')[np.triu_indices(3, 1)].tolist())
"""Zero by the choice of axes."""
BASE_NAMES = tuple(name for name in SensorModel().param_names if name not in UPPER)
"""Parameters of every calibration by hand, in their order."""
CROSS_TERMS = tuple(linear_names('accelerometer')[np.tril_indices(3, -1)].tolist())
"""Estimated off-diagonal entries of the accelerometer matrix."""
N_BASE = len(BASE_NAMES)
ACCELEROMETER, GYRO_BIAS, GYRO_MATRIX = slice(0, 9), slice(9, 12), slice(12, 21)
BASE_NOMINAL = np.array([0, 0, 0, 1, 0, 1, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1], float)
"""Zero bias, identity matrices."""
UNKNOWN_BY_HAND = {'angular acceleration', 'attitude', 'joint angle', 'joint rate'}
"""Quantities that cannot be determined from gravity in poses and the rates between them."""
REPEATS = 4
"""Fixed-point steps that invert an effect: each reduces the error by its size relative to the input, a thousand or more."""


def possible_by_hand(effect: Effect) -> bool:
    """Return whether an effect is observable from gravity in poses and the turns between them: it has columns, and none needs a table."""
    return bool(effect.groups) and effect.warp is None and not any(group.uses & UNKNOWN_BY_HAND for group in effect.groups)


def unpack(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return (accelerometer bias, accelerometer matrix, gyroscope bias, gyroscope matrix) of a parameter vector."""
    matrix = np.zeros((3, 3))
    for value, (i, j) in zip(values[3:9], LOWER):
        matrix[i, j] = value
    return values[0:3], matrix, values[GYRO_BIAS], values[GYRO_MATRIX].reshape(3, 3)


@dataclass(frozen=True, eq=False)
class HandModel:
    """
    A SensorModel without table: `BASE_NAMES`, then the further effects of the accelerometer, then the gyroscope's.

    Raises
    ------
    InputError
        When an effect needs a table.

    """

    model: SensorModel
    """The effects; bias and matrix of both sensors are among them."""
    gravity: float
    """Reference, m/s^2."""
    gyro_factor: float = 1.0
    """Nominal reading of the gyroscope over the true rate: 2 where the driver converts for half the actual full-scale range."""

    def __post_init__(self):
        """Refuse effects that are not observable by hand."""
        strange = [e.name for e in self.model.further if not possible_by_hand(e)]
        if strange:
            raise InputError('the reference by hand is gravity and the turns between poses, '
                             f'{", ".join(strange)} cannot be estimated from it; give a table, or omit it', key='table',
                             code='table_needed')

    @cached_property
    def extras(self) -> list[Effect]:
        """Effects beyond bias and matrix, in parameter order."""
        return self.model.further

    @cached_property
    def parts(self) -> dict[tuple[str, str], slice]:
        """(sensor, effect name) -> slice of the parameter vector, for the further effects."""
        ends = np.cumsum([N_BASE] + [e.size for e in self.extras])
        return {e.key: slice(a, b) for e, a, b in zip(self.extras, ends, ends[1:])}

    @cached_property
    def param_names(self) -> tuple[str, ...]:
        """SENSOR.EFFECT.COMPONENT of each parameter."""
        return (*BASE_NAMES, *(name for e in self.extras for name in e.param_names()))

    @property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.param_names)

    @cached_property
    def nominal(self) -> np.ndarray:
        """Values before any data, shape (n,)."""
        start, base = self.model.start(), BASE_NOMINAL.copy()
        base[GYRO_MATRIX] *= self.gyro_factor
        return np.concatenate([base, *(start[self.model.slices[e.key]] for e in self.extras)])

    @cached_property
    def priors(self) -> np.ndarray:
        """Standard deviations about `nominal` before any data, shape (n,)."""
        known = dict(zip(self.model.param_names, self.model.prior()[1]))
        sd = np.array([known[name] for name in self.param_names])
        sd[GYRO_MATRIX] *= self.gyro_factor
        return sd

    def tolerances(self, given: dict) -> np.ndarray:
        """Return the sufficient standard deviations, shape (n,); the catalogue's where `given` has none."""
        known = dict(zip(self.model.param_names, tolerances_of(self.model, given)))
        return np.array([known[name] for name in self.param_names])

    def index_of(self, sensor: str) -> np.ndarray:
        """Return the parameters of one sensor, bias and matrix first."""
        base = range(9) if sensor == 'accelerometer' else range(9, N_BASE)
        return np.array([*base, *(k for (s, _), part in self.parts.items() if s == sensor for k in range(part.start, part.stop))])

    def extra_index(self, sensor: str) -> np.ndarray:
        """Return the parameters of the further effects of one sensor."""
        return self.index_of(sensor)[9 if sensor == 'accelerometer' else 12:]

    def at(self, values: np.ndarray) -> 'HandModel':
        """Return the same model with the columns of warm-ups computed at `values`."""
        return replace(self, model=self.model.at(self.in_model_order(values)))

    def in_model_order(self, values: np.ndarray) -> np.ndarray:
        """Return the parameters in the order of the SensorModel."""
        known = dict(zip(self.param_names, values)) | dict.fromkeys(UPPER, 0.0)
        return np.array([known[name] for name in self.model.param_names])

    def further(self, sensor: str, values: np.ndarray, force: np.ndarray, *, rate: np.ndarray, time: np.ndarray | None = None,
                temperature_c: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the contribution of the further effects to the output of a sensor, and its derivative by their parameters.

        Parameters
        ----------
        force, rate : arrays, shape (m, 3)
            True specific force and rate.
        time : array, optional
            Seconds since the first sample, shape (m,).
        temperature_c : array, optional
            Shape (m,); needed by thermal effects.

        Returns
        -------
        tuple
            Output, shape (m, 3), and columns, shape (m, 3, p) in the order of `extra_index`.

        """
        effects = [e for e in self.extras if e.sensor == sensor]
        output, columns = np.zeros((len(force), 3)), [np.zeros((len(force), 3, 0))]
        if not effects:
            return output, columns[0]
        ref = _reference(force, rate, time, temperature_c, self.gravity)
        point, own = self.model.full_point(), self.model.values_of(sensor, self.in_model_order(values))
        for effect in effects:
            basis = {group.name: group.columns(ref, point) for group in effect.groups}
            coefficients, slopes = effect_slopes(effect, own, point)
            output = output + sum(basis[group] @ block for group, block in coefficients.items())
            columns.append(sum(np.einsum('mw,wip->mip', basis[group], block) for group, block in slopes.items()))
        return output, np.concatenate(columns, axis=2)

    def compensate(self, values: np.ndarray, force: np.ndarray, rate: np.ndarray, *, time: np.ndarray | None = None,
                   temperature_c: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return true specific force and rate for readings of shape (m, 3)."""
        bias_f, matrix_f, bias_w, matrix_w = unpack(values)
        true_f, true_w = np.linalg.solve(matrix_f, (force - bias_f).T).T, np.linalg.solve(matrix_w, (rate - bias_w).T).T
        for _ in range(REPEATS if self.extras else 0):
            more_f, more_w = (self.further(s, values, true_f, rate=true_w, time=time, temperature_c=temperature_c)[0] for s in SENSORS)
            true_f = np.linalg.solve(matrix_f, (force - bias_f - more_f).T).T
            true_w = np.linalg.solve(matrix_w, (rate - bias_w - more_w).T).T
        return true_f, true_w

    def norm_rows(self, values: np.ndarray, force: np.ndarray, *, time: np.ndarray | None = None,
                  temperature_c: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """
        Return ``|true force| - gravity`` of mean readings at rest, shape (k,), and minus its derivative by all parameters, shape (k, n).

        Parameters
        ----------
        force : array, shape (k, 3)
            Mean readings at rest.
        time, temperature_c : arrays, optional
            Shape (k,).

        """
        _, matrix, *_ = unpack(values)
        true = self.compensate(values, force, np.zeros_like(force), time=time, temperature_c=temperature_c)[0]
        norm = np.linalg.norm(true, axis=1)
        back = np.linalg.solve(matrix.T, (true / norm[:, None]).T).T
        columns = np.zeros((len(force), self.size))
        columns[:, 0:3] = back
        for place, (i, j) in enumerate(LOWER, 3):
            columns[:, place] = back[:, i] * true[:, j]
        slopes = self.further('accelerometer', values, true, rate=np.zeros_like(true), time=time, temperature_c=temperature_c)[1]
        columns[:, self.extra_index('accelerometer')] = np.einsum('ki,kip->kp', back, slopes)
        return norm - self.gravity, columns


def _reference(force, rate, time, temperature_c, gravity):
    time = np.zeros(len(force)) if time is None else np.asarray(time, float)
    return Reference(time, np.zeros((len(force), 3, 3)), force, rate, np.zeros_like(force), gravity, temperature_c)

