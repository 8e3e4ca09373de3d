"""What a recording can determine, in tolerances, and which motion would determine the rest."""

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from imu_calibration.effects.base import SENSORS
from imu_calibration.reference import Reference
from imu_calibration.sensor_model import coefficient_jacobian
from imu_calibration.effects.regressors import GROUPS

DEG = np.pi / 180
G = 9.80665


@dataclass(frozen=True)
class Motion:
    """A standard motion of the sensor, to be carried out on the table or by hand."""

    name: str
    """Short name."""
    text: str
    """What to do."""
    make: object
    """Function of gravity that returns pieces of the motion, each a Reference."""




def _turn(axis, time, angle, rate, alpha, gravity, up, temperature_c=None, arm=None):
    """Return the reference of a sensor that turns about its own `axis`; `up` is the vertical in the sensor at angle zero."""
    axis, up = np.asarray(axis, float) / np.linalg.norm(axis), np.asarray(up, float) / np.linalg.norm(up)
    cos, sin = np.cos(angle)[:, None], -np.sin(angle)[:, None]
    up_s = up * cos + np.cross(axis, up) * sin + axis * (axis @ up) * (1 - cos)
    rate_s, alpha_s = rate[:, None] * axis, alpha[:, None] * axis
    force = gravity * up_s
    if arm is not None:
        force = force + np.cross(alpha_s, arm) + np.cross(rate_s, np.cross(rate_s, arm))
    return Reference(time, _attitudes(up_s), force, rate_s, alpha_s, gravity, temperature_c)


def _attitudes(up_s):
    """Return attitudes whose third column is the vertical; the heading is arbitrary."""
    other = np.eye(3)[np.argmin(np.abs(up_s), axis=1)]
    first = np.cross(other, up_s)
    first /= np.linalg.norm(first, axis=1)[:, None]
    return np.stack([first, np.cross(up_s, first), up_s], axis=2)


TIME = np.arange(0.0, 30.0, 0.02)
EDGES = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)]


def _spin(axis, speeds, up=None, arm=None):
    def make(gravity):
        across = np.roll(axis, 1) if up is None else up
        return [_turn(axis, TIME, s * DEG * TIME, np.full(len(TIME), s * DEG), np.zeros(len(TIME)), gravity, across, arm=arm) for s in speeds]
    return make


def _oscillation(axis, degrees, hertz):
    def make(gravity):
        w, a = 2 * np.pi * hertz, degrees * DEG
        return [_turn(axis, TIME, a * np.sin(w * TIME), a * w * np.cos(w * TIME), -a * w**2 * np.sin(w * TIME), gravity, (0.3, 0.4, 1.0))]
    return make


def _poses(directions, temperatures=(None,)):
    def make(gravity):
        one = np.zeros(1)
        return [_turn((0, 0, 1), one + 60.0 * k, one, one, one, gravity, up, None if t is None else np.full(1, t))
                for t in temperatures for k, up in enumerate(directions)]
    return make


def _two_axis(gravity):
    """Turn about an axis that itself turns: rates about two axes at once, with the cross term in the angular acceleration."""
    pieces = []
    for inner, outer in ((0, 1), (1, 2), (2, 0)):
        w = 200 * DEG
        rate, alpha = np.zeros((len(TIME), 3)), np.zeros((len(TIME), 3))
        third = 3 - inner - outer
        rate[:, inner] = w
        rate[:, outer], rate[:, third] = w * np.cos(w * TIME), -w * np.sin(w * TIME)
        alpha[:, outer], alpha[:, third] = -w * w * np.sin(w * TIME), -w * w * np.cos(w * TIME)
        up = np.zeros((len(TIME), 3))
        up[:, outer], up[:, third] = np.cos(w * TIME), -np.sin(w * TIME)
        pieces.append(Reference(TIME, _attitudes(up), gravity * up, rate, alpha, gravity))
    return pieces


def _fine_poses():
    angle = np.arange(0, 2 * np.pi, np.pi / 12)
    rings = [np.roll(np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1), k, axis=1) for k in range(3)]
    return [tuple(v) for v in np.concatenate(rings)]


