"""
A turntable session made by physics, to hide effects in and to find them again.

Nothing here knows the catalogue of effects or the estimator: the table stands crooked, the clock is
late, the filter runs on a grid finer than the samples. `make_session` returns what a bag would
hold, the table description that the searcher gets, and the truth.
"""

import copy
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from imu_calibration.core.samples import ImuSamples, JointSamples, SampleBlock, TemperatureSamples
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.sensor_noise import (
    GRADES,
    ImuNoise,
    SimulatedNoise,
    jitter_stamps,
    read_encoders,
    realistic,
)

from worlds.physics_cause import NO_CAUSE
from worlds.physics_draw import Climate, draw_events, draw_imu, draw_value, generator, to_ns
from worlds.physics_sensor import filtered
from worlds.physics_table import local_gravity, move_table
from worlds.physics_vibration import Machine
from worlds.tables import Z_Y_X
from worlds.wanders import WANDERS, add_wander

PLACE = {'gravity': None, 'latitude': 48.8, 'height': 150.0, 'azimuth_deg': 20.0}
TABLES = {
    'three_axis': {
        'joints': Z_Y_X,
        'up': [0, 0, 1],
        **PLACE,
        'mount': {'rpy_deg': [0, 0, 0], 'xyz': None},
    },
    'two_axis': {
        'joints': [{'name': 'tilt', 'axis': [0, 1, 0]}, {'name': 'plate', 'axis': [0, 0, 1]}],
        'up': [0, 0, 1],
        **PLACE,
        'mount': {'rpy_deg': [0, 0, 0], 'xyz': None},
    },
    'centrifuge': {
        'joints': Z_Y_X,
        'up': [0, 0, 1],
        **PLACE,
        'mount': {'rpy_deg': [0, 0, 0], 'xyz': [0.2, 0.15, 0.1]},
    },
}
"""Tables by name; the last carries the sensor on an arm, so that spins leave 1 g."""


@dataclass(frozen=True, eq=False)
class Session:
    """What was recorded, what the searcher is told, and the truth."""

    imu: ImuSamples
    """IMU samples."""
    joints: JointSamples
    """Joint samples."""
    temperature: TemperatureSamples | None
    """Temperature samples, or None when nobody published any."""
    table: dict
    """Table description for the searcher, as in the table's YAML."""
    covariance: dict | None
    """Variances that the messages claim ('force', 'rate'), or None for unknown."""
    truth: dict
    """
    'accelerometer' and 'gyroscope' (Triads), 'values' (effect name -> value), 'earth_n', 'gravity',
    'temperature_c' (at the IMU samples), 'profile', 'noise', 'start_ns', and times of events.
    """

    @property
    def block(self):
        """Return everything as one block."""
        return SampleBlock(self.imu, self.joints, self.temperature)


