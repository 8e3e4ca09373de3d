"""Assignment of axes, joint signs and joint names: the exchange that explains the measured rates, for the recording or a part of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, permutations, product
from typing import NamedTuple

import numpy as np

from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window

CLEAR = 0.8
"""Agreement from which on an exchange of axes describes the matrix."""
POOR = 0.6
"""Agreement of the axes as they are below which they are wrong; a turn by 60 degrees has 0.67."""
TIE = 0.05


def signed_permutations() -> np.ndarray:
    """Return the 48 matrices that exchange axes and signs, the identity first, then by number of changes; shape (48, 3, 3)."""
    found = [np.eye(3)[list(order)] * np.array(signs)[:, None] for order in permutations(range(3)) for signs in product((1.0, -1.0),
                                                                                                                        repeat=3)]
    return np.array(sorted(found, key=lambda matrix: (matrix != np.eye(3)).any(axis=1).sum()))


@dataclass(frozen=True, eq=False)
class AxisMatch:
    """Assignment of measured axes to the axes of a reference."""

    matrix: np.ndarray
    """Closest signed permutation in ``measured = scale * matrix @ reference``, shape (3, 3)."""
    agreement: float
    """1: exactly as `matrix`."""
    as_they_are: float
    """1: every axis is that of the reference; -1: all turned round."""
    turned: bool
    """Whether a rotation explains it."""
    mirrored: bool
    """Whether a reflection explains it; with few turns both may."""

    @property
    def wrong(self) -> bool:
        """Return whether the axes differ from those of the reference."""
        return self.as_they_are < POOR

    def exchanges(self, seen: np.ndarray = np.eye(3)) -> list[tuple[int, int, float]]:
        """Return (measured axis, reference axis, sign) of each wrong axis, for the reference axes with motion."""
        found = []
        for j in np.flatnonzero(np.diag(seen) > 0.5):
            i = int(np.argmax(np.abs(self.matrix[:, j])))
            if i != j or self.matrix[i, j] < 0:
                found.append((i, int(j), float(self.matrix[i, j])))
        return sorted(found)


def match_axes(matrix: np.ndarray, seen: np.ndarray = np.eye(3)) -> AxisMatch:
    """
    Return the `AxisMatch` of ``measured = matrix @ reference``.

    Parameters
    ----------
    matrix : array, shape (3, 3)
        Up to a common positive factor; only ``matrix @ seen`` is used.
    seen : array, shape (3, 3)
        Projector on the directions in which the reference moved.

    """
    inside = matrix @ seen
    scale = np.sqrt((inside**2).sum() / np.trace(seen))
    candidates = signed_permutations()
    scores = np.einsum('kij,ij->k', candidates, inside) / (scale * np.trace(seen))
    best = scores.max()
    near = scores >= best - TIE
    proper = np.linalg.det(candidates) > 0
    return AxisMatch(candidates[np.argmax(near)], float(best), float(scores[0]), bool((near & proper).any()), bool((near & ~proper).any()))


SAME = 0.5
"""Smallest share of the measured rates that the reference explains on the same table, as a squared correlation."""
SURE = 0.8
"""Smallest share explained of an exchange that is reported."""
PIECE = 5.0
"""Duration of the pieces of a recording that are tested separately, s."""
LEAST_RATE = 0.02
"""Smallest rms rate of such a piece, rad/s."""
LEAST_SAMPLES, MOST_SAMPLES = 20, 5_000
"""Samples that are tested."""
MOST_JOINTS = 3
"""All orders and signs are tested up to this number of joints; above it, each sign and each exchange of two joints."""


class Exchange(NamedTuple):
    """Signs and order of joints, and IMU axes, with which the reference explains the measured rates."""

    joints: tuple[str, ...]
    """One phrase per joint to correct."""
    axes: tuple[str, ...]
    """One phrase per IMU axis to correct, in addition."""
    instead: tuple[str, ...]
    """One phrase per IMU axis; with these corrections and unchanged joints, rates and specific force are explained equally well."""
    share: float
    """Share of the rates that it explains, ``1 - sum |measured - reference|^2 / sum |measured|^2``."""
    span: tuple[float, float] | None
    """(start, stop) of the part of the recording to which it applies, s; None: all of it."""


def find_exchange(windows: Sequence[Window], table: Table) -> Exchange | None:
    """
    Return the `Exchange` that explains rates that the table as described does not explain, or None.

    Order and signs of joints are combined with the 48 signed permutations P of the IMU axes; the share is that of ``P @ rate_s``.
    Candidates with equal shares of the rates are separated by the specific force, then by the number of changes.

    Parameters
    ----------
    windows : sequence of Window
        Moving windows with their samples.
    table : Table

    """
    windows = [window for window in windows if len(window) >= LEAST_SAMPLES and len(window.motion) == len(window)]
    if not windows:
        return None
    time = np.concatenate([window.time for window in windows])
    every = slice(None, None, max(1, len(time) // MOST_SAMPLES))
    time, motion = time[every], JointMotion.joined([window.motion for window in windows]).select(every)
    measured = np.concatenate([np.hstack([window.rate_s, window.force_s]) for window in windows])[every]
    rate = measured[:, :3] = measured[:, :3] - np.median(measured[:, :3], axis=0)
    squares = np.stack([((rate - reference_motion(table, motion).rate_s)**2).sum(axis=1), (rate**2).sum(axis=1), np.ones(len(time))])
    piece = ((time - time.min()) / PIECE).astype(int)
    residual, power, count = np.array([np.bincount(piece, weights=each) for each in squares])
    tested = power > LEAST_RATE**2 * count
    part = (tested & (residual > (1.0 - SAME) * power))[piece]
    if part.sum() < LEAST_SAMPLES:
        return None
    for chosen, span in ((tested[piece], None), (part, (float(time[part].min()), float(time[part].max())))):
        (order, signs), axes, instead, share = _best(measured[chosen], motion.select(chosen), table)
        joints = _joint_phrases(table.joint_names, order, signs)
        if share >= SURE and (joints or _axis_phrases(axes)):
            return Exchange(joints, _axis_phrases(axes), _axis_phrases(instead) if joints else (), share, span)
    return None


def _best(measured, motion, table):
    """Return ((order, signs), matrix of the axes, that of the best candidate without joints, share explained) of the best candidate."""
    candidates, axes = _candidates(motion.position.shape[1]), signed_permutations()
    shares = np.empty((2, len(candidates), len(axes)))
    for k, (order, signs) in enumerate(candidates):
        parts = (getattr(motion, name)[:, order] * signs for name in ('position', 'rate', 'acceleration', 'jerk'))
        reference = reference_motion(table, JointMotion(motion.time, *parts))
        for row, known, expected in zip(shares, (measured[:, :3], measured[:, 3:]), (reference.rate_s, reference.force_s)):
            cross = np.einsum('pij,ij->p', axes, known.T @ expected)
            row[k] = (2.0 * cross - (expected**2).sum()) / max((known**2).sum(), 1e-300)
    near = shares[0] >= shares[0].max() - TIE
    near &= shares[1] >= shares[1][near].max() - TIE
    joint_changes = [np.count_nonzero((np.array(order) != range(len(order))) | (np.array(signs) < 0)) for order, signs in candidates]
    axis_changes = (axes != np.eye(3)).any(axis=2).sum(axis=1)
    changes = np.add.outer(joint_changes, axis_changes) + np.logical_and.outer(joint_changes, axis_changes)
    k, p = np.unravel_index(np.argmin(np.where(near, changes, np.inf)), changes.shape)
    return candidates[k], axes[p], axes[np.argmax(near[0])], float(shares[0, k, p])


def _candidates(n_joints):
    """Return (index of the joint with the readings of each joint, signs) of the candidates, the description itself first."""
    identity, plus = list(range(n_joints)), [1.0] * n_joints
    if n_joints <= MOST_JOINTS:
        return [(list(order), list(signs)) for order in permutations(identity) for signs in product((1.0, -1.0), repeat=n_joints)]
    reversed_joints = [(identity, [-1.0 if k == j else 1.0 for k in identity]) for j in identity]
    return [(identity, plus), *reversed_joints,
            *(([{a: b, b: a}.get(k, k) for k in identity], plus) for a, b in combinations(identity, 2))]


def _joint_phrases(names, order, signs):
    return tuple(f'{names[k]} turns {"the other way round" if j == k else f"as {names[j]} should" + ", reversed" * (sign < 0)}'
                 for k, (j, sign) in enumerate(zip(order, signs)) if k != j or sign < 0)


def _axis_phrases(axes):
    where = np.abs(axes).argmax(axis=1)
    return tuple(f"measured {'xyz'[i]} is {'minus ' if axes[i, j] < 0 else ''}the reference's {'xyz'[j]}"
                 for i, j in enumerate(where) if i != j or axes[i, j] < 0)
