"""Evaluation of a calibration by hand on held-out poses and turns."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from imu_calibration.calibration.plain_fit import PlainFit, with_plain_fits
from imu_calibration.calibration.proof import compared
from imu_calibration.compensation.compensate import Corrected, compensated_samples
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.proof_entry import Proof, ProofEntry
from imu_calibration.document.trust import (
    Uncorrected,
    judged_from_of,
    latest_settling,
    uncorrected_in_time,
)
from imu_calibration.effects.base import UNITS
from imu_calibration.effects.forward_equations import applied_values
from imu_calibration.estimation.scaled_solve import scaled_lstsq, triangular_of_band
from imu_calibration.estimation.solution import HELD
from imu_calibration.kinematics.rotations import unit_rows
from imu_calibration.kinematics.strapdown import total_rotation
from imu_calibration.references.gravity.equations import (
    COMPONENTS,
    GravityRows,
    Poses,
    TurnData,
    between_middles,
)
from imu_calibration.references.gravity.hand_calibration import HandCalibration
from imu_calibration.references.gravity.hand_parameters import HandModel
from imu_calibration.references.gravity.poses import distinct_attitudes

HAND_PROOF_FOLDS = 8
"""Number of held-out parts."""
ATTITUDES_LEAST = 10
"""
Fewest remaining attitudes when a part is held out: nine parameters of the accelerometer need one
equation each.
"""
FEW_ATTITUDES = 6
"""
Fewest remaining attitudes when one pose is held out: biases and scale factors of the accelerometer
need one equation each.
"""
TURNS_LEAST = 6
"""Fewest remaining turns, and fewest held-out turns in total."""
TURN_ANGLE_UNIT = 'rad per turn'
"""Unit of the angle between rotated and observed gravity."""


def prove_by_hand(
    hand: HandCalibration, turns: Sequence[TurnData], fits: Sequence[PlainFit] = ()
) -> Proof:
    """
    Return the proof of a calibration by hand.

    Every eighth pose, with few attitudes one pose, is held out with the turns that begin or end
    there: one step from the solution without their rows. The error of the accelerometer is the
    length of its corrected reading in a pose less gravity; that of the gyroscope the angle between
    gravity rotated by its rates and gravity in the pose at the end of a turn. Readings are
    corrected as by compensation; with effects that have settled the last third of the poses is
    evaluated. With too few poses or turns there is no entry.

    Parameters
    ----------
    hand : HandCalibration
    turns : sequence of TurnData
        Turns of the estimate.
    fits : sequence of PlainFit
        Plain fits that are applied in place of its parameters.

    """
    poses, model = hand.poses, hand.hand_model
    nominal = replace(model, gyro_factor=1.0).nominal
    held_out = held_out_by_hand(with_plain_fits(hand, fits), turns, folds_by_hand(poses))
    applied = applied_by_hand(hand, turns, [part.out for part in held_out])
    for fit in fits:
        applied = fit.merged(applied)

    norms = []
    angles = []
    for part, values in zip(held_out, applied, strict=True):
        norms.append(
            [norm_errors(hand, nominal, part.judged), norm_errors(hand, values, part.judged)]
        )
        if part.turns and part.n_turns_left >= TURNS_LEAST:
            angles.append(
                [
                    turn_errors(model, values, poses, turns=part.turns, gyroscope=gyroscope)
                    for gyroscope in (nominal, values)
                ]
            )
    if not norms:
        return {}
    # Rests near the axes of the sensor: held-out rests have the directions of the other rests.
    lengths = entry_of(_joined(norms), UNITS['accelerometer'])
    proof = {'accelerometer': replace(lengths, few_directions=bool(model.untested))}
    if sum(part[0].size for part in angles) >= TURNS_LEAST:
        proof['gyroscope'] = entry_of(_joined(angles), TURN_ANGLE_UNIT)
    return proof


@dataclass(frozen=True, eq=False)
class HeldOutPoses:
    """Poses that are held out together, with the turns that begin or end there."""

    out: np.ndarray
    """True for the poses that are held out, shape (n_poses,)."""
    judged: np.ndarray
    """True for those that are evaluated: effects that settle have settled, shape (n_poses,)."""
    turns: list[TurnData]
    """Turns against gravity that are held out and evaluated."""
    n_turns_left: int
    """Number of the remaining turns."""


def held_out_by_hand(
    hand: HandCalibration, turns: Sequence[TurnData], folds: Sequence[np.ndarray]
) -> list[HeldOutPoses]:
    """Return the poses and turns to evaluate, for each mask of poses in `folds`."""
    latest = latest_settling(hand.model, hand.values, hand.sd)
    judged = hand.poses.time >= judged_from_of(latest, end_by_hand(hand.poses))
    parts = []
    for out in folds:
        own = []
        for turn in turns:
            is_held_out = out[turn.first] or out[turn.last]
            if turn.rotation is None and is_held_out and judged[turn.first]:
                own.append(turn)
        parts.append(HeldOutPoses(out, out & judged, own, len(turns) - len(own)))
    return parts


def applied_by_hand(
    hand: HandCalibration, turns: Sequence[TurnData], folds: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Return the parameters without the poses of each mask, as compensation applies them."""
    centre = uncorrected_by_hand(hand).centre
    without = values_without(hand, turns, folds)
    return [applied_values(hand.model, values, centre) for values in without]


