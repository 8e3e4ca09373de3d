"""Parameters that windows on a table do not determine, and the motions that would."""

from collections.abc import Mapping

import numpy as np

from imu_calibration.document.verdict import incomplete_windows
from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.prior import make_prior
from imu_calibration.estimation.solution import (
    AZIMUTH_REMEDY,
    BIAS_PROCESS,
    HELD_PRIORS,
    PLACE_REMEDY,
    WANDER_REMEDY,
    Solution,
    remedy,
)
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable.observability import (
    needed_motions,
    sd_of_data,
    weak_directions,
)
from imu_calibration.references.turntable.standard_motions import Motion, motions_about


def motions_needed(
    solution: Solution, tolerances: np.ndarray, table: Table, *, quality: Mapping
) -> dict[str, tuple[str, float]]:
    """
    Return undetermined parameter -> (best motion, predicted sd after a minute of it).

    The best motion reduces the sd of the parameter most. Where another cause than a lack of motion
    makes it large, (remedy for the cause, NaN) (`estimation.solution.remedy`).

    Parameters
    ----------
    solution : Solution
    tolerances : ndarray, shape (n_params,)
    table : Table
    quality : mapping
        Statistics of the document, from which it follows whether the model is incomplete
        (`verdict.incomplete_windows`).

    """
    prior_sd = make_prior(solution.model).sd
    standard_motions = needed_motions(
        solution,
        tolerances,
        table.gravity_value,
        prior_sd=prior_sd,
        possible=possible_motions(table),
    )
    data_sd = sd_of_data(solution, prior_sd)
    wander_variance = np.diag(solution.terms[BIAS_PROCESS])
    counted = _counted(solution)
    # Whether each parameter is determined if noise is the only error.
    is_shown = dict(zip(solution.param_names, data_sd <= tolerances, strict=True))
    earth_rate_remedy = PLACE_REMEDY if table.latitude is None else AZIMUTH_REMEDY
    earth_rate_names: set[str] = set()
    for effect in solution.model.effects:
        if effect.known_size:
            earth_rate_names.update(effect.param_names())
    needed = {}
    for name, motion in standard_motions.items():
        if name not in counted:
            continue
        if name in earth_rate_names:
            needed[name] = (earth_rate_remedy, float('nan'))
            continue
        index = solution.param_names.index(name)
        section = name.partition('.')[0]
        # Both sensors determine table and clock.
        sensors = (section,) if section in SENSORS else SENSORS
        of_misfit: tuple[str, ...] = ()  # terms of the covariance that a misfit causes
        if any(incomplete_windows(quality, sensor) for sensor in sensors):
            # Bias processes describe the error of the model.
            of_misfit = (BIAS_PROCESS,)
        if any(each.startswith(sensors) and is_shown[each] for each in solution.not_believed):
            # A parameter that the motions determine is held for a misfit, not for their lack.
            of_misfit = (BIAS_PROCESS, HELD_PRIORS)
        text = remedy(solution.terms, index, tolerances[index], of_misfit=of_misfit)
        wanders = any(_wanders(solution, sensor) for sensor in sensors)
        if not text and wanders and wander_variance[index] > tolerances[index] ** 2:
            # The mean of the bias over the recording is as uncertain after more motions.
            text = WANDER_REMEDY
        needed[name] = (text, float('nan')) if text else motion
    return needed


def _wanders(solution: Solution, sensor: str) -> bool:
    """
    Return whether window means scatter more by a wandering bias than by independent offsets.

    More windows reduce the effect of independent offsets; a bias that wanders is correlated from
    window to window.
    """
    noise = solution.noise.get(sensor)
    return noise is not None and noise.bias_variance > noise.offset_sd**2


def possible_motions(table: Table) -> tuple[Motion, ...] | None:
    """Return the standard motions that a table with a single joint can do; None: any."""
    if len(table.joints) != 1 or not table.joints[0].turns:
        return None
    axis_s = table.mat_sl @ np.asarray(table.joints[0].axis)
    up_s = table.mat_sl @ np.asarray(table.up)
    return motions_about(axis_s, up_s)


def weak_on_table(
    solution: Solution, tolerances: np.ndarray, needed: dict[str, tuple[str, float]]
) -> tuple[dict, ...]:
    """
    Return {'parameters', 'needs'} of each weak direction, and of the other needed parameters.

    'parameters' are the weights of a direction in tolerances, or the sds in tolerances of
    parameters that no direction names; 'needs' is the motion for them.
    """
    names = _counted(solution)
    present = np.isin(solution.param_names, names)
    directions = weak_directions(
        solution.covariance[np.ix_(present, present)], tolerances[present], names
    )
    entries = [{'parameters': weights, 'needs': _need(weights, needed)} for weights in directions]

    # Needed parameters that no direction names; those with the same motion in one entry.
    named: set[str] = set().union(*directions)
    sd_in_tolerances = dict(zip(solution.param_names, solution.sd / tolerances))
    sds_of_motion: dict[str, dict[str, float]] = {}
    for name, (motion, _) in needed.items():
        if name not in named:
            sds_of_motion.setdefault(motion, {})[name] = round(float(sd_in_tolerances[name]), 3)
    for motion, sds in sds_of_motion.items():
        entries.append({'parameters': sds, 'needs': motion})
    return tuple(entries)


def _counted(solution: Solution) -> list[str]:
    """
    Return the names of the parameters that further motions can determine.

    Without one of the sensors, only the parameters of the present sensor: it may not determine the
    table and the clock.
    """
    if not solution.absent:
        return solution.param_names
    present = tuple(solution.noise)
    return [name for name in solution.param_names if name.startswith(present)]


def _need(weights: Mapping[str, float], needed: Mapping[str, tuple[str, float]]) -> str:
    """Return the motion for the parameter of a direction with the largest weight."""
    for name in sorted(weights, key=lambda name: -abs(weights[name])):
        if name in needed:
            return needed[name][0]
    return 'more of the same motion'