def make_session(
    seed,
    hidden=None,
    noise='white',
    *,
    grade='industrial',
    imu_rate=100.0,
    joint_rate=100.0,
    duration=None,
    profile='random',
    table='three_axis',
    arms=False,
    mount_rpy_deg=None,
    temperature='warm_up',
    velocity='good',
    encoder_resolution=None,
    dropped=None,
    only_at_rest=False,
    knock=False,
    wrong_covariance=False,
    oversampling=8,
    unit=None,
    cause=None,
    machine=False,
):
    """
    Return a `Session` with effects hidden in it.

    Parameters
    ----------
    seed : int
        Draws the IMU, the motion (of 'random'), the effects' values and the noise.
    hidden : dict, optional
        Effect (or outside cause) -> size. A number is the magnitude of a drawn value, None a
        clearly visible one, an array the value itself. Saturation: the fraction of samples that are
        clipped, or the array (level,). Drift: the amplitude, or the array (x, y, z, time constant).
    noise : str or SimulatedNoise
        'none', 'white', or 'realistic': bias wander, encoder resolution and stamp jitter too; a
        name in `worlds.wanders.WANDERS`: realistic, but the bias wanders in that way.
    grade : str
        IMU grade in `imu_calibration.simulation.sensor_noise.GRADES`.
    duration : float, optional
        Length of the session, s; default the profile's own.
    profile : str or Profile
        Name in `imu_calibration.simulation.profiles`, or a motion.
    table : str or dict
        Name in `TABLES` or a description; `mount_rpy_deg` changes the mount.
    arms : bool
        Give every accelerometer an arm of its own although none is hidden.
    temperature : str or None
        'warm_up' (8 K), 'cycle' (a heater too), or None: the same temperature, but nobody publishes
        it.
    velocity : str
        'good', 'none' (NaN), 'zero' or 'differences'.
    encoder_resolution : float, optional
        rad; overrides the noise model.
    dropped : str, optional
        'imu', 'joints' or 'both': two seconds are missing there.
    only_at_rest : bool
        The recorder was paused whenever a joint moved.
    knock : bool
        Someone bumps into the table once.
    wrong_covariance : bool
        The messages claim a noise that is ten times too small.
    oversampling : int
        Steps of the fine grid per sample, used when there is a filter.
    unit : int, optional
        Draws the IMU in place of `seed`: sessions of one unit.
    cause : worlds.physics_cause.Cause, optional
        What the world does beside the motion.
    machine : bool
        A machine on the bench shakes the sensor, now more, now less (`worlds.physics_vibration`).

    """
    cause = cause or NO_CAUSE
    hidden = dict(hidden or {})
    mapping = copy.deepcopy(TABLES[table] if isinstance(table, str) else table)
    if mount_rpy_deg is not None:
        mapping['mount']['rpy_deg'] = list(mount_rpy_deg)
    told = (
        make_profile(profile, seed=seed, table=mapping, duration=duration)
        if isinstance(profile, str)
        else profile
    )
    moves = cause.moved(told)
    n_joints = len(mapping['joints'])
    # Every thing is drawn from its own generator: hiding an effect leaves unit, motion and noise as
    # they were.
    values = {
        name: draw_value(name, size, n_joints, generator(seed, name))
        for name, size in hidden.items()
    }
    model = _noise_model(noise, grade, encoder_resolution)
    triads = draw_imu(
        GRADES[grade], values, arms, generator(seed if unit is None else unit, 'unit')
    )
    events = draw_events(moves, generator(seed, 'events'))
    climate = Climate(temperature or 'warm_up', moves.duration, generator(seed, 'climate'))
    gravity = mapping['gravity'] or local_gravity(mapping['latitude'], mapping['height'])
    sampling = _Sampling(
        imu_rate,
        moves.duration,
        max(cause.oversampling, oversampling if any(triad.lags for triad in triads) else 1),
    )

    world = _move(mapping, moves, sampling.fine_time, gravity, values, events)
    outputs = _sense(world, triads, climate.at(sampling.fine_time), values, events, cause)
    outputs = [
        filtered(out, sampling.step, triad)[:: sampling.factor]
        for out, triad in zip(outputs, triads)
    ]
    if knock or 'knock_step' in values:
        outputs = [
            out + shock for out, shock in zip(outputs, _shock(sampling.time, events['knock']))
        ]
    if machine:
        shaken = Machine(moves.duration, imu_rate, generator(seed, 'machine')).shake(
            sampling.time,
            lambda vectors: world.to_sensor(
                np.repeat(vectors, sampling.factor, axis=0)[: len(world.time)]
            )[:: sampling.factor],
            triads,
        )
        outputs = [out + more for out, more in zip(outputs, shaken)]
    _set_limits(triads, outputs, values)
    if noise in WANDERS:
        outputs = add_wander(
            outputs, noise, GRADES[grade].noise, 1.0 / imu_rate, generator(seed, 'wander')
        )
    outputs = ImuNoise(model, sample_rate=imu_rate, rng=generator(seed, 'noise')).add(*outputs)
    outputs = [np.clip(out, -triad.limit, triad.limit) for out, triad in zip(outputs, triads)]

    clock = generator(seed, 'clock')
    start_ns = 1_700_000_000_000_000_000 + int(clock.integers(10**12))
    stamp_ns = start_ns + to_ns(
        sampling.time
        + values.get('time_offset', 0.0)
        + values.get('clock_rate', 0.0) * sampling.time
        + cause.stamped(sampling.time, generator(seed, 'driver'))
    )
    imu = ImuSamples(jitter_stamps(stamp_ns, model.stamp_jitter, clock), *outputs, 'imu_link')
    joints = _read_joints(
        mapping,
        moves,
        values,
        model,
        joint_rate,
        velocity,
        start_ns,
        cause,
        generator(seed, 'encoders'),
    )
    published = (
        climate.publish(start_ns, moves.duration, generator(seed, 'thermometer'))
        if temperature
        else None
    )
    if 'earth_rate' in values:
        values['earth_rate'] = world.earth_n
    truth = {
        'accelerometer': triads[0],
        'gyroscope': triads[1],
        'values': values,
        'earth_n': world.earth_n,
        'gravity': gravity,
        'temperature_c': climate.at(sampling.time),
        'profile': moves,
        'noise': model,
        'start_ns': start_ns,
        **events,
    }
    claims = _claims(model, imu_rate) if wrong_covariance else None
    session = Session(imu, joints, published, _told(mapping, hidden), claims, truth)
    session = _drop(session, dropped, start_ns, events['gap'])
    return _at_rest(session, start_ns, moves.find('rest')) if only_at_rest else session


