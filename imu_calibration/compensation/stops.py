"""Detection of rest of an IMU on a robot: short blocks with constant means, in a stream of any length."""

from dataclasses import dataclass

import numpy as np

BLOCK = 0.25
"""s; means over it are steady at rest even where a motor shakes the robot."""
N_BLOCKS = 4
"""Blocks in a row that must agree, one second."""
MOST_RATE = 0.1
"""rad/s; larger than the rest reading of any gyroscope that is calibrated, so that a faster rotation is no rest."""
MOST_SHAKE = np.array([0.6] * 3 + [0.06] * 3)
"""Standard deviation within a block, m/s^2 and rad/s: above that of an idling engine, below that of driving over a floor."""
STEADY = np.array([0.05] * 3 + [3e-3] * 3)
"""Largest difference of block means in addition to noise, m/s^2 and rad/s: 0.3 degrees of tilt, 0.2 degrees per second."""
LONGEST = 30.0
"""s; a longer rest counts as several, so that a bias that drifts while the robot is parked is tracked."""
TIMES_NOISE = 6.0
"""Range of four means of noise, in their standard deviations: exceeded once in ten thousand times by three axes of two sensors."""


@dataclass(frozen=True, eq=False)
class Stop:
    """A rest of the IMU until now."""

    start: float
    """When it began, s."""
    end: float
    """The end of its last block, s."""
    n_samples: int
    """Samples in its later half."""
    mean: np.ndarray
    """Mean of specific force and rate over the later half, m/s^2 and rad/s, shape (6,): a slow stop settles in the earlier half."""
    others: np.ndarray
    """Mean of the further columns over the later half, shape (k,)."""
    shake_sd: np.ndarray
    """Standard deviation of the samples in the blocks of the later half, shape (6,)."""
    change: np.ndarray
    """Mean over the later half less that over the earlier half, shape (6,): bounds the error of `mean` while the motion decays."""

    @property
    def seconds(self) -> float:
        """Length, s."""
        return self.end - self.start


class StopDetector:
    """
    Processes readings in pieces of any length; the result does not depend on the division.

    A robot that rotates steadily at less than `MOST_RATE` about the vertical is not separable from one at rest.

    Parameters
    ----------
    noise_sd : ndarray, shape (6,)
        Standard deviation of a sample at rest, force then rate.

    """

    def __init__(self, noise_sd: np.ndarray):
        self._noise_sd = np.asarray(noise_sd, float)
        self._most_variance = (MOST_SHAKE + 4 * self._noise_sd)**2
        self._rest: np.ndarray = np.zeros((0, 1))
        self._blocks: list[tuple[float, float, int, np.ndarray, np.ndarray]] = []
        self._stand: list[tuple[float, float, int, np.ndarray, np.ndarray]] = []
        self._stop: Stop | None = None

    def push(self, rows: np.ndarray) -> Stop | None:
        """
        Process samples; return the stop that continues at their end, or None while the IMU moves.

        Parameters
        ----------
        rows : ndarray, shape (n, 7 + k)
            Time in s, specific force, rate, and columns of which the means are wanted as well.

        """
        rows = np.concatenate([self._rest, rows]) if len(self._rest) else rows
        while len(rows) and rows[-1, 0] - rows[0, 0] >= BLOCK:
            n = max(int(np.searchsorted(rows[:, 0], rows[0, 0] + BLOCK)), 1)
            self._take(rows[:n])
            rows = rows[n:]
        self._rest = rows
        return self._stop

    def _take(self, rows):
        """Process one block, or restart after a gap."""
        if self._blocks and rows[0, 0] - self._blocks[-1][1] > BLOCK:
            self._blocks, self._stand = [], []
        block = (rows[0, 0], rows[-1, 0], len(rows), rows[:, 1:].mean(axis=0), rows[:, 1:7].var(axis=0))
        self._blocks = [*self._blocks[-N_BLOCKS + 1:], block]
        if not self._may_be_still(*block[3:]) or not self._is_still():
            self._stand = []
        elif self._stand and block[1] - self._stand[0][0] <= LONGEST:
            self._stand.append(block)
        else:
            self._stand = [block] if self._stand else list(self._blocks)
        self._stop = self._stop_of(self._stand) if self._stand else None

    def _may_be_still(self, mean, variance):
        """Return whether a block turns and shakes little enough by itself; most blocks of a robot that drives do not."""
        wx, wy, wz = mean[3:6].tolist()
        return wx * wx + wy * wy + wz * wz < MOST_RATE**2 and bool((variance <= self._most_variance).all())

    def _is_still(self):
        if len(self._blocks) < N_BLOCKS:
            return False
        means = np.array([mean[:6] for _, _, _, mean, _ in self._blocks])
        shake = np.sqrt(np.max([variance for *_, variance in self._blocks], axis=0))
        least = min(n for _, _, n, _, _ in self._blocks)
        apart = np.ptp(means, axis=0)
        # Vibration of the robot is noise for the means as well.
        allowed = STEADY + TIMES_NOISE * np.maximum(self._noise_sd, shake) / np.sqrt(least)
        return bool((apart <= allowed).all() and (shake**2 <= self._most_variance).all())

    @staticmethod
    def _stop_of(stand):
        half = len(stand) // 2
        (early, _, _), (late, shake, n) = (_mean_of(part) for part in (stand[:half] or stand, stand[half:]))
        return Stop(stand[0][0], stand[-1][1], n, late[:6], late[6:], shake, (late - early)[:6])


def _mean_of(blocks):
    """Return (mean, sd within blocks, samples) of blocks."""
    number = np.array([n for _, _, n, _, _ in blocks])
    share = number / number.sum()
    return share @ [mean for *_, mean, _ in blocks], np.sqrt(share @ [variance for *_, variance in blocks]), int(number.sum())
