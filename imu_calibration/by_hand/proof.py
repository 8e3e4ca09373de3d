"""Does a calibration by hand help on poses and turns that took no part?"""

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np

from imu_calibration.by_hand.calibrate import HandCalibration
from imu_calibration.by_hand.equations import COMPONENTS, TurnData, between_middles, build_system, turned
from imu_calibration.by_hand.model import GYRO_BIAS, GYRO_MATRIX
from imu_calibration.by_hand.options import ByHandSettings
from imu_calibration.by_hand.poses import distinct_attitudes
from imu_calibration.calibration.proof import compared
from imu_calibration.calibration.status import HELD
from imu_calibration.estimation.scaled_solve import scaled_lstsq

FOLDS = 8
"""Parts that are left out in turn."""
ATTITUDES_LEAST = 10
"""So many attitudes must stay when a part is left out: nine parameters of the accelerometer take one equation each."""
TURNS_LEAST = 6
"""So many turns must stay, and be left out altogether."""
PER_TURN = 'rad per turn'
"""Unit of the angle by which gravity is carried past where it is found."""


def prove_by_hand(hand: HandCalibration, turns: Sequence[TurnData], settings: ByHandSettings) -> dict:
    """
    Return the proof of a calibration by hand: sensor -> entry of a document (see `calibration.proof`).

    Every eighth pose is left out with the turns that begin or end there: one step from the solution with their rows left out. The error of
    the accelerometer is the length of its corrected reading in a pose less gravity; that of the gyroscope the angle by which it carries
    gravity past the pose that a turn ends in. What is too few to leave any out has no entry.

    Parameters
    ----------
    hand : HandCalibration
    turns : sequence of TurnData
        What it was estimated from beside its poses.
    settings : ByHandSettings

    """
    poses, model, known = hand.poses, hand.model, _Rows(hand, turns)
    plain = replace(model, gyro_factor=1.0).nominal
    norms, angles = [], []
    for fold in range(FOLDS):
        out = np.arange(len(poses.start)) % FOLDS == fold
        if distinct_attitudes(poses.force[~out], settings.pose_apart) < ATTITUDES_LEAST:
            return {}
        values, part = known.values_without(out), _selected(poses, out)
        left = [turn for turn in turns if turn.rotation is None and (out[turn.first] or out[turn.last])]
        norms.append([model.norm_rows(each, part.force, time=part.time, temperature_c=part.temperature_c)[0]**2
                      for each in (plain, values)])
        if len(turns) - len(left) >= TURNS_LEAST:
            angles.append([_missed(model, values, poses, left, gyroscope)**2 for gyroscope in (plain, values)])
    proof = {'accelerometer': _entry(norms, 'm/s^2')}
    if sum(part[0].size for part in angles) >= TURNS_LEAST:
        proof['gyroscope'] = _entry(angles, PER_TURN)
    return proof


class _Rows:
    """The weighed equations at the solution, each row with the poses that it belongs to."""

    def __init__(self, hand, turns):
        model, count = hand.model, len(hand.poses.start)
        system = build_system(model, hand.state, hand.used_poses, turns=turns)
        scatter = np.array([*(hand.statistics[f'{name}_scatter_sd']**2 for name in COMPONENTS), 0.0])
        weight = 1.0 / np.sqrt(system.noise + scatter[system.component])
        held = np.array([dict(zip(hand.param_names, hand.statuses)).get(name) == HELD for name in model.param_names])
        self.values, self.free = hand.state.values, ~held
        self.rows = np.column_stack([system.nuisance, system.main[:, self.free], system.residual]) * weight[:, None]
        ends = [(turn.first, turn.last) if turn.rotation is None else (count, count) for turn in turns
                for _ in range(2 if turn.rotation is None else 3)]
        self.poses = np.concatenate([np.tile(np.repeat(np.arange(count), 3)[:, None], (3, 2)), np.array(ends, int).reshape(-1, 2)])
        prior = np.diag(1.0 / model.priors)[self.free][:, self.free]
        self.known = np.column_stack([np.zeros((len(prior), system.nuisance.shape[1])), prior,
                                      ((model.nominal - self.values) / model.priors)[self.free]])

    def values_without(self, out):
        """Return the parameters without some poses and the turns that begin or end there."""
        rows = self.rows[~np.append(out, False)[self.poses].any(axis=1)]
        rows = np.concatenate([rows, self.known])
        values = self.values.copy()
        values[self.free] += scaled_lstsq(rows[:, :-1], rows[:, -1])[-int(self.free.sum()):]
        return values


def _entry(parts, unit):
    before, after = (np.concatenate(side) for side in zip(*parts))
    return compared(before, after, np.ones(len(before)), components=1) | {'unit': unit, 'windows': len(before)}


def _selected(poses, mask):
    """Return some of the poses."""
    parts = {f.name: getattr(poses, f.name) for f in fields(poses)}
    return replace(poses, **{name: part[mask] for name, part in parts.items() if isinstance(part, np.ndarray)})


def _missed(model, values, poses, turns, gyroscope):
    """Return the angles by which turns are missed, rad, with the accelerometer of `values` and the gyroscope of others."""
    mixed = values.copy()
    for part in (GYRO_BIAS, GYRO_MATRIX, model.extra_index('gyroscope')):
        mixed[part] = gyroscope[part]
    true = model.compensate(values, poses.force, np.zeros_like(poses.force), time=poses.time, temperature_c=poses.temperature_c)[0]
    up = true / np.linalg.norm(true, axis=1, keepdims=True)
    carried = np.array([between_middles(poses, turn, turned(model, mixed, turn)) @ up[turn.first] for turn in turns]).reshape(-1, 3)
    last = up[[turn.last for turn in turns]].reshape(-1, 3)
    return np.arctan2(np.linalg.norm(np.cross(carried, last), axis=1), (carried * last).sum(axis=1))
