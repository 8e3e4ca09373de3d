"""Is this IMU on this table? Whether the joints and the gyroscope tell the same motion, and if not, why."""

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from imu_calibration.preflight.finding import REFUSE, CheckFinding
from imu_calibration.reference.joint_motion import JointMotion
from imu_calibration.reference.kinematics import reference_motion
from imu_calibration.reference.table import Table
from imu_calibration.segmentation.window import Window

TURNS = 0.05
"""Smallest gain of the gyroscope against the table's rate from which on it turns with it at all."""
SAME = 0.5
"""Smallest share of the measured rates that the joints' rates explain, as a squared correlation."""
SURE = 0.8
"""An exchange of joints is named when it explains this share."""
LARGEST_SHIFT = 5.0
"""Delays between the streams are looked for up to this size, s."""
LEAST_SHIFT = 0.05
"""Smaller ones are left to the estimation, s."""
ALIKE = 0.02
"""Shares explained that differ by less do not tell a delay from a wrong sign."""
MOST_SAMPLES = 5_000
"""Samples of moving windows that are looked at for exchanged joints."""
LEAST_SAMPLES = 20
"""Of a window to be looked at."""
MOST_JOINTS = 3
"""Exchanged joints are looked for up to this number of them."""


def same_motion(moments: tuple, windows: list[Window], table: Table | None) -> CheckFinding | None:
    """
    Return why the gyroscope does not tell the motion of the joints, or None when it does.

    Told apart: an IMU that rests while the table turns, streams that are apart in time, exchanged joints and signs, and any other motion.

    Parameters
    ----------
    moments : tuple of three arrays (3, 3)
        Sums of products of rates: measured with reference, reference with itself, measured with itself.
    windows : list of Window
        Moving windows with their samples, as far as they are kept; without them fewer causes are told apart.
    table : Table, optional

    """
    cross, reference, measured = moments
    matrix = cross @ np.linalg.pinv(reference, rcond=0.01)
    gain = np.sqrt(np.trace(matrix @ reference @ matrix.T) / np.trace(reference))
    explained = np.trace(matrix @ reference @ matrix.T) / max(np.trace(measured), 1e-300)
    if explained >= SAME and gain > 0.1 * TURNS:   # units, signs and axes are looked at elsewhere
        return _a_period_late(windows, table) if table is not None and explained < 1.0 - ALIKE else None
    key, cause = 'imu_topic', 'this IMU does not turn when the table does; is it the right topic?'
    if np.trace(measured) > TURNS * np.trace(reference):
        cause, key = (_cause(windows, table) if table is not None else ''), None
    elif gain > TURNS:
        return None
    if not cause:
        key, cause = 'imu_topic', ('it turns otherwise than the table; is it the right topic, are these the joints of its table, '
                                   'and do both clocks agree?')
    return CheckFinding('on_table', REFUSE, 'the gyroscope must tell the motion of the joints, '
                        f'they explain {100 * min(explained, 1.0):.0f} % of its rates at a gain of {gain:.2g}: {cause}', key=key)


def _cause(windows, table):
    """Return what would make the streams agree, or ''."""
    windows = [window for window in windows if len(window) >= LEAST_SAMPLES]
    if not windows:
        return ''
    shift, share, unshifted = _best_shift(windows, table)
    if abs(shift) > LEAST_SHIFT and share > max(SAME, 1.5 * max(unshifted, 0.0)):
        return _late(shift)
    order, signs, share = _best_order(_some(windows), table)
    if share < SURE:
        return ''
    names = table.joint_names
    changes = [f'{names[k]} turns {"the other way round" if j == k else ("as " if sign > 0 else "against what ") + names[j] + " should"}'
               for k, (j, sign) in enumerate(zip(order, signs)) if k != j or sign < 0]
    return f'{", ".join(changes)}; correct names and axes in the table description, or the joint states'


def _a_period_late(windows, table):
    """Return the finding for streams that agree roughly, because the motion repeats, and plainly better a period earlier or later."""
    windows = [window for window in windows if len(window) >= LEAST_SAMPLES]
    if not windows:
        return None
    shift, share, unshifted = _best_shift(windows, table)
    # opposite rates: a wrong sign, or half a period
    if abs(shift) <= LEAST_SHIFT or unshifted < 0 or share < max(SURE, unshifted + ALIKE):
        return None
    return CheckFinding('on_table', REFUSE, 'both streams must tell the same time, '
                        f'the joints explain {100 * unshifted:.0f} % of the rates as stamped and '
                        f'{100 * share:.0f} % shifted: {_late(shift)}')


def _late(shift):
    side = 'behind' if shift > 0 else 'ahead of'
    return (f'the stamps of the IMU are about {abs(shift):.1f} s {side} those of the joints; '
            'set both clocks by one source, or stamp in the drivers')


