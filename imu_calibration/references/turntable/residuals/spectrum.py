"""
Tones in the residual of every sample: at a fixed frequency, or a fixed number per turn of a joint.

Frequencies are in cycles per unit of a variable: seconds, or turns of a joint (then: orders).
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.core.distributions import binom_sf, f_sf
from imu_calibration.core.units import DEG, STANDARD_GRAVITY, for_people, significant
from imu_calibration.effects.base import AXES, SENSORS
from imu_calibration.preprocessing.window import Window
from imu_calibration.references.turntable.residuals.proposals import Proposal, with_formulas
from imu_calibration.references.turntable.residuals.residual_blocks import (
    BlockFits,
    BlockMeans,
    residuals,
    share_removed,
)
from imu_calibration.references.turntable.selection.investigation import Investigation

LOWEST_ORDER, HIGHEST_ORDER = 4, 64
"""Orders under test; lower ones are formulas."""
PIECE_S = 2.0
"""Length of the pieces for comparison of phases, s."""
CYCLES_OF_ORDER = 1.5
"""Cycles of an order in a piece, more than: fewer are a slope or a curve."""
MIN_SPECTRUM_PIECES = 8
"""Least number of pieces for an estimate of the scatter."""
LEAST_ORDER_POWER = 10.0
"""
Least power of an order over the median of all orders; residuals that repeat with the motion have
all orders.
"""
IN_PHASE = 0.5
"""Cosine of the largest phase difference at which a window is in phase with the wave: 60 deg."""
MIN_ORDER_SHARE = 0.75
"""Share of the windows in phase with an order, more than."""
SHORTEST_CYCLE = 2.2
"""Samples per cycle of an order, more than."""
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
    """Amplitude of the wave with a constant phase, in the unit of the residual, shape (k, m)."""
    p_value: np.ndarray
    """Probability by noise, with a random phase in every piece; shape (k, m)."""
    power: np.ndarray
    """Squared amplitude over the median of all orders, shape (k, m)."""
    share: np.ndarray
    """Share of the windows with a phase within 60 deg of that of the wave, shape (k, m)."""


def orders_of(
    windows: Sequence[Window], residuals_of_windows: Sequence[np.ndarray], joint: int
) -> Orders | None:
    """
    Return the orders of a joint in a residual, or None where too little turns.

    The residual of each piece of two seconds, without terms linear in time or quadratic in the
    angle, is projected on exp(-i k angle). The pieces add coherently for tones fixed to the joint,
    in either direction; noise, hum and effects of the motion cancel. Over the scatter of the pieces
    this is Hotelling's T² with two degrees of freedom.

    Parameters
    ----------
    windows : sequence of Window
    residuals_of_windows : sequence of ndarray
        Residual of each window, shape (n, m).
    joint : int

    """
    # Projections of p pieces on k orders, in m columns.
    order = np.arange(LOWEST_ORDER, HIGHEST_ORDER + 1)
    pieces = list(_pieces(windows, residuals_of_windows, joint))
    if not pieces:
        return None
    projected = [_projected(piece, order) for piece in pieces]
    sums = np.stack([projections for projections, _ in projected])  # (p, k, m)
    weight = np.stack([weights for _, weights in projected])  # (p, k)

    # Orders that enough pieces show.
    count = (weight > 0).sum(axis=0)
    enough = count >= MIN_SPECTRUM_PIECES
    if not enough.any():
        return None
    order = order[enough]
    sums = sums[:, enough]
    weight = weight[:, enough]
    count = count[enough]

    # The coherent wave, and its power over that of the other orders.
    wave = sums.sum(axis=0) / weight.sum(axis=0)[:, None]
    power = np.abs(wave) ** 2
    median_power = np.maximum(np.median(power, axis=0), np.finfo(float).tiny)
    share = _share_in_phase(np.array([piece.window for piece in pieces]), sums, weight, wave)
    p_value = _random_phase_p_value(sums, weight, count)
    return Orders(order, 2 * np.abs(wave), p_value, power / median_power, share)


def _random_phase_p_value(sums: np.ndarray, weight: np.ndarray, count: np.ndarray) -> np.ndarray:
    """
    Return the probability of a coherent wave by pieces with random phases, shape (k, m).

    Hotelling's T^2 of the real and imaginary parts over the n pieces that show an order::

        T^2 = n mean' S^-1 mean,    T^2 (n - 2) / (2 (n - 1)) ~ F(2, n - 2)

    Parameters
    ----------
    sums, weight
        As for `_share_in_phase`.
    count : ndarray, shape (k,)
        Number n of the pieces that show each order.

    """
    scaled = sums / np.sqrt(np.where(weight > 0, weight, np.inf))[..., None]
    parts = np.stack([scaled.real, scaled.imag], axis=-1)  # (p, k, m, 2)
    mean = parts.sum(axis=0) / count[:, None, None]
    squares = np.einsum('pkxi,pkxj->kxij', parts, parts)
    squares_of_mean = count[:, None, None, None] * np.einsum('kxi,kxj->kxij', mean, mean)
    covariance = (squares - squares_of_mean) / (count - 1)[:, None, None, None]

    # Repeated data have no scatter, with which a mean could be compared: there T^2 is zero.
    trace = np.trace(covariance, axis1=-2, axis2=-1)
    has_scatter = trace > ROUNDING_SHARE * (mean**2).sum(axis=-1)
    has_scatter &= np.linalg.det(covariance) > ROUNDING_SHARE * trace**2
    covariance[~has_scatter] = np.eye(2)
    mean[~has_scatter] = 0.0
    whitened = np.linalg.solve(covariance, mean[..., None])[..., 0]
    t_squared = count[:, None] * np.einsum('kxi,kxi->kx', mean, whitened)
    dof = (count - 2)[:, None]
    return f_sf(t_squared * dof / (2 * (count - 1)[:, None]), 2, dof)


def _share_in_phase(
    window: np.ndarray, sums: np.ndarray, weight: np.ndarray, wave: np.ndarray
) -> np.ndarray:
    """
    Return the share of the windows in phase with a wave, shape (k, m).

    The phase of a window is that of its sum over pieces. An effect of the motion has the same phase
    in the pieces of one window, and another one in other windows.

    Parameters
    ----------
    window : ndarray, shape (p,)
        Number of the window of each piece, in order.
    sums : ndarray of complex, shape (p, k, m)
        Projections of the pieces on k orders (`_projected`).
    weight : ndarray, shape (p, k)
        Zero where a piece does not show an order.
    wave : ndarray of complex, shape (k, m)
        Mean over all pieces.

    """
    # Sums over the pieces of each window, which follow one another from its first piece on.
    starts = np.flatnonzero(np.diff(window, prepend=-1))
    sums_of_windows = np.add.reduceat(sums, starts)
    known = np.add.reduceat(weight, starts) > 0
    # Re(s conj(w)) = |s| |w| cos(phase difference).
    projection = (sums_of_windows * wave.conj()).real
    in_phase = projection > IN_PHASE * np.abs(sums_of_windows) * np.abs(wave)
    return (in_phase & known[..., None]).sum(axis=0) / known.sum(axis=0)[:, None]


@dataclass(frozen=True, eq=False)
class _Piece:
    """About two seconds of a moving window, n samples."""

    window: int
    """Number of the window."""
    residual: np.ndarray
    """Shape (n, m)."""
    time: np.ndarray
    """Time of each sample, s, shape (n,)."""
    angle: np.ndarray
    """Angle of the joint, rad, shape (n,)."""


def _pieces(
    windows: Sequence[Window], residuals_of_windows: Sequence[np.ndarray], joint: int
) -> Iterator[_Piece]:
    """Yield the pieces of the windows with enough samples and the joints at each of them."""
    for number, (window, residual) in enumerate(zip(windows, residuals_of_windows)):
        if len(window) < FEWEST_SAMPLES or len(window.motion) != len(window):
            continue
        n_pieces = max(1, round((window.time[-1] - window.time[0]) / PIECE_S))
        residuals_of_pieces = np.array_split(residual, n_pieces)
        times = np.array_split(window.time, n_pieces)
        angles = np.array_split(window.motion.position[:, joint], n_pieces)
        for k in range(n_pieces):
            yield _Piece(number, residuals_of_pieces[k], times[k], angles[k])


def _projected(piece: _Piece, order: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the projections of a piece on k orders, shape (k, m), and their weights, shape (k,).

    With the residual r and the waves u, of which terms linear in time and quadratic in the angle
    are removed; both are zero for an order that the piece does not show::

        u = exp(-i order angle),    projection = u . r,    weight = |u|^2

    """
    residual = piece.residual
    time = piece.time
    angle = piece.angle

    # Enough cycles in the piece, and enough samples per cycle.
    turned = np.ptp(angle)
    largest_step = np.abs(np.diff(angle)).max()
    shown = turned * order > 2 * np.pi * CYCLES_OF_ORDER
    shown &= 2 * np.pi > SHORTEST_CYCLE * order * largest_step
    projections = np.zeros((len(order), residual.shape[1]), complex)
    weight = np.zeros(len(order))
    if shown.any():
        # Waves without terms linear in time and quadratic in the angle.
        centred = (angle - angle.mean()) / turned
        smooth_terms = [np.ones(len(time)), time - time.mean(), centred, centred**2]
        smooth, _ = np.linalg.qr(np.column_stack(smooth_terms))
        waves = np.exp(-1j * np.outer(angle, order[shown]))
        waves -= smooth @ (smooth.T @ waves)
        projections[shown] = waves.T @ residual
        weight[shown] = (np.abs(waves) ** 2).sum(axis=0)
    return projections, weight


