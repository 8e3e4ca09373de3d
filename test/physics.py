"""
A turntable session made by physics, to hide effects in and to find them again.

Nothing here knows the catalogue of effects or the estimator: the table stands crooked, the clock is late, the filter runs on a
grid finer than the samples. `make_session` returns what a bag would hold, the table description that the searcher gets, and
the truth.
"""

import copy
from dataclasses import dataclass, replace
from zlib import crc32

import numpy as np
from physics_sensor import Triad, low_pass
from physics_table import local_gravity, move_table

from imu_calibration import noise as noise_models
from imu_calibration.joint_motion import JointMotion
from imu_calibration.profiles import make_profile
from imu_calibration.samples import ImuSamples, JointSamples, SampleBlock, TemperatureSamples

G = 9.80665
MG = 1e-3 * G
DEG = np.pi / 180
ARCMIN = DEG / 60
PLACE = {'gravity': None, 'latitude': 48.8, 'height': 150.0, 'azimuth_deg': 20.0}
Z_Y_X = [{'name': 'outer', 'axis': [0, 0, 1]}, {'name': 'middle', 'axis': [0, 1, 0]}, {'name': 'inner', 'axis': [1, 0, 0]}]
TABLES = {
    'three_axis': {'joints': Z_Y_X, 'up': [0, 0, 1], **PLACE, 'mount': {'rpy_deg': [0, 0, 0], 'xyz': None}},
    'two_axis': {'joints': [{'name': 'tilt', 'axis': [0, 1, 0]}, {'name': 'plate', 'axis': [0, 0, 1]}], 'up': [0, 0, 1], **PLACE,
                 'mount': {'rpy_deg': [0, 0, 0], 'xyz': None}},
    'centrifuge': {'joints': Z_Y_X, 'up': [0, 0, 1], **PLACE, 'mount': {'rpy_deg': [0, 0, 0], 'xyz': [0.2, 0.15, 0.1]}},
}
"""Tables by name; the last carries the sensor on an arm, so that spins leave 1 g."""

# Clearly visible sizes, by effect: (size, shape of the truth or None when it is made in a way of its own).
EFFECTS = {
    'accel_quadratic': (1e-3 / G, (3,)), 'accel_cubic': (2e-3 / G**2, (3,)), 'accel_scale_asymmetry': (1e-3, (3,)),
    'accel_cross_product': (1e-3 / G, (3, 3)), 'accel_size_effect': (8e-3, (3, 3)), 'lever_arm': (10e-3, (3,)),
    'accel_thermal_bias': (0.3 * MG, (3,)), 'accel_thermal_scale': (3e-4, (3,)), 'accel_bias_drift': (2 * MG, None),
    'accel_saturation': (0.02, None), 'accel_bandwidth': (4e-3, None),
    'gyro_g_sensitivity': (0.02 * DEG / G, (3, 3)), 'gyro_rate_product': (1e-3, (3, 3)), 'gyro_quadratic': (1e-3, (3,)),
    'gyro_scale_asymmetry': (1e-3, (3,)), 'gyro_thermal_bias': (0.01 * DEG, (3,)), 'gyro_thermal_scale': (5e-4, (3,)),
    'gyro_bias_drift': (0.05 * DEG, None), 'gyro_saturation': (0.02, None), 'gyro_bandwidth': (4e-3, None),
    'table_tilt': (5 * ARCMIN, (2,)), 'axis_non_orthogonality': (5 * ARCMIN, None), 'encoder_zero': (5 * ARCMIN, None),
    'encoder_harmonic': (3 * ARCMIN, None), 'time_offset': (2e-3, ()), 'earth_rate': (1.0, None),
}
"""Effects that can be hidden: name -> (clearly visible size, shape of its value or None)."""
OUTSIDE = {'angle_bias_accel': 2 * MG, 'angle_bias_gyro': 0.05 * DEG, 'stop_bias': 2 * MG, 'knock_step': 5 * MG, 'fixture_slip': 10 * ARCMIN,
           'second_warm_up': 3 * MG}
