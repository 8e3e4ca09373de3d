"""Coverage of directions by a calibration, and the state of each effect."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from imu_calibration.calibration.result import CalibrationResult
from imu_calibration.core.text_enum import StrEnum
from imu_calibration.document.outcome import parameter_count
from imu_calibration.effects.base import Effect
from imu_calibration.effects.motions import ALL_MOTIONS
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.sphere import DIRECTIONS

MIN_CELL_WORTH = 0.02
"""A cell with a gain below this share of the excess is not proposed for a pose."""


def sd_excess(sd: np.ndarray, tolerances: np.ndarray) -> np.ndarray:
    """
    Return the excess ``sum log max(sd / tolerance, 1)`` of standard deviations.

    Parameters
    ----------
    sd : array, shape (..., n)
    tolerances : array, shape (n,)

    Returns
    -------
    array, shape (...)
        0 when each standard deviation is within its tolerance.

    """
    return np.log(np.maximum(sd / tolerances, 1.0)).sum(axis=-1)


def share_gained(before: float | np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the share of the excess `before` that is removed, 0 to 1, shape of `after`."""
    if before > 0:
        return np.clip((before - after) / before, 0.0, 1.0)
    return np.zeros_like(after)


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
    """Worst status of the parameters of the effect."""
    parameter: str
    """The parameter with the largest standard deviation in tolerances."""
    sd: float
    """Standard deviation of `parameter`, SI; NaN before the first solution."""
    tolerance: float
    """Tolerance of `parameter`, SI."""
    unit: str
    """Unit of `sd` and `tolerance`."""
    needs: str = ''
    """The motion that is still needed."""
    predicted_sd: float = float('nan')
    """Standard deviation after one minute of that motion; NaN when it cannot be predicted."""
    counts: bool = True
    """Whether a parameter of the effect was requested; those of the reference do not count."""


def group_states(result: CalibrationResult) -> list[GroupState]:
    """Return the GroupState of every effect of the present sensors, in the order of the model."""
    calibration = result.calibration
    return [
        _group_state(result, effect)
        for effect in calibration.model.effects
        if effect.sensor not in calibration.absent
    ]


def _group_state(result: CalibrationResult, effect: Effect) -> GroupState:
    """Return the state of one effect: that of its worst parameter."""
    calibration = result.calibration
    names = calibration.param_names
    sd = calibration.own_sd
    parameters = calibration.model.slices[effect.key]
    sd_over_tolerance = sd[parameters] / result.tolerances[parameters]
    worst = parameters.start + int(np.argmax(sd_over_tolerance))

    statuses = calibration.status[parameters]
    progress = Progress.DETERMINED
    if Progress.WEAK in statuses:
        progress = Progress.WEAK
    if Progress.HELD in statuses:
        progress = Progress.HELD

    # The need of the worst parameter, or of the first one that has a need.
    needs = ''
    predicted_sd = float('nan')
    if progress != Progress.DETERMINED:
        for name in (names[worst], *names[parameters]):
            if name in result.needed:
                needs, predicted_sd = result.needed[name]
                break
    return GroupState(
        effect.sensor,
        effect.name,
        progress,
        parameter=names[worst],
        sd=float(sd[worst]),
        tolerance=float(result.tolerances[worst]),
        unit=effect.unit_of(worst - parameters.start),
        needs=needs,
        predicted_sd=predicted_sd,
        counts=any(name in calibration.requested for name in names[parameters]),
    )


def waiting_groups(model: SensorModel) -> list[GroupState]:
    """Return the GroupState of every effect of a model without data."""
    states = []
    for effect in model.effects:
        states.append(
            GroupState(
                effect.sensor,
                effect.name,
                Progress.WAITING,
                parameter=effect.param_names()[0],
                sd=float('nan'),
                tolerance=effect.tolerance,
                unit=effect.unit_of(0),
                needs=ALL_MOTIONS[effect.motion[0]],
            )
        )
    return states


@dataclass(frozen=True, eq=False)
class Step:
    """The next step."""

    text: str
    """Text for the user; '' when no motion is missing."""
    up: np.ndarray | None = None
    """Direction of the sensor frame to turn up and hold, unit vector, shape (3,)."""
    axis: np.ndarray | None = None
    """
    Axis of the sensor frame to turn about, counter-clockwise seen from its tip, unit vector, shape
    (3,).
    """
    angle: float = 0.0
    """Angle of the rotation, rad; 0: continuous."""


