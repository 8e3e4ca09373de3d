"""Effects that a recording on a table can test."""

from collections.abc import Sequence

import numpy as np

from imu_calibration.effects.base import Effect
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.signal_history import HALF_WIDTH
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.rest_detection import least_variance
from imu_calibration.preprocessing.window import Window, WindowKind, sensors_of
from imu_calibration.references.turntable.estimation.session_noise import VIBRATES
from imu_calibration.selection.questions import lacking_temperature, sort_effects

TURN = 4 * HALF_WIDTH
"""Sufficient reversal of the temperature, K."""


BRANCHES_APART = 1.5
"""Least span of the thermal branch, from -1 to 1, that separates cooling from warming up."""


SHAKEN_RESTS = 3
"""Least number of rests whose noise has `VIBRATES` times the variance of the quietest."""


def testable_effects(
    model: SensorModel, table: Table, windows: Sequence[Window]
) -> tuple[list[Effect], list[dict]]:
    """
    Return (testable effects, list of {'effect', 'why', 'needs'} for all other ones).

    Parameters
    ----------
    model : SensorModel
        The baseline; its effects are not tested again.
    table : Table
        The searcher's description of the table.
    windows : sequence of Window
        The recording.

    """
    # Range of the temperature and of the thermal branch, which both may be unknown.
    temperatures = []
    branches = []
    for window in windows:
        if window.temperature_c is not None:
            temperatures.append(float(np.mean(window.temperature_c)))
        if window.motion.thermal_branch is not None:
            branches.append(float(window.motion.thermal_branch.mean()))
    span = None
    if temperatures and len(temperatures) == len(windows):
        span = max(temperatures) - min(temperatures)
    turned = bool(branches) and max(branches) - min(branches) >= BRANCHES_APART

    kinds = {window.kind for window in windows}
    have = {effect.key for effect in model.effects}
    shaken = _vibrates(windows)
    return sort_effects(
        model,
        lambda effect: _why_not(
            effect, have, table, kinds=kinds, span=span, turned=turned, shaken=shaken
        ),
        sensors_of(windows),
    )


def _vibrates(windows: Sequence[Window]) -> bool:
    """Return whether vibration differs between rests."""
    of_rests = []  # variance of the accelerometer, all axes, at least that of rounding
    for window in windows:
        if window.kind == 'static' and len(window) > 3:
            variance = window.noise_sd[0] @ window.noise_sd[0]
            of_rests.append(max(variance, least_variance(window.force_s)))
    variances = np.array(of_rests)
    shaken = variances > VIBRATES * variances.min(initial=np.inf)
    return int(np.count_nonzero(shaken)) >= SHAKEN_RESTS


def _why_not(
    effect: Effect,
    have: set[tuple[str, str]],
    table: Table,
    *,
    kinds: set[WindowKind],
    span: float | None,
    turned: bool,
    shaken: bool,
) -> tuple[str, str] | None:
    """
    Return (why, needs) of an effect that a recording cannot test; None for a testable one.

    Parameters
    ----------
    effect : Effect
    have : set
        Keys of the effects of the model.
    table : Table
    kinds : set
        Kinds of the windows of the recording.
    span : float or None
        Range of the temperature, K; None where it is not known throughout.
    turned : bool
        Whether the temperature reversed.
    shaken : bool
        Whether vibration differs between rests.

    """
    moving = kinds & {'spin', 'dynamic'}
    why = lacking_temperature(effect, span)
    if why:
        return why
    if 'rotation' in effect.needs and not moving:
        return 'the recording has no rotation', 'spin and swing the table'
    if 'dynamic' in effect.needs and not moving:
        return 'the recording has no motion', 'swing the table at several frequencies'
    if (effect.sensor, effect.contained_in) in have:
        return (
            f'the {effect.contained_in} of the model contains it',
            f'omit {effect.contained_in} in the model',
        )
    if effect.moot and (why := effect.moot(table)):
        return why
    if 'cooling' in effect.needs and not turned:
        return (
            'the temperature did not reverse: one branch only',
            f'record while it warms up and while it cools, by {TURN:g} K',
        )
    if 'vibration' in effect.needs and not shaken:
        return (
            'it did not vibrate now more, now less at rest',
            f'record {SHAKEN_RESTS} rests and more while a machine on the table runs',
        )
    return None