def norm_errors(hand: HandCalibration, values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return ``|corrected force| - gravity`` of the poses of a mask, m/s^2."""
    poses = _selected(hand.poses, mask)
    corrected = corrected_with(
        hand.hand_model, values, poses.force, temperature_c=poses.temperature_c
    )
    return np.linalg.norm(corrected.force, axis=1) - hand.gravity


def values_without(
    hand: HandCalibration, turns: Sequence[TurnData], folds: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """
    Return the parameters without the poses of each mask and the turns that begin or end there.

    One Gauss-Newton step.
    """
    model = hand.hand_model
    system = GravityRows(model, hand.used_poses, turns).linearise(
        replace(hand.state, values=hand.values)
    )
    scatter = np.array([*(hand.statistics[f'{name}_scatter_sd'] ** 2 for name in COMPONENTS), 0.0])
    free = ~hand.held & ~model.fixed
    rows = np.column_stack([system.nuisance, system.main[:, free], system.residual])
    rows /= np.sqrt(system.noise + scatter[system.component])[:, None]
    prior = np.column_stack(
        [np.diag(1.0 / model.priors), (model.nominal - hand.values) / model.priors]
    )[free][:, np.append(free, True)]
    found, last = [], slice(system.nuisance.shape[1], None)
    for out in folds:
        kept = np.concatenate(
            [
                triangular_of_band(rows[~np.append(out, False)[system.group].any(axis=1)])[
                    last, last
                ],
                prior,
            ]
        )
        moved = hand.values.copy()
        moved[free] += scaled_lstsq(kept[:, :-1], kept[:, -1])
        found.append(moved)
    return found


def folds_by_hand(poses: Poses) -> list[np.ndarray]:
    """
    Return masks of the poses to hold out in turn.

    An eighth of them, or with few attitudes one pose; none with too few.
    """
    number = np.arange(len(poses.start))
    for count, least in ((HAND_PROOF_FOLDS, ATTITUDES_LEAST), (len(number), FEW_ATTITUDES)):
        folds = [number % count == fold for fold in range(count)]
        if all(distinct_attitudes(poses.force[~out]) >= least for out in folds):
            return folds
    return []


def end_by_hand(poses: Poses) -> float:
    """Return the end of the last pose, s since the first sample."""
    return float(poses.time[-1] + 0.5 * (poses.stop[-1] - poses.start[-1]) * poses.period)


def uncorrected_by_hand(hand: HandCalibration) -> Uncorrected:
    """Return the effects in time that compensation replaces by a constant."""
    return uncorrected_in_time(
        hand.model.at(hand.values),
        hand.values,
        hand.poses.time,
        end=end_by_hand(hand.poses),
        latest=latest_settling(hand.model, hand.values, hand.sd),
    )


def _joined(folds: Iterable[Sequence[np.ndarray]]) -> list[np.ndarray]:
    """Return errors before and after of all folds, each shape (n, 1)."""
    return [np.concatenate(side)[:, None] for side in zip(*folds)]


def entry_of(errors: Iterable[np.ndarray], unit: str, seconds: float | None = None) -> ProofEntry:
    """Return an entry of a proof, of the errors before and after, each shape (n, components)."""
    before, after = errors
    found = compared(
        (before**2).sum(axis=1),
        (after**2).sum(axis=1),
        np.ones(len(before)),
        unit=unit,
        components=before.shape[1],
    )
    return ProofEntry(**vars(replace(found, windows=len(before), seconds=seconds)))


def _selected(poses: Poses, mask: np.ndarray) -> Poses:
    """Return some of the poses."""
    parts = {f.name: getattr(poses, f.name) for f in fields(poses)}
    return replace(
        poses, **{name: part[mask] for name, part in parts.items() if isinstance(part, np.ndarray)}
    )


def corrected_with(
    model: HandModel,
    values: np.ndarray,
    force: np.ndarray,
    *,
    rate: np.ndarray | None = None,
    temperature_c: np.ndarray | None = None,
) -> Corrected:
    """
    Return readings corrected as by compensation with the parameters `values` of `model`.

    Shape (n, 3); without `rate` at rest.
    """
    rate = np.zeros_like(force) if rate is None else rate
    known = Calibration(
        model.model.at(values), values, np.zeros((model.size,) * 2), (HELD,) * model.size
    )
    return compensated_samples(
        known, force, rate, alpha_s=np.zeros_like(force), temperature_c=temperature_c
    )


def turn_errors(
    model: HandModel,
    values: np.ndarray,
    poses: Poses,
    *,
    turns: Sequence[TurnData],
    gyroscope: np.ndarray,
) -> np.ndarray:
    """
    Return the angle errors of turns, rad.

    With the accelerometer of `values` and the parameters `gyroscope` of the gyroscope.
    """
    mixed = values.copy()
    for part in (model.gyro_bias, model.gyro_matrix, model.extra_index('gyroscope')):
        mixed[part] = gyroscope[part]
    true = corrected_with(model, values, poses.force, temperature_c=poses.temperature_c).force
    up = unit_rows(true)
    rates = [
        corrected_with(
            model, mixed, turn.force, rate=turn.rate, temperature_c=turn.temperature_c
        ).rate
        for turn in turns
    ]
    return np.array(
        [turn_error(poses, turn, rate, up=up) for turn, rate in zip(turns, rates, strict=True)]
    )


def turn_error(poses: Poses, turn: TurnData, rates: np.ndarray, *, up: np.ndarray) -> float:
    """
    Return the angle between gravity after a turn and rotated gravity before it, rad.

    The direction of gravity before the turn is rotated by corrected rates.

    Parameters
    ----------
    poses : Poses
    turn : TurnData
    rates : array, shape (n, 3)
        Corrected rates during the turn, rad/s; samples that are not finite are omitted.
    up : array, shape (n_poses, 3)
        Unit vector of gravity in each pose.

    """
    known = np.isfinite(rates).all(axis=1)
    rotated, last = (
        between_middles(poses, turn, total_rotation(turn.time[known], rates[known]))
        @ up[turn.first],
        up[turn.last],
    )
    return float(np.arctan2(np.linalg.norm(np.cross(rotated, last)), rotated @ last))
