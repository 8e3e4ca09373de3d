"""Integer orders of a joint's turn: tones with a constant phase on the joint, in spins and in swings."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from imu_calibration.core.distributions import f_sf
from imu_calibration.preprocessing.window import Window

LOWEST, HIGHEST_ORDER = 4, 64
"""Orders under test; lower ones are formulas."""
PIECE_S = 2.0
"""Length of the pieces for comparison of phases, s."""
LEAST_CYCLES = 1.5
"""Of an order in a piece that can show it: less is a slope or a curve."""
LEAST_PIECES = 8
"""Least number of pieces for an estimate of the scatter."""
OUT = 10.0
"""Least power of an order over the median of all orders; residuals that repeat with the motion have all orders."""
IN_PHASE = 0.5
"""Cosine of the angle within which a window is in phase."""
MOST = 0.75
"""Share of the windows that must be, more than."""
SHORTEST_CYCLE = 2.2
"""Samples per cycle, at least."""
REPEATED = 1e-12
"""Least variance over the squared mean, and least determinant over the squared trace: less is rounding."""
FEWEST_SAMPLES = 16
"""Least number of samples of a window, or of equal steps of a turning joint, for a spectrum."""


@dataclass(frozen=True, eq=False)
class Orders:
    """Amplitudes of the orders of one joint in the three axes of a residual."""

    order: np.ndarray
    """Cycles per turn, shape (k,)."""
    amplitude: np.ndarray
    """Of the wave that keeps its phase, in the unit of the rest, shape (k, 3)."""
    p_value: np.ndarray
    """Probability by noise, with a random phase in every piece; shape (k, 3)."""
    power: np.ndarray
    """Squared amplitude over the median of all orders, shape (k, 3)."""
    share: np.ndarray
    """Share of the windows with a phase within 60 degrees of it, shape (k, 3)."""


def orders_of(windows: Sequence[Window], rests: Sequence[np.ndarray], joint: int) -> Orders | None:
    """
    Return the orders of a joint in a rest, or None where too little turns.

    The residual of each piece of two seconds, without terms linear in time or quadratic in the angle, is projected on exp(-i k angle). The
    pieces add coherently for tones fixed to the joint, in either direction; noise, hum and effects of the motion cancel.
    Over the scatter of the pieces this is Hotelling's T² with two degrees of freedom.

    Parameters
    ----------
    windows : sequence of Window
    rests : sequence of ndarray
        Rest of each window, shape (n, 3).
    joint : int

    """
    order = np.arange(LOWEST, HIGHEST_ORDER + 1)
    pieces = [(number, *_projected(rest, time, angle, order)) for number, rest, time, angle in _pieces(windows, rests, joint)]
    if not pieces:
        return None
    number, sums, weight = (np.stack(part) for part in zip(*pieces))   # (p,), (p, k, 3), (p, k)
    seen = weight > 0
    enough = seen.sum(axis=0) >= LEAST_PIECES
    if not enough.any():
        return None
    order, sums, weight, count = order[enough], sums[:, enough], weight[:, enough], seen.sum(axis=0)[enough]
    scaled = sums / np.sqrt(np.where(weight > 0, weight, np.inf))[..., None]
    parts = np.stack([scaled.real, scaled.imag], axis=-1)   # (p, k, 3, 2)
    mean = parts.sum(axis=0) / count[:, None, None]
    about = np.einsum('pkxi,pkxj->kxij', parts, parts) - count[:, None, None, None] * np.einsum('kxi,kxj->kxij', mean, mean)
    scatter = about / (count - 1)[:, None, None, None]
    spread = np.trace(scatter, axis1=-2, axis2=-1)
    known = (spread > REPEATED * (mean**2).sum(axis=-1)) & (np.linalg.det(scatter) > REPEATED * spread**2)   # repeated data have no scatter
    scatter[~known], mean[~known] = np.eye(2), 0.0
    t_squared = count[:, None] * np.einsum('kxi,kxi->kx', mean, np.linalg.solve(scatter, mean[..., None])[..., 0])
    degrees = (count - 2)[:, None]
    p_value = f_sf(t_squared * degrees / (2 * (count - 1)[:, None]), 2, degrees)
    wave = sums.sum(axis=0) / weight.sum(axis=0)[:, None]
    power = np.abs(wave)**2
    usual = np.maximum(np.median(power, axis=0), np.finfo(float).tiny)
    return Orders(order, 2 * np.abs(wave), p_value, power / usual, _alike(number, sums, weight, wave))


def _alike(number, sums, weight, wave):
    """Return the share of the windows in phase with a wave; effects of a motion have the same phase in all of its pieces only."""
    starts = np.flatnonzero(np.diff(number, prepend=-1))
    each, known = np.add.reduceat(sums, starts), np.add.reduceat(weight, starts) > 0
    in_phase = (each * wave.conj()).real > IN_PHASE * np.abs(each) * np.abs(wave)
    return (in_phase & known[..., None]).sum(axis=0) / known.sum(axis=0)[:, None]


def long_enough(windows: Sequence[Window], rests: Sequence[np.ndarray], *, with_joints: bool) -> Iterator[tuple[int, Window, np.ndarray]]:
    """Yield (number, window, rest) of the windows that have enough samples for a spectrum, optionally with the joints at each of them."""
    for place, (window, rest) in enumerate(zip(windows, rests)):
        if len(window) >= FEWEST_SAMPLES and (not with_joints or len(window.motion) == len(window)):
            yield place, window, rest


def _pieces(windows, rests, joint) -> Iterator[tuple[int, np.ndarray, np.ndarray, np.ndarray]]:
    """Yield (number of the window, rest, time, angle) of pieces of moving windows."""
    for place, window, rest in long_enough(windows, rests, with_joints=True):
        number = max(1, round((window.time[-1] - window.time[0]) / PIECE_S))
        yield from zip([place] * number, np.array_split(rest, number), np.array_split(window.time, number),
                       np.array_split(window.motion.position[:, joint], number))


def _projected(rest, time, angle, order):
    """Return (sum of the rest against each order, shape (k, 3), weight, shape (k,)); zero where a piece does not show an order."""
    turned = np.ptp(angle)
    shown = (turned * order > 2 * np.pi * LEAST_CYCLES) & (2 * np.pi > SHORTEST_CYCLE * order * np.abs(np.diff(angle)).max())
    sums, weight = np.zeros((len(order), 3), complex), np.zeros(len(order))
    if shown.any():
        middle = (angle - angle.mean()) / turned
        smooth = np.linalg.qr(np.column_stack([np.ones(len(time)), time - time.mean(), middle, middle**2]))[0]
        waves = np.exp(-1j * np.outer(angle, order[shown]))
        waves -= smooth @ (smooth.T @ waves)
        sums[shown], weight[shown] = waves.T @ rest, (np.abs(waves)**2).sum(axis=0)
    return sums, weight