def write_bag(session, path, **options):
    """Write the session into a new bag, with the covariances that it claims."""
    from msg_adapters.write import write_session

    if session.covariance is not None:
        options.update(
            {f'{name}_cov': variance * np.eye(3) for name, variance in session.covariance.items()}
        )
    write_session(path, session.imu, session.joints, temperature=session.temperature, **options)


def _noise_model(noise, grade, encoder_resolution):
    if isinstance(noise, str):
        full = realistic(grade)
        quiet = SimulatedNoise(
            accel_density=full.accel_density, gyro_density=full.gyro_density, encoder_noise=2e-6
        )
        real = replace(full, encoder_noise=2e-6)
        still = replace(real, accel_instability=0.0, gyro_instability=0.0)
        noise = {
            'none': SimulatedNoise(),
            'white': quiet,
            'realistic': real,
            **dict.fromkeys(WANDERS, still),
        }[noise]
    return (
        noise
        if encoder_resolution is None
        else replace(noise, encoder_resolution=encoder_resolution)
    )


class _Sampling:
    """Times of the IMU's samples, and a grid `factor` times finer that contains them."""

    def __init__(self, rate, duration, factor):
        self.factor, self.step = factor, 1.0 / rate / factor
        self.time = np.arange(round(duration * rate)) / rate
        self.fine_time = np.arange((len(self.time) - 1) * factor + 1) * self.step


def _move(mapping, moves, time, gravity, values, events):
    motion = moves.at(time)
    if 'encoder_zero' in values:
        offset = np.zeros(motion.position.shape[1])
        offset[1:-1] = values['encoder_zero']
        motion = JointMotion(
            time, motion.position + offset, motion.rate, motion.acceleration, motion.jerk
        )
    slip = None
    if 'fixture_slip' in values:
        slip = np.where(
            time[:, None] > events['slip'], values['fixture_slip'] * events['turn'], 0.0
        )
    return move_table(
        mapping,
        time,
        motion,
        gravity,
        values.get('table_tilt', (0.0, 0.0)),
        values.get('axis_non_orthogonality'),
        slip,
        sag=values.get('axis_sag'),
        wobble=values.get('axis_wobble'),
        beside=values.get('axis_offset'),
    )


def _sense(world, triads, temperature_c, values, events, cause):
    accel, gyro = triads
    plate = [world.to_sensor(vector) for vector in (world.force_n, world.rate_n, world.alpha_n)]
    force_s, rate_s = cause.carried(world.time, *plate)
    if 'load_compliance' in values:
        force_s, rate_s = bent(world.time, force_s, rate_s, values['load_compliance'])
    same = not np.any(accel.arms)
    forces = (
        [force_s] * 3 if same else [world.force_at(arm) + force_s - plate[0] for arm in accel.arms]
    )
    rates = [rate_s] * 3
    outputs = [
        accel.respond(forces, world.time, temperature_c, force_s),
        gyro.respond(rates, world.time, temperature_c, force_s),
    ]
    first, second = world.joints[:, 0], world.joints[:, min(1, world.joints.shape[1] - 1)]
    for k, name in enumerate(('angle_bias_accel', 'angle_bias_gyro')):
        if name in values:
            outputs[k] += values[name] * np.outer(
                np.sin(3.0 * first) * np.cos(5.0 * second), events['direction']
            )
    if 'stop_bias' in values:
        outputs[0] += (
            values['stop_bias']
            * events['stop_bias'][np.searchsorted(events['stops'], world.time, side='right')]
        )
    if 'knock_step' in values:
        outputs[0] += values['knock_step'] * np.outer(
            world.time > events['knock'], events['direction']
        )
    if 'second_warm_up' in values:
        since = np.maximum(world.time - events['second_start'], 0.0)
        outputs[0] -= values['second_warm_up'] * np.outer(
            np.expm1(-since / events['second_constant']), events['direction']
        )
    outputs = [
        out + more
        for out, more in zip(outputs, cause.added(world, temperature_c, force_s, rate_s, plate[2]))
    ]
    return cause.delivered(world.time, outputs, rate_s)


