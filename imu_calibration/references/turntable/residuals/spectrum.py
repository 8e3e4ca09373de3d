"""Tones in the rest: at a fixed frequency, or at a fixed multiple of a joint's speed."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.core.distributions import binom_sf, f_sf
from imu_calibration.core.units import DEG, STANDARD_GRAVITY, for_people, significant
from imu_calibration.effects.base import AXES, SENSORS
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window
from imu_calibration.references.turntable.residuals.proposals import Proposal, with_formulas
from imu_calibration.references.turntable.residuals.residual_blocks import (
    BlockFits,
    ResidualBlocks,
    residuals,
    share_removed,
)
from imu_calibration.references.turntable.selection.investigation import Investigation

LOWEST_ORDER, HIGHEST_ORDER = 4, 64
"""Orders under test; lower ones are formulas."""
PIECE_S = 2.0
"""Length of the pieces for comparison of phases, s."""
CYCLES_OF_ORDER = 1.5
"""Of an order in a piece that can show it: less is a slope or a curve."""
MIN_SPECTRUM_PIECES = 8
"""Least number of pieces for an estimate of the scatter."""
OUT = 10.0
"""
Least power of an order over the median of all orders; residuals that repeat with the motion have
all orders.
"""
IN_PHASE = 0.5
"""Cosine of the angle within which a window is in phase."""
MIN_ORDER_SHARE = 0.75
"""Share of the windows that must be, more than."""
SHORTEST_CYCLE = 2.2
"""Samples per cycle, at least."""
ROUNDING_SHARE = 1e-12
"""
Least variance over the squared mean, and least determinant over the squared trace: less is
rounding.
"""
FEWEST_SAMPLES = 16
"""Least number of samples of a window, or of equal steps of a turning joint, for a spectrum."""


@dataclass(frozen=True, eq=False)
class Orders:
    """Amplitudes of the orders of one joint in the columns of a residual."""

    order: np.ndarray
    """Cycles per turn, shape (k,)."""
    amplitude: np.ndarray
    """Of the wave that keeps its phase, in the unit of the rest, shape (k, m)."""
    p_value: np.ndarray
    """Probability by noise, with a random phase in every piece; shape (k, m)."""
    power: np.ndarray
    """Squared amplitude over the median of all orders, shape (k, m)."""
    share: np.ndarray
    """Share of the windows with a phase within 60 degrees of it, shape (k, m)."""


def orders_of(windows: Sequence[Window], rests: Sequence[np.ndarray], joint: int) -> Orders | None:
    """
    Return the orders of a joint in a rest, or None where too little turns.

    The residual of each piece of two seconds, without terms linear in time or quadratic in the
    angle, is projected on exp(-i k angle). The pieces add coherently for tones fixed to the joint,
    in either direction; noise, hum and effects of the motion cancel. Over the scatter of the pieces
    this is Hotelling's T² with two degrees of freedom.

    Parameters
    ----------
    windows : sequence of Window
    rests : sequence of ndarray
        Rest of each window, shape (n, m).
    joint : int

    """
    # Projections of p pieces on k orders, in m columns.
    order = np.arange(LOWEST_ORDER, HIGHEST_ORDER + 1)
    windows_of_pieces = []
    sums_of_pieces = []
    weights_of_pieces = []
    for window, rest, time, angle in _pieces(windows, rests, joint):
        sums_of_piece, weight_of_piece = _projected(rest, time, angle, order)
        windows_of_pieces.append(window)
        sums_of_pieces.append(sums_of_piece)
        weights_of_pieces.append(weight_of_piece)
    if not windows_of_pieces:
        return None
    sums = np.stack(sums_of_pieces)  # (p, k, m)
    weight = np.stack(weights_of_pieces)  # (p, k)

    # Orders that enough pieces show.
    count = (weight > 0).sum(axis=0)
    enough = count >= MIN_SPECTRUM_PIECES
    if not enough.any():
        return None
    order = order[enough]
    sums = sums[:, enough]
    weight = weight[:, enough]
    count = count[enough]

    # T^2 = n mean' S^-1 mean, with mean and covariance S of real and imaginary part over n pieces.
    scaled = sums / np.sqrt(np.where(weight > 0, weight, np.inf))[..., None]
    parts = np.stack([scaled.real, scaled.imag], axis=-1)  # (p, k, m, 2)
    mean = parts.sum(axis=0) / count[:, None, None]
    squares = np.einsum('pkxi,pkxj->kxij', parts, parts)
    squares_of_mean = count[:, None, None, None] * np.einsum('kxi,kxj->kxij', mean, mean)
    covariance = (squares - squares_of_mean) / (count - 1)[:, None, None, None]
    # Repeated data have no scatter.
    trace = np.trace(covariance, axis1=-2, axis2=-1)
    known = trace > ROUNDING_SHARE * (mean**2).sum(axis=-1)
    known &= np.linalg.det(covariance) > ROUNDING_SHARE * trace**2
    covariance[~known] = np.eye(2)
    mean[~known] = 0.0
    whitened = np.linalg.solve(covariance, mean[..., None])[..., 0]
    t_squared = count[:, None] * np.einsum('kxi,kxi->kx', mean, whitened)

    # T^2 (n - 2) / (2 (n - 1)) follows F(2, n - 2).
    degrees = (count - 2)[:, None]
    p_value = f_sf(t_squared * degrees / (2 * (count - 1)[:, None]), 2, degrees)

    # The coherent wave, and its power over that of the other orders.
    wave = sums.sum(axis=0) / weight.sum(axis=0)[:, None]
    power = np.abs(wave) ** 2
    median_power = np.maximum(np.median(power, axis=0), np.finfo(float).tiny)
    share = _share_in_phase(np.array(windows_of_pieces), sums, weight, wave)
    return Orders(order, 2 * np.abs(wave), p_value, power / median_power, share)


def _share_in_phase(
    number: np.ndarray, sums: np.ndarray, weight: np.ndarray, wave: np.ndarray
) -> np.ndarray:
    """
    Return the share of the windows in phase with a wave.

    Effects of a motion have the same phase in all of its pieces only.
    """
    starts = np.flatnonzero(np.diff(number, prepend=-1))
    each = np.add.reduceat(sums, starts)
    known = np.add.reduceat(weight, starts) > 0
    in_phase = (each * wave.conj()).real > IN_PHASE * np.abs(each) * np.abs(wave)
    return (in_phase & known[..., None]).sum(axis=0) / known.sum(axis=0)[:, None]


def long_enough(
    windows: Sequence[Window], rests: Sequence[np.ndarray], *, with_joints: bool
) -> Iterator[tuple[int, Window, np.ndarray]]:
    """
    Yield (number, window, rest) of the windows that have enough samples.

    Enough means enough for a spectrum, and optionally the joints at each sample are given too.
    """
    for place, (window, rest) in enumerate(zip(windows, rests)):
        if len(window) >= FEWEST_SAMPLES and (not with_joints or len(window.motion) == len(window)):
            yield place, window, rest


def _pieces(
    windows: Sequence[Window], rests: Sequence[np.ndarray], joint: int
) -> Iterator[tuple[int, np.ndarray, np.ndarray, np.ndarray]]:
    """Yield (number of the window, rest, time, angle) of pieces of moving windows."""
    for place, window, rest in long_enough(windows, rests, with_joints=True):
        number = max(1, round((window.time[-1] - window.time[0]) / PIECE_S))
        yield from zip(
            [place] * number,
            np.array_split(rest, number),
            np.array_split(window.time, number),
            np.array_split(window.motion.position[:, joint], number),
        )


def _projected(
    rest: np.ndarray, time: np.ndarray, angle: np.ndarray, order: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (sum of the rest against each order, shape (k, m), weight, shape (k,)).

    Zero where a piece does not show an order.
    """
    # Enough cycles in the piece, and enough samples per cycle.
    turned = np.ptp(angle)
    largest_step = np.abs(np.diff(angle)).max()
    shown = turned * order > 2 * np.pi * CYCLES_OF_ORDER
    shown &= 2 * np.pi > SHORTEST_CYCLE * order * largest_step
    sums = np.zeros((len(order), rest.shape[1]), complex)
    weight = np.zeros(len(order))
    if shown.any():
        # Waves without terms linear in time and quadratic in the angle.
        centred = (angle - angle.mean()) / turned
        smooth_terms = [np.ones(len(time)), time - time.mean(), centred, centred**2]
        smooth, _ = np.linalg.qr(np.column_stack(smooth_terms))
        waves = np.exp(-1j * np.outer(angle, order[shown]))
        waves -= smooth @ (smooth.T @ waves)
        sums[shown] = waves.T @ rest
        weight[shown] = (np.abs(waves) ** 2).sum(axis=0)
    return sums, weight


