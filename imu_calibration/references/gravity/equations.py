"""
The equations of a calibration by hand.

Poses at rest, turns between them, and full turns of known angle.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from imu_calibration.core.samples import AlignedArrays
from imu_calibration.estimation.prior import zero_sum_rows
from imu_calibration.estimation.rows import NO_COMPONENT, Rows
from imu_calibration.estimation.sensor_noise import SensorNoise
from imu_calibration.kinematics.rotations import cross, skew, unit_rows
from imu_calibration.kinematics.strapdown import Turn, integrate_turn, small_rotation
from imu_calibration.references.gravity.hand_parameters import HandModel
from imu_calibration.references.rows.scalar_rows import scalar_rows

COMPONENTS = ('pose', 'drift', 'turn')
"""
Scatter beyond the noise: of the accelerometer between poses, of the gyroscope's bias, of the turns.
"""
SCATTER_SD = (0.002, 1e-4, 2e-3)
"""
Standard deviations of the `COMPONENTS` when poses or turns are too few to estimate them, m/s^2,
rad/s, rad.
"""


OF_DIRECTION, OF_DRIFT = slice(0, 2), slice(2, 5)
"""
Nuisances of a pose: components of its direction, departure of the gyroscope's bias; pose after
pose, so that the rows form a band.
"""
MAX_FIRST_ORDER_ANGLE = 1e-3
"""rad; its square, times a turn's few radians, is the error of the first-order correction."""
CALM = 0.05
"""
Least scatter of the drifts in units of the noise of the means, so that no row has infinite weight.
"""


@dataclass(frozen=True, eq=False)
class Poses(AlignedArrays):
    """Means over the intervals at rest."""

    force: np.ndarray
    """Mean accelerometer reading, m/s^2, shape (k, 3)."""
    rate: np.ndarray
    """Mean gyroscope reading, rad/s, shape (k, 3)."""
    force_sem: np.ndarray
    """Sd of `force` from the scatter within the intervals, shape (k, 3)."""
    rate_sem: np.ndarray
    """Sd of `rate` from the scatter within the intervals, shape (k, 3)."""
    start: np.ndarray
    """Index of the first sample, shape (k,)."""
    stop: np.ndarray
    """Index after the last sample, shape (k,)."""
    time: np.ndarray
    """Middle of each interval, seconds since the first sample, shape (k,)."""
    temperature_c: np.ndarray | None = None
    """Mean temperature, shape (k,), when it was recorded."""
    noise: dict[str, SensorNoise] = field(default_factory=dict)
    """Sensor -> noise within the intervals."""
    period: float = 0.0
    """Time from sample to sample, s."""
    half_turn: np.ndarray | None = None
    """
    Angle by which the attitude creeps across gravity from the middle of each interval to its end,
    rad, shape (k, 3); not in `rate`.
    """
    sway: float = 0.0
    """Rms tilt within the intervals that both sensors measure, rad (`sway.sway_at_rest`)."""
    hidden: 'HiddenRates | None' = None
    """Errors of `rate` that are the same in all poses."""

    @property
    def conditions(self) -> dict[str, Any]:
        """Time and temperature, as the functions of `HandModel` take them."""
        return {'time': self.time, 'temperature_c': self.temperature_c}


@dataclass(frozen=True)
class HiddenRates:
    """Errors of small rates that no number of rests averages, of each axis of the gyroscope."""

    dead_band: tuple[float, ...]
    """Largest rate that is given as zero in all poses, rad/s; 0 without a dead band."""
    rounding_sd: tuple[float, ...]
    """Standard deviation of the error of a mean of rounded readings, rad/s."""
    step: tuple[float, ...]
    """Step of the readings, rad/s; rounding errors of faster motions average."""


@dataclass(frozen=True, eq=False)
class TurnData:
    """Samples of a stretch of motion."""

    time: np.ndarray
    """Seconds, shape (n,)."""
    rate: np.ndarray
    """Measured rate, rad/s, shape (n, 3)."""
    force: np.ndarray
    """Measured specific force, m/s^2, shape (n, 3)."""
    first: int = -1
    """Pose before the turn."""
    last: int = -1
    """Pose after the turn."""
    noise_variance: float = 0.0
    """Variance of the integrated rate noise per axis, rad^2."""
    rotation: np.ndarray | None = None
    """
    Known rotation vector about a body axis, rad, shape (3,); None when gravity is the reference.
    """
    rotation_cov: np.ndarray | None = None
    """Covariance of `rotation`, shape (3, 3)."""
    temperature_c: np.ndarray | None = None
    """Temperature, shape (n,), when it was recorded."""