def bent(time, force_s, rate_s, compliance):
    """
    Return force and rate in a sensor with a compliant mount, exactly.

    The mount turns by the rotation vector ``compliance @ force``.
    """
    turn = force_s @ np.asarray(compliance).T
    back = Rotation.from_rotvec(turn).inv()
    return back.apply(force_s), back.apply(rate_s) + np.gradient(turn, time, axis=0)


def _set_limits(triads, outputs, values):
    """
    Give the triads their range.

    A fraction becomes the level that this share of samples would pass on some axis.
    """
    for name, triad, out in zip(('accel_saturation', 'gyro_saturation'), triads, outputs):
        if name in values:
            wanted = values[name]
            level = (
                wanted[0] if np.ndim(wanted) else np.quantile(np.abs(out).max(axis=1), 1.0 - wanted)
            )
            values[name] = triad.limit = float(level)


def _shock(time, start):
    """Return what accelerometer and gyroscope feel of a blow: 35 Hz that dies out within 0.3 s."""
    since = np.maximum(time - start, 0.0)
    ring = (time >= start) * np.exp(-since / 0.08) * np.sin(2.0 * np.pi * 35.0 * since + 0.5)
    return 3.0 * np.outer(ring, [1.0, -0.6, 0.3]), 0.05 * np.outer(ring, [0.3, 1.0, -0.5])


def _read_joints(mapping, moves, values, model, joint_rate, velocity, start_ns, cause, rng):
    time = np.arange(round(moves.duration * joint_rate)) / joint_rate + rng.uniform(
        0.0, 1.0 / joint_rate
    )
    motion = moves.at(time)
    shown, slope = encoder_reading(motion.position, values.get('encoder_harmonic'))
    too_much, growth = cause.encoder_error(time, motion)
    shown, rate = shown + too_much, motion.rate * slope + growth
    shown = read_encoders(shown, model, rng)
    rate = {
        'good': rate + rng.normal(0.0, 1e-5, rate.shape) * (model.encoder_noise > 0.0),
        'none': np.full_like(rate, np.nan),
        'zero': np.zeros_like(rate),
        'differences': np.gradient(shown, 1.0 / joint_rate, axis=0),
    }[velocity]
    return JointSamples(
        start_ns + to_ns(time), shown, rate, tuple(joint['name'] for joint in mapping['joints'])
    )


def encoder_reading(angle, harmonics):
    """Return the reading q with ``angle = q + sum of c cos(k q) + s sin(k q)``, and dq / dangle."""
    reading, slope = angle, np.ones_like(angle)
    if harmonics is None:
        return reading, slope
    for _ in range(4):
        error, growth = np.zeros_like(angle), np.zeros_like(angle)
        for order, (cosine, sine) in enumerate(np.moveaxis(harmonics, 0, -1), start=1):
            error += cosine * np.cos(order * reading) + sine * np.sin(order * reading)
            growth += order * (sine * np.cos(order * reading) - cosine * np.sin(order * reading))
        reading, slope = angle - error, 1.0 / (1.0 + growth)
    return reading, slope


def _told(mapping, hidden):
    """
    Return the description that the searcher gets.

    Nominal, and without its azimuth when the Earth's rate is hidden.
    """
    told = copy.deepcopy(mapping)
    if 'earth_rate' in hidden:
        told.update(azimuth_deg=None)
    return told


def _claims(model, imu_rate):
    return {
        'force': 0.01 * model.accel_density**2 * imu_rate,
        'rate': 0.01 * model.gyro_density**2 * imu_rate,
    }


def _drop(session, dropped, start_ns, gap):
    def kept(samples):
        since = (samples.stamp_ns - start_ns) * 1e-9
        return samples.select((since < gap) | (since > gap + 2.0))

    if dropped is None:
        return session
    return replace(
        session,
        imu=kept(session.imu) if dropped in ('imu', 'both') else session.imu,
        joints=kept(session.joints) if dropped in ('joints', 'both') else session.joints,
    )


def _at_rest(session, start_ns, rests):
    def kept(samples):
        since = (samples.stamp_ns - start_ns) * 1e-9
        return samples.select(
            np.searchsorted(rests[:, 0], since) == np.searchsorted(rests[:, 1], since) + 1
        )

    return replace(session, imu=kept(session.imu), joints=kept(session.joints))
