"""Observability of parameters by a recording, in tolerances, and motions that determine the remaining parameters."""

from collections.abc import Sequence

import numpy as np
import scipy.linalg

from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.forward_equations import coefficient_jacobian
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.noise_model import NoiseModel
from imu_calibration.estimation.scaled_solve import inverse_normal
from imu_calibration.estimation.solution import Solution
from imu_calibration.estimation.standard_motions import MOTIONS, OTHER_MOUNT, TABLE_MOTIONS, Motion


def added_information(model: SensorModel, values: np.ndarray, noise: dict[str, NoiseModel], *, motion: Motion,
                      gravity: float) -> np.ndarray:
    """
    Return the information matrix that one minute of a standard motion would add, shape (n_params, n_params).

    Each piece counts as one window at 100 Hz with the noise and the between-window scatter of this session.
    """
    total = np.zeros((len(values), len(values)))
    for piece in motion.make(gravity):
        for sensor in SENSORS:
            total += _piece_information(model, sensor, values, noise[sensor], piece)
    return total


def _piece_information(model, sensor, values, noise, piece):
    layout = model.layout(sensor)
    design = np.concatenate([_columns(layout, name, rows, piece) for name, rows in layout.rows.items()], axis=1)
    dc = coefficient_jacobian(model, sensor, values)
    static = len(piece) == 1
    count = 500.0 if static else 2.0 * len(piece)
    mean = design.mean(axis=0)
    within = (design - mean).T @ (design - mean) * (0.0 if static else 2.0)
    information = np.zeros((dc.shape[2], dc.shape[2]))
    for axis in range(3):
        rows = mean @ dc[:, axis]
        variance = noise.low_variance[axis]
        information += np.outer(rows, rows) / (variance / count + noise.offset_sd**2 + noise.bias_variance)
        information += dc[:, axis].T @ within @ dc[:, axis] / variance
    return information


def _columns(layout, name, rows, piece):
    """Return the columns of a group; zeros where the motion has no temperature or no joints, and for columns of a warp."""
    group = layout.groups.get(name)
    unknown = group is None or (piece.temperature_c is None and 'temperature' in group.uses) or (
        piece.motion is None and bool(group.uses & {'joint angle', 'joint rate'}))
    return np.zeros((len(piece), rows.stop - rows.start)) if unknown else group.columns(piece, layout.point)


def tolerance_scaled_singular_values(information: np.ndarray, tolerances: np.ndarray) -> np.ndarray:
    """
    Return the singular values of the design with parameters in units of their tolerance, descending.

    A value of one means that the direction is determined to one tolerance; below one it is weak. Rank is no sufficient criterion.
    """
    scaled = information * np.outer(tolerances, tolerances)
    return np.sqrt(np.clip(scipy.linalg.eigvalsh((scaled + scaled.T) / 2)[::-1], 0, None))


def weak_directions(covariance: np.ndarray, tolerances: np.ndarray, names: Sequence[str], *, limit: int = 6) -> list[dict[str, float]]:
    """
    Return the directions in which the standard deviation exceeds the tolerance, worst first.

    Returns
    -------
    list of dict
        {name: weight}, the weights in tolerances, members below 0.2 of the largest left out.

    """
    scaled = covariance / np.outer(tolerances, tolerances)
    variances, vectors = scipy.linalg.eigh((scaled + scaled.T) / 2)
    found = []
    for variance, vector in sorted(zip(variances, vectors.T), key=lambda pair: -pair[0]):
        if variance <= 1.0 or len(found) >= limit:
            break
        vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
        strong = np.abs(vector) >= 0.2 * np.max(np.abs(vector))
        found.append({names[k]: round(float(vector[k]), 3) for k in np.flatnonzero(strong).tolist()})
    return found


def needed_motions(solution: Solution, tolerances: np.ndarray, gravity: float, *, prior_sd: np.ndarray,
                   possible: Sequence[Motion] | None = None) -> dict[str, tuple[str, float]]:
    """
    Return for each undetermined parameter the standard motion that reduces its standard deviation most.

    Every motion of the catalogue is tried: its information is added, and the predicted standard errors are compared with the
    tolerances. A table that turns the sensor about one axis only can do few of them (`possible`): where none of these would help, the IMU
    must be remounted.

    Returns
    -------
    dict
        Parameter name -> (motion text, predicted standard deviation).

    """
    lacking = np.flatnonzero(solution.sd > tolerances)
    if not len(lacking):
        return {}
    base = solution.information + np.diag(1 / prior_sd**2)
    before, predicted = _sd_of(base), {}
    for motion in MOTIONS if possible is None else possible:
        total = base + added_information(solution.model, solution.values, solution.noise, motion=motion, gravity=gravity)
        predicted[motion] = _sd_of(total) * np.maximum(solution.sd / before, 1.0)   # the model error remains
    best = _best if possible is None else _best_on_one_joint
    return {solution.param_names[k]: best(solution, k, predicted) for k in lacking}


def _sd_of(information):
    return np.sqrt(np.clip(np.diag(inverse_normal(information)), 1e-300, None))


def _best_on_one_joint(solution, index, predicted):
    motion = min(predicted, key=lambda m: predicted[m][index], default=None)
    sd = float('nan') if motion is None else float(predicted[motion][index])
    return (motion.text, sd) if sd < 0.7 * solution.sd[index] else (OTHER_MOUNT, float('nan'))


def _best(solution, index, predicted):
    motion = min(predicted, key=lambda m: predicted[m][index])
    sd = float(predicted[motion][index])
    if sd > 0.7 * solution.sd[index]:
        owner = next(e for e in solution.model.effects if solution.param_names[index] in e.param_names())
        texts = {m.name: m.text for m in MOTIONS} | TABLE_MOTIONS
        return texts[owner.motion[0]], float('nan')
    return motion.text, sd
