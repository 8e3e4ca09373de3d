"""What to do next when a calibration by hand leaves a parameter weak: the pose or turn that would help most."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from imu_calibration.by_hand.model import GYRO_MATRIX, HandModel, unpack
from imu_calibration.calibration.coverage import DIRECTIONS
from imu_calibration.effects.base import AXES
from imu_calibration.reference.reference_motion import skew


@dataclass(frozen=True, eq=False)
class HandStep:
    """A pose or a turn that a person can do."""

    rows: np.ndarray
    """Equations that it adds, in standard deviations, shape (k, n_params)."""
    words: str
    """What to do."""
    up: np.ndarray
    """Direction of the sensor that points up, before a turn, unit vector."""
    turn: str | None = None
    """Axis of the sensor about which it is turned by half a turn; None: it is held still."""


def missing_motion(model: HandModel, factor: np.ndarray, values: np.ndarray, *, statuses: Sequence[str], tolerances: np.ndarray,
                   pose_sd: float, turn_sd: float) -> tuple[dict, ...]:
    """
    Name the standard pose or turn that lowers the worst sd of each sensor most.

    The declared standard motions (26 directions up; turns of 180 deg about each sensor axis held level, in two attitudes)
    are added to the equations one at a time and the predicted sd over tolerance is compared.

    Parameters
    ----------
    model : HandModel
    factor : array, shape (n, n)
        Weighted equations so far.
    values : array, shape (n,)
    statuses : sequence of str
    tolerances : array, shape (n,)
    pose_sd, turn_sd : float
        Accuracy expected of one more pose (m/s^2) and turn (rad).

    Returns
    -------
    tuple of dict
        {'parameters': {name: sd over tolerance}, 'needs': sentence} for each sensor that is not fully determined.

    """
    advice = []
    groups = ((model.index_of('accelerometer'), pose_steps(model, values, pose_sd)),
              (model.index_of('gyroscope'), turn_steps(model, turn_sd)))
    for index, candidates in groups:
        lacking = [k for k in index if statuses[k] != 'determined']
        if not lacking:
            continue
        before = _predicted(factor, model.priors, tolerances)
        scores = [(_score(_predicted(np.vstack([factor, step.rows]), model.priors, tolerances)[lacking]), step.words) for step in candidates]
        best = min(scores, key=lambda s: s[0])
        advice.append({'parameters': {model.param_names[k]: float(before[k]) for k in lacking}, 'needs': best[1]})
    return tuple(advice)


def _score(ratio):
    """Return one number for how bad a set of sd over tolerance is; the excess in each parameter counts, the worst most."""
    return float(np.sum(np.maximum(ratio, 1.0)**2))


def _predicted(rows, priors, tolerances):
    factor = np.linalg.qr(np.vstack([rows, np.diag(1 / priors)]), mode='r')
    return np.linalg.norm(np.linalg.inv(factor), axis=1) / tolerances


def pose_steps(model: HandModel, values: np.ndarray, sd: float) -> Iterator[HandStep]:
    """Yield the standard poses, each known to `sd` (m/s^2)."""
    bias, matrix, *_ = unpack(values)
    for up in DIRECTIONS:
        # temperature and time as at the reference point: one more pose there says nothing of thermal effects
        rows = model.norm_rows(values, (bias + model.gravity * matrix @ up)[None], time=np.zeros(1), temperature_c=np.full(1, model.model.temperature_ref_c))[1]
        yield HandStep(rows / sd, f'hold it still with {direction_words(up)} up', up)


def direction_words(up: np.ndarray) -> str:
    """Return a standard direction for people: '+x -z'."""
    return ' '.join(f'{"+" if c > 0 else "-"}{a}' for c, a in zip(up, AXES) if abs(c) > 1e-9)


def turn_steps(model: HandModel, sd: float) -> Iterator[HandStep]:
    """Yield half turns about each axis held level, gravity first along either of the other two, each known to `sd` (rad)."""
    for axis, first in itertools.permutations(range(3), 2):
        about, up = np.eye(3)[axis], np.eye(3)[first]
        carried = -up  # after half a turn about a level axis
        across = np.array([about, np.cross(about, up)])
        rows = np.zeros((2, model.size))
        rows[:, GYRO_MATRIX] = (across @ skew(carried) @ rotation_slopes(about)).reshape(2, 9)
        yield HandStep(rows / sd, f'turn it by 180 deg about its {AXES[axis]} axis held level, {AXES[first]} up before the turn, '
                   'still before and after', up, AXES[axis])


def rotation_slopes(about: np.ndarray, angle: float = np.pi) -> np.ndarray:
    """Return the derivative of the rotation error in the turned frame by the gyroscope's matrix, near the identity, shape (3, 9)."""
    cross = skew(about)
    # integral over the turn of the rotation still to come, C(angle - t)
    to_come = angle * np.outer(about, about) + np.sin(angle) * (np.eye(3) - np.outer(about, about)) - (1 - np.cos(angle)) * cross
    return -np.einsum('ip,q->ipq', to_come, about).reshape(3, 9)
