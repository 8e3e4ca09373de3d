"""``imu_calibration simulate``: a bag from a simulated session, and the truth beside it."""

import math
from dataclasses import replace

import numpy as np

from imu_calibration import documents, files
from imu_calibration.calibration.document import Calibration, calibration_to_text
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.errors import InputError
from imu_calibration.reference.table import Table
from imu_calibration.resources import config_file
from imu_calibration.simulation.profiles import make_profile, profile_names
from imu_calibration.simulation.sensor_noise import GRADES
from imu_calibration.simulation.session import SimulationOptions, hidden_effect, random_values, simulate

NAME = 'simulate'
HELP = 'Write a bag from a simulated session on a turntable, and truth.yaml beside its data.'


def add_arguments(parser):
    """Declare the arguments."""
    parser.add_argument('--table', metavar='TABLE', help='table description (YAML); default: a three-axis table')
    parser.add_argument('--output', metavar='BAG', required=True, help='rosbag2 folder to make')
    parser.add_argument('--calibration', metavar='FILE', help='simulate with a fitted or extended model instead of a random IMU')
    parser.add_argument('--effect', metavar='NAME', action='append', default=[], help='add an effect of the catalogue; may be repeated')
    parser.add_argument('--size', type=float, default=0.3, help='size of added effects as a share of the largest plausible one, default 0.3')
    parser.add_argument('--profile', metavar='NAME', default='calibration', help='motion: ' + ', '.join(profile_names()))
    parser.add_argument('--grade', choices=sorted(GRADES), default='industrial', help='grade of the IMU, default industrial')
    parser.add_argument('--seed', type=int, default=0, help='seed of noise and motion, default 0')
    parser.add_argument('--imu-seed', type=int, help='seed of the IMU itself, default the same: two sessions of one IMU share it')
    parser.add_argument('--duration', type=float, help='wanted length, s')
    parser.add_argument('--imu-rate', type=float, default=100.0, help='Hz, default 100')
    parser.add_argument('--joint-rate', type=float, default=100.0, help='Hz, default 100')
    parser.add_argument('--encoder-resolution-deg', type=float, default=0.0, help='step of the joint positions, deg, default none')
    parser.add_argument('--stamp-jitter-us', type=float, default=0.0, help='standard deviation of the IMU stamps, microseconds, default none')
    parser.add_argument('--temperature', action='store_true', help='publish a temperature that warms up from 25 C')
    parser.add_argument('--storage', choices=('sqlite3', 'mcap'), default='sqlite3')
    parser.add_argument('--compression', choices=('none', 'zstd', 'lz4'), default='none', help='of the chunks of an mcap, default none')


def run(options):
    """Simulate and write."""
    from msg_adapters.write import write_session
    table = files.read_table(options.table or config_file('table_three_axis.yaml'))
    profile = make_profile(options.profile, options.seed, table, options.duration)
    if profile.table is not None:
        table = Table.from_mapping(profile.table)
    model, values = _truth(options, table)
    noise = replace(GRADES[options.grade].noise, encoder_resolution=math.radians(options.encoder_resolution_deg), stamp_jitter=options.stamp_jitter_us * 1e-6)
    settings = SimulationOptions(options.imu_rate, options.joint_rate, noise,
                                 temperature_start_c=25.0 if options.temperature or 'thermal' in ' '.join(options.effect) else None)
    imu, joints, temperature = simulate(model, values, table, profile, settings, options.seed)
    packed = {} if options.compression == 'none' else {'compression': options.compression}
    write_session(options.output, imu, joints, temperature, storage=options.storage, **packed)
    truth = Calibration(model.at(values), values, np.zeros((len(values),) * 2), ('determined',) * len(values), settings.frame_id,
                        {'origin': 'mean_of_sensitive_points', 'axes': 'mount'}, provenance={'simulated': {'seed': options.seed, 'profile': options.profile}})
    files.write_text(f'{options.output}/truth.yaml', calibration_to_text(truth))
    files.write_text(f'{options.output}/table.yaml', documents.to_text(table.to_mapping()))
    print(f'written: {options.output} ({profile.duration:.0f} s, {len(imu)} Imu, {len(joints)} JointState), with truth.yaml and table.yaml')
    return 0


def _truth(options, table):
    names = table.joint_names
    if options.calibration:
        calibration = files.read_calibration(options.calibration)
        if calibration.model.reference and set(calibration.model.joint_names) != set(names):
            raise InputError(f"the calibration must be of a table with joints {', '.join(names)}, it names {', '.join(calibration.model.joint_names)}; "
                             'give the table it was made with')
        model, values = calibration.model, calibration.values
    else:
        model = SensorModel(accelerometer=('bias', 'matrix', 'accel_size_effect'), joint_names=names)
        values = random_values(model, options.grade, options.seed if options.imu_seed is None else options.imu_seed)
    for name in options.effect:
        sensor, hidden = hidden_effect(name, names, options.seed, options.size)
        wider = model.with_effect(sensor, name)
        extended = wider.start()
        for effect in model.effects:
            extended[wider.slices[effect.sensor, effect.name]] = values[model.slices[effect.sensor, effect.name]]
        extended[wider.slices[sensor, name]] = hidden
        model, values = replace(wider, point={}), extended
    return model, values
