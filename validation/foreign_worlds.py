"""
Recordings of a three-axis table whose physics is written here alone.

Rotations, filters, play operators and clocks are its own.

Nothing of the package is imported. `make_world` returns stamps, readings, joint angles and the
truth about one hidden cause: its sensor, its axis, its place (a variable of the recording and a
mask) or the fact that it has none, and the names that describe it correctly. Twenty kinds of worlds
act at a place, twenty do not; a world without a cause is made with the kind 'nothing'.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.signal import bilinear, lfilter, lfilter_zi

RATE, FINE = 100, 8
"""Samples per second, and steps of the fine grid per sample."""
DEG, GRAVITY = np.pi / 180, 9.8093
LATITUDE, AZIMUTH, EARTH = 48.8, 20.0, 7.292115e-5
JOINTS = ('outer', 'middle', 'inner')
TABLE = {
    'joints': [
        {'name': name, 'axis': axis}
        for name, axis in zip(JOINTS, ([0, 0, 1], [0, 1, 0], [1, 0, 0]))
    ],
    'up': [0, 0, 1],
    'gravity': GRAVITY,
    'gravity_sd': 1e-5,
    'latitude': LATITUDE,
    'height': 150.0,
    'azimuth_deg': AZIMUTH,
    'mount': {'rpy_deg': [0, 0, 0], 'xyz': None},
}
"""Description of the table for the calibration."""
START_NS = 1_750_000_000_000_000_000
FORCE, TURN = 0.03, 0.12 * DEG
"""Sizes of a cause where it acts, m/s^2 and rad/s."""


@dataclass(eq=False)
class World:
    """One recording and its truth."""

    stamp_ns: np.ndarray
    force: np.ndarray
    rate: np.ndarray
    joint_ns: np.ndarray
    angle: np.ndarray
    temperature_ns: np.ndarray
    temperature_c: np.ndarray
    true_force: np.ndarray
    """At the stamps, in the sensor frame, m/s^2."""
    true_rate: np.ndarray
    time: np.ndarray
    sensor: str = ''
    axes: frozenset = frozenset()
    """Axes that carry the cause; empty: any."""
    place: tuple = ()
    """Beginnings of the names of variables that describe the place correctly; empty: no place."""
    inside: np.ndarray | None = None
    """Whether the cause acts at each sample."""
    names: frozenset = frozenset()
    """Effects of a catalogue that describe the cause correctly."""


@dataclass(eq=False)
class Scene:
    """The state on the fine grid, which causes may change."""

    time: np.ndarray
    angle: np.ndarray
    turn: np.ndarray
    """Joint rates, rad/s."""
    mat_sn: np.ndarray
    force: np.ndarray
    rate: np.ndarray
    warm: np.ndarray
    rng: np.random.Generator
    axis: int
    added_force: np.ndarray
    added_rate: np.ndarray
    seen_angle: np.ndarray
    clock: Callable[[np.ndarray], np.ndarray]
    """Function from true time to stamps, s."""
    thin: Callable[[int], tuple[np.ndarray, np.ndarray]] | None = None
    """Function from a number of samples to (kept samples, their stamps in samples)."""
    truth: dict = field(default_factory=dict)


def _blend(start, end, duration, step):
    share = np.arange(0.0, duration, step) / duration
    return start + (end - start) * (share**3 * (10 - 15 * share + 6 * share**2))[:, None]


def _motion(rng, step):
    """
    Return joint angles, rad, shape (n, 3).

    26 poses of 4 s, two spins of each joint, swings of two joints at a time.
    """
    here, parts = np.zeros(3), []
    poses = rng.permutation(
        [[o, m, i] for o in (0, 90) for m in (-90, -45, 0, 45, 90) for i in (0, 90, 180)]
    )[:26]
    plan = [('pose', pose + rng.uniform(-8, 8, 3)) for pose in poses]
    plan += [
        ('spin', (joint, sign * rng.uniform(50, 110))) for joint in range(3) for sign in (-1, 1)
    ]
    plan += [
        ('swing', (rng.permutation(3)[:2], rng.uniform(0.25, 0.9, 2), rng.uniform(10, 35, 2)))
        for _ in range(5)
    ]
    for number in rng.permutation(len(plan)):
        kind, what = plan[number]
        if kind == 'pose':
            goal = what * DEG
            parts.append(_blend(here, goal, max(1.0, np.abs(goal - here).max() / (70 * DEG)), step))
            parts.append(np.tile(goal, (round(4.0 / step), 1)))
        elif kind == 'spin':
            joint, speed = what
            time = np.arange(0.0, 9.0, step)
            ramp = np.clip(np.minimum(time, 9.0 - time), 0.0, 1.0)
            path = np.cumsum(3 * ramp**2 - 2 * ramp**3) * step * speed * DEG
            goal = here + path[-1] * np.eye(3)[joint]
            parts.append(here + path[:, None] * np.eye(3)[joint])
        else:
            time = np.arange(0.0, 12.0, step)
            taper = np.clip(np.minimum(time, 12.0 - time) / 2.0, 0.0, 1.0)
            taper = 3 * taper**2 - 2 * taper**3
            path = np.zeros((len(time), 3))
            for joint, hertz, size in zip(*what):
                path[:, joint] = size * DEG * taper * np.sin(2 * np.pi * hertz * time)
            goal = here
            parts.append(here + path)
        here = goal
        parts.append(np.tile(here, (round(1.5 / step), 1)))
    return np.concatenate(parts)


def _about(axis, angle):
    """Return rotations about a coordinate axis, shape (n, 3, 3)."""
    mats = np.zeros((len(angle), 3, 3))
    one, two = (axis + 1) % 3, (axis + 2) % 3
    mats[:, axis, axis] = 1.0
    mats[:, one, one] = mats[:, two, two] = np.cos(angle)
    mats[:, one, two], mats[:, two, one] = -np.sin(angle), np.sin(angle)
    return mats


def _inputs(angle, turn):
    """
    Return (n-to-s matrices, specific force in s, rate in s) of joint angles and rates.

    They are at the intersection of the axes.
    """
    outer, middle, inner = (_about(axis, angle[:, k]) for k, axis in enumerate((2, 1, 0)))
    mat_ns = outer @ middle @ inner
    mat_sn = mat_ns.transpose(0, 2, 1)
    latitude, azimuth = LATITUDE * DEG, AZIMUTH * DEG
    earth = EARTH * np.array(
        [np.cos(latitude) * np.cos(azimuth), np.cos(latitude) * np.sin(azimuth), np.sin(latitude)]
    )
    axes = np.stack(
        [np.tile([0.0, 0.0, 1.0], (len(angle), 1)), outer[:, :, 1], (outer @ middle)[:, :, 0]],
        axis=1,
    )
    rate_n = earth + (axes * turn[:, :, None]).sum(axis=1)
    return mat_sn, mat_sn @ [0.0, 0.0, GRAVITY], (mat_sn @ rate_n[:, :, None])[:, :, 0]


def least_squares(world: World) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """
    Return sensor -> (bias, matrix) by least squares.

    Each sample in the time of the joints has the same weight; the table is as described.
    """
    time = (world.stamp_ns - START_NS) / 1e9
    joint_time = (world.joint_ns - START_NS) / 1e9
    turn = np.gradient(world.angle, joint_time, axis=0)
    inside = (time > joint_time[1]) & (time < joint_time[-2])
    angle = np.stack([np.interp(time[inside], joint_time, part) for part in world.angle.T], axis=1)
    turn = np.stack([np.interp(time[inside], joint_time, part) for part in turn.T], axis=1)
    _, force, rate = _inputs(angle, turn)
    fits = {}
    for sensor, true, readings in (
        ('accelerometer', force, world.force),
        ('gyroscope', rate, world.rate),
    ):
        columns = np.column_stack([np.ones(len(true)), true])
        fit = np.linalg.lstsq(columns, readings[inside], rcond=None)[0]
        fits[sensor] = (fit[0], fit[1:].T)
    return fits


def make_world(kind: str, unit: int, motion: int) -> World:
    """
    Return a recording of a unit with a motion and noise of their own.

    The unit fixes instrument and cause.
    """
    own, rng = np.random.default_rng([unit, 1]), np.random.default_rng([motion, 2])
    step = 1.0 / RATE / FINE
    angle = _motion(rng, step)
    time = step * np.arange(len(angle))
    turn = np.gradient(angle, step, axis=0)
    mat_sn, force, rate = _inputs(angle, turn)
    warm = (
        24.0
        + own.uniform(6, 9) * -np.expm1(-time / (0.4 * time[-1]))
        + 0.5 * np.sin(2 * np.pi * time / (0.7 * time[-1]))
    )
    biases = own.normal(0.0, 0.05, 3), own.normal(0.0, 0.3 * DEG, 3)
    mats = [np.eye(3) + own.normal(0.0, 4e-3, (3, 3)) for _ in range(2)]
    axis = int(own.integers(3))
    zeros = np.zeros_like(force)
    scene = Scene(
        time,
        angle,
        turn,
        mat_sn,
        force.copy(),
        rate.copy(),
        warm,
        np.random.default_rng([unit, 3]),
        axis,
        zeros.copy(),
        zeros.copy(),
        angle.copy(),
        lambda t: t,
        None,
    )
    if kind != 'nothing':
        KINDS[kind](scene)
    outputs = [
        bias + value @ mat.T + more
        for bias, value, mat, more in zip(
            biases, (scene.force, scene.rate), mats, (scene.added_force, scene.added_rate)
        )
    ]
    outputs = [
        scene.truth[key](out) if key in scene.truth else out
        for key, out in zip(('filter_force', 'filter_rate'), outputs)
    ]
    outputs = [out[::FINE] for out in outputs]
    count = len(outputs[0])
    densities, wanders = (
        (1.0e-3 * np.sqrt(RATE), 0.012 * DEG * np.sqrt(RATE) / 3),
        (4e-4, 1.5e-3 * DEG),
    )
    for out, density, wander in zip(outputs, densities, wanders):
        out += rng.normal(0.0, density, out.shape)
        decay = np.exp(-1.0 / RATE / 120.0)
        steps = rng.normal(0.0, wander * np.sqrt(1 - decay**2), out.shape)
        out += lfilter([1.0], [1.0, -decay], steps, axis=0)
    kept, places = (
        (np.arange(count), np.arange(count) / RATE) if scene.thin is None else scene.thin(count)
    )
    stamps = scene.clock(places)
    joint_time = np.arange(0.0, time[-1], 1.0 / RATE) + 0.0037
    at_joint = np.minimum((joint_time / step).round().astype(int), len(time) - 1)
    seen = scene.seen_angle[at_joint] + rng.normal(0.0, 2e-6, (len(at_joint), 3))
    warm_time = np.arange(0.0, time[-1], 1.0)
    truth = {key: scene.truth[key] for key in ('sensor', 'place', 'names') if key in scene.truth}
    inside = scene.truth.get('inside')
    axes = scene.truth.get('axes', {axis} if kind != 'nothing' else ())
    return World(
        START_NS + (stamps * 1e9).round().astype(np.int64),
        outputs[0][kept],
        outputs[1][kept],
        START_NS + (time[at_joint] * 1e9).round().astype(np.int64),
        seen,
        START_NS + (warm_time * 1e9).round().astype(np.int64),
        np.interp(warm_time, time, warm) + rng.normal(0.0, 0.01, len(warm_time)),
        force[::FINE][kept],
        rate[::FINE][kept],
        time[::FINE][kept],
        axes=frozenset('xyz'[k] for k in axes),
        inside=None if inside is None else inside[::FINE][kept],
        **truth,
    )


# --- causes at a place ----------------------------------------------------------------------------


def _mark(scene, sensor, inside, *place, names=(), axes=None):
    scene.truth |= {'sensor': sensor, 'inside': inside, 'place': place, 'names': frozenset(names)}
    if axes is not None:
        scene.truth['axes'] = axes


def _arc(scene, joint, width):
    middle = (
        scene.rng.choice(
            [0.0, 90.0, -45.0, 45.0]
            if joint == 1
            else [0.0, 90.0, 180.0]
            if joint == 2
            else [0.0, 90.0]
        )
        * DEG
    )
    away = np.abs((scene.angle[:, joint] - middle + np.pi) % (2 * np.pi) - np.pi)
    return away < 0.5 * width * DEG


def _offset(scene, sensor, inside, *place, names=(), share=1.0):
    target, size = (
        (scene.added_force, FORCE) if sensor == 'accelerometer' else (scene.added_rate, TURN)
    )
    target[:, scene.axis] += share * size * scene.rng.choice([-1, 1]) * inside
    _mark(scene, sensor, inside, *place, names=names)


def _arc_offset(sensor, joint):
    def act(scene):
        _offset(scene, sensor, _arc(scene, joint, 50.0), f'angle of {JOINTS[joint]}')

    return act


def _rattle_in_an_arc(scene):
    inside = _arc(scene, 1, 50.0)
    scene.added_force[:, scene.axis] += (
        3
        * FORCE
        * inside
        * np.repeat(scene.rng.normal(size=len(inside) // FINE + 1), FINE)[: len(inside)]
    )
    _mark(scene, 'accelerometer', inside, 'angle of middle')


def _gear_whine(scene):
    joint = int(scene.rng.integers(3))
    inside = np.abs(scene.turn[:, joint]) > 40 * DEG
    scene.added_rate[:, scene.axis] += (
        4
        * TURN
        * inside
        * np.sin(2 * np.pi * 21.0 * scene.time + np.cumsum(scene.rng.normal(0, 0.02, len(inside))))
    )
    _mark(scene, 'gyroscope', inside, f'rate of {JOINTS[joint]}', 'speed', 'rate about')


def _after(scene, low, high):
    return scene.time > scene.rng.uniform(low, high) * scene.time[-1]


def _knock(scene):
    _offset(scene, 'accelerometer', _after(scene, 0.35, 0.75), 'time', names=['accel_bias_step'])


def _supply_dip(scene):
    start = scene.rng.uniform(0.25, 0.5) * scene.time[-1]
    _offset(
        scene,
        'gyroscope',
        (scene.time > start) & (scene.time < start + 0.25 * scene.time[-1]),
        'time',
    )


def _warm_stick(scene):
    _offset(
        scene,
        'accelerometer',
        scene.warm > np.quantile(scene.warm, scene.rng.uniform(0.35, 0.6)),
        'temperature',
        'time',
    )


def _one_direction(scene):
    joint = int(scene.rng.integers(3))
    _offset(
        scene, 'gyroscope', scene.turn[:, joint] > 5 * DEG, f'rate of {JOINTS[joint]}', share=2.0
    )


def _play(values, width):
    """Return the output of a play operator."""
    out, level = np.empty_like(values), values[0]
    for k, value in enumerate(values):
        level = min(max(level, value - width), value + width)
        out[k] = level
    return out


def _approach(scene):
    joint = int(scene.rng.integers(3))
    lag = scene.angle[:, joint] - _play(scene.angle[:, joint], 1.0 * DEG)
    _offset(
        scene,
        'accelerometer',
        lag > 0,
        f'approach of {JOINTS[joint]}',
        f'last motion of {JOINTS[joint]}',
        f'before rest of {JOINTS[joint]}',
        JOINTS[joint],
    )


def _one_sided(scene):
    _offset(
        scene,
        'accelerometer',
        scene.force[:, scene.axis] > 6.0,
        f'specific force along {"xyz"[scene.axis]}',
        'angle of',
    )


def _bad_code(scene):
    inside = np.abs(scene.force[:, scene.axis]) < 1.2
    _offset(scene, 'accelerometer', inside, f'specific force along {"xyz"[scene.axis]}', 'angle of')


def _fast_offset(scene):
    _offset(scene, 'gyroscope', np.linalg.norm(scene.rate, axis=1) > 45 * DEG, 'speed', share=2.0)


def _loose_for_a_while(scene):
    start = scene.rng.uniform(0.3, 0.6) * scene.time[-1]
    inside = (scene.time > start) & (scene.time < start + 0.2 * scene.time[-1])
    scene.added_force[:, scene.axis] += (
        3
        * FORCE
        * inside
        * np.repeat(scene.rng.normal(size=len(inside) // FINE + 1), FINE)[: len(inside)]
    )
    _mark(scene, 'accelerometer', inside, 'time')


def _axes_exchanged(scene):
    inside = _after(scene, 0.45, 0.65)

    def exchange(out):
        one, two = (scene.axis + 1) % 3, (scene.axis + 2) % 3
        out[inside, one], out[inside, two] = out[inside, two].copy(), out[inside, one].copy()
        return out

    scene.truth['filter_rate'] = exchange
    _mark(scene, 'gyroscope', inside, 'time', axes={(scene.axis + 1) % 3, (scene.axis + 2) % 3})


def _mount_knocked(scene):
    inside = _after(scene, 0.45, 0.65)
    turn = _about(scene.axis, np.array([0.6 * DEG]))[0]
    for values in (scene.force, scene.rate):
        values[inside] = values[inside] @ turn
    _mark(scene, 'both', inside, 'time', axes={(scene.axis + 1) % 3, (scene.axis + 2) % 3})


def _belt_slipped(scene):
    inside = _after(scene, 0.45, 0.65)
    joint = int(scene.rng.integers(1, 3))
    scene.seen_angle[inside, joint] += 0.8 * DEG
    _mark(scene, 'both', inside, 'time', axes=())


def _clock_stepped(scene):
    moment = 0.6 * scene.time[-1]
    scene.clock = lambda t: t + 0.008 * (t > moment)
    _mark(scene, 'both', scene.time > moment, 'time', names=['clock_step'], axes=())


PLACED = {
    'gyro_offset_in_outer_arc': _arc_offset('gyroscope', 0),
    'gyro_offset_in_middle_arc': _arc_offset('gyroscope', 1),
    'gyro_offset_in_inner_arc': _arc_offset('gyroscope', 2),
    'accel_offset_in_outer_arc': _arc_offset('accelerometer', 0),
    'accel_offset_in_middle_arc': _arc_offset('accelerometer', 1),
    'accel_offset_in_inner_arc': _arc_offset('accelerometer', 2),
    'rattle_in_an_arc': _rattle_in_an_arc,
    'gear_whine': _gear_whine,
    'knock': _knock,
    'supply_dip': _supply_dip,
    'warm_stick': _warm_stick,
    'one_direction': _one_direction,
    'approach': _approach,
    'one_sided': _one_sided,
    'bad_code': _bad_code,
    'fast_offset': _fast_offset,
    'loose_for_a_while': _loose_for_a_while,
    'axes_exchanged': _axes_exchanged,
    'mount_knocked': _mount_knocked,
    'belt_slipped': _belt_slipped,
}
"""Kinds that act at a place."""


# --- causes without a place -----------------------------------------------------------------------


def _add(scene, sensor, signal, *, names=(), axes=None, size=1.0):
    target, rms = (
        (scene.added_force, FORCE) if sensor == 'accelerometer' else (scene.added_rate, TURN)
    )
    target[:, scene.axis] += size * rms * signal / np.sqrt((signal**2).mean())
    _mark(scene, sensor, None, names=names, axes=axes)


def _signal(sensor, make, **options):
    def act(scene):
        _add(scene, sensor, make(scene), **options)

    return act


def _hysteretic_gyro(scene):
    rate = scene.rate[:, scene.axis]
    return rate - _play(rate, 1.0 * DEG)


def _resonator(values, hertz, damping, step):
    """
    Return the deflection of a damped spring that is driven by values.

    It is divided by its static deflection (trapezoidal rule).
    """
    omega = 2 * np.pi * hertz
    above, below = bilinear([omega**2], [1.0, 2 * damping * omega, omega**2], 1.0 / step)
    return lfilter(above, below, values, zi=lfilter_zi(above, below) * values[0])[0]


def _resonant_gyro(scene):
    def pass_through(out):
        out[:, scene.axis] = _resonator(out[:, scene.axis], 6.0, 0.3, 1.0 / RATE / FINE)
        return out

    scene.truth['filter_rate'] = pass_through
    _mark(
        scene, 'gyroscope', None, names=['gyro_filter', 'gyro_delay', 'gyro_bandwidth', 'gyro_lag']
    )


def _noise_with_motion(scene):
    count = len(scene.time) // FINE + 1
    bursts = np.repeat(scene.rng.standard_t(3, count // 200 + 1), 200 * FINE)[: len(scene.time)]
    grains = np.repeat(scene.rng.normal(size=count), FINE)[: len(scene.time)]
    speed = np.linalg.norm(scene.rate, axis=1)
    scene.added_rate[:, scene.axis] += 8 * TURN * np.abs(bursts) * grains * speed / speed.max()
    _mark(scene, 'gyroscope', None)


def _clock_fast(scene):
    scene.clock = lambda t: t * (1 + 2e-4)
    _mark(scene, 'both', None, names=['clock_rate'], axes=())


def _floored(scene):
    phase = scene.rng.uniform(0.0, 0.01)
    scene.clock = lambda t: np.floor((t * 1.0003 + phase) * 100) / 100
    _mark(scene, 'both', None, names=['clock_rate', 'time_offset'], axes=())


def _lost(scene):
    def thin(count):
        kept = np.flatnonzero(np.arange(count) % 50 != 17)
        return kept, np.linspace(0.0, (count - 1) / RATE, len(kept))

    scene.thin = thin
    _mark(scene, 'both', None, names=['clock_rate', 'time_offset'], axes=())


def _soft_mount(scene):
    """
    The mount bends under its load and swings at 9 Hz.

    Below that frequency it is a product of two forces, which is the name of its cause.
    """
    other = (scene.axis + 1) % 3
    bend = 2e-3 * _resonator(scene.force[:, other], 9.0, 0.05, 1.0 / RATE / FINE) / GRAVITY
    return bend * scene.force[:, (scene.axis + 2) % 3]


def _order(scene):
    return np.sin(7.3 * scene.angle[:, 0]) * np.clip(np.abs(scene.turn[:, 0]) / (30 * DEG), 0, 1)


UNPLACED = {
    'hysteretic_gyro': _signal('gyroscope', _hysteretic_gyro),
    'resonant_gyro': _resonant_gyro,
    'noise_with_motion': _noise_with_motion,
    'clock_fast': _clock_fast,
    'floored': _floored,
    'lost': _lost,
    'drift_gyro': _signal(
        'gyroscope', lambda s: s.time - s.time.mean(), names=['gyro_bias_trend', 'gyro_bias_drift']
    ),
    'drift_accel': _signal(
        'accelerometer',
        lambda s: s.time - s.time.mean(),
        names=['accel_bias_trend', 'accel_bias_drift'],
    ),
    'field_turns_gyro': _signal(
        'gyroscope', lambda s: np.sin(3 * s.angle[:, 0]) * np.sin(2 * s.angle[:, 1] + 1)
    ),
    'field_turns_accel': _signal(
        'accelerometer', lambda s: np.sin(2 * s.angle[:, 2]) * np.sin(3 * s.angle[:, 1] + 1)
    ),
    'coriolis': _signal(
        'accelerometer', lambda s: s.rate[:, s.axis] * s.force[:, (s.axis + 1) % 3], size=2.0
    ),
    'scale_by_force': _signal(
        'gyroscope', lambda s: s.rate[:, s.axis] * s.force[:, (s.axis + 2) % 3], size=2.0
    ),
    'warm_rate_product': _signal(
        'gyroscope', lambda s: (s.warm - 27) * s.rate[:, (s.axis + 1) % 3], size=2.0
    ),
    'warm_force_product': _signal(
        'accelerometer', lambda s: (s.warm - 27) * s.force[:, (s.axis + 1) % 3]
    ),
    'force_cubed_in_gyro': _signal('gyroscope', lambda s: s.force[:, s.axis] ** 3),
    'tone': _signal('accelerometer', lambda s: np.sin(2 * np.pi * 31.0 * s.time), size=3.0),
    'order': _signal('gyroscope', _order, size=3.0),
    'soft_mount': _signal('accelerometer', _soft_mount, names=['accel_cross_product']),
    'friction': _signal('gyroscope', lambda s: np.tanh(s.turn[:, 1] / (0.3 * DEG))),
    'bent_scale': _signal(
        'gyroscope',
        lambda s: np.tanh(s.rate[:, s.axis] / (40 * DEG)) - 0.7 * s.rate[:, s.axis] / (40 * DEG),
        names=['gyro_cubic', 'gyro_quadratic', 'gyro_scale_asymmetry'],
        size=2.0,
    ),
}
"""Kinds without a place."""
KINDS = PLACED | UNPLACED | {'clock_stepped': _clock_stepped}
