"""Observability of parameters, and the information that standard motions add to a recording."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
import scipy.linalg

from imu_calibration.effects.expressions import ColumnGroup
from imu_calibration.effects.forward_equations import coefficient_jacobian
from imu_calibration.effects.motions import ALL_MOTIONS
from imu_calibration.effects.sensor_model import ColumnLayout, SensorModel
from imu_calibration.estimation.scaled_solve import inverse_normal
from imu_calibration.estimation.sensor_noise import SensorNoise
from imu_calibration.estimation.solution import Solution
from imu_calibration.kinematics.rotations import Reference
from imu_calibration.references.turntable.standard_motions import MOTIONS, OTHER_MOUNT, Motion

REST_SAMPLES = 500.0
"""Samples of a rest."""
SAMPLES_PER_POINT = 2.0
"""Samples of a moving piece for each of its points in time: 100 Hz."""
MAX_WEAK_DIRECTIONS = 6
"""Weak directions that are reported: a motion for the worst ones changes the other ones too."""
MIN_MEMBER_WEIGHT = 0.2
"""Weight of a parameter over the largest of a direction from which it is reported."""
MAX_SD_RATIO = 0.7
"""Largest ratio of the sd of a parameter after a motion to that before, for the motion to help."""


@dataclass(frozen=True, eq=False)
class MotionInformation:
    """
    Information about the parameters of a model that standard motions add.

    Each piece counts as one window at 100 Hz with the noise and the between-window scatter of this
    session.
    """

    model: SensorModel
    """The effects."""
    values: np.ndarray
    """Their parameters."""
    noise: Mapping[str, SensorNoise]
    """Sensor -> its noise."""
    gravity: float
    """m/s^2."""

    @cached_property
    def _slopes(self) -> dict[str, np.ndarray]:
        """Derivative of the coefficients of each sensor, (n_columns, 3, n_params)."""
        return {
            sensor: coefficient_jacobian(self.model, sensor, self.values) for sensor in self.noise
        }

    def added_by(self, motion: Motion) -> np.ndarray:
        """Return the information of one minute of a motion, shape (n_params, n_params)."""
        total = np.zeros((len(self.values), len(self.values)))
        for sensor, noise in self.noise.items():
            layout = _HashableLayout.of(self.model.layout(sensor))
            columns = _motion_columns(layout, motion, self.gravity)
            total += columns.information(self._slopes[sensor], noise)
        return total


@dataclass(frozen=True)
class _HashableLayout:
    """The columns of one sensor, equal to those of another model with the same columns."""

    rows: tuple[tuple[str, int, int], ...]
    """(name, first column, last column + 1) of each group."""
    groups: tuple[ColumnGroup, ...]
    """Definition of the columns of each group."""
    point: tuple[tuple[str, bytes], ...]
    """Values of the effects where the columns were linearised."""
    layout: ColumnLayout = field(compare=False)
    """The layout itself."""

    @classmethod
    def of(cls, layout: ColumnLayout) -> '_HashableLayout':
        """Return a layout with the values by which it is compared."""
        rows = tuple((name, part.start, part.stop) for name, part in layout.rows.items())
        point = tuple(
            (name, np.asarray(values, float).tobytes()) for name, values in layout.point.items()
        )
        return cls(rows, tuple(layout.groups.values()), point, layout)


@dataclass(frozen=True, eq=False)
class _MotionColumns:
    """Columns of one sensor in a motion, without the noise and the values of the parameters."""

    means: np.ndarray
    """Mean of each piece, shape (n_pieces, n_columns)."""
    counts: np.ndarray
    """Samples of each piece, shape (n_pieces,)."""
    within: np.ndarray | None
    """
    Sum of squares about the means of all samples, shape (n_columns, n_columns); None of rests.
    """

    def information(self, slope: np.ndarray, noise: SensorNoise) -> np.ndarray:
        """
        Return the sum of ``A' V^-1 A`` over all rows and axes, shape (n_params, n_params).

        `slope` is the derivative of the coefficients by the parameters, shape (n_columns, 3,
        n_params).
        """
        information = np.zeros((slope.shape[2], slope.shape[2]))
        for axis in range(3):
            # Only the mean has an offset of the window in addition to its noise.
            rows = self.means @ slope[:, axis]
            variance = noise.low_variance[axis]
            mean_variance = variance / self.counts + noise.offset_sd**2 + noise.bias_variance
            information += rows.T @ (rows / mean_variance[:, None])
            if self.within is not None:
                information += slope[:, axis].T @ self.within @ slope[:, axis] / variance
        return information


# A live session uses 26 rests and some twenty motions, for two sensors.
@lru_cache(maxsize=128)
def _motion_columns(columns: _HashableLayout, motion: Motion, gravity: float) -> _MotionColumns:
    """Return means and sums of squares of the columns of one sensor in the pieces of a motion."""
    layout = columns.layout
    means = []
    counts = []
    within = None
    for piece in motion.make(gravity):
        groups = [_columns(layout, name, rows, piece) for name, rows in layout.rows.items()]
        design = np.concatenate(groups, axis=1)
        means.append(design.mean(axis=0))
        if len(piece) == 1:
            counts.append(REST_SAMPLES)
            continue
        counts.append(SAMPLES_PER_POINT * len(piece))
        centred = design - means[-1]
        squares = SAMPLES_PER_POINT * centred.T @ centred
        within = squares if within is None else within + squares
    return _MotionColumns(np.array(means), np.array(counts), within)


def _columns(layout: ColumnLayout, name: str, rows: slice, piece: Reference) -> np.ndarray:
    """
    Return the columns of a group at the samples of a piece, shape (n, width).

    Zeros where the motion has no temperature or no joints, and for columns of a warp.
    """
    group = layout.groups.get(name)
    zeros = np.zeros((len(piece), rows.stop - rows.start))
    if group is None or (piece.temperature_c is None and 'temperature' in group.uses):
        return zeros
    if piece.motion is None and group.uses & {'joint angle', 'joint rate'}:
        return zeros
    return group.columns(piece, layout.point)


def tolerance_scaled_singular_values(information: np.ndarray, tolerances: np.ndarray) -> np.ndarray:
    """
    Return the singular values of the design in units of the tolerances, descending.

    They are the roots of the eigenvalues of ``T information T``, T the tolerances. A value of one
    means that the direction is determined to one tolerance; below one it is weak. Rank is no
    sufficient criterion.
    """
    scaled = information * np.outer(tolerances, tolerances)
    return np.sqrt(np.clip(scipy.linalg.eigvalsh((scaled + scaled.T) / 2)[::-1], 0, None))


def weak_directions(
    covariance: np.ndarray, tolerances: np.ndarray, names: Sequence[str]
) -> list[dict[str, float]]:
    """
    Return the directions in which the standard deviation exceeds the tolerance, worst first.

    At most `MAX_WEAK_DIRECTIONS` are returned.

    Returns
    -------
    list of dict
        {name: weight}, the weights in tolerances, without members below `MIN_MEMBER_WEIGHT`.

    """
    scaled = covariance / np.outer(tolerances, tolerances)
    variances, vectors = scipy.linalg.eigh((scaled + scaled.T) / 2)
    directions = []
    for variance, vector in sorted(zip(variances, vectors.T), key=lambda pair: -pair[0]):
        if variance <= 1.0 or len(directions) >= MAX_WEAK_DIRECTIONS:
            break
        # The largest weight is positive; small ones are omitted.
        vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
        is_large = np.abs(vector) >= MIN_MEMBER_WEIGHT * np.max(np.abs(vector))
        weights = {names[k]: round(float(vector[k]), 3) for k in np.flatnonzero(is_large).tolist()}
        directions.append(weights)
    return directions


def needed_motions(
    solution: Solution,
    tolerances: np.ndarray,
    gravity: float,
    *,
    prior_sd: np.ndarray,
    possible: Sequence[Motion] | None = None,
) -> dict[str, tuple[str, float]]:
    """
    Return the standard motion that reduces the sd of each undetermined parameter most.

    Every motion of the catalogue is tried: its information is added to that of the recording. A
    table that turns the sensor about one axis only can do few of them (`possible`): where none of
    these would help, the IMU must be remounted.

    Returns
    -------
    dict
        Parameter name -> (motion text, predicted standard deviation).

    """
    lacking = np.flatnonzero(solution.sd > tolerances)
    if not len(lacking):
        return {}
    base = _information_of(solution, prior_sd)
    # A motion reduces the noise only: the ratio of the sd with model errors to that without them
    # is assumed to be constant.
    ratio = np.maximum(solution.sd / sd_of_information(base), 1.0)
    information = MotionInformation(solution.model, solution.values, solution.noise, gravity)
    predicted = {}
    for motion in MOTIONS if possible is None else possible:
        predicted[motion] = sd_of_information(base + information.added_by(motion)) * ratio
    needed = {}
    for k in lacking.tolist():
        name = solution.param_names[k]
        needed[name] = _best(solution, k, predicted, one_joint=possible is not None)
    return needed


def sd_of_data(solution: Solution, prior_sd: np.ndarray) -> np.ndarray:
    """
    Return the standard deviations of the parameters from noise only, shape (n_params,).

    With the information of the recording and the prior, without model errors or held parameters.
    """
    return sd_of_information(_information_of(solution, prior_sd))


def _information_of(solution: Solution, prior_sd: np.ndarray) -> np.ndarray:
    """Return the information of the data and of the prior, shape (n_params, n_params)."""
    return solution.information + np.diag(1 / prior_sd**2)


def sd_of_information(information: np.ndarray) -> np.ndarray:
    """Return the standard deviations of an information matrix, shape (n_params,)."""
    return np.sqrt(np.clip(np.diag(inverse_normal(information)), 1e-300, None))


def _best(
    solution: Solution, index: int, predicted: dict[Motion, np.ndarray], *, one_joint: bool
) -> tuple[str, float]:
    """
    Return (text, predicted sd) of the best motion for one parameter.

    Where none helps, (another mount or the motion of the effect, NaN). `predicted`: motion -> sd of
    all parameters after it.
    """
    motion = min(predicted, key=lambda m: predicted[m][index], default=None)
    if motion is not None and predicted[motion][index] <= MAX_SD_RATIO * solution.sd[index]:
        return motion.text, float(predicted[motion][index])
    if one_joint:
        return OTHER_MOUNT, float('nan')
    owner = next(
        e for e in solution.model.effects if solution.param_names[index] in e.param_names()
    )
    return ALL_MOTIONS[owner.motion[0]], float('nan')