@dataclass(frozen=True, eq=False)
class Coverage:
    """The displayed state of a session."""

    worth: np.ndarray
    """
    Share of the excess that a rest with each of `DIRECTIONS` up would remove, 0 to 1, shape (26,).
    """
    seen: np.ndarray
    """Directions that have been up at rest, unit vectors, shape (k, 3)."""
    up: np.ndarray | None
    """Upward direction now, or at the last rest, shape (3,)."""
    next: Step
    """The next step."""
    seconds: float
    """Remaining time, s; NaN when unknown."""
    done: bool = False
    """Whether every requested parameter of the sensors is determined."""
    arms: np.ndarray | None = None
    """
    Sensitive points of the accelerometer's axes, m in the sensor frame, rows x, y, z, shape (3, 3);
    None while they are not known.
    """
    frame_id: str = ''
    """Frame of the sensor."""


NOTHING_SEEN = Coverage(
    worth=np.ones(len(DIRECTIONS)),
    seen=np.zeros((0, 3)),
    up=None,
    next=Step('move the table'),
    seconds=float('nan'),
)
"""Before anything is known."""


def is_done(result: CalibrationResult) -> bool:
    """Return whether every requested parameter of the sensors is determined."""
    return not parameter_count(result.calibration).lacking


RADIUS = 0.5
"""Radius of the sphere in the picture, m."""
ARMS_TIMES = 10.0
"""Factor by which arms, some millimetres long, are drawn larger."""
WANTED, VISITED, DONE_COLOUR, ARROW, NOW, TEXT_COLOUR = (
    (0.95, 0.55, 0.1),
    (0.25, 0.6, 0.95),
    (0.2, 0.75, 0.3),
    (0.9, 0.1, 0.5),
    (0.5, 0.5, 0.6),
    (0.9, 0.9, 0.9),
)
SEEN_DIAMETER = 0.03
"""Diameter of the mark of an earlier up direction, m."""


Colour = tuple[float, ...]
"""Red, green and blue, 0 to 1."""


class Balls(NamedTuple):
    """One or more balls of the picture."""

    place: np.ndarray
    """Middle, m in the sensor frame, shape (3,), or (k, 3) of k balls."""
    colour: Colour
    diameter: float


class Arrow(NamedTuple):
    """An arrow of the picture, m in the sensor frame."""

    name: str
    start: np.ndarray
    end: np.ndarray
    colour: Colour


class Label(NamedTuple):
    """A line of text of the picture."""

    place: np.ndarray
    colour: Colour
    text: str


def sphere_cells(coverage: Coverage) -> Iterator[Balls]:
    """
    Yield the ball of each of `DIRECTIONS`.

    A cell is orange and large where a rest still has a gain, green and small elsewhere.
    """
    largest = max(float(coverage.worth.max()), MIN_CELL_WORTH)
    for direction, worth in zip(DIRECTIONS, coverage.worth, strict=True):
        share = 0.0 if coverage.done or worth < MIN_CELL_WORTH else float(worth) / largest
        colour = []
        for wanted, done in zip(WANTED, DONE_COLOUR, strict=True):
            colour.append(share * wanted + (1 - share) * done)
        yield Balls(RADIUS * direction, tuple(colour), diameter=0.06 + 0.1 * share)


def arrows_of(coverage: Coverage) -> Iterator[Arrow]:
    """
    Yield the arrows of the picture.

    They are the up direction now, the direction or axis of the next motion, and arms that are not
    zero.
    """
    step = coverage.next
    centre = np.zeros(3)
    # Within the sphere the direction now, beyond it the next one.
    if coverage.up is not None:
        yield Arrow('up now', centre, 0.85 * RADIUS * coverage.up, NOW)
    if step.up is not None:
        yield Arrow('next', centre, 1.25 * RADIUS * step.up, ARROW)
    elif step.axis is not None:
        yield Arrow('next', -1.25 * RADIUS * step.axis, 1.25 * RADIUS * step.axis, ARROW)
    if coverage.arms is None:
        return
    # Red, green and blue for the axes x, y, z.
    for colour, arm in zip(0.9 * np.eye(3), coverage.arms, strict=False):
        if arm.any():
            yield Arrow('arms', centre, ARMS_TIMES * arm, tuple(colour))


def seen_of(coverage: Coverage) -> Balls:
    """Return the balls of the earlier up directions."""
    return Balls(1.1 * RADIUS * coverage.seen, VISITED, SEEN_DIAMETER)


def label_of(coverage: Coverage) -> Label:
    """Return the label above the sphere."""
    place = np.array([0.0, 0.0, 1.6 * RADIUS])
    if coverage.done:
        return Label(place, DONE_COLOUR, 'all parameters are determined: save the calibration')
    line = coverage.next.text or 'go on'
    if coverage.seconds and not np.isnan(coverage.seconds):
        line += f', about {coverage.seconds:.0f} s left'
    return Label(place, TEXT_COLOUR, line)
