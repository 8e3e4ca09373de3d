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
"""Turns between rests that are compared."""
LEAST_ANGLE = 0.3
"""Least turn of gravity for a test of factors, rad."""
MAX_TURN_SECONDS = 30.0
"""s; the gyroscope's wander adds up in longer turns."""


def believed_factor(missed_angle: Callable[[float], float]) -> float:
    """
    Return the factor of the measured rates over true ones that the rotation of gravity shows.

    It is 1 where the rates explain the rotation without a factor, or no factor explains it.

    Parameters
    ----------
    missed_angle : callable
        Factor -> typical angle, rad, between gravity after a turn and its prediction from gravity
        before it, by the integral of the rates divided by the factor.

    """
    angle_of_one = missed_angle(1.0)
    if angle_of_one < MIN_MISSED_ANGLE:
        return 1.0
    angles = [missed_angle(factor) for factor in FACTORS]
    best = int(np.argmin(angles))
    if angles[best] >= MAX_ANGLE_SHARE * angle_of_one:
        return 1.0
    # Full-scale ranges differ by powers of two, and the scale of the sensor adds a few per cent.
    return nearest_power(FACTORS[best])


def nearest_power(factor: float) -> float:
    """Return the power of two that a factor is within `NEAR_POWER` of, else the factor itself."""
    power = 2.0 ** np.round(np.log2(factor))
    return float(power if abs(factor / power - 1) < NEAR_POWER else factor)


@dataclass(frozen=True, eq=False)
class _Turn:
    """Rotation from one rest to the next, as measured by the gyroscope."""

    rotations: np.ndarray
    """Mean rate minus bias, times the duration, of each chunk in between, rad, shape (n, 3)."""
    before: np.ndarray
    """Direction of the specific force at the first rest, shape (3,)."""
    after: np.ndarray
    """The same at the next rest."""

    def missed_angle(self, factor: float) -> float:
        """Return the angle from gravity to its prediction with rates divided by `factor`, rad."""
        # In axes that turn with the sensor, gravity rotates with the negative rate.
        turned = self.before
        for step in rotation(-(self.rotations / factor)):
            turned = step @ turned
        return np.arccos(np.clip(turned @ self.after, -1.0, 1.0))