FREQUENCY_STEP = 0.1
"""
Spacing of the frequencies under test, cycles per second or per turn; its inverse is the largest
length of a stretch.
"""
ANGLES_PER_TURN = 128
"""Angles per turn at which the residual of a turning joint is sampled."""
CYCLES_OF_TONE = 3.0
"""Of a tone in a stretch that can show it."""
MAX_ORDER_SHARE = 0.45
"""Highest order in that of the samples: interpolation to equal angles weakens higher ones."""
MIN_LINE_POWER, LINE_CHANCE = 4.0, 0.05
"""
Least power over its surroundings in a stretch, and its probability by noise: e^-4, and more where
few frequencies determine the surroundings.
"""
TONE_P_VALUE = 1e-4
"""Probability of a tone by noise, times the number of frequencies, axes and joints."""
MOSTLY = 0.5
"""Least share of the stretches with the tone; effects of the motion occur in some of them only."""
MIN_ORDER_RATE = 1.0 * DEG
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
    rested: bool = False
    """Whether the recording contains rest, so that a fixed frequency is independent of motion."""
    tilts: bool = False
    """Whether it is a tilt of the level frame, which turns the direction of gravity."""

    @property
    def text(self) -> str:
        """Description."""
        if self.tilts:
            angle, unit = for_people('rad')
            size = f'{significant(self.amplitude / STANDARD_GRAVITY * angle, 2)} {unit}'
            return (
                f'the level frame tilts with a period of {significant(1 / self.frequency)} s by'
                f' {size}, mostly on {self.sensor} {self.axis}: the floor or the table sways'
            )
        factor, unit = for_people('m/s^2' if self.sensor == SENSORS[0] else 'rad/s')
        where = f'on {self.sensor} {self.axis}, {significant(self.amplitude * factor, 2)} {unit}'
        if self.joint is None:
            cause = (
                'independent of motion: electrical, or a resonance'
                if self.rested
                else 'at a fixed frequency; whether motion causes it is open, because nothing rests'
            )
            return f'a tone of {self.frequency:.1f} Hz {where}, {cause}'
        return (
            f'{self.frequency:.1f} times per turn of {self.joint} {where}, at every speed: its'
            ' bearing, gear, motor or encoder'
        )

    def to_mapping(self) -> dict:
        """Return the tone as plain data."""
        return {
            'axis': self.axis,
            'joint': self.joint,
            'frequency': self.frequency,
            'amplitude': self.amplitude,
            'p_value': self.p_value,
            'share': self.share,
            'text': self.text,
        }


