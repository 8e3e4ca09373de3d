"""Uncertainty of a parameter in relation to its tolerance."""

from collections.abc import Collection, Iterable
from enum import StrEnum

import numpy as np

from imu_calibration.effects.sensor_model import SensorModel


class Status(StrEnum):
    """Status of a parameter; stored as text in a document."""

    DETERMINED = 'determined'
    """Its standard deviation is within the tolerance."""
    WEAK = 'weak'
    """It is not, but value and standard deviation are honest."""
    HELD = 'held'
    """Not determined by the recording: value and sd are those of the prior."""
    FIXED = 'fixed'
    """A convention, for example the axes: exact."""


DETERMINED, WEAK, HELD, FIXED = Status
LACKING = (WEAK, HELD)
"""Statuses of parameters that need more data."""
COMMON_SCALE = 'accelerometer.common_scale'
"""Factor on all accelerometer readings by hand from an uncertain gravity; the sds of the other parameters are judged without it."""
WEAK_DATA, LIKELIHOOD_RATIO, REPLACEMENT = 'weak data', 'likelihood ratio', 'replacement'
"""
Reasons for which a parameter is held: its sd would exceed half the prior's; its prior is not significantly worse; the prior has the smaller
expected error.
"""


def statuses(sd: Iterable[float], held: Iterable[bool], tolerances: Iterable[float]) -> tuple[Status, ...]:
    """
    Return the status of each parameter.

    Parameters
    ----------
    sd : array_like, shape (n_params,)
        Standard deviations, SI; 0 for a convention.
    held : array_like of bool, shape (n_params,)
        Whether the parameter is fixed at its prior.
    tolerances : array_like, shape (n_params,)
        Largest standard deviation of a determined parameter, SI.

    """
    return tuple(HELD if h else FIXED if s == 0 else DETERMINED if s <= t else WEAK for h, s, t in zip(held, sd, tolerances, strict=True))


def reasons_held(held: Iterable[bool], names: Iterable[str], replaced: Collection[str], *,
                 tested: Collection[str] = ()) -> dict[str, str]:
    """Return held parameter -> the reason: `replaced` by its prior, for those `tested` by likelihood ratio, or too weak data."""
    return {name: WEAK_DATA if name not in replaced else LIKELIHOOD_RATIO if name in tested else REPLACEMENT
            for name, flag in zip(names, held, strict=True) if flag}


def tolerances_of(model: SensorModel, overrides: dict | None = None) -> np.ndarray:
    """
    Return the tolerance of each parameter of a model, shape (n_params,).

    Parameters
    ----------
    overrides : dict, optional
        {section: {effect: tolerance}} in SI, as in config/tolerances.yaml.

    """
    overrides = overrides or {}
    return np.concatenate([np.full(e.size, float(overrides.get(e.sensor, {}).get(e.name, e.tolerance))) for e in model.effects])
