"""
A machine on the bench.

It runs at several speeds' loudness, shakes the sensor far above the output's band, and what is even
in an element rectifies it.
"""

import numpy as np

LOUDEST = 0.3
"""
What the machine leaves in the band of the output where it is loudest, root mean square of all axes,
m/s^2.
"""
LEVELS = (0.0, 0.35, 0.7, 1.0)
"""How loud it is, in terms of the loudest: off, and three gears."""
HOLDS = 8.0, 20.0
"""Each lasts between these times, s."""
RAMP = 0.3
"""Time constant with which it goes from one to the next, s."""
ABOVE = 2.25, 2.42
"""
Frequencies of its lines in terms of the sample rate: what passes is aliased to between a quarter
and two fifths of it.
"""
CORNER = 0.25
"""
The readout passes half of the power at this share of the sample rate, a tenth of the amplitude at
the lines.
"""
ROCKS = 0.01
"""
The bench rocks by so much angular rate for each m/s^2, a quarter of a turn behind, (rad/s)/(m/s^2).
"""


class Machine:
    """
    Lines of a machine whose speed wanders a little, along directions that are fixed in the room.
    """

    def __init__(self, duration, rate, rng, lines=3):
        self.frequency = rate * rng.uniform(*ABOVE, lines)
        self.passed = 1.0 / np.hypot(1.0, self.frequency / (CORNER * rate))
        along = rng.normal(size=(lines, 3)) + 1j * rng.normal(size=(lines, 3))
        self.along = along / np.linalg.norm(along * self.passed[:, None]) * np.sqrt(2.0) * LOUDEST
        self.phase, self.wander = rng.uniform(0.0, 2.0 * np.pi, lines), rng.uniform(3.0, 8.0, lines)
        self.changes = np.cumsum(rng.uniform(*HOLDS, int(duration / HOLDS[0]) + 1))
        self.gears = np.empty(len(self.changes) + 1, int)
        for k in range(len(self.gears)):
            self.gears[k] = rng.choice(
                [gear for gear in range(len(LEVELS)) if k == 0 or gear != self.gears[k - 1]]
            )

    def level(self, time):
        """Return how loud it is, shape (n,)."""
        levels = np.array(LEVELS)[self.gears]
        level = np.full(len(time), levels[0])
        for when, step in zip(self.changes, np.diff(levels)):
            level -= step * np.expm1(-np.maximum(time - when, 0.0) / RAMP)
        return level

    def shake(self, time, to_sensor, triads):
        """
        Return what comes onto the outputs of the two triads, each (n, 3).

        What passes the readout comes as it is, aliased; an element that answers to the square of
        what it feels gives its envelope, beats included: the readout passes no twice as fast lines.
        """
        level = self.level(time)
        felt = [
            to_sensor(np.tile(part, (len(time), 1)))
            for along in self.along
            for part in (along.real, along.imag)
        ]
        felt = [level[:, None] * (real + 1j * imag) for real, imag in zip(felt[::2], felt[1::2])]
        band, whole = np.zeros((2, len(time), 3), complex)
        for line, frequency, phase, wander, passed in zip(
            felt, self.frequency, self.phase, self.wander, self.passed
        ):
            line = (
                line
                * np.exp(1j * (2.0 * np.pi * frequency * time + phase + np.sin(time / wander)))[
                    :, None
                ]
            )
            band, whole = band + passed * line, whole + line
        accel, gyro = triads
        return (
            band.real @ accel.matrix.T + self._rectified(whole, accel),
            ROCKS * band.imag @ gyro.matrix.T + self._rectified(whole, gyro),
        )

    def _rectified(self, whole, triad):
        """
        Return the mean of what the elements answer to the square of the acceleration.

        `triad.rectifies` is in terms of what is left in the band.
        """
        if not np.any(triad.rectifies):
            return 0.0
        share = 0.5 * np.mean(self.passed**2)
        if np.ndim(triad.rectifies) == 1:
            axes = triad.matrix / np.linalg.norm(triad.matrix, axis=1, keepdims=True)
            return share * triad.rectifies * np.abs(whole @ axes.T) ** 2
        return share * np.abs(whole) ** 2 @ np.asarray(triad.rectifies).T