@dataclass(frozen=True, eq=False)
class State:
    """Estimated quantities."""

    values: np.ndarray
    """Parameters in the order of the model, shape (n,)."""
    up: np.ndarray
    """True direction of the specific force in each pose, unit vectors, shape (k, 3)."""
    drift: np.ndarray
    """Departure of the gyroscope's bias in each pose, rad/s, shape (k, 3)."""


def tangent(up: np.ndarray) -> np.ndarray:
    """Return two unit vectors orthogonal to each row of `up`, shape (k, 3, 2)."""
    helper = np.eye(3)[np.argmin(np.abs(up), axis=1)]
    first = unit_rows(cross(up.T, helper.T).T)
    return np.stack([first, cross(up.T, first.T).T], axis=2)


@dataclass(frozen=True, eq=False)
class GravityRows:
    """Poses, drifts of the bias and turns as rows of an estimate (`row_estimate.RowReference`)."""

    model: HandModel
    """Parameters."""
    poses: Poses
    """Means at rest."""
    turns: Sequence[TurnData]
    """Turns between them."""
    memory: dict[TurnData, '_RememberedTurn'] = field(default_factory=dict)
    """
    Turns integrated before; for similar parameters they are corrected to first order instead of
    being integrated again.
    """

    nominal = property(lambda self: self.model.nominal)
    priors = property(lambda self: self.model.priors)
    fixed = property(lambda self: self.model.fixed)

    def moved(self, state: State, step: np.ndarray) -> State:
        """
        Return the state after a step.

        The step has 5 nuisances for each pose, 2 components of its direction and 3 of its drift,
        then the parameters: shape (5 k + n,).
        """
        of_poses = step[: 5 * len(state.up)].reshape(-1, 5)
        direction_step = of_poses[:, OF_DIRECTION]
        drift_step = of_poses[:, OF_DRIFT]
        up = state.up + np.einsum('kij,kj->ki', tangent(state.up), direction_step)
        return State(state.values + step[of_poses.size :], unit_rows(up), state.drift + drift_step)

    def linearise(self, state: State) -> Rows:
        """Return the rows of poses, bias drifts, calm drifts and turns at a state."""
        equations = _Equations(self.model, self.poses, state, self.memory)
        rows = [
            equations.of_poses(),
            equations.of_drifts(),
            equations.of_calm_drifts(),
            equations.of_zero_sums(),
        ]
        for turn in self.turns:
            if turn.rotation is None or turn.rotation_cov is None:
                rows.append(equations.of_turn(turn))
            else:
                rows.append(equations.of_known_turn(turn, turn.rotation, turn.rotation_cov))
        return Rows.concatenate(rows)


@dataclass(frozen=True, eq=False)
class _RememberedTurn:
    """A turn, and the gyroscope's parameters with which it was integrated."""

    bias: np.ndarray
    """Bias, rad/s, shape (3,)."""
    matrix: np.ndarray
    """Matrix, shape (3, 3)."""
    further_values: np.ndarray
    """Values of the further effects, shape (p,)."""
    turn: Turn
    """Rotation, and its derivatives by these parameters."""

    def moved(
        self, bias: np.ndarray, matrix: np.ndarray, further_values: np.ndarray
    ) -> np.ndarray | None:
        """
        Return `Turn.mat_ji` at other parameters to first order, ``(1 - [psi x]) mat_ji``.

        None where the rotation psi due to the change of the parameters is too large for that.
        """
        psi = (
            self.turn.by_bias @ (bias - self.bias)
            + self.turn.by_matrix.reshape(3, 9) @ (matrix - self.matrix).ravel()
            + self.turn.by_further @ (further_values - self.further_values)
        )
        if np.linalg.norm(psi) >= MAX_FIRST_ORDER_ANGLE:
            return None
        return small_rotation(-psi) @ self.turn.mat_ji