@dataclass(frozen=True)
class Delay:
    """A delay between the streams that explains opposite rates."""

    words: str
    """The cause and what to do."""
    sure: bool
    """Whether it explains them plainly better than a wrong sign."""


def signs_or_delay(windows: list[Window], table: Table) -> Delay | None:
    """
    Return the delay that explains rates of the opposite sign, or None where a sign explains them better.

    A table that sweeps to and fro tells half a period of delay from a wrong sign only as far as its sweeps differ.

    Parameters
    ----------
    windows : list of Window
        Moving windows with their samples.
    table : Table

    """
    windows = [window for window in windows if len(window) >= LEAST_SAMPLES]
    if not windows:
        return None
    shift, share, unshifted = _best_shift(windows, table)
    if abs(shift) <= LEAST_SHIFT or share < SAME or share < -unshifted - ALIKE:
        return None
    return Delay(_late(shift), share > -unshifted + ALIKE)


def _some(windows):
    """Return moving windows up to MOST_SAMPLES, the first ones."""
    kept, total = [], 0
    for window in windows:
        if not kept or total + len(window) <= MOST_SAMPLES:
            kept.append(window)
            total += len(window)
    return kept


def _best_shift(windows, table):
    """
    Return by how much the IMU is late, s, the share of the rates that the joints then explain, and that without a delay.

    The last is negative where the rates are opposite.
    """
    period = float(np.median([window.period for window in windows]))
    start, end = windows[0].time[0], windows[-1].time[-1]
    felt, told = np.zeros((2, int((end - start) / period) + 2, 3))
    bias = np.median(np.concatenate([window.rate_s for window in windows]), axis=0)
    for window in windows:
        first = int(np.ceil((window.time[0] - start) / period))
        grid = start + period * np.arange(first, int((window.time[-1] - start) / period) + 1)
        for line, rate in ((felt, window.rate_s - bias), (told, reference_motion(table, window.motion).rate_s)):
            line[first:first + len(grid)] = np.stack([np.interp(grid, window.time, column) for column in rate.T], axis=1)
    felt, told = felt - felt.mean(axis=0), told - told.mean(axis=0)
    size = 1 << int(np.ceil(np.log2(2 * len(felt))))
    products = np.fft.irfft((np.fft.rfft(felt, size, axis=0) * np.conj(np.fft.rfft(told, size, axis=0))).sum(axis=1), size)
    most = min(int(LARGEST_SHIFT / period), len(felt) // 2)
    products = np.concatenate([products[-most:], products[:most + 1]])
    # what a shift moves out of the recording is made up for, so that long ones are judged like short ones
    products *= len(felt) / (len(felt) - np.abs(np.arange(-most, most + 1)))
    best = _nearest_peak(products, most)
    # what moved outside of the windows is missing: a lower bound
    share = products[[best, most]] * np.abs(products[[best, most]]) / max((felt**2).sum() * (told**2).sum(), 1e-300)
    return (best - most) * period, float(share[0]), float(share[1])


def _nearest_peak(products, middle):
    """Return the place of the peak nearest to no delay among those that are as good as the highest: what repeats has many."""
    inner = products[1:-1]
    peaks = 1 + np.flatnonzero((inner >= products[:-2]) & (inner >= products[2:]) & (inner >= (1.0 - ALIKE) * products.max()))
    return int(peaks[np.argmin(np.abs(peaks - middle))]) if len(peaks) else int(np.argmax(products))


def _best_order(windows, table):
    """Return (which joint's readings each joint needs, with which signs, share of the rates that it explains)."""
    n_joints = windows[0].motion.position.shape[1]
    identity, best = tuple(range(n_joints)), (0.0, None, None)
    if n_joints > MOST_JOINTS:
        return identity, (1.0,) * n_joints, 0.0
    measured = np.concatenate([window.rate_s for window in windows])
    measured = measured - np.median(measured, axis=0)
    for order, signs in product(permutations(identity), product((1.0, -1.0), repeat=n_joints)):
        told = np.concatenate([reference_motion(table, _exchanged(window.motion, order, signs)).rate_s for window in windows])
        share = 1.0 - ((measured - told)**2).sum() / max((measured**2).sum(), 1e-300)
        best = max(best, (share, order, signs), key=lambda found: found[0])
    return best[1] or identity, best[2] or (1.0,) * n_joints, best[0]


def _exchanged(motion, order, signs):
    parts = (getattr(motion, name)[:, list(order)] * np.array(signs) for name in ('position', 'rate', 'acceleration', 'jerk'))
    return JointMotion(motion.time, *parts)
