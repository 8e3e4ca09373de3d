"""
Options and parameters of a calibration by hand.

Bias and matrix of both sensors, and further effects of the catalogue.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.errors import InputError
from imu_calibration.core.units import STANDARD_GRAVITY, STANDARD_GRAVITY_SD
from imu_calibration.effects.base import Effect, Role
from imu_calibration.effects.catalogue import CATALOGUE, Catalogue
from imu_calibration.effects.forward_equations import output_of_effects
from imu_calibration.effects.sensor_model import BASE, SensorModel, linear_names, parse_effects
from imu_calibration.kinematics.rotations import Reference

UPPER_TERMS = tuple(linear_names('accelerometer')[np.triu_indices(3, 1)].tolist())
"""Zero by the choice of axes."""
CROSS_TERMS = tuple(linear_names('accelerometer')[np.tril_indices(3, -1)].tolist())
"""Estimated off-diagonal entries of the accelerometer matrix."""
CONVENTION_SD = 1e-12
"""Sd of a parameter that a convention fixes."""
UNKNOWN_BY_HAND = {
    'angular acceleration',
    'attitude',
    'joint angle',
    'joint rate',
    'temperature rate',
}
"""Quantities that cannot be determined from gravity in poses and the rates between them."""
REPEATS = 4
"""
Fixed-point steps that invert an effect: each reduces the error by its size relative to the input, a
thousand or more.
"""


def possible_by_hand(effect: Effect) -> bool:
    """
    Return whether an effect is observable from gravity in poses and the turns between them.

    It has columns, does not change the time axis, and none of its inputs needs a table.
    """
    if not effect.groups or effect.warp is not None:
        return False
    return not any(group.uses & UNKNOWN_BY_HAND for group in effect.groups)


class LinearParameters(NamedTuple):
    """Bias and matrix of both sensors."""

    force_bias: np.ndarray
    """Bias of the accelerometer, m/s^2, shape (3,)."""
    force_matrix: np.ndarray
    """Matrix of the accelerometer, shape (3, 3)."""
    gyro_bias: np.ndarray
    """Bias of the gyroscope, rad/s, shape (3,)."""
    gyro_matrix: np.ndarray
    """Matrix of the gyroscope, shape (3, 3)."""


@dataclass(frozen=True, eq=False)
class HandModel:
    """
    A SensorModel without table, in its order of parameters; `UPPER_TERMS` is fixed.

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
    """
    Nominal reading of the gyroscope over the true rate: 2 where the driver converts for half the
    actual full-scale range.
    """
    held_terms: tuple[str, ...] = ()
    """Cross terms that are held at their prior, because no attitude tests them."""
    absent: tuple[str, ...] = ()
    """Sensors without readings; all their parameters are held."""

    def __post_init__(self) -> None:
        """Refuse effects that are not observable by hand."""
        impossible = [e.name for e in self.model.further if not possible_by_hand(e)]
        if impossible:
            raise InputError(
                'the reference by hand is gravity and the turns between poses, '
                f'{", ".join(impossible)} cannot be estimated from it; give a table, or omit it',
                key='table',
                code='table_needed',
            )

    @cached_property
    def extras(self) -> list[Effect]:
        """Effects beyond bias and matrix, in parameter order."""
        return self.model.further

    @property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.fixed)

    @cached_property
    def fixed(self) -> np.ndarray:
        """Mask of the parameters that the choice of axes fixes, shape (n,)."""
        return np.isin(self.model.param_names, UPPER_TERMS)

    @cached_property
    def always_held(self) -> np.ndarray:
        """Mask of `held_terms` and of all parameters of absent sensors, shape (n,)."""
        of_absent_sensors = self.model.mask(lambda effect: effect.sensor in self.absent)
        return np.isin(self.model.param_names, self.held_terms) | of_absent_sensors

    @cached_property
    def nominal(self) -> np.ndarray:
        """Values before any data, shape (n,)."""
        start = self.model.start()
        start[self.gyro_matrix] *= self.gyro_factor
        return start

    @cached_property
    def priors(self) -> np.ndarray:
        """Standard deviations about `nominal` before any data, shape (n,)."""
        sd = np.where(self.fixed, CONVENTION_SD, self.model.prior()[1])
        sd[self.gyro_matrix] *= self.gyro_factor
        return sd

    @property
    def gyro_bias(self) -> slice:
        """Parameters of the bias of the gyroscope."""
        return self.model.part('gyroscope', Role.OFFSET)

    @property
    def gyro_matrix(self) -> slice:
        """Parameters of the matrix of the gyroscope."""
        return self.model.part('gyroscope', Role.LINEAR)

    def base_index(self, sensor: str) -> np.ndarray:
        """Return the indices of the estimated parameters of bias and matrix of one sensor."""
        all_indices = np.arange(self.size)
        bias = all_indices[self.model.part(sensor, Role.OFFSET)]
        matrix = all_indices[self.model.part(sensor, Role.LINEAR)]
        index = np.concatenate([bias, matrix])
        return index[~self.fixed[index]]

    def extra_index(self, sensor: str) -> np.ndarray:
        """Return the indices of the parameters of the further effects of one sensor."""
        all_indices = np.arange(self.size)
        indices = [np.zeros(0, int)]
        for effect in self.extras:
            if effect.sensor == sensor:
                indices.append(all_indices[self.model.slices[effect.key]])
        return np.concatenate(indices)

    def linear(self, values: np.ndarray) -> LinearParameters:
        """Return the biases and matrices of a parameter vector, shape (n,)."""
        return LinearParameters(
            values[self.model.part('accelerometer', Role.OFFSET)],
            values[self.model.part('accelerometer', Role.LINEAR)].reshape(3, 3),
            values[self.gyro_bias],
            values[self.gyro_matrix].reshape(3, 3),
        )

    def at(self, values: np.ndarray) -> 'HandModel':
        """Return the same model with the columns of warm-ups computed at `values`."""
        return replace(self, model=self.model.at(values))

    def further_output(
        self,
        sensor: str,
        values: np.ndarray,
        force: np.ndarray,
        *,
        rate: np.ndarray | None = None,
        time: np.ndarray | None = None,
        temperature_c: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the output of a sensor's effects beyond bias and matrix, and its derivative.

        Parameters
        ----------
        sensor : str
            Sensor whose effects are added up.
        values : array, shape (n,)
            All parameters of the model.
        force, rate : arrays, shape (m, 3)
            True specific force and rate; default: at rest.
        time : array, optional
            Seconds since the first sample, shape (m,); default: zero.
        temperature_c : array, optional
            Shape (m,); needed by thermal effects.

        Returns
        -------
        tuple
            Output, shape (m, 3), and its derivative by the parameters of the effects, shape
            (m, 3, p) in the order of `extra_index`.

        """
        effects = [effect for effect in self.extras if effect.sensor == sensor]
        if not effects:
            return np.zeros((len(force), 3)), np.zeros((len(force), 3, 0))
        time = np.zeros(len(force)) if time is None else np.asarray(time, float)
        rate = np.zeros_like(force) if rate is None else rate
        # Attitude and angular acceleration are unknown. No effect reads these zeros: those that
        # would are refused (`possible_by_hand`).
        ref = Reference(
            time=time,
            mat_sn=np.zeros((len(force), 3, 3)),
            force_s=force,
            rate_s=rate,
            alpha_s=np.zeros_like(force),
            gravity=self.gravity,
            temperature_c=temperature_c,
        )
        return output_of_effects(effects, self.model, values, ref=ref)

    def compensate(
        self,
        values: np.ndarray,
        force: np.ndarray,
        rate: np.ndarray,
        *,
        time: np.ndarray | None = None,
        temperature_c: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Return (true specific force, true rate) of readings, each of shape (m, 3).

        Bias and matrix are inverted directly, further effects by a fixed-point iteration::

            true = matrix^-1 (reading - bias - further_output(true))
        """
        force_bias, force_matrix, gyro_bias, gyro_matrix = self.linear(values)
        true_force = np.linalg.solve(force_matrix, (force - force_bias).T).T
        true_rate = np.linalg.solve(gyro_matrix, (rate - gyro_bias).T).T
        for _ in range(REPEATS if self.extras else 0):
            inputs = {'rate': true_rate, 'time': time, 'temperature_c': temperature_c}
            further_force, _ = self.further_output('accelerometer', values, true_force, **inputs)
            further_rate, _ = self.further_output('gyroscope', values, true_force, **inputs)
            true_force = np.linalg.solve(force_matrix, (force - force_bias - further_force).T).T
            true_rate = np.linalg.solve(gyro_matrix, (rate - gyro_bias - further_rate).T).T
        return true_force, true_rate

    def norm_rows(
        self,
        values: np.ndarray,
        force: np.ndarray,
        *,
        time: np.ndarray | None = None,
        temperature_c: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Return ``|true force| - gravity`` at rest, shape (k,), and minus its derivative, (k, n).

        With the unit vector u of the true force t and the matrix M, minus the derivative is
        ``M^-T u`` by the bias, ``(M^-T u) t'`` by the matrix, and ``(M^-T u)' slopes`` by the
        parameters of further effects.

        Parameters
        ----------
        force : array, shape (k, 3)
            Mean readings at rest.
        time, temperature_c : arrays, optional
            Shape (k,).

        """
        matrix = self.linear(values).force_matrix
        true, _ = self.compensate(
            values, force, np.zeros_like(force), time=time, temperature_c=temperature_c
        )
        norm = np.linalg.norm(true, axis=1)
        by_reading = np.linalg.solve(matrix.T, (true / norm[:, None]).T).T  # M^-T u, shape (k, 3)
        columns = np.zeros((len(force), self.size))
        columns[:, 0:3] = by_reading
        # Row i of the lower triangular matrix has the elements up to i.
        true_of_row = np.tril(true[:, None].repeat(3, axis=1))
        columns[:, 3:12] = (by_reading[:, :, None] * true_of_row).reshape(-1, 9)
        _, slopes = self.further_output(
            'accelerometer', values, true, time=time, temperature_c=temperature_c
        )
        columns[:, self.extra_index('accelerometer')] = np.einsum('ki,kip->kp', by_reading, slopes)
        return norm - self.gravity, columns

    def rate_rows(
        self,
        values: np.ndarray,
        force: np.ndarray,
        rate: np.ndarray,
        *,
        time: np.ndarray | None = None,
        temperature_c: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Return ``rate - bias - further effects`` at rest, shape (k, 3), and its columns, (k, 3, n).

        The columns are minus its derivative by all parameters. `rate` is the mean reading, `force`
        the true specific force, each of shape (k, 3).
        """
        further_output, slopes = self.further_output(
            'gyroscope', values, force, time=time, temperature_c=temperature_c
        )
        columns = np.zeros((len(rate), 3, self.size))
        columns[:, :, self.gyro_bias] = np.eye(3)
        columns[:, :, self.extra_index('gyroscope')] = slopes
        return rate - values[self.gyro_bias] - further_output, columns


GRAVITY_LEAST, GRAVITY_MOST = 9.7, 9.9
"""
Smallest and largest gravity on the surface of the Earth with a margin, m/s^2: 9.764 on a mountain
in Peru, 9.834 in the Arctic.
"""


@dataclass(frozen=True)
class KnownTurn:
    """A turn of known angle about a fixed body axis."""

    start: int
    """Index of the first sample."""
    stop: int
    """Index after the last sample."""
    axis: tuple
    """Unit vector in the sensor frame; turns counter-clockwise seen from its tip."""
    angle: float
    """Angle of the turn, rad."""


@dataclass(frozen=True)
class HandOptions:
    """Options passed from `api` to the equations."""

    gravity: float = STANDARD_GRAVITY
    """Local gravity, m/s^2."""
    gravity_sd: float = 0.0
    """Standard deviation of the local gravity, m/s^2."""
    tolerances: dict = field(default_factory=dict)
    """{sensor: {effect: sufficient sd}}; by default the catalogue's."""
    accelerometer: tuple[str, ...] | None = None
    """Effects to estimate; None: bias and matrix."""
    gyroscope: tuple[str, ...] | None = None
    """Effects to estimate; None: bias and matrix, and the g-sensitivity if it is significant."""
    added: tuple[tuple[str, str], ...] = ()
    """(sensor, effect) that the recording demands in addition."""
    point: dict[str, np.ndarray] = field(default_factory=dict)
    """Effect -> values at which its columns are first computed."""
    catalogue: Catalogue = CATALOGUE
    """Declarations of the effects."""

    @property
    def model(self) -> SensorModel:
        """The requested effects, by default bias and matrix; without those of `added`."""
        return SensorModel(
            self.accelerometer or BASE, self.gyroscope or BASE, catalogue=self.catalogue
        )


def hand_options(options: CalibrationOptions) -> HandOptions:
    """
    Return the options of a calibration by hand.

    If the local gravity is unknown, the standard one with its uncertainty is the reference.

    Raises
    ------
    InputError
        When an effect does not exist, gravity is impossible, or a requested option needs a table.

    """
    if options.noise is not None:
        raise InputError(
            'a separate noise file is for tables only; by hand it must be omitted',
            key='table',
            code='table_only',
        )
    accelerometer = None
    if options.accelerometer_model is not None:
        accelerometer = parse_effects(
            'accelerometer', options.accelerometer_model, catalogue=options.catalogue
        )
    gyroscope = None
    if options.gyroscope_model is not None:
        gyroscope = parse_effects('gyroscope', options.gyroscope_model, catalogue=options.catalogue)
    if options.gravity is not None and not GRAVITY_LEAST <= options.gravity <= GRAVITY_MOST:
        raise InputError(
            f'gravity must be {GRAVITY_LEAST} to {GRAVITY_MOST} m/s^2, which covers the surface of'
            f' the Earth, got {options.gravity:g}; give the local gravity in m/s^2, or none',
            key='gravity',
        )
    gravity = options.gravity
    gravity_sd = options.gravity_sd
    if gravity is None:
        gravity = STANDARD_GRAVITY
        gravity_sd = STANDARD_GRAVITY_SD
    return HandOptions(
        gravity,
        gravity_sd,
        tolerances=options.tolerances,
        accelerometer=accelerometer,
        gyroscope=gyroscope,
        added=options.added,
        point=options.point,
        catalogue=options.catalogue,
    )