def find_tones(
    found: Investigation, table: Table, formulas: Sequence[Proposal] = ()
) -> dict[str, tuple[Tone, ...]]:
    """
    Return sensor -> the tones in the residual, the most significant first.

    The residual is that of the findings and of some formulas.

    The residual of every stretch of at most ten seconds, or of at most ten turns of a joint in
    steady rotation, is transformed to frequencies. A peak has four times the median power around
    it; a tone has peaks in most stretches, tested against noise (binomial law). Rests and motions
    are both analysed in seconds; a tone at a multiple of a speed is constant per turn and varies
    per second. Where few stretches turn, integer orders are searched in all motions of the joint
    (`orders_of`). Fixed frequencies are removed before multiples of a speed are searched.
    """
    model = found.problem.recording.model
    values = found.problem.values(found.named)[: len(model.param_names)]
    model, values = with_formulas(model, values, formulas)
    edges = np.cumsum([len(window) for window in found.used])[:-1]
    residual_of = {}  # sensor -> residual of each window
    for sensor, residual in residuals(found.used, table, model, values=values).items():
        residual_of[sensor] = np.split(residual, edges)
    tests = 1 + len(table.joint_names)

    # Fixed frequencies. They are removed, because sampled at equal angles a fixed frequency would
    # be a multiple of some speeds.
    tones = {}
    for sensor, of_windows in residual_of.items():
        stretches = _stretches(found.used, of_windows, None)
        tones[sensor] = _significant(of_stretches(sensor, stretches, None), tests)
        for tone in tones[sensor].values():
            axis = AXES.index(tone.axis)
            for window, residual in zip(found.used, of_windows):
                residual[:, axis] = _without(tone.frequency, window.time, residual[:, axis])

    # Multiples of the speed of each joint: in steady rotation, and in all motions.
    of_all_sensors = [np.concatenate(pair, axis=1) for pair in zip(*residual_of.values())]
    orders = [
        orders_of(found.used, of_all_sensors, joint) for joint in range(len(table.joint_names))
    ]
    for place, (sensor, of_windows) in enumerate(residual_of.items()):
        candidates: list[Tone] = []
        for joint, name in enumerate(table.joint_names):
            candidates += of_stretches(sensor, _stretches(found.used, of_windows, joint), name)
            candidates += _whole(sensor, orders[joint], name, place=place)
        tones[sensor] |= _significant(candidates, tests)

    rested = any(window.kind == 'static' for window in found.used)
    in_order = {}
    for sensor, of_sensor in tones.items():
        likeliest_first = sorted(of_sensor.values(), key=lambda tone: tone.p_value)
        in_order[sensor] = tuple(replace(tone, rested=rested) for tone in likeliest_first)
    return in_order