FREQUENCY_STEP = 0.1
"""
Spacing of the frequencies under test, cycles per second or per turn; its inverse is the largest
length of a stretch.
"""
ANGLES_PER_TURN = 128
"""Angles per turn at which the residual of a turning joint is sampled."""
CYCLES_OF_TONE = 3.0
"""Cycles of a tone in a stretch, at least."""
MAX_ORDER_SHARE = 0.45
"""
Highest order over the samples per turn: interpolation to equal angles weakens higher ones.
"""
MIN_LINE_POWER = 4.0
"""Least power of a peak over the power around it, in a stretch."""
LINE_CHANCE = 0.05
"""
Probability of such a peak by noise: e^-4, and more where few frequencies determine the power around
it.
"""
FEWEST_AROUND = 8
"""Least number of frequencies of an octave from which the power around a peak is estimated."""
TONE_P_VALUE = 1e-4
"""Probability of a tone by noise, times the number of frequencies, axes and joints."""
MIN_TONE_SHARE = 0.5
"""
Share of the stretches with the tone, more than; effects of the motion occur in some of them only.
"""
MIN_ORDER_RATE = 1.0 * DEG
"""A joint that turns slower at times has no orders, rad/s."""


@dataclass(frozen=True, eq=False)
class Tone:
    """One line in the spectrum of a sensor's residual."""

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
    """Mean power of the axis at these frequencies, over the power around each, shape (n,)."""
    rested: bool = False
    """Whether the recording contains rest, so that a fixed frequency is independent of motion."""
    tilts: bool = False
    """Whether the tone is a tilt of the level frame, which turns the direction of gravity."""

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
    investigation: Investigation, formulas: Sequence[Proposal] = ()
) -> dict[str, tuple[Tone, ...]]:
    """
    Return sensor -> the tones in the residual, the most significant first.

    The model contains the findings and some formulas. The residual of every stretch of at most ten
    seconds, or of at most ten turns of a joint in steady rotation, is transformed to frequencies. A
    peak has four times the median power around it; a tone has peaks in most stretches, tested
    against noise (binomial law). Rests and motions are both analysed in seconds; a tone at a
    multiple of a speed is constant per turn and varies per second. Where few stretches turn,
    integer orders are searched in all motions of the joint (`orders_of`). Fixed frequencies are
    removed before multiples of a speed are searched.
    """
    model = investigation.problem.recording.model
    values = investigation.problem.values(investigation.named)[: len(model.param_names)]
    model, values = with_formulas(model, values, formulas)
    table = investigation.table
    windows = investigation.used
    edges = np.cumsum([len(window) for window in windows])[:-1]
    residual_of = {}  # sensor -> residual of each window
    for sensor, residual in residuals(windows, table, model, values=values).items():
        residual_of[sensor] = np.split(residual, edges)
    n_tests = 1 + len(table.joint_names)

    # Fixed frequencies. They are removed, because sampled at equal angles a fixed frequency would
    # be a multiple of some speeds.
    tones = {}
    for sensor, of_windows in residual_of.items():
        stretches = _stretches_of_time(windows, of_windows)
        tones[sensor] = _significant(of_stretches(sensor, stretches, joint=None), n_tests)
        for tone in tones[sensor].values():
            axis = AXES.index(tone.axis)
            for window, residual in zip(windows, of_windows):
                residual[:, axis] = _without(tone.frequency, window.time, residual[:, axis])

    # Multiples of the speed of each joint: in steady rotation, and in all motions.
    of_all_sensors = [np.concatenate(pair, axis=1) for pair in zip(*residual_of.values())]
    orders = [orders_of(windows, of_all_sensors, joint) for joint in range(len(table.joint_names))]
    for place, (sensor, of_windows) in enumerate(residual_of.items()):
        candidates: list[Tone] = []
        for joint, name in enumerate(table.joint_names):
            stretches = _stretches_of_turns(windows, of_windows, joint)
            candidates += of_stretches(sensor, stretches, name)
            candidates += _tones_of_orders(sensor, orders[joint], name, place=place)
        tones[sensor] |= _significant(candidates, n_tests)

    rested = any(window.kind == 'static' for window in windows)
    in_order = {}
    for sensor, of_sensor in tones.items():
        likeliest_first = sorted(of_sensor.values(), key=lambda tone: tone.p_value)
        in_order[sensor] = tuple(replace(tone, rested=rested) for tone in likeliest_first)
    return in_order