"""Causes that no catalogue holds: name -> clearly visible size."""


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
    """'accelerometer' and 'gyroscope' (Triads), 'values' (effect name -> value), 'earth_n', 'temperature_c' (at the IMU samples), 'profile',
    'noise', and times of events."""

    @property
    def block(self):
        """Return everything as one block."""
        return SampleBlock(self.imu, self.joints, self.temperature)


def make_session(seed, hidden=None, noise='white', *, grade='industrial', imu_rate=100.0, joint_rate=100.0, duration=None, profile='random',
                 table='three_axis', arms=False, mount_rpy_deg=None, temperature='warm_up', velocity='good', encoder_resolution=None,
                 dropped=None, knock=False, wrong_covariance=False, oversampling=8):
    """
    Return a `Session` with effects hidden in it.

    Parameters
    ----------
    seed : int
        Draws the IMU, the motion (of 'random'), the effects' values and the noise.
    hidden : dict, optional
        Effect (or outside cause) -> size. A number is the magnitude of a drawn value, None a clearly visible one, an array the value itself.
        Saturation: the fraction of samples that are clipped. Drift: the amplitude, or the array (x, y, z, time constant).
    noise : str or NoiseModel
        'none', 'white', or 'realistic': bias wander, encoder resolution and stamp jitter too.
    grade : str
        IMU grade in `imu_calibration.noise.GRADES`.
    duration : float, optional
        Length of the session, s; default the profile's own.
    profile : str
        Name in `imu_calibration.profiles`.
    table : str or dict
        Name in `TABLES` or a description; `mount_rpy_deg` changes the mount.
    arms : bool
        Give every accelerometer an arm of its own although none is hidden.
    temperature : str or None
        'warm_up' (8 K), 'cycle' (a heater too), or None: the same temperature, but nobody publishes it.
    velocity : str
        'good', 'none' (NaN), 'zero' or 'differences'.
    encoder_resolution : float, optional
        rad; overrides the noise model.
    dropped : str, optional
        'imu', 'joints' or 'both': two seconds are missing there.
    knock : bool
        Someone bumps into the table once.
    wrong_covariance : bool
        The messages claim a noise that is ten times too small.
    oversampling : int
        Steps of the fine grid per sample, used when there is a filter.

    """
    hidden = dict(hidden or {})
    mapping = copy.deepcopy(TABLES[table] if isinstance(table, str) else table)
    if mount_rpy_deg is not None:
        mapping['mount']['rpy_deg'] = list(mount_rpy_deg)
    moves = make_profile(profile, seed=seed, table=mapping, duration=duration)
    n_joints = len(mapping['joints'])
    # Every thing is drawn from its own generator: hiding an effect leaves unit, motion and noise as they were.
    values = {name: _draw(name, size, n_joints, _generator(seed, name)) for name, size in hidden.items()}
    model = _noise_model(noise, grade, encoder_resolution)
    triads = _draw_imu(noise_models.GRADES[grade], values, arms, _generator(seed, 'unit'))
    events = _draw_events(moves, _generator(seed, 'events'))
    climate = _Climate(temperature or 'warm_up', moves.duration, _generator(seed, 'climate'))
    gravity = mapping['gravity'] or local_gravity(mapping['latitude'], mapping['height'])
    sampling = _Sampling(imu_rate, moves.duration, oversampling if any(triad.low_pass for triad in triads) else 1)

    world = _move(mapping, moves, sampling.fine_time, gravity, values, events)
    outputs = _sense(world, triads, climate.at(sampling.fine_time), values, events, n_joints)
    outputs = [low_pass(out, sampling.step, triad.low_pass, triad.low_pass_order)[:: sampling.factor] for out, triad in zip(outputs, triads)]
    if knock or 'knock_step' in values:
        outputs = [out + shock for out, shock in zip(outputs, _shock(sampling.time, events['knock']))]
    for name, triad, out in zip(('accel_saturation', 'gyro_saturation'), triads, outputs):
        if name in values:
            values[name] = triad.limit = float(np.quantile(np.abs(out).max(axis=1), 1.0 - values[name]))
    outputs = noise_models.add_imu_noise(*outputs, model, imu_rate, _generator(seed, 'noise'))
    outputs = [np.clip(out, -triad.limit, triad.limit) for out, triad in zip(outputs, triads)]

    rng = _generator(seed, 'clock')
    start_ns = 1_700_000_000_000_000_000 + int(rng.integers(10**12))
    imu = ImuSamples(noise_models.jitter_stamps(start_ns + _to_ns(sampling.time + values.get('time_offset', 0.0)), model.stamp_jitter, rng),
                     *outputs, 'imu_link')
    joints = _read_joints(mapping, moves, values, model, joint_rate, velocity, start_ns, _generator(seed, 'encoders'))
    values.update({'earth_rate': world.earth_n} if 'earth_rate' in hidden else {})
    session = Session(imu, joints, climate.publish(start_ns, moves.duration, _generator(seed, 'thermometer')) if temperature else None, _told(mapping, gravity, hidden),
                      _claims(model, imu_rate) if wrong_covariance else None,
                      {'accelerometer': triads[0], 'gyroscope': triads[1], 'values': values, 'earth_n': world.earth_n, 'gravity': gravity,
                       'temperature_c': climate.at(sampling.time),
                       'profile': moves, 'noise': model, 'start_ns': start_ns, **events})
    return _drop(session, dropped, start_ns, events['gap'])


