"""Tones in the rest: at a fixed frequency, or at a fixed multiple of a joint's speed."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.core.distributions import binom_sf
from imu_calibration.core.units import DEG, for_people, significant
from imu_calibration.effects.base import AXES, SENSORS
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window
from imu_calibration.selection.investigation import Investigation
from imu_calibration.selection.orders import FEWEST_SAMPLES, MOST, OUT, long_enough, orders_of
from imu_calibration.selection.proposals import Proposal
from imu_calibration.selection.residual_blocks import residuals

STEP = 0.1
"""Spacing of the frequencies under test, cycles per second or per turn; its inverse is the largest length of a stretch."""
PER_TURN = 128
"""Angles per turn at which the residual of a turning joint is sampled."""
LEAST_CYCLES = 3.0
"""Of a tone in a stretch that can show it."""
HIGHEST = 0.45
"""Highest frequency in that of the samples."""
CLEAR, BY_CHANCE = 4.0, 0.05
"""
Least power over its surroundings in a stretch, and its probability by noise: e^-4, and more where few frequencies determine the
surroundings.
"""
SIGNIFICANT = 1e-4
"""Probability of a tone by noise, times the number of frequencies, axes and joints."""
MOSTLY = 0.5
"""Least share of the stretches with the tone; effects of the motion occur in some of them only."""
SLOWEST = 1.0 * DEG
"""A joint that turns slower at times has no orders, rad/s."""


@dataclass(frozen=True, eq=False)
class Tone:
    """One line in the spectrum of a sensor's rest."""

    sensor: str
    """'accelerometer' or 'gyroscope'."""
    axis: str
    """Axis of the sensor."""
    joint: str | None
    """Joint of the unit 'cycles per turn'; None: seconds."""
    frequency: float
    """Cycles per second, or per turn of the joint."""
    amplitude: float
    """m/s^2 or rad/s."""
    p_value: float
    """Probability by noise, times the number of tests."""
    share: float
    """Share of the stretches that show it."""
    frequencies: np.ndarray
    """All frequencies under test, shape (n,)."""
    power: np.ndarray
    """Mean power of the axis there, over that around it, shape (n,)."""

    @property
    def text(self) -> str:
        """Description."""
        factor, unit = for_people('m/s^2' if self.sensor == SENSORS[0] else 'rad/s')
        where = f'on {self.sensor} {self.axis}, {significant(self.amplitude * factor, 2)} {unit}'
        if self.joint is None:
            return f'a tone of {self.frequency:.1f} Hz {where}, independent of motion: electrical, or a resonance'
        return f'{self.frequency:.1f} times per turn of {self.joint} {where}, at every speed: its bearing, gear, motor or encoder'

    def to_mapping(self) -> dict:
        """Return the tone as plain data."""
        return {'axis': self.axis, 'joint': self.joint, 'frequency': self.frequency, 'amplitude': self.amplitude, 'p_value': self.p_value,
                'share': self.share, 'text': self.text}


def find_tones(found: Investigation, table: Table, formulas: Sequence[Proposal] = ()) -> dict[str, tuple[Tone, ...]]:
    """
    Return sensor -> the tones in the residual of the findings and of some formulas, the most significant first.

    The residual of every stretch of at most ten seconds, or of at most ten turns of a joint in steady rotation, is transformed to
    frequencies. A peak has four times the median power around it; a tone has peaks in most stretches, tested against noise
    (binomial law). Rests and motions are both analysed in seconds; a tone at a multiple of a speed is constant per turn and varies per
    second. Where few stretches turn, integer orders are searched in all motions of the joint (`selection.orders`). Fixed frequencies are
    removed before multiples of a speed are searched.
    """
    model = found.attempt.recording.model
    values = found.attempt.values(found.named)[:len(model.param_names)]
    for effect, value in ((effect, value) for formula in formulas for effect, value in zip(formula.effects, formula.values)):
        wider = replace(model, catalogue=model.catalogue.with_effects(effect)).with_effect(effect.sensor, effect.name)
        extended = wider.start_from(model, values)
        extended[wider.slices[effect.key]] = value
        model, values = wider, extended
    left = residuals(found.used, table, model, values=values)
    edges = np.cumsum([len(window) for window in found.used])[:-1]
    tones = {}
    for sensor in SENSORS:
        parts = np.split(left[sensor], edges)
        fixed = _significant(of_stretches(sensor, _stretches(found.used, parts, None), None), 1 + len(table.joint_names))
        for tone in fixed.values():   # sampled at equal angles, a fixed frequency would be a multiple of some speeds
            for window, part in zip(found.used, parts):
                part[:, AXES.index(tone.axis)] = _without(tone.frequency, window.time, part[:, AXES.index(tone.axis)])
        turning = (tone for joint, name in enumerate(table.joint_names)
                   for tone in (*of_stretches(sensor, _stretches(found.used, parts, joint), name),
                                *_whole(sensor, found.used, parts, joint, name)))
        every = fixed | _significant(turning, 1 + len(table.joint_names))
        tones[sensor] = tuple(sorted(every.values(), key=lambda tone: tone.p_value))
    return tones


def _significant(tones, tests):
    """Return (axis, joint) -> the most significant tone, its p-value times the number of tests and axes."""
    told, first = [replace(tone, p_value=tone.p_value * len(AXES) * tests) for tone in tones], {}
    for tone in sorted((tone for tone in told if tone.p_value < SIGNIFICANT), key=lambda tone: tone.p_value):
        first.setdefault((tone.axis, tone.joint), tone)
    return first


