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


def _smooth(share):
    """Return the step from 0 to 1 without a jump of its slope, at shares of its length."""
    return 3 * share**2 - 2 * share**3


def _plan(rng):
    """Return (kind of motion, its parameters) of each motion, in deg, deg/s and Hz."""
    poses = rng.permutation(
        [[o, m, i] for o in (0, 90) for m in (-90, -45, 0, 45, 90) for i in (0, 90, 180)]
    )[:26]
    plan = [('pose', pose + rng.uniform(-8, 8, 3)) for pose in poses]
    for joint in range(3):
        for sign in (-1, 1):
            plan.append(('spin', (joint, sign * rng.uniform(50, 110))))
    for _ in range(5):
        joints = rng.permutation(3)[:2]
        plan.append(('swing', (joints, rng.uniform(0.25, 0.9, 2), rng.uniform(10, 35, 2))))
    return [plan[number] for number in rng.permutation(len(plan))]


def _motion(rng, step):
    """
    Return joint angles, rad, shape (n, 3).

    26 poses of 4 s, two spins of each joint, swings of two joints at a time.
    """
    position = np.zeros(3)
    parts = []
    for kind, parameters in _plan(rng):
        if kind == 'pose':
            goal = parameters * DEG
            seconds = max(1.0, np.abs(goal - position).max() / (70 * DEG))
            parts.append(_blend(position, goal, seconds, step))
            parts.append(np.tile(goal, (round(4.0 / step), 1)))
            position = goal
        elif kind == 'spin':
            joint, speed = parameters
            time = np.arange(0.0, 9.0, step)
            ramp = np.clip(np.minimum(time, 9.0 - time), 0.0, 1.0)
            path = np.cumsum(_smooth(ramp)) * step * speed * DEG
            parts.append(position + path[:, None] * np.eye(3)[joint])
            position = position + path[-1] * np.eye(3)[joint]
        else:
            time = np.arange(0.0, 12.0, step)
            taper = _smooth(np.clip(np.minimum(time, 12.0 - time) / 2.0, 0.0, 1.0))
            path = np.zeros((len(time), 3))
            for joint, hertz, size in zip(*parameters):
                path[:, joint] = size * DEG * taper * np.sin(2 * np.pi * hertz * time)
            parts.append(position + path)
        parts.append(np.tile(position, (round(1.5 / step), 1)))  # rest
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
    unit_rng = np.random.default_rng([unit, 1])
    rng = np.random.default_rng([motion, 2])

    # The true motion and temperature on the fine grid, and the errors of the instrument.
    step = 1.0 / RATE / FINE
    angle = _motion(rng, step)
    time = step * np.arange(len(angle))
    turn = np.gradient(angle, step, axis=0)
    mat_sn, force, rate = _inputs(angle, turn)
    warm = (
        24.0
        + unit_rng.uniform(6, 9) * -np.expm1(-time / (0.4 * time[-1]))
        + 0.5 * np.sin(2 * np.pi * time / (0.7 * time[-1]))
    )
    force_bias = unit_rng.normal(0.0, 0.05, 3)
    rate_bias = unit_rng.normal(0.0, 0.3 * DEG, 3)
    force_mat = np.eye(3) + unit_rng.normal(0.0, 4e-3, (3, 3))
    rate_mat = np.eye(3) + unit_rng.normal(0.0, 4e-3, (3, 3))

    # The cause, which changes the scene.
    scene = Scene(
        time=time,
        angle=angle,
        turn=turn,
        mat_sn=mat_sn,
        force=force.copy(),
        rate=rate.copy(),
        warm=warm,
        rng=np.random.default_rng([unit, 3]),
        axis=int(unit_rng.integers(3)),
        added_force=np.zeros_like(force),
        added_rate=np.zeros_like(rate),
        seen_angle=angle.copy(),
        clock=lambda true_time: true_time,
    )
    axes = ()
    if kind != 'nothing':
        KINDS[kind](scene)
        axes = scene.truth.get('axes', {scene.axis})

    # Readings with noise and bias wander, at their stamps.
    force_out = force_bias + scene.force @ force_mat.T + scene.added_force
    rate_out = rate_bias + scene.rate @ rate_mat.T + scene.added_rate
    if 'filter_rate' in scene.truth:
        rate_out = scene.truth['filter_rate'](rate_out)
    force_out = _noisy(force_out[::FINE], 1.0e-3 * np.sqrt(RATE), 4e-4, rng)
    rate_out = _noisy(rate_out[::FINE], 0.012 * DEG * np.sqrt(RATE) / 3, 1.5e-3 * DEG, rng)
    count = len(force_out)
    kept, places = np.arange(count), np.arange(count) / RATE
    if scene.thin is not None:
        kept, places = scene.thin(count)

    # Joint states, temperatures and the truth.
    joint_time = np.arange(0.0, time[-1], 1.0 / RATE) + 0.0037
    at_joint = np.minimum((joint_time / step).round().astype(int), len(time) - 1)
    seen_angle = scene.seen_angle[at_joint] + rng.normal(0.0, 2e-6, (len(at_joint), 3))
    warm_time = np.arange(0.0, time[-1], 1.0)
    truth = {key: scene.truth[key] for key in ('sensor', 'place', 'names') if key in scene.truth}
    inside = scene.truth.get('inside')
    return World(
        stamp_ns=_stamps(scene.clock(places)),
        force=force_out[kept],
        rate=rate_out[kept],
        joint_ns=_stamps(time[at_joint]),
        angle=seen_angle,
        temperature_ns=_stamps(warm_time),
        temperature_c=np.interp(warm_time, time, warm) + rng.normal(0.0, 0.01, len(warm_time)),
        true_force=force[::FINE][kept],
        true_rate=rate[::FINE][kept],
        time=time[::FINE][kept],
        axes=frozenset('xyz'[k] for k in axes),
        inside=None if inside is None else inside[::FINE][kept],
        **truth,
    )


