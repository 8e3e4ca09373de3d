"""End of the range of a sensor, and turns whose angle does not agree with gravity."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from imu_calibration.kinematics.rotations import rotation, skew, unit_rows
from imu_calibration.preprocessing.scan import Chunks, Rest

MIN_MISSED_ANGLE = 0.25
"""
Rms angle by which gravity misses the direction after a turn, rad, above which factors are tested:
scale errors of a tenth cause less.
"""
MAX_ANGLE_SHARE = 0.3
"""A factor is accepted when the remaining angle is below this share of the angle without it."""
FACTORS = 2.0 ** np.arange(-4.0, 4.01, 0.25)
"""
Tested ratios of readings to true rates: full-scale ranges from a sixteenth to sixteen times the set
range, and intermediate values.
"""
NEAR_POWER = 0.15
"""A factor within this share of a power of two is one: scales are off by a few per cent."""
LEAST_TURNS, MOST_TURNS = 3, 16
LEAST_ANGLE = 0.3
"""Least turn of gravity for a test of factors, rad."""
MAX_TURN_SECONDS = 30.0
"""s; the gyroscope's wander adds up in longer turns."""


def believed_factor(missed: Callable[[float], float]) -> float:
    """
    Return the factor between measured and true rates that fits gravity.

    The factor carries gravity from before each turn to after it. It is 1 when the rates fit as they
    are.

    Parameters
    ----------
    missed : callable
        Factor -> typical angle by which gravity misses its direction after a turn, rad.

    """
    as_it_is = missed(1.0)
    if as_it_is < MIN_MISSED_ANGLE:
        return 1.0
    angles = [missed(factor) for factor in FACTORS]
    best = int(np.argmin(angles))
    return nearest_power(FACTORS[best]) if angles[best] < MAX_ANGLE_SHARE * as_it_is else 1.0


def nearest_power(factor: float) -> float:
    """Return the power of two that a factor is within `NEAR_POWER` of, else the factor itself."""
    power = 2.0 ** np.round(np.log2(factor))
    return float(power if abs(factor / power - 1) < NEAR_POWER else factor)


