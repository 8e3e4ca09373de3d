"""Whether the error of a calibration has changed since its recording, by regime of motion."""

from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.document.proof_entry import Proof, RegimeErrors

QUANTILE = 1.96
"""Half width of the central 95 % of the normal distribution, in standard deviations."""
SMALLEST_SHARE = 1e-3
"""Smallest lower end of an interval as a share of its upper end: its logarithm is finite."""
KIND_BY_HAND = {'accelerometer': 'rest', 'gyroscope': 'turns'}
"""Sensor -> the only kind of motion of its held-out error by hand (`HeldOutPoses`)."""


@dataclass(frozen=True)
class RegimeChange:
    """Error of one sensor in one regime of motion, now and on the day of the calibration."""

    sensor: str
    """Sensor."""
    regime: str
    """Kind of motion."""
    unit: str
    """Unit of the errors."""
    stored: float
    """Held-out error in the file of the calibration."""
    now: float
    """Error on the new recording."""
    low: float
    """Lower end of the 95 % interval of now / stored."""
    high: float
    """Upper end."""

    @property
    def factor(self) -> float:
        """Error now / error on the day."""
        return self.now / self.stored

    def exceeds(self, limit: float) -> bool:
        """Return whether the complete interval lies above a factor."""
        return self.low > limit

    @property
    def text(self) -> str:
        """The factor with its interval."""
        return f'a factor of {self.factor:.2g} ({self.low:.2g} to {self.high:.2g})'


def checked_limit(limit: float) -> float:
    """Return the factor from which a change counts; raises an InputError below 1."""
    if not (np.isfinite(limit) and limit >= 1.0):
        raise InputError(
            f'the factor from which a change counts must be at least 1, got {limit:g}; correct it',
            code='change_limit',
        )
    return limit


def with_kinds_by_hand(stored: Proof) -> Proof:
    """
    Return the proof of a file in which the entries by hand have their kind of motion as regime.

    Parameters
    ----------
    stored : mapping
        Sensor -> entry of the file.

    """
    proof = {}
    for sensor, entry in stored.items():
        proof[sensor] = entry
        if not entry.regimes:
            proof[sensor] = replace(entry, regimes={KIND_BY_HAND[sensor]: entry})
    return proof


def changes_since(stored: Proof, proof: Proof) -> tuple[RegimeChange, ...]:
    """
    Return the changes of the error in the regimes that both proofs have, with the same unit.

    With the standard deviations s, s' of the logarithms of both errors, from the intervals of
    after / before, the interval of now / stored is ``exp(+-1.96 sqrt(s^2 + s'^2))`` about the
    ratio.

    Parameters
    ----------
    stored, proof : mapping
        Sensor -> entry (`calibration.proof.prove`): of the file, and of the new recording.

    """
    changes = []
    for sensor, entry in proof.items():
        if sensor not in stored:
            continue
        for regime, errors in entry.regimes.items():
            earlier = stored[sensor].regimes.get(regime)
            if earlier is None or earlier.unit != errors.unit:
                continue
            if not earlier.after > 0.0 or not errors.after > 0.0:  # no ratio
                continue
            ratio = errors.after / earlier.after
            interval_factor = np.exp(QUANTILE * np.hypot(_log_sd(earlier), _log_sd(errors)))
            changes.append(
                RegimeChange(
                    sensor,
                    regime,
                    errors.unit,
                    stored=earlier.after,
                    now=errors.after,
                    low=float(ratio / interval_factor),
                    high=float(ratio * interval_factor),
                )
            )
    return tuple(changes)


def _log_sd(errors: RegimeErrors) -> float:
    """
    Return the standard deviation of the logarithm of after / before, from its 95 % interval.

    That interval is ``exp(m +- 1.96 s)``, so that ``s = log(high / low) / (2 * 1.96)``.
    """
    low, high = errors.ci95
    if not high > 0.0:
        return 0.0
    return float(np.log(high / max(low, SMALLEST_SHARE * high)) / (2.0 * QUANTILE))