def _noisy(out, white_sd, wander_sd, rng):
    """Return readings with white noise and a first-order Gauss-Markov bias of 120 s."""
    out = out + rng.normal(0.0, white_sd, out.shape)
    decay = np.exp(-1.0 / RATE / 120.0)
    steps = rng.normal(0.0, wander_sd * np.sqrt(1 - decay**2), out.shape)
    return out + lfilter([1.0], [1.0, -decay], steps, axis=0)


def _stamps(seconds):
    """Return stamps of seconds since the start, ns."""
    return START_NS + (seconds * 1e9).round().astype(np.int64)


# --- causes at a place ----------------------------------------------------------------------------


def _mark(scene, sensor, inside, *place, names=(), axes=None):
    scene.truth |= {'sensor': sensor, 'inside': inside, 'place': place, 'names': frozenset(names)}
    if axes is not None:
        scene.truth['axes'] = axes


def _arc(scene, joint, width):
    rests_deg = ([0.0, 90.0], [0.0, 90.0, -45.0, 45.0], [0.0, 90.0, 180.0])
    middle = scene.rng.choice(rests_deg[joint]) * DEG
    away = np.abs((scene.angle[:, joint] - middle + np.pi) % (2 * np.pi) - np.pi)
    return away < 0.5 * width * DEG


def _target(scene, sensor):
    """Return (readings that are added on the axis of a cause, size of a cause) of a sensor."""
    if sensor == 'accelerometer':
        return scene.added_force[:, scene.axis], FORCE
    return scene.added_rate[:, scene.axis], TURN


def _offset(scene, sensor, inside, *place, names=(), share=1.0):
    added, size = _target(scene, sensor)
    added += share * size * scene.rng.choice([-1, 1]) * inside
    _mark(scene, sensor, inside, *place, names=names)


def _arc_offset(sensor, joint):
    def act(scene):
        _offset(scene, sensor, _arc(scene, joint, 50.0), f'angle of {JOINTS[joint]}')

    return act


def _rattle(scene, inside, place):
    """Add white noise on one axis of the accelerometer inside of a place."""
    noise = np.repeat(scene.rng.normal(size=len(inside) // FINE + 1), FINE)[: len(inside)]
    scene.added_force[:, scene.axis] += 3 * FORCE * inside * noise
    _mark(scene, 'accelerometer', inside, place)


def _rattle_in_an_arc(scene):
    _rattle(scene, _arc(scene, 1, 50.0), 'angle of middle')


def _gear_whine(scene):
    joint = int(scene.rng.integers(3))
    inside = np.abs(scene.turn[:, joint]) > 40 * DEG
    phase = np.cumsum(scene.rng.normal(0, 0.02, len(inside)))
    tone = np.sin(2 * np.pi * 21.0 * scene.time + phase)
    scene.added_rate[:, scene.axis] += 4 * TURN * inside * tone
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
    _rattle(scene, inside, 'time')


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
    added, rms = _target(scene, sensor)
    added += size * rms * signal / np.sqrt((signal**2).mean())
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
