"""
Worlds in which something changes at one moment, or the clock of the sensor runs away.

Each by its physics.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from worlds.physics_cause import Cause


class Clock(Cause):
    """
    Stamps by a clock of another rate, with a step after a share of the session.

    Or with a bend: its lag approaches another value within a sixth of the session.
    """

    def __init__(self, rate=0.0, step=0.0, share=0.6, bend=0.0):
        super().__init__()
        self.rate, self.step, self.share, self.bend = rate, step, share, bend

    def stamped(self, time, rng):
        """Return the lag of each stamp."""
        course = time / time[-1]
        step = self.step * (course > self.share)
        return self.rate * time + step + self.bend * np.tanh(8.0 * (course - self.share))


class LouderInMotion(Cause):
    """White noise of the gyroscope that has a larger standard deviation in motion, rad/s."""

    def __init__(self, sd):
        super().__init__()
        self.sd = sd

    def delivered(self, time, outputs, rate_s):
        """Add the noise of the motion."""
        moving = np.linalg.norm(rate_s, axis=1, keepdims=True) > 0.02
        noise = np.random.default_rng(11).normal(0.0, self.sd, outputs[1].shape)
        return [outputs[0], outputs[1] + moving * noise]


class LouderWithSpeed(Cause):
    """White noise of both sensors in proportion to the speed up to 1 rad/s, m/s^2 and rad/s."""

    def __init__(self, sd):
        super().__init__()
        self.sd = sd

    def delivered(self, time, outputs, rate_s):
        """Add the noise of the motion."""
        rng = np.random.default_rng(12)
        speed = np.minimum(np.linalg.norm(rate_s, axis=1, keepdims=True), 1.0)
        return [
            output + sd * speed * rng.normal(size=output.shape)
            for output, sd in zip(outputs, self.sd, strict=True)
        ]


class Moment(Cause):
    """
    After a share of the session the sensor or the table changes.

    Then the axes x and y are exchanged ('axes'), the sensor is turned by `turn` ('mount', 'creep':
    gradually), a joint slips ('belt'), or a shock changes the biases by `shock` ('shock').
    """

    def __init__(
        self, kind, share=0.55, turn=(0.01, -0.006, 0.008), joint=1, slip=0.03, shock=(None, None)
    ):
        super().__init__()
        self.kind, self.share, self.turn, self.joint, self.slip = (
            kind,
            share,
            np.array(turn),
            joint,
            slip,
        )
        self.shock = shock

    def delivered(self, time, outputs, rate_s):
        """Exchange the axes of the accelerometer, or add the change of the biases."""
        if self.kind == 'shock':
            after = (time > self.share * time[-1])[:, None]
            return [output + after * np.array(step) for output, step in zip(outputs, self.shock)]
        if self.kind != 'axes':
            return outputs
        return [
            np.where((time > self.share * time[-1])[:, None], outputs[0][:, [1, 0, 2]], outputs[0]),
            outputs[1],
        ]

    def carried(self, time, force_s, rate_s, alpha_s):
        """Turn the sensor on its mount."""
        if self.kind not in ('mount', 'creep'):
            return force_s, rate_s
        course = (
            time > self.share * time[-1]
            if self.kind == 'mount'
            else np.clip((time / time[-1] - 0.3) / 0.4, 0.0, 1.0)
        )
        turned = Rotation.from_rotvec(np.outer(course, self.turn)).inv()
        return turned.apply(force_s), turned.apply(rate_s)

    def encoder_error(self, time, motion):
        """Let the belt of a joint slip."""
        error = np.zeros_like(motion.position)
        error[:, self.joint] = self.slip * (time > self.share * time[-1]) * (self.kind == 'belt')
        return error, np.zeros_like(error)


class Wander(Cause):
    """Biases that walk at random: `sd` of each sensor at the end, m/s^2 and rad/s."""

    def __init__(self, sd, seed=3):
        super().__init__()
        self.sd, self.seed = sd, seed

    def delivered(self, time, outputs, rate_s):
        """Add the walk."""
        rng = np.random.default_rng(self.seed)
        share = np.sqrt(np.diff(time, prepend=time[0]) / (time[-1] - time[0]))[:, None]
        return [
            output + sd * np.cumsum(share * rng.normal(size=output.shape), axis=0)
            for output, sd in zip(outputs, self.sd)
        ]
