"""Parameters that windows on a table do not determine, and the motions that would."""

from collections.abc import Mapping, Sequence

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
    Return undetermined parameter -> (best motion, its sd after a minute of it).

    The motion is the one that would serve best a parameter that is not determined; where no motion
    serves it, the remedy for the cause and NaN (`estimation.solution.remedy`).

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
    needed = needed_motions(
        solution,
        tolerances,
        table.gravity_value,
        prior_sd=prior_sd,
        possible=possible_motions(table),
    )
    data_sd = sd_of_data(solution, prior_sd)
    of_bias_process = np.diag(solution.terms[BIAS_PROCESS])
    counted = _counted(solution)
    is_shown = dict(zip(solution.param_names, data_sd <= tolerances, strict=True))
    of_place = PLACE_REMEDY if table.latitude is None else AZIMUTH_REMEDY
    of_known_size: set[str] = set()
    for effect in solution.model.effects:
        if effect.known_size:
            of_known_size.update(effect.param_names())
    for name in list(needed):
        if name not in counted:
            del needed[name]
            continue
        if name in of_known_size:
            needed[name] = (of_place, float('nan'))
            continue
        index = solution.param_names.index(name)
        section = name.partition('.')[0]
        # Both sensors determine table and clock.
        sensors = (section,) if section in SENSORS else SENSORS
        of_misfit: tuple[str, ...] = ()
        if any(incomplete_windows(quality, sensor) for sensor in sensors):
            # Bias processes describe the error of the model.
            of_misfit = (BIAS_PROCESS,)
        if any(each.startswith(sensors) and is_shown[each] for each in solution.not_believed):
            # A parameter that the motions determine is held for a misfit, not for their lack.
            of_misfit = (BIAS_PROCESS, HELD_PRIORS)
        text = remedy(solution.terms, index, tolerances[index], of_misfit=of_misfit)
        wanders = any(_wanders(solution, sensor) for sensor in sensors)
        if not text and wanders and of_bias_process[index] > tolerances[index] ** 2:
            # The mean of the bias over the recording is as uncertain after more motions.
            text = WANDER_REMEDY
        if text:
            needed[name] = (text, float('nan'))
    return needed


def _wanders(solution: Solution, sensor: str) -> bool:
    """
    Return whether the scatter of window means is that of a bias that wanders.

    The offsets of windows are independent, so that more windows reduce their part; a bias that
    wanders keeps its value from window to window.
    """
    noise = solution.noise.get(sensor)
    return noise is not None and noise.bias_variance > noise.offset_sd**2


def possible_motions(table: Table) -> tuple[Motion, ...] | None:
    """Return the standard motions that a table with a single joint can do; None: any."""
    if len(table.joints) != 1 or not table.joints[0].turns:
        return None
    return motions_about(
        *(table.mat_sl @ np.asarray(direction) for direction in (table.joints[0].axis, table.up))
    )


def weak_on_table(
    solution: Solution, tolerances: np.ndarray, needed: dict[str, tuple[str, float]]
) -> tuple[dict, ...]:
    """
    Return the weak directions with helpful motions, and the unnamed parameters.

    The motions would help with the weak directions. The parameters are the ones that none of the
    directions names.
    """
    names = _counted(solution)
    present = np.isin(solution.param_names, names)
    directions = weak_directions(
        solution.covariance[np.ix_(present, present)], tolerances[present], names
    )
    others = _besides(directions, needed, dict(zip(solution.param_names, solution.sd / tolerances)))
    known = [(weights, _need(weights, needed)) for weights in directions]
    return tuple({'parameters': weights, 'needs': need} for weights, need in (*known, *others))


def _counted(solution: Solution) -> list[str]:
    """
    Return the parameters for which a motion can be asked.

    Those of an absent sensor are nominal. The other one may not see the table and the clock: only
    its own parameters count.
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


def _besides(
    directions: Sequence[Mapping[str, float]],
    needed: Mapping[str, tuple[str, float]],
    in_tolerances: Mapping[str, float],
) -> list[tuple[dict[str, float], str]]:
    """
    Return (sds in tolerances, motion) of the parameters that none of the worst directions names.
    """
    named: set[str] = set().union(*directions)
    others: dict[str, dict[str, float]] = {}
    for name, (text, _) in needed.items():
        if name not in named:
            others.setdefault(text, {})[name] = round(float(in_tolerances[name]), 3)
    return [(names, text) for text, names in others.items()]