MOTIONS = (
    Motion('static_poses', 'rest in six faces and twelve edge positions, at several headings', _poses(EDGES)),
    Motion('static_dense', 'rest every 15 degrees on three rings', _poses(_fine_poses())),
    Motion('spin_x', "spin about the sensor's x axis at 100 and 200 deg/s in both senses", _spin((1, 0, 0), (-200, -100, 100, 200))),
    Motion('spin_y', "spin about the sensor's y axis at 100 and 200 deg/s in both senses", _spin((0, 1, 0), (-200, -100, 100, 200))),
    Motion('spin_z', "spin about the sensor's z axis at 100 and 200 deg/s in both senses", _spin((0, 0, 1), (-200, -100, 100, 200))),
    Motion('three_speeds', 'spin about skewed axes at 50, 100 and 200 deg/s in both senses', lambda g: [
        piece for axis in ((1, 1, 0), (0, 1, 1), (1, 0, 1), (1, 0, 0), (0, 1, 0), (0, 0, 1))
        for piece in _spin(axis, (-200, -100, -50, 50, 100, 200))(g)]),
    Motion('oscillate_x', "oscillate about the sensor's x axis, 30 deg at 1 Hz", _oscillation((1, 0, 0), 30, 1.0)),
    Motion('oscillate_y', "oscillate about the sensor's y axis, 30 deg at 1 Hz", _oscillation((0, 1, 0), 30, 1.0)),
    Motion('oscillate_z', "oscillate about the sensor's z axis, 30 deg at 1 Hz", _oscillation((0, 0, 1), 30, 1.0)),
    Motion('two_axis', 'turn about two axes at once at 200 deg/s, for each pair of axes', _two_axis),
    Motion('centrifuge', 'spin at 300 deg/s on an arm of 0.3 m, about each axis', lambda g: [
        piece for k in range(3) for piece in _spin(np.eye(3)[k], (-300, 300), arm=0.3 * np.roll(np.eye(3)[k], 1))(g)]),
    Motion('warm_up', 'rest in six faces, cold and warm', _poses([tuple(s * np.eye(3)[k]) for k in range(3) for s in (1, -1)], (15.0, 25.0, 35.0))),
)
"""Standard motions of the sensor; motions of table joints are named by the effects that need them."""

TABLE_MOTIONS = {
    'turn_about_vertical': 'turn slowly through a full circle about the vertical, resting at several headings',
    'slow_turn': 'turn each joint slowly through full circles, with the sensor mounted at two attitudes',
    'oscillate_fast': 'oscillate at 1, 2 and 4 Hz about two axes, in both phases',
    'fast_spin': 'spin slowly up to the fastest rate in both senses',
}
"""Motions that concern the table or the clock; their gain depends on the table and is not predicted."""


def added_information(model, values, noise, motion, gravity):
    """
    Return the information matrix that one minute of a standard motion would add, shape (n_params, n_params).

    Each piece counts as one window at 100 Hz with the noise and the between-window scatter of this session.
    """
    total = np.zeros((len(values), len(values)))
    point = model.full_point()
    for piece in motion.make(gravity):
        for sensor in SENSORS:
            total += _piece_information(model, sensor, values, noise[sensor], piece, point)
    return total


def _piece_information(model, sensor, values, noise, piece, point):
    design = np.concatenate([_group(name, width, piece, point) for name, width in model.groups(sensor)], axis=1)
    dc = coefficient_jacobian(model, sensor, values)
    static = len(piece) == 1
    count = 500.0 if static else 2.0 * len(piece)
    mean = design.mean(axis=0)
    within = (design - mean).T @ (design - mean) * (0.0 if static else 2.0)
    information = np.zeros((dc.shape[2], dc.shape[2]))
    for axis in range(3):
        rows = mean @ dc[:, axis]
        variance = noise.white_variance[axis] * noise.inflation[axis]
        information += np.outer(rows, rows) / (variance / count + noise.offset_sd**2 + noise.wander_sd**2)
        information += dc[:, axis].T @ within @ dc[:, axis] / variance
    return information


def _group(name, width, piece, point):
    thermal = name.endswith('temperature') and piece.temperature_c is None
    return np.zeros((len(piece), width)) if thermal or name not in GROUPS else GROUPS[name](piece, point)


def tolerance_scaled_singular_values(information, tolerances):
    """
    Return the singular values of the design with parameters in units of their tolerance, descending.

    A value of one means that the direction is determined to one tolerance; below one it is weak. Rank alone proves nothing.
    """
    scaled = information * np.outer(tolerances, tolerances)
    return np.sqrt(np.clip(scipy.linalg.eigvalsh((scaled + scaled.T) / 2)[::-1], 0, None))


def weak_directions(covariance, tolerances, names, limit=6):
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
        found.append({names[k]: round(float(vector[k]), 3) for k in np.flatnonzero(strong)})
    return found


def needed_motions(solution, tolerances, gravity, prior_sd):
    """
    Return for each parameter that is not determined the standard motion that would serve it best.

    Every motion of the catalogue is tried: its information is added, and the predicted standard errors are compared with the
    tolerances.

    Returns
    -------
    dict
        Parameter name -> (motion text, predicted standard deviation).

    """
    lacking = np.flatnonzero(solution.sd > tolerances)
    if not len(lacking):
        return {}
    base = solution.information + np.diag(1 / prior_sd**2)
    predicted = {}
    for motion in MOTIONS:
        total = base + added_information(solution.model, solution.values, solution.noise, motion, gravity)
        scale = np.sqrt(np.diag(total))
        inverse = np.linalg.inv(total / np.outer(scale, scale))
        predicted[motion] = np.sqrt(np.clip(np.diag(inverse), 0, None)) / scale
    return {solution.param_names[k]: _best(solution, k, predicted) for k in lacking}


def _best(solution, index, predicted):
    motion = min(predicted, key=lambda m: predicted[m][index])
    sd = float(predicted[motion][index])
    if sd > 0.7 * solution.sd[index]:
        owner = next(e for e in solution.model.effects if solution.param_names[index] in e.param_names())
        texts = {m.name: m.text for m in MOTIONS} | TABLE_MOTIONS
        return texts[owner.motion[0]], float('nan')
    return motion.text, sd