def _without(frequency, time, values):
    """Return values without the waves about a frequency, to the resolution of their duration."""
    waves = np.exp(2j * np.pi * np.outer(time - time[0], frequency + 0.5 * np.arange(-2, 3) / np.ptp(time)))
    basis = np.linalg.qr(np.column_stack([waves.real, waves.imag]))[0]
    return values - basis @ (basis.T @ values)


def _whole(sensor, windows, parts, joint, name) -> Iterator[Tone]:
    """Yield the most significant Tone of each axis with a constant phase on a joint, if any."""
    orders = None if joint is None else orders_of(windows, parts, joint)
    if orders is None:
        return
    for axis in range(3):
        out = (orders.power[:, axis] > OUT) & (orders.share[:, axis] > MOST)
        if out.any():
            best = int(np.argmin(np.where(out, orders.p_value[:, axis], np.inf)))
            yield Tone(sensor, AXES[axis], name, float(orders.order[best]), float(orders.amplitude[best, axis]),
                       float(orders.p_value[best, axis] * len(orders.order)), float(orders.share[best, axis]), orders.order,
                       orders.power[:, axis])


def _stretches(windows: Sequence[Window], parts: Sequence[np.ndarray], joint: int | None) -> Iterator[tuple[np.ndarray, float, float]]:
    """Yield (rest at equal steps, shape (n, 3), step in seconds or turns, highest frequency) of stretches that can show a tone."""
    for _, window, rest in long_enough(windows, parts, with_joints=joint is not None):
        step = float(np.median(np.diff(window.time)))
        if joint is None:
            # Samples that are missing are few: a tone keeps its frequency but for the stretch that they are in.
            yield from ((piece, step, HIGHEST / step) for piece in _cut(rest, round(1 / (STEP * step))))
        elif _keeps_turning(window.motion.rate[:, joint]):
            turns = window.motion.position[:, joint] / (2 * np.pi)
            order = slice(None, None, int(np.sign(turns[-1] - turns[0])))
            even = np.arange(turns[order][0], turns[order][-1], 1 / PER_TURN)
            if len(even) < FEWEST_SAMPLES:
                continue
            taken = np.stack([np.interp(even, turns[order], axis[order]) for axis in rest.T], axis=1)
            fastest = float(np.abs(window.motion.rate[:, joint]).max()) * step / (2 * np.pi)
            yield from ((piece, 1 / PER_TURN, min(HIGHEST / fastest, HIGHEST * PER_TURN)) for piece in _cut(taken, round(PER_TURN / STEP)))


def _keeps_turning(rate):
    return rate.min() > SLOWEST or rate.max() < -SLOWEST


def _cut(rest, longest):
    """Return a rest in pieces of equal length, at most `longest`."""
    return np.array_split(rest, -(-len(rest) // longest))


def of_stretches(sensor: str, stretches: Iterable[tuple[np.ndarray, float, float]], joint: str | None) -> Iterator[Tone]:
    """Yield the most significant Tone of each axis, if any; its p-value counts frequencies only."""
    every = list(stretches)
    if not every:
        return
    grid = STEP * np.arange(round(1 / (STEP * every[0][1])) // 2 + 1)
    hits, ratios, plain, excess = np.zeros((4, len(grid), 3))
    count = np.zeros(len(grid), int)
    for rest, step, highest in every:
        inside = (grid * len(rest) * step >= LEAST_CYCLES) & (grid <= highest)
        power, around, inside = _powers(rest, round(1 / (STEP * every[0][1])), inside)
        at = np.flatnonzero(inside)
        count[at] += 1
        hits[at] += power[at] > CLEAR * around[at]
        ratios[at] += power[at] / around[at]
        plain[at] += power[at] / np.maximum(np.median(power, axis=0), 1e-300)
        excess[at] += np.maximum(power[at] - around[at], 0.0) * 4 / (2 / 3 * len(rest))   # of a line under a Hann window
    if not count.any():
        return
    chance = np.where(hits > MOSTLY * count[:, None], binom_sf(hits - 1, count[:, None], BY_CHANCE) * np.count_nonzero(count), 1.0)
    for axis in range(3):
        mean = ratios[:, axis] / np.maximum(count, 1)
        # The highest significant peak: the surroundings are known by octaves only.
        best = int(np.argmax(np.where(chance[:, axis] < SIGNIFICANT, plain[:, axis] / np.maximum(count, 1), -1.0)))
        if chance[best, axis] < SIGNIFICANT:
            yield Tone(sensor, AXES[axis], joint, float(grid[best]), float(np.sqrt(excess[best, axis] / count[best])),
                       float(chance[best, axis]),
                       float(hits[best, axis] / count[best]), grid[count > 0], mean[count > 0])


def _powers(rest, size, inside):
    """Return (power, power around it by octaves, both shape (n, 3), which frequencies have enough around them)."""
    window, line = np.hanning(len(rest)), np.linspace(-1.0, 1.0, len(rest))[:, None]
    level = rest - rest.mean(axis=0)
    level -= line * (line * level).sum(axis=0) / (line**2).sum()
    power = np.abs(np.fft.rfft(level * window[:, None], size, axis=0))**2 / (window**2).sum()
    around, inside = np.ones_like(power), inside.copy()
    octave = np.zeros(len(power), int)
    octave[1:] = np.log2(np.arange(1, len(power))).astype(int)
    for number in range(octave.max() + 1):
        rows = inside & (octave == number)
        if rows.sum() < 8:
            inside[rows] = False
        else:
            around[rows] = np.maximum(np.median(power[rows], axis=0) / np.log(2), 1e-300)
    return power, around, inside