def write_bag(session, path, **options):
    """Write the session into a new bag, with the covariances that it claims."""
    from msg_adapters.write import write_session
    if session.covariance is not None:
        options.update({f'{name}_cov': variance * np.eye(3) for name, variance in session.covariance.items()})
    write_session(path, session.imu, session.joints, session.temperature, **options)


# --- what is drawn -----------------------------------------------------------------------------------------------------------

def _generator(seed, what):
    return np.random.default_rng([seed, crc32(what.encode())])


def _draw(name, size, n_joints, rng):
    """Return the value of an effect: the given array, or a random one of the given magnitude."""
    if name not in EFFECTS and name not in OUTSIDE:
        raise KeyError(f'{name} is neither in EFFECTS nor in OUTSIDE')
    if size is not None and np.ndim(size):
        return np.asarray(size, float)
    if name in OUTSIDE:
        return float(OUTSIDE[name] if size is None else size)
    usual, shape = EFFECTS[name]
    size = float(usual if size is None else size)
    if name.endswith('_saturation') or name.endswith('_bandwidth') or name == 'earth_rate':
        return size
    if name.endswith('_bias_drift'):
        return np.append(size * _pattern((3,), rng), rng.uniform(40.0, 150.0))
    if name == 'encoder_harmonic':
        phase = rng.uniform(0.0, 2.0 * np.pi, (n_joints, 2))
        amplitude = size * rng.uniform(0.6, 1.4, (n_joints, 2)) * [1.0, 0.4]
        return np.stack([amplitude * np.cos(phase), amplitude * np.sin(phase)], axis=2)
    shape = {'axis_non_orthogonality': (n_joints - 1,), 'encoder_zero': (n_joints - 2,)}.get(name, shape)
    return float(size * _pattern((), rng)) if shape == () else size * _pattern(shape, rng)


def _pattern(shape, rng):
    return rng.uniform(0.6, 1.4, shape) * rng.choice([-1.0, 1.0], shape)


