"""
Causes that no catalogue holds, each by its physics.

What comes onto a sensor's output, whatever columns the search may try.
"""

from dataclasses import dataclass

import numpy as np

from worlds.physics_cause import Cause
from worlds.physics_draw import DEG, MG

SIZE = {'accelerometer': 2 * MG, 'gyroscope': 0.06 * DEG}
"""Rms of a cause over the session, where it acts everywhere."""


@dataclass(frozen=True)
class Kind:
    """One kind of cause."""

    sensor: str
    """Whose output it enters."""
    family: frozenset | None
    """
    Quantities that a right formula speaks of; None where no formula is right, since it is a matter
    of place.
    """
    signal: object
    """``signal(scene, rng) -> (n,)``: how it goes, up to its size."""
    place: str = ''
    """What it goes by where it acts in some places only: beginning of a regime's variable."""


class Scene:
    """What a cause may go by."""

    def __init__(self, world, temperature_c, force_s, rate_s, alpha_s, other):
        self.other = other  # an axis that is not the one the cause acts on
        self.time, self.angle, self.world = world.time, world.joints, world
        self.force, self.rate, self.alpha = force_s, rate_s, alpha_s
        self.turn = np.gradient(world.joints, world.time, axis=0)
        self.warm = temperature_c - 25.0
        self.warming = np.gradient(temperature_c, world.time) > 0


def _axis(rng):
    return int(rng.integers(3))


