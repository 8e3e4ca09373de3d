"""A planner that separates causes: motions after which one member of a collinear class remains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.document.calibration import Calibration
from imu_calibration.effects.base import Role
from imu_calibration.estimation.noise_model import NoiseModel
from imu_calibration.estimation.status import tolerances_of
from imu_calibration.kinematics.motion_limits import MotionLimits, limits_of
from imu_calibration.kinematics.table import Table
from imu_calibration.planning.belief import exact_information
from imu_calibration.planning.coordinates import Cause, Coordinates, ToldApart
from imu_calibration.planning.planner import Planner
from imu_calibration.planning.repertoire import Repertoire
from imu_calibration.planning.situation import Situation
from imu_calibration.references.options import CalibrationOptions
from imu_calibration.simulation.profiles import make_profile

SESSION = 'quick'
"""Profile on which the mates imitate the finding."""


def make_separator(table: Table, calibration: Calibration, causes: Sequence[tuple[str, str]], *, noise: Mapping[str, NoiseModel],
                   rate: float = 100.0, options: CalibrationOptions = CalibrationOptions(),
                   sizes: Mapping[str, float] | None = None, limits: MotionLimits | None = None) -> Planner:
    """
    Return a planner whose goal is to separate causes.

    Parameters
    ----------
    table : Table
    calibration : Calibration
        Calibration of the extended model of a diagnosis, with the size of the first cause.
    causes : sequence of (sensor, effect name)
        The finding, then its collinear alternatives.
    noise : mapping
        Sensor -> NoiseModel of single samples at `rate`.
    rate : float
        Samples of the IMU per second.
    options : CalibrationOptions
        Its tolerances and catalogue.
    sizes : mapping, optional
        Parameter -> value, SI, of the alternatives as estimated in the diagnosis in place of the first; without an estimate, as
        large as they must be to pass for it on a usual session.
    limits : MotionLimits, optional
        Default: the limits of the table.

    Raises
    ------
    InputError
        When the calibration lacks the first cause, or a motion cannot show one of them.

    """
    first, *mates = causes
    if first not in calibration.model.slices:
        raise InputError(f"the calibration must contain '{first[1]}', which is to be separated; give that of the diagnosis",
                         key='calibration')
    model = calibration.model
    for sensor, name in mates:
        if (sensor, name) not in model.slices:
            model = model.with_effect(sensor, name)
    for key in causes:
        _require_shown_by_motion(model, key)
    values = model.start_from(calibration.model, calibration.values)
    coordinates = Coordinates(model, tolerances_of(model, options.tolerances), values)
    situation = Situation(Repertoire(table, limits or limits_of(table)), coordinates, dict(noise), rate=rate)
    questions = len(model.catalogue.effects(model.joint_names))
    situation.goal = ToldApart(coordinates, suspected(situation, causes, table, sizes=sizes or {}), questions)
    names = {name: k for k, name in enumerate(calibration.param_names) if k not in _indices(calibration.model, first)}
    return Planner(situation, coordinates.information_from(names, calibration.covariance))


def suspected(situation: Situation, causes: Sequence[tuple[str, str]], table: Table, *,
              sizes: Mapping[str, float]) -> list[Cause]:
    """
    Return the causes with their sizes: the first as estimated, the mates with the size that imitates it.

    If `sizes` lacks a mate, ``theta_b = [M_bb - M_br M_rr^-1 M_rb]^-1 [M_ba - M_br M_rr^-1 M_ra] theta_a``, M the
    information of a usual session, r the baseline.
    """
    coordinates = situation.coordinates
    found = []
    for key in causes:
        places, names = _indices(coordinates.model, key), coordinates.model.param_names
        known = coordinates.values[places] if not found else [sizes.get(names[k], np.nan) for k in places]
        found.append(Cause(key, _places(coordinates, key), np.asarray(known, float) / coordinates.units[places]))
    unknown = [cause for cause in found if np.isnan(cause.size).any()]
    passing = _imitating(situation, found, unknown, table) if unknown else {}
    return [replace(cause, size=passing.get(cause.key, cause.size)) for cause in found]


def _imitating(situation, causes, unknown, table):
    """Return the sizes that causes must have to pass for the first one on a usual session, by key."""
    windows = situation.predictor.predict([make_profile(SESSION, 0, table).segments])[0]
    times = np.array([window.middle for window in windows])
    information = situation.coordinates.prior_information + exact_information(windows, times, situation.noise)
    first, found = causes[0], {}
    rest = np.setdiff1d(np.arange(len(information)), np.concatenate([cause.places for cause in causes]))
    inner = np.linalg.inv(information[np.ix_(rest, rest)])
    for cause in unknown:
        across = information[np.ix_(cause.places, rest)] @ inner
        bb = information[np.ix_(cause.places, cause.places)] - across @ information[np.ix_(rest, cause.places)]
        ba = information[np.ix_(cause.places, first.places)] - across @ information[np.ix_(rest, first.places)]
        found[cause.key] = np.linalg.solve(bb, ba @ first.size)
    return found


def _indices(model, key):
    part = model.slices[key]
    return np.arange(part.start, part.stop)


def _places(coordinates, key):
    return np.array([int(np.argmax(np.abs(coordinates.basis[k]))) for k in _indices(coordinates.model, key)])


def _require_shown_by_motion(model, key):
    effect = model.catalogue.find(*key, model.joint_names)
    if effect.role is Role.LIMIT or effect.n_amplitudes < effect.size or 'temperature' in effect.needs:
        raise InputError(f"effects that motion separates must depend on it, '{key[1]}' depends on time, temperature or range; "
                         'omit it')