def _draw_imu(grade, values, arms, rng):
    """Return the accelerometer and the gyroscope of one random unit, with the hidden effects built in."""
    accel, gyro = (Triad(rng.normal(0.0, min(bias, most), 3), np.diag(1.0 + rng.normal(0.0, grade.scale, 3)) + _misalignment(grade.misalignment, rng))
                   for bias, most in ((grade.accel_bias, 30 * MG), (grade.gyro_bias, 1.0 * DEG)))
    drawn_arms = rng.uniform(-1.0, 1.0, (3, 3)) * grade.arm
    if arms:
        accel.arms = drawn_arms
    accel.arms = accel.arms + values.get('accel_size_effect', 0.0) + values.get('lever_arm', 0.0)
    for triad, short in ((accel, 'accel'), (gyro, 'gyro')):
        triad.quadratic = values.get(short + '_quadratic', 0.0)
        triad.asymmetry = values.get(short + '_scale_asymmetry', 0.0)
        triad.thermal_bias = values.get(short + '_thermal_bias', 0.0)
        triad.thermal_scale = values.get(short + '_thermal_scale', 0.0)
        triad.low_pass = float(values.get(short + '_bandwidth', 0.0))
        if short + '_bias_drift' in values:
            triad.drift, triad.drift_constant = values[short + '_bias_drift'][:3], values[short + '_bias_drift'][3]
    accel.cubic = values.get('accel_cubic', 0.0)
    accel.products, gyro.products = values.get('accel_cross_product'), values.get('gyro_rate_product')
    gyro.to_force = values.get('gyro_g_sensitivity')
    return accel, gyro


def _misalignment(size, rng):
    matrix = rng.normal(0.0, size, (3, 3))
    np.fill_diagonal(matrix, 0.0)
    return matrix


def _draw_events(moves, rng):
    """Return the times and directions of things that may happen, drawn always so that the rest of the session does not depend on them."""
    length = moves.duration
    stops = moves.find('rest')[:, 0]
    return {'knock': rng.uniform(0.25, 0.75) * length, 'slip': rng.uniform(0.3, 0.7) * length, 'gap': rng.uniform(0.2, 0.8) * length,
            'second_start': rng.uniform(0.2, 0.5) * length, 'second_constant': rng.uniform(0.1, 0.3) * length,
            'direction': _unit(rng.normal(size=3)), 'turn': _unit(rng.normal(size=3)), 'stops': stops, 'stop_bias': rng.normal(size=(len(stops) + 1, 3))}


def _unit(vector):
    return vector / np.linalg.norm(vector)


def _noise_model(noise, grade, encoder_resolution):
    if isinstance(noise, str):
        full = noise_models.realistic(grade)
        quiet = replace(full.white_only(), encoder_noise=2e-6)
        noise = {'none': noise_models.NoiseModel(), 'white': quiet, 'realistic': replace(full, encoder_noise=2e-6)}[noise]
    return noise if encoder_resolution is None else replace(noise, encoder_resolution=encoder_resolution)


# --- what happens ------------------------------------------------------------------------------------------------------------

class _Sampling:
    """Times of the IMU's samples, and a grid `factor` times finer that contains them."""

    def __init__(self, rate, duration, factor):
        self.factor, self.step = factor, 1.0 / rate / factor
        self.time = np.arange(round(duration * rate)) / rate
        self.fine_time = np.arange((len(self.time) - 1) * factor + 1) * self.step


class _Climate:
    """Temperature at the sensor: a warm-up, the room's control on top, and a heater when asked."""

    def __init__(self, kind, duration, rng):
        self.rise, self.constant = rng.uniform(6.0, 10.0), rng.uniform(0.2, 0.6) * duration
        self.period, self.phase = rng.uniform(0.5, 0.8) * duration, rng.uniform(0.0, 2.0 * np.pi)
        self.heater = 6.0 if kind == 'cycle' else 0.0
        self.duration = duration

    def at(self, time):
        room = 0.7 * np.sin(2.0 * np.pi * time / self.period + self.phase) + 0.5 * self.heater * (1.0 - np.cos(4.0 * np.pi * time / self.duration))
        return 24.0 - self.rise * np.expm1(-time / self.constant) + room

    def publish(self, start_ns, duration, rng, rate=1.0):
        time = np.arange(0.0, duration, 1.0 / rate)
        return TemperatureSamples(start_ns + _to_ns(time), np.round(self.at(time) + rng.normal(0.0, 0.01, len(time)), 2))


def _move(mapping, moves, time, gravity, values, events):
    motion = moves.at(time)
    if 'encoder_zero' in values:
        offset = np.zeros(motion.position.shape[1])
        offset[1:-1] = values['encoder_zero']
        motion = JointMotion(time, motion.position + offset, motion.rate, motion.acceleration, motion.jerk)
    slip = None
    if 'fixture_slip' in values:
        slip = np.where(time[:, None] > events['slip'], values['fixture_slip'] * events['turn'], 0.0)
    return move_table(mapping, time, motion, gravity, values.get('table_tilt', (0.0, 0.0)), values.get('axis_non_orthogonality'), slip)