def factor_between_rests(chunks: Chunks, rest: Rest | None) -> float | None:
    """
    Return the `believed_factor` of a recording in chunks.

    Or None when too few turns lie between rests.

    The mean rates of the chunks are added up from rest to rest; turns within a chunk commute well
    enough for a factor.
    """
    if rest is None or len(rest.ranges) <= LEAST_TURNS:
        return None
    centre = rest.sphere.centre if rest.sphere is not None else np.zeros(3)
    up = unit_rows(rest.force - centre)
    whole = np.abs(chunks.duration / np.median(chunks.duration) - 1) < 0.5
    turns = []
    for first, ((_, start), (stop, _)) in enumerate(zip(rest.ranges, rest.ranges[1:])):
        span = chunks.time[stop] - chunks.time[start - 1]
        unbroken = whole[start:stop].all() and span < 1.5 * np.median(chunks.duration) * (
            stop - start + 1
        )
        if (
            stop > start
            and unbroken
            and span < MAX_TURN_SECONDS
            and up[first] @ up[first + 1] < np.cos(LEAST_ANGLE)
        ):
            turns.append(
                (
                    (chunks.mean[start:stop, 3:] - rest.rate) * chunks.duration[start:stop, None],
                    up[first],
                    up[first + 1],
                )
            )
    if len(turns) < LEAST_TURNS:
        return None
    turns = turns[:: max(len(turns) // MOST_TURNS, 1)]
    return believed_factor(
        lambda factor: float(
            np.median(
                [_missed(vectors / factor, before, after) for vectors, before, after in turns]
            )
        )
    )


def _missed(vectors, before, after):
    # Gravity turns the other way in the sensor's axes.
    turned = before
    for step in rotation(-vectors):
        turned = step @ turned
    return np.arccos(np.clip(turned @ after, -1.0, 1.0))


COUNTED_OUTPUTS = 24
"""Different outputs below the largest that are counted."""
NEAR_LARGEST_SHARE = 0.9
"""Outputs above this share of the largest are evaluated."""
MAX_NEAR_OUTPUTS = 400
MIN_CLIPPED_SAMPLES = 4
JUMP = 0.01
"""A step to the largest value by more than this share of it is not noise."""
PILE = 5.0
"""A pile has this many times the samples of the outputs just below it."""


class Extremes:
    """The largest distinct values of one signal with their counts, in bounded memory."""

    def __init__(self) -> None:
        self.level = -np.inf
        self.count = 0
        self.n_jumps = 0
        self._below, self._last = {}, np.inf

    def push(self, values: np.ndarray) -> None:
        """Process values, shape (n,)."""
        before = self._last
        self._last = values[-1]
        largest = values.max()
        if largest <= 0 or largest < NEAR_LARGEST_SHARE * self.level:
            return
        if largest > self.level:
            if np.isfinite(self.level):
                self._below[self.level] = self.count
            self.level, self.count, self.n_jumps = float(largest), 0, 0
        near = values[values > NEAR_LARGEST_SHARE * self.level]
        below = near < self.level
        self.count += len(near) - int(np.count_nonzero(below))
        near = near[below]
        if largest == self.level:
            at = np.flatnonzero(values == largest)
            self.n_jumps += int(
                np.count_nonzero(np.where(at > 0, values[at - 1], before) < (1 - JUMP) * largest)
            )
        if len(near) > MAX_NEAR_OUTPUTS:
            near = np.partition(near, len(near) - MAX_NEAR_OUTPUTS)[-MAX_NEAR_OUTPUTS:]
        for value, count in zip(*np.unique(near, return_counts=True)):
            self._below[float(value)] = self._below.get(float(value), 0) + int(count)
        self._below = dict(sorted(self._below.items(), reverse=True)[:COUNTED_OUTPUTS])

    @property
    def jumped(self) -> bool:
        """
        Whether the largest value was often reached by a large step.

        This does not occur with rounded readings of a constant.
        """
        return self.n_jumps >= MIN_CLIPPED_SAMPLES

    @property
    def n_clipped(self) -> int:
        """
        Samples at the largest value if they are unusually many, else 0.

        Their number must be far above that of neighbouring values.
        """
        counts = [
            count for value, count in self._below.items() if value > NEAR_LARGEST_SHARE * self.level
        ][:10]
        usual = sum(counts) / len(counts) if counts else 1.0
        return self.count if self.count >= max(MIN_CLIPPED_SAMPLES, PILE * usual) else 0


LARGEST_TURN = 0.7
"""Turns of gravity from chunk to chunk above it are left out, rad."""
FORCE_BAND = 0.2
"""
Chunks in which the specific force differs from the usual length, or scatters, by more than this
share are excluded as accelerated.
"""
LEAST_TURN = 1.0
"""Gravity must turn by this much altogether, rad."""
LEAST_EXPLAINED = 0.5
CHUNK_SD_FACTOR = 4.0
"""Factor on standard deviations for the correlation of errors of neighbouring chunks."""
DETERMINED_SD_SHARE = 0.15
"""
A direction is determined when the standard deviation of its column is below this share of its
length.
"""


@dataclass(frozen=True, eq=False)
class Turning:
    """Relation between measured rates and the rotation of measured gravity."""

    matrix: np.ndarray
    """
    ``true rate = matrix @ measured rate`` in the frame of the accelerometer, zero across the
    directions that were not seen, shape (3, 3).
    """
    seen: np.ndarray
    """
    Projector on the directions with measured rates, shape (3, 3): turns about only (1, 1, 1)
    determine one direction and no axis.
    """

    @property
    def axes(self) -> np.ndarray:
        """Which of the gyroscope's axes were mostly seen, shape (3,)."""
        return np.diag(self.seen) > 0.5

    @property
    def everywhere(self) -> bool:
        """Whether the rates covered all directions."""
        return round(np.trace(self.seen)) == 3

    @property
    def factor(self) -> float:
        """True rate over measured rate: 1, or pi / 180 for deg/s."""
        return float(
            np.median(np.linalg.svd(self.matrix, compute_uv=False)[: round(np.trace(self.seen))])
        )


def relate_turns(chunks: Chunks) -> Turning | None:
    """
    Return the `Turning` of Chunks.

    Or None when gravity turns too little or is not explained by the rates.

    ``du/dt = u x (matrix @ rate + offset)`` for the direction u of specific force; no assumptions
    on units, axes or bias.
    """
    pairs = _pairs(chunks)
    if pairs is None:
        return None
    direction, change, turn_time, rate = pairs
    spread, directions = np.linalg.eigh(rate.T @ rate / len(rate))
    spread = np.sqrt(np.maximum(spread, 0.0))
    if np.linalg.norm(change, axis=1).sum() < LEAST_TURN or not spread.max() > 0:
        return None
    kept = spread > 1e-3 * spread.max()
    while kept.any():
        seen = directions[:, kept]
        scale = spread[kept]
        matrix, sure, explained = _fit(direction, change, turn_time, rate @ seen / scale)
        if explained < LEAST_EXPLAINED:
            return None
        if sure.all():
            return Turning(matrix / scale @ seen.T, seen @ seen.T)
        # The direction with the smallest rates may be leakage of another direction, and then
        # degrades both.
        kept = kept & (spread > spread[kept].min())
    return None


def _fit(direction, change, turn_time, rate):
    """Return (matrix (3, m), which of the m rates are sure, share explained) by least squares."""
    lever = skew(direction) * turn_time[:, None, None]
    inputs = np.column_stack([rate, np.ones(len(rate))])
    width = inputs.shape[1]
    design = (lever[:, :, :, None] * inputs[:, None, None, :]).reshape(-1, 3 * width)
    target = change.ravel()
    normal = design.T @ design
    inverse = np.linalg.pinv(normal + 1e-9 * np.trace(normal) * np.eye(3 * width))
    solution = inverse @ (design.T @ target)
    rest = float(((target - design @ solution) ** 2).sum())
    sd = (
        CHUNK_SD_FACTOR
        * np.sqrt(np.diag(inverse) * rest / max(len(target) - 3 * width, 1)).reshape(3, width)[
            :, :-1
        ]
    )
    matrix = solution.reshape(3, width)[:, :-1]
    return (
        matrix,
        np.linalg.norm(sd, axis=0) < DETERMINED_SD_SHARE * np.linalg.norm(matrix, axis=0),
        1.0 - rest / float((target**2).sum()),
    )


def _pairs(chunks):
    """
    Return (direction, its change, time between, rate), or None.

    The values are for neighbouring chunks in which gravity rules the accelerometer.
    """
    if len(chunks) < 20:
        return None
    length = np.linalg.norm(chunks.mean[:, :3], axis=1)
    usual = np.median(length)
    if not usual > 0:
        return None
    direction = chunks.mean[:, :3] / np.maximum(length, 1e-9 * usual)[:, None]
    step = np.diff(chunks.time)
    change = np.diff(direction, axis=0)
    whole = np.abs(chunks.duration / np.median(chunks.duration) - 1) < 0.5
    whole &= (np.abs(length / usual - 1) < FORCE_BAND) & (
        np.linalg.norm(chunks.sd[:, :3], axis=1) < FORCE_BAND * usual
    )
    good = (
        whole[1:]
        & whole[:-1]
        & (step > 0)
        & (step < 1.5 * np.median(step))
        & (np.linalg.norm(change, axis=1) < LARGEST_TURN)
    )
    if good.sum() < 20:
        return None
    middle = unit_rows(direction[1:] + direction[:-1])
    rate = 0.5 * (chunks.mean[1:, 3:] + chunks.mean[:-1, 3:])[good]
    return middle[good], change[good], step[good], rate - np.median(rate, axis=0)