class _Equations:
    """The equations of poses and turns, linearised at a state."""

    def __init__(
        self, model: HandModel, poses: Poses, state: State, memory: dict[TurnData, _RememberedTurn]
    ):
        self.model = model
        self.poses = poses
        self.state = state
        # Turns as integrated before; new ones are added.
        self.memory = memory
        # Two unit vectors across gravity in each pose, shape (k, 3, 2).
        self.across = tangent(state.up)
        # True specific force in each pose, m/s^2, shape (k, 3).
        self.true_force = model.gravity * state.up
        linear = model.linear(state.values)
        self.force_bias = linear.force_bias
        self.force_matrix = linear.force_matrix
        self.gyro_bias = linear.gyro_bias
        self.gyro_matrix = linear.gyro_matrix
        # Parameters of the further effects of the gyroscope, indices.
        self.further_of_gyroscope = model.extra_index('gyroscope')

    def of_poses(self) -> Rows:
        """
        Return ``force = bias + matrix @ (gravity * up) + further effects``, three rows per pose.

        Two of them determine the direction `up` of the pose, one the parameters.
        """
        model = self.model
        poses = self.poses
        true = self.true_force
        further_output, slopes = model.further_output(
            'accelerometer', self.state.values, true, **poses.conditions
        )
        main = np.zeros((len(true), 3, model.size))
        main[:, :, 0:3] = np.eye(3)
        # After three biases, row i of the matrix begins at the place 3 + 3 i. Of its lower triangle
        # it has i + 1 elements; those above the diagonal are fixed.
        for i in range(3):
            first = 3 + 3 * i
            main[:, i, first : first + i + 1] = true[:, : i + 1]
        main[:, :, model.extra_index('accelerometer')] = slopes
        return self._of_each_pose(
            poses.force - self.force_bias - true @ self.force_matrix.T - further_output,
            main,
            poses.force_sem**2,
            place=OF_DIRECTION,
            blocks=model.gravity * self.force_matrix @ self.across,
            component=COMPONENTS.index('pose'),
        )

    def of_drifts(self) -> Rows:
        """Return ``rate = bias + further effects (gravity * up) + drift`` at rest."""
        rate, main = self.model.rate_rows(
            self.state.values, self.true_force, self.poses.rate, **self.poses.conditions
        )
        return self._of_each_pose(
            rate - self.state.drift,
            main,
            self.poses.rate_sem**2,
            place=OF_DRIFT,
            blocks=np.eye(3),
            component=NO_COMPONENT,
        )

    def of_calm_drifts(self) -> Rows:
        """Return ``0 = drift`` within the scatter of the drifts."""
        return self._of_each_pose(
            -self.state.drift,
            np.zeros((len(self.state.up), 3, self.model.size)),
            (CALM * self.poses.rate_sem) ** 2,
            place=OF_DRIFT,
            blocks=np.eye(3),
            component=COMPONENTS.index('drift'),
        )

    def _of_each_pose(
        self,
        residual: np.ndarray,
        main: np.ndarray,
        noise: np.ndarray,
        *,
        place: slice,
        blocks: np.ndarray,
        component: int,
    ) -> Rows:
        """
        Return three rows per pose.

        Parameters
        ----------
        residual, noise : array, shape (k, 3)
            Measured minus predicted, and its variance.
        main : array, shape (k, 3, n)
            Columns of the parameters.
        place : slice
            `OF_DIRECTION` or `OF_DRIFT`: nuisances of the pose in its rows.
        blocks : array, shape (k, 3, m) or (3, m)
            Columns of these nuisances.
        component : int
            Place in `COMPONENTS`.

        """
        # Five nuisances of each pose, shape (k, 3, k, 5): a row has only those of its own pose.
        pose = np.arange(len(residual))
        size = residual.size
        nuisance = np.zeros((*residual.shape, len(residual), 5))
        nuisance[pose, :, pose, place] = blocks
        return scalar_rows(
            nuisance.reshape(size, -1),
            main.reshape(size, -1),
            residual.ravel(),
            variance=noise.ravel(),
            component=np.full(size, component),
            group=np.repeat(pose, 3),
        )

    def of_zero_sums(self) -> Rows:
        """
        Return ``0 = sum / tolerance`` of `Effect.zero_sums`.

        At rest the length of the specific force is that of gravity, so that poses and turns do not
        distinguish such a sum from the bias. The same rows are in the prior on a table.
        """
        model = self.model
        sums = zero_sum_rows(model.model)
        count = len(sums)
        n_poses = len(self.state.up)
        return scalar_rows(
            np.zeros((count, 5 * n_poses)),
            sums,
            -sums @ self.state.values,
            variance=np.ones(count),
            component=np.full(count, NO_COMPONENT),
            group=np.full(count, n_poses),
        )

    def of_turn(self, data: TurnData) -> Rows:
        """
        Return two rows of a turn: the direction before it, rotated by the rates, is that after it.

        With the directions u, their tangents T and nuisances n in the poses i and j, and the
        rotation R from the middle of pose i to the middle of pose j::

            0 = T_j' R (u_i + T_i n_i) - T_j' T_j n_j,    R = exp(-[psi x]) mat_ji
        """
        model, state = self.model, self.state
        i, j = data.first, data.last
        # The bias of the turn is that between the drifts of both poses.
        bias = self.gyro_bias + 0.5 * (state.drift[i] + state.drift[j])
        mat_ji, turn = self._integrated(data, bias)
        mat_ji = between_middles(self.poses, data, mat_ji)
        carried = mat_ji @ state.up[i]
        across_i = self.across[i]
        across_j = self.across[j]

        # By the gyroscope's parameters, through psi: d(R u_i) = -psi x (R u_i).
        by_psi = across_j.T @ skew(carried)
        main = np.zeros((2, model.size))
        main[:, model.gyro_bias] = by_psi @ turn.by_bias
        main[:, model.gyro_matrix] = by_psi @ turn.by_matrix.reshape(3, 9)
        main[:, self.further_of_gyroscope] = by_psi @ turn.by_further

        # By both directions and by half of each drift.
        nuisance = np.zeros((2, len(state.up), 5))
        nuisance[:, i, OF_DIRECTION] = across_j.T @ mat_ji @ across_i
        nuisance[:, j, OF_DIRECTION] = -(carried @ state.up[j]) * np.eye(2)
        nuisance[:, [i, j], OF_DRIFT] = 0.5 * main[:, None, model.gyro_bias]
        return scalar_rows(
            nuisance.reshape(2, -1),
            main,
            -across_j.T @ carried,
            variance=np.full(2, data.noise_variance),
            component=np.full(2, COMPONENTS.index('turn')),
            group=np.full(2, i),
            end_group=np.full(2, j),
        )

    def _integrated(self, data: TurnData, bias: np.ndarray) -> tuple[np.ndarray, Turn]:
        """
        Return (mat_ji, Turn) of a turn at the present parameters.

        A remembered turn is corrected to first order if the parameters have changed little.
        """
        further_values = self.state.values[self.further_of_gyroscope]
        if data in self.memory:
            remembered = self.memory[data]
            mat_ji = remembered.moved(bias, self.gyro_matrix, further_values)
            if mat_ji is not None:
                return mat_ji, remembered.turn
        turn = integrate_turn(
            data.time,
            data.rate,
            bias=bias,
            matrix=self.gyro_matrix,
            further=self._further_of_turn(data, bias),
        )
        self.memory[data] = _RememberedTurn(bias, self.gyro_matrix, further_values, turn)
        return turn.mat_ji, turn

    def of_known_turn(self, data: TurnData, known: np.ndarray, known_cov: np.ndarray) -> Rows:
        """
        Return three rows of a turn by a known rotation about a fixed body axis, whitened.

        They are ``matrix^-1 integral(measured - bias - further effects) = known``, rad.
        """
        model = self.model
        count = len(self.state.up)
        output, columns = self._further_of_turn(data, self.gyro_bias)
        turn = integrate_turn(
            data.time,
            data.rate,
            bias=self.gyro_bias,
            matrix=self.gyro_matrix,
            further=(output, columns),
        )
        inverse = np.linalg.inv(self.gyro_matrix)
        rotation = inverse @ turn.integral

        # d rotation by bias, matrix (d M^-1 = -M^-1 dM M^-1) and the impulse of further effects.
        main = np.zeros((3, model.size))
        main[:, model.gyro_bias] = -turn.duration * inverse
        main[:, model.gyro_matrix] = -np.einsum('rp,q->rpq', inverse, rotation).reshape(3, 9)
        means = 0.5 * (columns[:-1] + columns[1:])
        impulse = np.einsum('m,mip->ip', np.diff(data.time), means)
        main[:, self.further_of_gyroscope] = -inverse @ impulse

        variance = known_cov + data.noise_variance * np.eye(3)
        white = np.linalg.inv(np.linalg.cholesky(variance))
        return scalar_rows(
            np.zeros((3, 5 * count)),
            white @ main,
            white @ (known - rotation),
            variance=np.ones(3),
            component=np.full(3, NO_COMPONENT),
            group=np.full(3, count),
        )

    def _further_of_turn(self, data: TurnData, bias: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Return (output, columns) of the gyroscope's further effects along a turn.

        The shapes are those of `HandModel.further_output`. The true force and rate, at which the
        effects are computed, are approximated by readings corrected for bias and matrix only.
        """
        force = np.linalg.solve(self.force_matrix, (data.force - self.force_bias).T).T
        rate = np.linalg.solve(self.gyro_matrix, (data.rate - bias).T).T
        return self.model.further_output(
            'gyroscope',
            self.state.values,
            force,
            rate=rate,
            time=data.time,
            temperature_c=data.temperature_c,
        )


def between_middles(poses: Poses, turn: TurnData, mat_ji: np.ndarray) -> np.ndarray:
    """
    Return the rotation from the middle of the pose before a turn to the middle of the one after.

    `mat_ji`, shape (3, 3), is the rotation from the end of the first to the start of the second.
    """
    if poses.half_turn is None:
        return mat_ji
    return (
        small_rotation(-poses.half_turn[turn.last])
        @ mat_ji
        @ small_rotation(-poses.half_turn[turn.first])
    )
