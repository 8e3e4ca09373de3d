"""State of each effect of a running calibration: determined, weak, held or waiting, and the motion that is still needed."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from imu_calibration.calibration.result import CalibrationResult
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.standard_motions import MOTIONS, TABLE_MOTIONS


class Progress(StrEnum):
    """Progress of a session with an effect, or of the session in total."""

    WAITING = 'waiting'
    """There is no solution yet."""
    HELD = 'held'
    WEAK = 'weak'
    DETERMINED = 'determined'


@dataclass(frozen=True)
class GroupState:
    """State of one effect of one sensor."""

    sensor: str
    """'accelerometer', 'gyroscope' or 'reference'."""
    effect: str
    """Name of the effect."""
    status: Progress
    """That of the worst of its parameters."""
    parameter: str
    """The parameter with the largest standard deviation in tolerances."""
    sd: float
    """Its standard deviation, SI; NaN before the first solution."""
    tolerance: float
    """Its tolerance, SI."""
    unit: str
    """Unit of both."""
    needs: str = ''
    """The motion that is still needed."""
    predicted_sd: float = float('nan')
    """Standard deviation after one minute of that motion; NaN when it cannot be predicted."""


def group_states(result: CalibrationResult) -> list[GroupState]:
    """Return the GroupState of every effect of a CalibrationResult, in the order of the model."""
    calibration, states = result.calibration, []
    names, sd = calibration.param_names, calibration.own_sd
    for effect in calibration.model.effects:
        part = calibration.model.slices[effect.key]
        worst = part.start + int(np.argmax(sd[part] / result.tolerances[part]))
        state = group_status(calibration.status[part])
        lacking = () if state == Progress.DETERMINED else (names[worst], *names[part])
        known = [result.needed[name] for name in lacking if name in result.needed]
        text, predicted = known[0] if known else ('', float('nan'))
        states.append(GroupState(effect.sensor, effect.name, state, names[worst], float(sd[worst]), float(result.tolerances[worst]),
                                 effect.unit_of(worst - part.start), text, predicted))
    return states


def group_status(statuses: Sequence[str]) -> Progress:
    """Return the worst of the statuses of an effect's parameters."""
    return next((progress for progress in (Progress.HELD, Progress.WEAK) if progress in statuses), Progress.DETERMINED)


def waiting_groups(model: SensorModel) -> list[GroupState]:
    """Return the GroupState of every effect of a model without data."""
    texts = {motion.name: motion.text for motion in MOTIONS} | TABLE_MOTIONS
    return [GroupState(e.sensor, e.name, Progress.WAITING, e.param_names()[0], float('nan'), e.tolerance, e.unit_of(0), texts[e.motion[0]])
            for e in model.effects]