def _arc(angle, rng):
    """
    Return a smooth bump over an arc of 60 degrees of a joint.

    It is about an angle at which the session is often.
    """
    middle = rng.choice(angle[:: max(1, len(angle) // 200)])
    return np.exp(-0.5 * (np.angle(np.exp(1j * (angle - middle))) / (10 * DEG)) ** 2)


def _approach(scene, rng):
    """
    Return +-1: on which flank of its gears a joint came to lie, which shifts the load of the mount.
    """
    turn = scene.turn[:, int(rng.integers(scene.turn.shape[1]))]
    side, moving = np.sign(turn), np.abs(turn) > 0.5 * DEG
    place = np.maximum.accumulate(np.where(moving, np.arange(len(turn)), 0))
    return np.where(side[place] > 0, 1.0, 0.0)


def _power(which, power):
    return lambda scene, rng: getattr(scene, which)[:, _axis(rng)] ** power


def _fast(scene, rng):
    """Return what a resonance adds beyond a speed: nothing below."""
    speed = np.linalg.norm(scene.rate, axis=1)
    return np.maximum(speed - np.quantile(speed, 0.85), 0.0)


def _cogging(scene, rng):
    joint = int(rng.integers(scene.angle.shape[1]))
    return scene.turn[:, joint] * np.sin(
        int(rng.integers(3, 8)) * scene.angle[:, joint] + rng.uniform(0, 6)
    )


def _two_joints(scene, rng):
    orders = rng.integers(2, 6, 2)
    return np.sin(orders[0] * scene.angle[:, 0] + rng.uniform(0, 6)) * np.sin(
        orders[1] * scene.angle[:, 1] + rng.uniform(0, 6)
    )


def _settling(which):
    return lambda scene, rng: (
        -getattr(scene, which)[:, _axis(rng)]
        * np.expm1(-scene.time / rng.uniform(0.1, 0.4) / scene.time[-1])
    )


def _of(*names):
    return frozenset(names)


def _magnet(scene, rng):
    """Return the component along one axis of a field that stays with the room."""
    # Along the vertical it would be a response to gravity.
    field = np.append(rng.normal(size=2), 0.0)
    return scene.world.to_sensor(np.broadcast_to(field, scene.force.shape))


KINDS = {
    'warm_cross_axis_force': Kind(
        'accelerometer', _of('force', 'temperature'), lambda s, r: s.warm * s.force[:, s.other]
    ),
    'warm_cross_axis_rate': Kind(
        'gyroscope', _of('rate', 'temperature'), lambda s, r: s.warm * s.rate[:, s.other]
    ),
    'warm_g_sensitivity': Kind(
        'gyroscope', _of('force', 'temperature'), lambda s, r: s.warm * s.force[:, _axis(r)]
    ),
    'force_cubed_in_gyro': Kind('gyroscope', _of('force'), _power('force', 3)),
    'gyro_cubic': Kind('gyroscope', _of('rate'), _power('rate', 3)),
    'acceleration_under_load': Kind(
        'gyroscope',
        _of('angular acceleration', 'force'),
        lambda s, r: s.alpha[:, _axis(r)] * s.force[:, _axis(r)],
    ),
    'scale_under_load': Kind(
        'gyroscope', _of('force', 'rate'), lambda s, r: s.force[:, _axis(r)] * s.rate[:, _axis(r)]
    ),
    'coriolis_in_accelerometer': Kind(
        'accelerometer',
        _of('force', 'rate'),
        lambda s, r: s.force[:, _axis(r)] * s.rate[:, _axis(r)],
    ),
    'gyro_scale_settling': Kind('gyroscope', _of('rate', 'time'), _settling('rate')),
    'accel_scale_settling': Kind('accelerometer', _of('force', 'time'), _settling('force')),
    'motor_hum': Kind(
        'accelerometer',
        _of('joint rate'),
        lambda s, r: np.abs(s.turn[:, int(r.integers(s.turn.shape[1]))]),
    ),
    'bearing_drag': Kind(
        'gyroscope',
        _of('joint rate'),
        lambda s, r: np.tanh(s.turn[:, int(r.integers(s.turn.shape[1]))] / (0.2 * DEG)),
    ),
    'cogging': Kind('gyroscope', _of('joint angle', 'joint rate'), _cogging),
    'stray_field_accel': Kind('accelerometer', _of('joint angle'), _two_joints),
    'stray_field_gyro': Kind('gyroscope', _of('joint angle'), _two_joints),
    'field_of_the_room': Kind('gyroscope', _of('attitude'), _magnet),
    'cable_in_an_arc': Kind(
        'accelerometer',
        None,
        lambda s, r: _arc(s.angle[:, int(r.integers(s.angle.shape[1]))], r),
        'angle',
    ),
    'resonance_when_fast': Kind('gyroscope', None, _fast, 'speed'),
    'knock': Kind(
        'accelerometer',
        None,
        lambda s, r: (s.time > r.uniform(0.4, 0.85) * s.time[-1]) * 1.0,
        'time',
    ),
    'backlash': Kind('accelerometer', None, _approach, 'approach'),
    'sticks_when_warm': Kind(
        'gyroscope',
        None,
        lambda s, r: (s.warm > np.quantile(s.warm, r.uniform(0.4, 0.7))) * 1.0,
        'temperature',
    ),
}
"""Name -> Kind."""


class Beyond(Cause):
    """One cause of a kind, on one or all axes of its sensor."""

    def __init__(self, kind, seed, size=1.0):
        super().__init__(size)
        self.kind, self.seed = KINDS[kind], seed
        rng = np.random.default_rng([seed, 77])
        self.axis = int(rng.integers(3))

    def added(self, world, temperature_c, force_s, rate_s, alpha_s):
        """Return the cause on the axes of its sensor; it remembers itself."""
        scene = Scene(world, temperature_c, force_s, rate_s, alpha_s, (self.axis + 1) % 3)
        signal = self.kind.signal(scene, np.random.default_rng([self.seed, 78]))
        if signal.ndim == 1:
            signal = signal[:, None] * np.eye(3)[self.axis]
        self.signal = (
            self.size * SIZE[self.kind.sensor] * signal / np.sqrt((signal**2).sum(axis=1).mean())
        )
        self.time = world.time
        return (self.signal, 0.0) if self.kind.sensor == 'accelerometer' else (0.0, self.signal)

    @property
    def axes(self):
        """Axes that carry a tenth of it at least."""
        strength = np.sqrt((self.signal**2).mean(axis=0))
        return {axis for axis, s in zip('xyz', strength) if s > 0.3 * strength.max()}


class Machine(Cause):
    """
    A mains hum in accelerometer z, and teeth of the outer joint's gear that gyroscope x feels.

    `size` 1: 1 mg and 0.2 deg/s.
    """

    hum_hz, teeth = 23.7, 12.4

    def added(self, world, temperature_c, force_s, rate_s, alpha_s):
        """Return both: the hum drifts in phase, the teeth do not."""
        hum, mesh = np.zeros((2, len(world.time), 3))
        hum[:, 2] = MG * np.sin(2 * np.pi * self.hum_hz * world.time + np.sin(world.time / 20))
        mesh[:, 0] = 0.2 * DEG * np.sin(self.teeth * world.joints[:, 0])
        return self.size * hum, self.size * mesh