def _sense(world, triads, temperature_c, values, events, n_joints):
    accel, gyro = triads
    force_s = world.to_sensor(world.force_n)
    same = not np.any(accel.arms)
    forces = [force_s] * 3 if same else [world.force_at(arm) for arm in accel.arms]
    rates = [world.to_sensor(world.rate_n)] * 3
    outputs = [accel.respond(forces, world.time, temperature_c, force_s), gyro.respond(rates, world.time, temperature_c, force_s)]
    first, second = world.joints[:, 0], world.joints[:, min(1, n_joints - 1)]
    for k, name in enumerate(('angle_bias_accel', 'angle_bias_gyro')):
        if name in values:
            outputs[k] += values[name] * np.outer(np.sin(3.0 * first) * np.cos(5.0 * second), events['direction'])
    if 'stop_bias' in values:
        outputs[0] += values['stop_bias'] * events['stop_bias'][np.searchsorted(events['stops'], world.time, side='right')]
    if 'knock_step' in values:
        outputs[0] += values['knock_step'] * np.outer(world.time > events['knock'], events['direction'])
    if 'second_warm_up' in values:
        since = np.maximum(world.time - events['second_start'], 0.0)
        outputs[0] -= values['second_warm_up'] * np.outer(np.expm1(-since / events['second_constant']), events['direction'])
    return outputs


def _shock(time, start):
    """Return what accelerometer and gyroscope feel of a blow: 35 Hz that dies out within 0.3 s."""
    since = np.maximum(time - start, 0.0)
    ring = (time >= start) * np.exp(-since / 0.08) * np.sin(2.0 * np.pi * 35.0 * since + 0.5)
    return 3.0 * np.outer(ring, [1.0, -0.6, 0.3]), 0.05 * np.outer(ring, [0.3, 1.0, -0.5])


# --- what is told ------------------------------------------------------------------------------------------------------------

def _read_joints(mapping, moves, values, model, joint_rate, velocity, start_ns, rng):
    time = np.arange(round(moves.duration * joint_rate)) / joint_rate + rng.uniform(0.0, 1.0 / joint_rate)
    motion = moves.at(time)
    shown, slope = _encoder_reading(motion.position, values.get('encoder_harmonic'))
    rate = motion.rate * slope
    shown = noise_models.read_encoders(shown, model, rng)
    rate = {'good': rate + rng.normal(0.0, 1e-5, rate.shape) * (model.encoder_noise > 0.0), 'none': np.full_like(rate, np.nan), 'zero': np.zeros_like(rate),
            'differences': np.gradient(shown, 1.0 / joint_rate, axis=0)}[velocity]
    return JointSamples(start_ns + _to_ns(time), shown, rate, tuple(joint['name'] for joint in mapping['joints']))


def _encoder_reading(angle, harmonics):
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


def _told(mapping, gravity, hidden):
    """Return the description that the searcher gets: nominal, and without latitude when Earth rate is hidden."""
    told = copy.deepcopy(mapping)
    if 'earth_rate' in hidden:
        told.update(gravity=float(gravity), latitude=None, height=None, azimuth_deg=None)
    return told


def _claims(model, imu_rate):
    return {'force': 0.01 * model.accel_density**2 * imu_rate, 'rate': 0.01 * model.gyro_density**2 * imu_rate}


def _drop(session, dropped, start_ns, gap):
    def kept(samples):
        since = (samples.stamp_ns - start_ns) * 1e-9
        return samples.select((since < gap) | (since > gap + 2.0))
    if dropped is None:
        return session
    return replace(session, imu=kept(session.imu) if dropped in ('imu', 'both') else session.imu,
                   joints=kept(session.joints) if dropped in ('joints', 'both') else session.joints)


def _to_ns(time):
    return np.round(np.asarray(time) * 1e9).astype(np.int64)