def _significant(tones: Iterable[Tone], n_tests: int) -> dict[tuple[str, str | None], Tone]:
    """
    Return (axis, joint) -> the most significant tone, of the tones that noise does not explain.

    Their p-values, multiplied by the numbers of tests and axes, are below `TONE_P_VALUE`.
    """
    significant = []
    for tone in tones:
        corrected = replace(tone, p_value=tone.p_value * len(AXES) * n_tests)
        if corrected.p_value < TONE_P_VALUE:
            significant.append(corrected)
    first: dict[tuple[str, str | None], Tone] = {}
    for tone in sorted(significant, key=lambda tone: tone.p_value):
        first.setdefault((tone.axis, tone.joint), tone)
    return first


def _without(frequency: float, time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """
    Return values of one axis, shape (n,), without the waves about a frequency.

    The waves are those that the duration does not resolve from the frequency, Hz.
    """
    # Five frequencies, with a distance of half the resolution 1 / duration.
    frequencies = frequency + 0.5 * np.arange(-2, 3) / np.ptp(time)
    waves = np.exp(2j * np.pi * np.outer(time - time[0], frequencies))
    basis, _ = np.linalg.qr(np.column_stack([waves.real, waves.imag]))
    return values - basis @ (basis.T @ values)


def _tones_of_orders(
    sensor: str, orders: Orders | None, joint: str, *, place: int
) -> Iterator[Tone]:
    """
    Yield the most significant Tone of each axis with a constant phase on a joint, if any.

    The columns of `orders` are the three axes of each sensor with readings, of which `sensor` has
    the number `place`.
    """
    if orders is None:
        return
    for axis in range(3):
        column = 3 * place + axis
        clear = orders.power[:, column] > LEAST_ORDER_POWER
        clear &= orders.share[:, column] > MIN_ORDER_SHARE
        if clear.any():
            best = int(np.argmin(np.where(clear, orders.p_value[:, column], np.inf)))
            yield Tone(
                sensor=sensor,
                axis=AXES[axis],
                joint=joint,
                frequency=float(orders.order[best]),
                amplitude=float(orders.amplitude[best, column]),
                p_value=float(orders.p_value[best, column] * len(orders.order)),
                share=float(orders.share[best, column]),
                frequencies=orders.order,
                power=orders.power[:, column],
            )


@dataclass(frozen=True, eq=False)
class EvenStretch:
    """A residual of n samples at equal steps of time, or of the angle of a joint."""

    residual: np.ndarray
    """Shape (n, 3)."""
    step: float
    """Seconds, or turns."""
    highest: float
    """Highest frequency that the samples show, per second or per turn."""


def _stretches_of_time(
    windows: Sequence[Window], residuals_of_windows: Sequence[np.ndarray]
) -> Iterator[EvenStretch]:
    """Yield stretches of at most ten seconds of the windows with enough samples."""
    for window, residual in zip(windows, residuals_of_windows):
        if len(window) < FEWEST_SAMPLES:
            continue
        # Few samples are missing: a tone keeps its frequency except in the stretch of the gap.
        step = float(np.median(np.diff(window.time)))
        # At half of the rate a wave is real: its power has one degree of freedom.
        highest = 0.5 / step - FREQUENCY_STEP
        for piece in _equal_pieces(residual, round(1 / (FREQUENCY_STEP * step))):
            yield EvenStretch(piece, step, highest)


def _stretches_of_turns(
    windows: Sequence[Window], residuals_of_windows: Sequence[np.ndarray], joint: int
) -> Iterator[EvenStretch]:
    """Yield stretches of at most ten turns of the windows in which a joint turns one way."""
    for window, residual in zip(windows, residuals_of_windows):
        if len(window) < FEWEST_SAMPLES or len(window.motion) != len(window):
            continue
        rate = window.motion.rate[:, joint]
        if rate.min() <= MIN_ORDER_RATE and rate.max() >= -MIN_ORDER_RATE:
            continue

        # Interpolated to equal steps of the angle, which has to increase: samples of a joint that
        # turns backwards are in reversed order.
        turns = window.motion.position[:, joint] / (2 * np.pi)
        upwards = slice(None, None, int(np.sign(turns[-1] - turns[0])))
        even_turns = np.arange(turns[upwards][0], turns[upwards][-1], 1 / ANGLES_PER_TURN)
        if len(even_turns) < FEWEST_SAMPLES:
            continue
        of_axes = [np.interp(even_turns, turns[upwards], axis[upwards]) for axis in residual.T]

        # Orders with enough samples per cycle: of the recording at the highest speed, and of the
        # equal steps.
        step = float(np.median(np.diff(window.time)))
        most_turns_per_sample = float(np.abs(rate).max()) * step / (2 * np.pi)
        highest = min(MAX_ORDER_SHARE / most_turns_per_sample, MAX_ORDER_SHARE * ANGLES_PER_TURN)
        longest = round(ANGLES_PER_TURN / FREQUENCY_STEP)
        for piece in _equal_pieces(np.stack(of_axes, axis=1), longest):
            yield EvenStretch(piece, 1 / ANGLES_PER_TURN, highest)


def _equal_pieces(residual: np.ndarray, longest: int) -> list[np.ndarray]:
    """Return a residual in the fewest pieces of equal length, of at most `longest` samples."""
    return np.array_split(residual, -(-len(residual) // longest))


def of_stretches(
    sensor: str, stretches: Iterable[EvenStretch], joint: str | None
) -> Iterator[Tone]:
    """
    Yield the most significant Tone of each axis, if any; its p-value counts frequencies only.

    A stretch has a peak at a frequency if the power P exceeds `MIN_LINE_POWER` times the power N
    around it. With h peaks in n stretches, the p-value of a frequency is the probability of at
    least h peaks by noise (binomial law), times the number of frequencies.
    """
    stretches = list(stretches)
    if not stretches:
        return
    # All stretches are padded to the longest that is possible, so that they share the frequencies.
    size = round(1 / (FREQUENCY_STEP * stretches[0].step))
    grid = FREQUENCY_STEP * np.arange(size // 2 + 1)
    # Sums over the stretches, for each frequency and axis.
    n_peaks = np.zeros((len(grid), 3))
    sum_of_ratios = np.zeros((len(grid), 3))  # P / N
    sum_of_heights = np.zeros((len(grid), 3))  # P over the median of all frequencies
    sum_of_excess = np.zeros((len(grid), 3))  # squared amplitude by P - N
    n_stretches = np.zeros(len(grid), int)
    for stretch in stretches:
        length = len(stretch.residual)
        shown = (grid * length * stretch.step >= CYCLES_OF_TONE) & (grid <= stretch.highest)
        spectrum = _spectrum(stretch.residual, size, shown)
        at = np.flatnonzero(spectrum.shown)
        power = spectrum.power[at]
        around = spectrum.around[at]
        n_stretches[at] += 1
        n_peaks[at] += power > MIN_LINE_POWER * around
        sum_of_ratios[at] += power / around
        sum_of_heights[at] += power / np.maximum(np.median(spectrum.power, axis=0), 1e-300)
        # A line of amplitude A has the power A^2 (2 / 3) n / 4 under a Hann window.
        sum_of_excess[at] += np.maximum(power - around, 0.0) * 4 / (2 / 3 * length)
    if not n_stretches.any():
        return
    # P-value of each frequency, 1 where too few stretches have a peak.
    chance = np.where(
        n_peaks > MIN_TONE_SHARE * n_stretches[:, None],
        binom_sf(n_peaks - 1, n_stretches[:, None], LINE_CHANCE) * np.count_nonzero(n_stretches),
        1.0,
    )
    for axis in range(3):
        mean_ratio = sum_of_ratios[:, axis] / np.maximum(n_stretches, 1)
        # The highest significant peak. Its height is over the median of all frequencies, because
        # the power around each is known by octaves only.
        mean_height = sum_of_heights[:, axis] / np.maximum(n_stretches, 1)
        significant_height = np.where(chance[:, axis] < TONE_P_VALUE, mean_height, -1.0)
        best = int(np.argmax(significant_height))
        if chance[best, axis] < TONE_P_VALUE:
            yield Tone(
                sensor=sensor,
                axis=AXES[axis],
                joint=joint,
                frequency=float(grid[best]),
                amplitude=float(np.sqrt(sum_of_excess[best, axis] / n_stretches[best])),
                p_value=float(chance[best, axis]),
                share=float(n_peaks[best, axis] / n_stretches[best]),
                frequencies=grid[n_stretches > 0],
                power=mean_ratio[n_stretches > 0],
            )


@dataclass(frozen=True, eq=False)
class _Spectrum:
    """Power spectrum of the three axes of a stretch at f frequencies."""

    power: np.ndarray
    """Shape (f, 3)."""
    around: np.ndarray
    """Mean power of noise in the octave of each frequency, by its median, shape (f, 3)."""
    shown: np.ndarray
    """Mask of the frequencies under test in an octave with enough of them, shape (f,)."""


def _spectrum(residual: np.ndarray, size: int, shown: np.ndarray) -> _Spectrum:
    """
    Return the spectrum of a stretch of n samples, shape (n, 3), with a Hann window.

    It has the `size` of the transform; `shown` (mask) are the frequencies under test.
    """
    # Without mean and slope.
    window = np.hanning(len(residual))
    line = np.linspace(-1.0, 1.0, len(residual))[:, None]
    level = residual - residual.mean(axis=0)
    level -= line * (line * level).sum(axis=0) / (line**2).sum()
    power = np.abs(np.fft.rfft(level * window[:, None], size, axis=0)) ** 2 / (window**2).sum()

    # The power of noise has an exponential distribution: its median is ln 2 times its mean.
    around = np.ones_like(power)
    shown = shown.copy()
    octave = np.zeros(len(power), int)
    octave[1:] = np.log2(np.arange(1, len(power))).astype(int)
    for number in range(octave.max() + 1):
        rows = shown & (octave == number)
        if rows.sum() < FEWEST_AROUND:
            shown[rows] = False
        else:
            around[rows] = np.maximum(np.median(power[rows], axis=0) / np.log(2), 1e-300)
    return _Spectrum(power, around, shown)


SWAY_CYCLES = 3.0
"""Least number of cycles of a sway in a recording."""
FASTEST_SWAY = 0.1
"""Highest frequency of a sway, Hz: at rest a window is one mean."""
SWAY_STEPS = 2.0
"""Frequencies under test in each interval of the resolution, 1 / duration."""
SWAY_SHARE = 0.2
"""Least share of the excess that a sway removes from windows that were held out."""
LIKE_THE_JOINTS = 0.5
"""Share of a wave explained by the joints, above which their motion has its period."""


def find_sway(blocks: BlockMeans, fits: BlockFits) -> Tone | None:
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
    columns = []  # of each frequency, shape (b, 4, 3): cosine, then sine, along two level axes
    for wave in waves:
        along_level_axes = wave[:, None, None] * horizontal
        cosine_and_sine = [along_level_axes.real, along_level_axes.imag]
        columns.append(blocks.means(np.concatenate(cosine_and_sine, axis=1)))

    # Fall of the sum of squares by the four amplitudes of each frequency.
    n_amplitudes = columns[0].shape[1]
    white_columns, residual = fits.outside_catalogue(np.concatenate(columns, axis=1))
    columns_of_waves = np.split(white_columns, len(frequencies), axis=1)
    falls = []
    for columns_of_wave in columns_of_waves:
        basis = np.linalg.qr(columns_of_wave)[0]
        falls.append(float(np.sum((basis.T @ residual) ** 2)))
    best = int(np.argmax(falls))

    # F test, with at least half of the blocks as degrees of freedom of the residual.
    squares = float(residual @ residual)
    n_columns = max(design.shape[1] for design in blocks.design)
    dof = len(residual) - 3 * n_columns - n_amplitudes
    if dof < len(residual) / 2:
        return None
    variance = max(squares - falls[best], 1e-300) / dof
    f_ratio = falls[best] / n_amplitudes / variance
    p_value = float(f_sf(f_ratio, n_amplitudes, dof)) * len(frequencies)
    # Where the joints move with that period, their errors can be the cause.
    if p_value > TONE_P_VALUE or _follows_joints(waves[best], ref.joint_angle):
        return None
    share = share_removed(fits.fit(), fits.fit(columns[best]))
    if share < SWAY_SHARE:
        return None

    amplitudes = np.linalg.lstsq(columns_of_waves[best], residual, rcond=None)[0]
    output = np.einsum('bka,k->ba', columns[best], amplitudes)
    rms_of_axes = np.sqrt(np.mean(output**2, axis=0))
    return Tone(
        sensor=blocks.sensor,
        axis=AXES[int(np.argmax(rms_of_axes))],
        joint=None,
        frequency=float(frequencies[best]),
        amplitude=float(np.linalg.norm(amplitudes)),
        p_value=p_value,
        share=share,
        frequencies=frequencies,
        power=np.array(falls) / n_amplitudes / variance,
        tilts=True,
    )


def _follows_joints(wave: np.ndarray, angles: np.ndarray | None) -> bool:
    """
    Return whether the joints move with the period of a wave, shape (n,), complex.

    That is: a constant and the angles of the joints, shape (n, n_joints), with their cosines and
    sines, explain more than `LIKE_THE_JOINTS` of its squares.
    """
    if angles is None:
        return False
    design = np.column_stack([np.ones(len(wave)), angles, np.cos(angles), np.sin(angles)])
    target = np.column_stack([wave.real, wave.imag])
    target = target - target.mean(axis=0)
    residual = target - design @ np.linalg.lstsq(design, target, rcond=None)[0]
    return bool(1 - np.sum(residual**2) / np.sum(target**2) > LIKE_THE_JOINTS)
