"""Weighted least squares over all windows: noise, outliers, held parameters, covariance."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from imu_calibration.core.errors import NotObservableError
from imu_calibration.effects.base import Role
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.estimate import estimate
from imu_calibration.estimation.gauss_newton import gauss_newton, halved
from imu_calibration.estimation.held_parameters import Factors, undetermined_parameters, weak_alone
from imu_calibration.estimation.prior import fixed_parameters
from imu_calibration.estimation.scaled_solve import scaled_lstsq
from imu_calibration.estimation.sensor_noise import BiasProcess
from imu_calibration.estimation.solution import (
    AttitudeDependence,
    Solution,
    total,
)
from imu_calibration.references.turntable.accumulator import Accumulator
from imu_calibration.references.turntable.estimation.attitude_dependence import attitude_dependence
from imu_calibration.references.turntable.estimation.implausible_parameters import (
    implausible_parameters,
)
from imu_calibration.references.turntable.estimation.model_error_of_windows import model_error
from imu_calibration.references.turntable.estimation.one_attitude import not_separable
from imu_calibration.references.turntable.estimation.session_noise import (
    first_noise,
    moving_misfit,
    updated_noise,
)
from imu_calibration.references.turntable.estimation.weighted_system import WeightedSystem
from imu_calibration.references.turntable.estimation.window_means import predict_session_offsets
from imu_calibration.references.turntable.estimation.window_outliers import outlier_windows
from imu_calibration.references.turntable.noise_model import NoiseModel

NOISE_ROUNDS = 6
"""Largest number of alternating estimates of noise and parameters."""
OUTLIER_ROUNDS = 5
"""Largest number of rounds of outlier exclusion; one outlier may hide another."""
MAX_SOLVE_STEPS = 40
"""Largest number of Gauss-Newton steps of one solve."""
SMALL_STEP = 1e-7
"""A solve ends with a step below this many standard deviations."""
SMALL_STEP_OF_NOISE = 0.01
"""As `SMALL_STEP`, while the noise is not known yet."""
MAX_HALVINGS = 11
"""Largest number of halvings of a step that raises the cost."""
EQUALLY_WEAK = 0.99
"""Ratio to the largest sd, in sds of the prior, from which parameters are equally undetermined."""
START_PENALTY = 1e-6
"""Weight of the nominal sensor in the first values, for motions that do not determine them."""
Noises = dict[str, NoiseModel]
"""Sensor -> its noise."""


def solve(
    accumulator: Accumulator,
    model: SensorModel,
    *,
    noise: dict[str, NoiseModel] | None = None,
    bias_processes: dict[str, tuple[BiasProcess, ...]] | None = None,
) -> Solution:
    """
    Estimate all parameters jointly from accumulated windows.

    Minimises the sum of squares of whitened rows ``[columns | output] @ [coefficients(values);
    -1]`` over all windows and axes plus the prior. Window offsets and bias processes are part of
    the noise (restricted maximum likelihood).

    Parameters
    ----------
    accumulator : Accumulator
        Rows of windows, reduced with the columns of `model`.
    model : SensorModel
    noise : dict, optional
        Sensor -> NoiseModel, if known.
    bias_processes : dict, optional
        Sensor -> bias processes from a separate measurement; the other noise parameters are
        estimated.

    Returns
    -------
    Solution

    Raises
    ------
    NotObservableError
        When no parameter is determined.

    """
    if not accumulator.rows:
        raise NotObservableError(
            'at least one static window, spin or dynamic stretch must be found, none was; '
            'rest the table between moves, or check the joint states',
            code='no_windows',
        )
    system = WeightedSystem(accumulator, model)
    problem = _WindowProblem(system, noises_are_known=noise is not None)
    values = start(system)
    # The fit begins with the known noise, or with one before any residual.
    noises = noise or first_noise(system, values, bias_processes or {})
    joint = estimate(problem, _Fit(values, noises))
    values = joint.state.values
    noises = joint.state.noises

    of_model = model_error(system, values, noises, free=joint.free)
    quality = _fit_quality(system, values, noises)
    not_believed = {}
    for number, value in joint.not_believed.items():
        not_believed[model.param_names[number]] = value
    return Solution(
        model=model,
        values=values,
        terms={**joint.terms, **of_model.terms(total(joint.terms))},
        held=joint.held,
        noise=noises,
        chi2_per_dof=quality.chi2,
        information=joint.rows.data.T @ joint.rows.data,
        residual_rms=quality.rms,
        session_biases=_session_biases(system, values, noises),
        not_believed=not_believed,
        slow_over_fast=quality.slow_over_fast,
        attitude=quality.attitude,
    )


@dataclass(frozen=True, eq=False)
class _Fit:
    """Values of the parameters, and the noise with which the rows are weighted."""

    values: np.ndarray
    """Shape (n_params,)."""
    noises: Noises
    factors: Factors = field(default_factory=dict)
    """Triangular factors of the rows weighted by `noises`; empty before they are computed."""


@dataclass(frozen=True, eq=False)
class _WindowProblem:
    """Estimate from accumulated windows (`EstimateProblem`)."""

    system: WeightedSystem
    noises_are_known: bool
    """Whether the noise is not estimated."""

    @property
    def prior_sd(self) -> np.ndarray:
        """Prior standard deviations, shape (n_params,)."""
        return self.system.prior.sd

    @property
    def adjustable(self) -> np.ndarray:
        """True for the parameters that are not fixed by the model, shape (n_params,)."""
        return ~fixed_parameters(self.system.model)

    def fitted(self, fit: _Fit) -> _Fit:
        """Return the values of least cost with the noise, both without outlying windows."""
        if not self.noises_are_known:
            fit = self._values_and_noise(fit)
            # One outlier may hide another.
            for _ in range(OUTLIER_ROUNDS):
                outliers = outlier_windows(self.system, fit.values, fit.noises)
                if not any(outliers.values()):
                    break
                noises = {}
                for sensor, noise in fit.noises.items():
                    noises[sensor] = replace(noise, left_out=noise.left_out | outliers[sensor])
                fit = self._values_and_noise(_Fit(fit.values, noises))
        return self._minimised(fit.values, self._weighed(fit), self.adjustable)

    def _values_and_noise(self, fit: _Fit) -> _Fit:
        """
        Return values and noise, estimated in turn until the weights remain the same.

        One round usually suffices: the likelihood of the offsets is restricted, so it does not
        depend on the values of the parameters. With separate weights of slow and fast parts,
        weights and parameters depend on each other.
        """
        for _ in range(NOISE_ROUNDS):
            before = self._weighed(fit)
            values = self._minimised(
                fit.values, before, self.adjustable, SMALL_STEP_OF_NOISE
            ).values
            noises = {}
            for sensor, noise in before.noises.items():
                noises[sensor] = updated_noise(self.system, sensor, values, noise=noise)
            fit = _Fit(values, noises)
            if all(noises[sensor].weighs_alike(before.noises[sensor]) for sensor in noises):
                break
        return fit

    def _weighed(self, fit: _Fit) -> _Fit:
        """Return the fit with the triangular factors of the rows weighted by its noise."""
        system = self.system
        factors = {sensor: system.factors(sensor, fit.noises[sensor]) for sensor in system.sensors}
        return replace(fit, factors=factors)

    def _minimised(
        self, values: np.ndarray, fit: _Fit, free: np.ndarray, small_step: float = SMALL_STEP
    ) -> _Fit:
        """
        Return the fit with the values of least cost for its factors.

        The iteration starts at `values`, of which those `free` (mask) change, and ends with a step
        below `small_step` standard deviations.
        """
        squares = _WindowSquares(self.system, fit.factors, free, small_step)
        last = gauss_newton(squares, squares.at(values), n_steps=MAX_SOLVE_STEPS)
        return replace(fit, values=last.values)

    def undetermined(self, fit: _Fit) -> np.ndarray:
        """Return a mask of the parameters that the windows do not determine or separate."""
        rows = self.weighted(fit)
        held = undetermined_parameters(
            rows.design,
            self.prior_sd,
            free=self.adjustable,
            held=self.adjustable & weak_alone(rows.data, self.prior_sd),
            tie=EQUALLY_WEAK,
        )
        held |= not_separable(self.system.accumulator, self.system.model)
        if (held | ~self.adjustable).all():
            raise NotObservableError(
                'the recording must determine at least one parameter, it determines none; '
                'record static positions in at least four different attitudes'
            )
        return held

    def holding(self, fit: _Fit, held: np.ndarray) -> _Fit:
        """
        Return the values of least cost with the parameters `held` (mask) at their prior.

        The noise depends little on them, and remains the same.
        """
        if not held.any():
            return fit
        values = np.where(held, self.system.prior.mean, fit.values)
        return self._minimised(values, fit, self.adjustable & ~held)

    def weighted(self, fit: _Fit) -> '_WeightedWindows':
        """Return the rows at a fit."""
        data = self.system.linearise(fit.values, fit.factors).columns
        return _WeightedWindows(self.system, fit, data)

    def not_believed(self, fit: _Fit, free: np.ndarray, sd: np.ndarray) -> Mapping[int, float]:
        """
        Return number -> value of the `implausible_parameters`; none if all free ones are.
        """
        implausible = implausible_parameters(
            self.system, fit.values, sd=sd, noises=fit.noises, free=free
        )
        if not (free & ~implausible).any():
            return {}
        return {int(number): float(fit.values[number]) for number in np.flatnonzero(implausible)}


@dataclass(frozen=True, eq=False)
class _WeightedWindows:
    """Weighted rows of all windows at a fit (`WeightedRows`)."""

    system: WeightedSystem
    fit: _Fit
    data: np.ndarray
    """Columns without the prior, shape (m, n_params)."""

    @property
    def design(self) -> np.ndarray:
        """Columns of all rows, those of the prior last, shape (m + n_prior, n_params)."""
        return np.concatenate([self.data, self.system.prior.root])

    def scatter_term(self, covariance: np.ndarray) -> np.ndarray:
        """Return the part of the covariance that is due to offsets and bias processes."""
        information = self.system.bias_information(self.fit.values, self.fit.noises)
        return covariance @ information @ covariance


def start(system: WeightedSystem) -> np.ndarray:
    """
    Return the solution for bias and matrix of each sensor, all other parameters at their prior.

    Shape (n_params,). The means of windows, weighted by their numbers of samples, are fitted with
    the columns of bias and matrix, drawn slightly to the nominal sensor: bias 0, matrix 1.
    """
    model = system.model
    values = model.start()
    values = np.where(np.isfinite(values), values, 0.0)
    # Rows ``weight [1 | true input] @ [bias; matrix'] = weight output`` of the means, and the same
    # of the nominal sensor with a small weight.
    weight = np.sqrt(system.count / system.count.max())[:, None]
    nominal = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    penalty = START_PENALTY * np.eye(4)
    for sensor in system.sensors:
        columns = np.arange(model.layout(sensor).width)
        of_bias = columns[model.columns_of(sensor, Role.OFFSET)]
        of_matrix = columns[model.columns_of(sensor, Role.LINEAR)]
        means = system.means[sensor]
        design = np.concatenate([weight * means[:, [*of_bias, *of_matrix]], penalty])
        target = np.concatenate([weight * means[:, -3:], penalty @ nominal])
        solution = np.linalg.lstsq(design, target, rcond=None)[0]
        values[model.part(sensor, Role.OFFSET)] = solution[0]
        values[model.part(sensor, Role.LINEAR)] = solution[1:].T.ravel()
    return values


@dataclass(frozen=True, eq=False)
class _Point:
    """Values of the parameters with their residual."""

    values: np.ndarray
    """Shape (n_params,)."""
    residual: np.ndarray
    """Residual of the weighted rows, then of the prior, shape (m,)."""


@dataclass(frozen=True, eq=False)
class _Step:
    """A step of the free parameters."""

    change: np.ndarray
    """Shape (n_free,)."""
    length: float
    """Largest change of a parameter, in its sd if all other ones were known."""


@dataclass(frozen=True, eq=False)
class _WindowSquares:
    """
    Sum of squares of all windows and of the prior as a function of the values (`LeastSquares`).

    With the triangular factors ``[R | y]``, the coefficients B, the root P of the information of
    the prior and its mean m::

        residual = [y - R B(values), P (m - values)]
    """

    system: WeightedSystem
    factors: Factors
    """Triangular factors of the whitened rows."""
    free: np.ndarray
    """True for the parameters that are estimated, shape (n_params,)."""
    small_step: float
    """A shorter step is the last one, standard deviations."""

    def at(self, values: np.ndarray) -> _Point:
        """Return values with their residual."""
        prior = self.system.prior
        of_windows = self.system.residual(values, self.factors)
        return _Point(values, np.append(of_windows, prior.root @ (prior.mean - values)))

    def step(self, point: _Point) -> _Step:
        """Return the step from a point."""
        prior = self.system.prior
        rows = self.system.linearise(point.values, self.factors)
        rows = rows.with_prior(prior.mean - point.values, prior.root)
        columns = rows.columns[:, self.free]
        change = scaled_lstsq(columns, rows.residual)
        data = columns[: -len(prior.root)]
        information = (data**2).sum(axis=0) + 1 / prior.sd[self.free] ** 2
        return _Step(change, float(np.max(np.abs(change) * np.sqrt(information), initial=0.0)))

    def moved(self, point: _Point, step: _Step) -> _Point:
        """Return the point after the longest of the halved steps that does not raise the cost."""
        return halved(self, point, step, n_halvings=MAX_HALVINGS)

    def after(self, point: _Point, step: _Step, share: float) -> _Point:
        """Return the point after a share of a step."""
        values = point.values.copy()
        values[self.free] += step.change * share
        return self.at(values)

    def cost(self, point: _Point) -> float:
        """Return the sum of squares of a point."""
        return float(point.residual @ point.residual)

    def is_last(self, point: _Point, step: _Step) -> bool:
        """Return whether a step is small; a large misfit limits the accuracy."""
        return step.length < self.small_step * max(1.0, 1e-7 * np.sqrt(self.cost(point)))


@dataclass(frozen=True, eq=False)
class _FitQuality:
    """How well the rows fit."""

    chi2: dict[str, dict[str, float]]
    """Sensor -> 'means' or kind of the centred rows -> chi-square per degree of freedom."""
    rms: dict[str, np.ndarray]
    """Sensor -> rms residual of the moving samples and of the means of windows, SI, shape (2,)."""
    slow_over_fast: dict[str, dict[str, float]]
    """Sensor -> kind -> `BandMisfit.slow_over_fast`."""
    attitude: dict[str, AttitudeDependence]
    """Sensor -> its means at rest with the attitude, with sufficiently many rests."""


def _fit_quality(system: WeightedSystem, values: np.ndarray, noises: Noises) -> _FitQuality:
    """Return the fit quality at the estimate `values` with the noise of each sensor."""
    chi2 = {}
    rms = {}
    slow_over_fast = {}
    attitude = {}
    for sensor in system.sensors:
        noise = noises[sensor]
        dependence = attitude_dependence(system, sensor, values, noise=noise)
        if dependence is not None:
            attitude[sensor] = dependence

        # Means of all windows.
        misfit = system.misfit(sensor, system.means[sensor], values)
        white = system.mean_rows(misfit[:, :, None], noise).white()
        dof = max(white.size - _parameters_of_means(system, sensor), 1)
        chi2[sensor] = {'means': float((white**2).sum() / dof)}

        # Centred rows of each kind of moving window.
        slow_over_fast[sensor] = {}
        moving_squares = 0.0
        moving_count = 0
        for kind, rows in system.within[sensor].items():
            squares = (system.misfit(sensor, rows, values) ** 2).sum(axis=0)
            expected = system.dof_within[kind] * noise.white_variance
            chi2[sensor][kind] = float(np.mean(squares / expected))
            moving_squares = moving_squares + squares.sum()
            moving_count += 3 * system.dof_within[kind]
            bands = moving_misfit(system, sensor, kind, values=values)
            slow_over_fast[sensor][kind] = bands.slow_over_fast(noise.inflation)
        rms_moving = np.sqrt(moving_squares / moving_count) if moving_count else np.nan
        rms[sensor] = np.array([rms_moving, np.sqrt((misfit**2).mean())])
    return _FitQuality(chi2, rms, slow_over_fast, attitude)


def _session_biases(
    system: WeightedSystem, values: np.ndarray, noises: Noises
) -> dict[str, np.ndarray]:
    """
    Return sensor -> its bias in each recording, shape (n_sessions, 3).

    Only sensors of which the bias differs between recordings. It is the common bias and the best
    linear prediction of the difference (`predict_session_offsets`).
    """
    biases = {}
    for sensor in system.sensors:
        noise = noises[sensor]
        if noise.session_variance <= 0:
            continue
        misfit = system.misfit(sensor, system.means[sensor], values)
        offsets = predict_session_offsets(system.mean_rows(misfit[:, :, None], noise))
        biases[sensor] = values[system.model.part(sensor, Role.OFFSET)] + offsets
    return biases


def _parameters_of_means(system: WeightedSystem, sensor: str) -> int:
    """
    Return how many parameters the means determine: those of the sensor, at most half the data.
    """
    n_params = sum(effect.size for effect in system.model.concerning(sensor))
    return min(n_params, system.means[sensor].shape[0] * 3 // 2)