def factor_between_rests(chunks: Chunks, rest: Rest | None) -> float | None:
    """
    Return the factor of the measured rates over true ones, from turns between rests.

    None when there are too few turns. The mean rates of the chunks are integrated from rest to
    rest; rotations within a chunk commute well enough for a factor.
    """
    if rest is None or len(rest.ranges) <= LEAST_TURNS:
        return None
    centre = rest.sphere.centre if rest.sphere is not None else np.zeros(3)
    up = unit_rows(rest.force - centre)
    usual_duration = np.median(chunks.duration)
    is_whole = _whole_chunks(chunks)
    turns = []
    for k, (first_rest, next_rest) in enumerate(zip(rest.ranges, rest.ranges[1:])):
        # The chunks between both rests.
        start = first_rest[1]
        stop = next_rest[0]
        if stop <= start:
            continue
        # From the last chunk of one rest to the first of the next: stop - start + 1 steps.
        span = chunks.time[stop] - chunks.time[start - 1]
        has_gap = span >= 1.5 * usual_duration * (stop - start + 1)
        if has_gap or not is_whole[start:stop].all() or span >= MAX_TURN_SECONDS:
            continue
        # A small turn does not distinguish factors.
        if up[k] @ up[k + 1] < np.cos(LEAST_ANGLE):
            rate = chunks.mean[start:stop, 3:] - rest.rate
            rotations = rate * chunks.duration[start:stop, None]
            turns.append(_Turn(rotations, up[k], up[k + 1]))
    if len(turns) < LEAST_TURNS:
        return None
    turns = turns[:: max(len(turns) // MOST_TURNS, 1)]
    return believed_factor(
        lambda factor: float(np.median([turn.missed_angle(factor) for turn in turns]))
    )


def _whole_chunks(chunks: Chunks) -> np.ndarray:
    """Return which chunks have about the usual duration, and therefore no gap, bool, (n,)."""
    return np.abs(chunks.duration / np.median(chunks.duration) - 1) < 0.5


COUNTED_OUTPUTS = 24
"""Different outputs below the largest that are counted."""
NEAR_LARGEST_SHARE = 0.9
"""Outputs above this share of the largest are evaluated."""
MAX_NEAR_OUTPUTS = 400
"""Largest number of evaluated outputs of one piece, the largest ones."""
MIN_CLIPPED_SAMPLES = 4
"""Samples at the largest value from which on they may be clipped."""
JUMP = 0.01
"""A step to the largest value by more than this share of it is not noise."""
PILE = 5.0
"""A pile has this many times the samples of the outputs just below it."""


class Extremes:
    """The largest distinct values of one signal with their counts, in bounded memory."""

    def __init__(self) -> None:
        self.level = -np.inf
        """Largest value so far."""
        self.count = 0
        """Samples with this value."""
        self.n_jumps = 0
        """Samples of these after a value that is smaller by more than `JUMP`."""
        # Value -> samples, of the `COUNTED_OUTPUTS` largest values below the largest.
        self._count_below: dict[float, int] = {}
        self._last_value = np.inf

    def push(self, values: np.ndarray) -> None:
        """
        Process the next values, shape (n,).

        Only positive values count: the end of a range is far from zero.
        """
        value_before_all = self._last_value
        self._last_value = values[-1]
        largest = values.max()
        # Smaller values decide nothing: only a pile at the largest one may be the end of a range.
        if largest <= 0 or largest < NEAR_LARGEST_SHARE * self.level:
            return
        # A new largest value: the previous one becomes one of those below it.
        if largest > self.level:
            if np.isfinite(self.level):
                self._count_below[self.level] = self.count
            self.level = float(largest)
            self.count = 0
            self.n_jumps = 0
        # Samples at the largest value, and those of them that follow a much smaller one.
        near = values[values > NEAR_LARGEST_SHARE * self.level]
        is_below = near < self.level
        self.count += len(near) - int(np.count_nonzero(is_below))
        if largest == self.level:
            at_largest = np.flatnonzero(values == largest)
            value_before = np.where(at_largest > 0, values[at_largest - 1], value_before_all)
            self.n_jumps += int(np.count_nonzero(value_before < (1 - JUMP) * largest))

        # Count the largest of the values below, in bounded memory.
        below = near[is_below]
        if len(below) > MAX_NEAR_OUTPUTS:
            below = np.partition(below, len(below) - MAX_NEAR_OUTPUTS)[-MAX_NEAR_OUTPUTS:]
        for value, count in zip(*np.unique(below, return_counts=True)):
            self._count_below[float(value)] = self._count_below.get(float(value), 0) + int(count)
        self._count_below = dict(sorted(self._count_below.items(), reverse=True)[:COUNTED_OUTPUTS])

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
        near = [value for value in self._count_below if value > NEAR_LARGEST_SHARE * self.level]
        # The ten next values; the dictionary is sorted, the largest first.
        counts = [self._count_below[value] for value in near[:10]]
        mean_count = sum(counts) / len(counts) if counts else 1.0
        return self.count if self.count >= max(MIN_CLIPPED_SAMPLES, PILE * mean_count) else 0


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
"""Share of the rotation of gravity that the rates explain, at least."""
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
        """True rate over measured rate: 1, or pi / 180 for deg/s; median of the directions."""
        n_directions = round(np.trace(self.seen))
        return float(np.median(np.linalg.svd(self.matrix, compute_uv=False)[:n_directions]))


def relate_turns(chunks: Chunks) -> Turning | None:
    """
    Return the `Turning` of a recording in chunks.

    None when gravity turns too little or is not explained by the rates.

    ``du/dt = u x (matrix @ rate + offset)`` for the direction u of specific force; no assumptions
    on units, axes or bias.
    """
    pairs = _chunk_pairs(chunks)
    if pairs is None:
        return None
    # Principal directions of the rates, and the rms rate along each.
    rate = pairs.rate
    variance, directions = np.linalg.eigh(rate.T @ rate / len(rate))
    rms = np.sqrt(np.maximum(variance, 0.0))
    if np.linalg.norm(pairs.change, axis=1).sum() < LEAST_TURN or not rms.max() > 0:
        return None
    used = rms > 1e-3 * rms.max()
    while used.any():
        # Rates along the used directions in units of their rms; a column of the fit belongs to one.
        seen = directions[:, used]
        scale = rms[used]
        fit = _fit(pairs, rate @ seen / scale)
        if fit.explained < LEAST_EXPLAINED:
            return None
        if fit.determined.all():
            return Turning(fit.matrix / scale @ seen.T, seen @ seen.T)
        # The direction with the smallest rates may be leakage of another direction, and then
        # degrades both.
        used = used & (rms > rms[used].min())
    return None


@dataclass(frozen=True, eq=False)
class _ChunkPairs:
    """Rotation of gravity from one chunk to the next, and the rates."""

    direction: np.ndarray
    """Direction u of the specific force between both chunks, shape (n, 3)."""
    change: np.ndarray
    """Change of u from one chunk to the next, shape (n, 3)."""
    seconds: np.ndarray
    """Time between them, s, shape (n,)."""
    rate: np.ndarray
    """Mean measured rate of both minus its median, shape (n, 3)."""


def _chunk_pairs(chunks: Chunks) -> _ChunkPairs | None:
    """Return the pairs of neighbouring chunks without large accelerations, or None if too few."""
    if len(chunks) < 20:
        return None
    length = np.linalg.norm(chunks.mean[:, :3], axis=1)
    median_length = np.median(length)
    if not median_length > 0:
        return None
    direction = chunks.mean[:, :3] / np.maximum(length, 1e-9 * median_length)[:, None]
    change = np.diff(direction, axis=0)
    seconds = np.diff(chunks.time)

    has_usual_length = np.abs(length / median_length - 1) < FORCE_BAND
    is_calm = np.linalg.norm(chunks.sd[:, :3], axis=1) < FORCE_BAND * median_length
    is_good = _whole_chunks(chunks) & has_usual_length & is_calm
    used = is_good[1:] & is_good[:-1]
    used &= (seconds > 0) & (seconds < 1.5 * np.median(seconds))
    used &= np.linalg.norm(change, axis=1) < LARGEST_TURN
    if used.sum() < 20:
        return None
    middle = unit_rows(direction[1:] + direction[:-1])
    rate = 0.5 * (chunks.mean[1:, 3:] + chunks.mean[:-1, 3:])[used]
    return _ChunkPairs(middle[used], change[used], seconds[used], rate - np.median(rate, axis=0))


@dataclass(frozen=True, eq=False)
class _TurnFit:
    """Least-squares fit of the rotation of gravity by rates along m directions."""

    matrix: np.ndarray
    """True rate per rate along each direction, shape (3, m)."""
    determined: np.ndarray
    """Whether the sd of each column is small against its length, bool, shape (m,)."""
    explained: float
    """Share of the squared changes of direction that the fit explains."""


def _fit(pairs: _ChunkPairs, rate: np.ndarray) -> _TurnFit:
    """
    Fit ``change = [u x] (matrix @ rate + offset) seconds`` to rates of shape (n, m).

    The 3 (m + 1) unknowns are the rows of (matrix, offset).
    """
    # Row (sample, i) and column (j, k) of the design: lever[sample, i, j] inputs[sample, k].
    lever = skew(pairs.direction) * pairs.seconds[:, None, None]
    inputs = np.column_stack([rate, np.ones(len(rate))])
    width = inputs.shape[1]
    design = (lever[:, :, :, None] * inputs[:, None, None, :]).reshape(-1, 3 * width)
    target = pairs.change.ravel()
    normal = design.T @ design
    inverse = np.linalg.pinv(normal + 1e-9 * np.trace(normal) * np.eye(3 * width))
    solution = inverse @ (design.T @ target)
    residual = float(((target - design @ solution) ** 2).sum())
    n_spare = max(len(target) - 3 * width, 1)
    sd = CHUNK_SD_FACTOR * np.sqrt(np.diag(inverse) * residual / n_spare)
    # Columns of the matrix, without the offset, which belongs to the last input.
    column_sd = np.linalg.norm(sd.reshape(3, width)[:, :-1], axis=0)
    matrix = solution.reshape(3, width)[:, :-1]
    determined = column_sd < DETERMINED_SD_SHARE * np.linalg.norm(matrix, axis=0)
    return _TurnFit(matrix, determined, 1.0 - residual / float((target**2).sum()))