def _significant(tones: Iterable[Tone], tests: int) -> dict[tuple[str, str | None], Tone]:
    """
    Return (axis, joint) -> the most significant tone.

    Its p-value is multiplied by the number of tests and axes.
    """
    significant = []
    for tone in tones:
        corrected = replace(tone, p_value=tone.p_value * len(AXES) * tests)
        if corrected.p_value < TONE_P_VALUE:
            significant.append(corrected)
    first: dict[tuple[str, str | None], Tone] = {}
    for tone in sorted(significant, key=lambda tone: tone.p_value):
        first.setdefault((tone.axis, tone.joint), tone)
    return first


def _without(frequency: float, time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values without the waves about a frequency, to the resolution of their duration."""
    # Five frequencies, with a distance of half the resolution 1 / duration.
    frequencies = frequency + 0.5 * np.arange(-2, 3) / np.ptp(time)
    waves = np.exp(2j * np.pi * np.outer(time - time[0], frequencies))
    basis, _ = np.linalg.qr(np.column_stack([waves.real, waves.imag]))
    return values - basis @ (basis.T @ values)


def _whole(sensor: str, orders: Orders | None, joint: str, *, place: int) -> Iterator[Tone]:
    """
    Yield the most significant Tone of each axis with a constant phase on a joint, if any.

    From the orders of all sensors with readings, of which `sensor` has the number `place`.
    """
    if orders is None:
        return
    for axis in range(3):
        column = 3 * place + axis
        out = (orders.power[:, column] > OUT) & (orders.share[:, column] > MIN_ORDER_SHARE)
        if out.any():
            best = int(np.argmin(np.where(out, orders.p_value[:, column], np.inf)))
            yield Tone(
                sensor,
                AXES[axis],
                joint,
                float(orders.order[best]),
                float(orders.amplitude[best, column]),
                float(orders.p_value[best, column] * len(orders.order)),
                float(orders.share[best, column]),
                orders.order,
                orders.power[:, column],
            )


def _stretches(
    windows: Sequence[Window], parts: Sequence[np.ndarray], joint: int | None
) -> Iterator[tuple[np.ndarray, float, float]]:
    """
    Yield (rest, step, highest frequency) of stretches that can show a tone.

    The rest is at equal steps, shape (n, 3), and the step is in seconds or turns.
    """
    for _, window, rest in long_enough(windows, parts, with_joints=joint is not None):
        step = float(np.median(np.diff(window.time)))
        if joint is None:
            # Samples that are missing are few: a tone keeps its frequency but for the stretch that
            # they are in.
            # At half of the rate a wave is real: its power has one degree of freedom.
            highest = 0.5 / step - FREQUENCY_STEP
            yield from (
                (piece, step, highest) for piece in _cut(rest, round(1 / (FREQUENCY_STEP * step)))
            )
        elif (
            rate := window.motion.rate[:, joint]
        ).min() > MIN_ORDER_RATE or rate.max() < -MIN_ORDER_RATE:
            turns = window.motion.position[:, joint] / (2 * np.pi)
            order = slice(None, None, int(np.sign(turns[-1] - turns[0])))
            even = np.arange(turns[order][0], turns[order][-1], 1 / ANGLES_PER_TURN)
            if len(even) < FEWEST_SAMPLES:
                continue
            taken = np.stack(
                [np.interp(even, turns[order], axis[order]) for axis in rest.T], axis=1
            )
            fastest = float(np.abs(rate).max()) * step / (2 * np.pi)
            highest = min(MAX_ORDER_SHARE / fastest, MAX_ORDER_SHARE * ANGLES_PER_TURN)
            yield from (
                (piece, 1 / ANGLES_PER_TURN, highest)
                for piece in _cut(taken, round(ANGLES_PER_TURN / FREQUENCY_STEP))
            )


def _cut(rest: np.ndarray, longest: int) -> list[np.ndarray]:
    """Return a rest in pieces of equal length, at most `longest`."""
    return np.array_split(rest, -(-len(rest) // longest))


def of_stretches(
    sensor: str, stretches: Iterable[tuple[np.ndarray, float, float]], joint: str | None
) -> Iterator[Tone]:
    """Yield the most significant Tone of each axis, if any; its p-value counts frequencies only."""
    every = list(stretches)
    if not every:
        return
    grid = FREQUENCY_STEP * np.arange(round(1 / (FREQUENCY_STEP * every[0][1])) // 2 + 1)
    hits, ratios, plain, excess = np.zeros((4, len(grid), 3))
    count = np.zeros(len(grid), int)
    for rest, step, highest in every:
        inside = (grid * len(rest) * step >= CYCLES_OF_TONE) & (grid <= highest)
        power, around, inside = _powers(rest, round(1 / (FREQUENCY_STEP * every[0][1])), inside)
        at = np.flatnonzero(inside)
        count[at] += 1
        hits[at] += power[at] > MIN_LINE_POWER * around[at]
        ratios[at] += power[at] / around[at]
        plain[at] += power[at] / np.maximum(np.median(power, axis=0), 1e-300)
        # Of a line under a Hann window.
        excess[at] += np.maximum(power[at] - around[at], 0.0) * 4 / (2 / 3 * len(rest))
    if not count.any():
        return
    chance = np.where(
        hits > MOSTLY * count[:, None],
        binom_sf(hits - 1, count[:, None], LINE_CHANCE) * np.count_nonzero(count),
        1.0,
    )
    for axis in range(3):
        mean = ratios[:, axis] / np.maximum(count, 1)
        # The highest significant peak: the surroundings are known by octaves only.
        best = int(
            np.argmax(
                np.where(
                    chance[:, axis] < TONE_P_VALUE, plain[:, axis] / np.maximum(count, 1), -1.0
                )
            )
        )
        if chance[best, axis] < TONE_P_VALUE:
            yield Tone(
                sensor,
                AXES[axis],
                joint,
                float(grid[best]),
                float(np.sqrt(excess[best, axis] / count[best])),
                float(chance[best, axis]),
                float(hits[best, axis] / count[best]),
                grid[count > 0],
                mean[count > 0],
            )


def _powers(
    rest: np.ndarray, size: int, inside: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Return (power, power around it by octaves, mask of the frequencies).

    Both powers have shape (n, 3), and the mask marks the frequencies that have enough around them.
    """
    window = np.hanning(len(rest))
    line = np.linspace(-1.0, 1.0, len(rest))[:, None]
    level = rest - rest.mean(axis=0)
    level -= line * (line * level).sum(axis=0) / (line**2).sum()
    power = np.abs(np.fft.rfft(level * window[:, None], size, axis=0)) ** 2 / (window**2).sum()
    around = np.ones_like(power)
    inside = inside.copy()
    octave = np.zeros(len(power), int)
    octave[1:] = np.log2(np.arange(1, len(power))).astype(int)
    for number in range(octave.max() + 1):
        rows = inside & (octave == number)
        if rows.sum() < 8:
            inside[rows] = False
        else:
            around[rows] = np.maximum(np.median(power[rows], axis=0) / np.log(2), 1e-300)
    return power, around, inside


SWAY_CYCLES = 3.0
"""Least number of cycles of a sway in a recording."""
FASTEST_SWAY = 0.1
"""Highest frequency of a sway, Hz: at rest a window is one mean."""
SWAY_STEPS = 2.0
"""Frequencies under test, per inverse duration."""
SWAY_SHARE = 0.2
"""Least share of the excess that a sway removes from windows that were held out."""
LIKE_THE_JOINTS = 0.5
"""Share of a wave that the joints may follow: their motion has the same period then."""


def find_sway(blocks: ResidualBlocks, fits: BlockFits) -> Tone | None:
    """
    Return the periodic tilt of the level frame in the residual of the accelerometer, None without.

    A tilt by the small angle ``a(t)`` about horizontal axes changes the specific force at rest by
    ``a x g``, a horizontal vector of the level frame. Its components are ``A cos(2 pi f t) + B
    sin(2 pi f t)``; the frequency with the largest gain is tested by an F test, and on windows that
    were held out.
    """
    duration = float(np.ptp(blocks.time))
    frequencies = np.arange(SWAY_CYCLES / duration, FASTEST_SWAY, 1 / (SWAY_STEPS * duration))
    if not len(frequencies):
        return None
    ref = blocks.ref
    horizontal = np.moveaxis(ref.mat_sn[:, :, :2], 1, 2)  # (rows, two level axes, axes of s)
    waves = [np.exp(2j * np.pi * frequency * ref.time) for frequency in frequencies]
    columns = []
    for wave in waves:
        turned = wave[:, None, None] * horizontal
        columns.append(blocks.means(np.concatenate([turned.real, turned.imag], axis=1)))

    # Fall of the sum of squares by the four amplitudes of each frequency.
    count = columns[0].shape[1]
    every, residual = fits.outside_catalogue(np.concatenate(columns, axis=1))
    falls = []
    for place in range(len(frequencies)):
        basis = np.linalg.qr(every[:, place * count : (place + 1) * count])[0]
        falls.append(float(np.sum((basis.T @ residual) ** 2)))
    best = int(np.argmax(falls))
    own = slice(best * count, (best + 1) * count)
    total = float(residual @ residual)
    spare = len(residual) - 3 * max(design.shape[1] for design in blocks.design) - count
    if spare < len(residual) / 2:
        return None
    scatter = max(total - falls[best], 1e-300) / spare
    p_value = float(f_sf(falls[best] / count / scatter, count, spare)) * len(frequencies)
    if p_value > TONE_P_VALUE or _follows_joints(waves[best], ref.joint_angle):
        return None
    share = share_removed(fits.fit(), fits.fit(columns[best]))
    if share < SWAY_SHARE:
        return None

    values = np.linalg.lstsq(every[:, own], residual, rcond=None)[0]
    on_axes = np.sqrt(np.mean(np.einsum('bka,k->ba', columns[best], values) ** 2, axis=0))
    return Tone(
        blocks.sensor,
        AXES[int(np.argmax(on_axes))],
        None,
        float(frequencies[best]),
        float(np.linalg.norm(values)),
        p_value,
        share,
        frequencies,
        np.array(falls) / count / scatter,
        tilts=True,
    )


def _follows_joints(wave: np.ndarray, angles: np.ndarray | None) -> bool:
    """Return whether the joints move with the period of a wave."""
    if angles is None:
        return False
    design = np.column_stack([np.ones(len(wave)), angles, np.cos(angles), np.sin(angles)])
    target = np.column_stack([wave.real, wave.imag])
    target = target - target.mean(axis=0)
    left = target - design @ np.linalg.lstsq(design, target, rcond=None)[0]
    return bool(1 - np.sum(left**2) / np.sum(target**2) > LIKE_THE_JOINTS)
