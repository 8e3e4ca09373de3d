"""
``imu_calibration simulate``.

A bag of a simulated session or of a replayed recording, with the true parameters.
"""

from imu_calibration.cli.parser import OneLineParser, Options, VerbResult, print_line
from imu_calibration.core.errors import InputError
from imu_calibration.simulation.sensor_noise import GRADES
from msg_adapters.storages import identifiers

EXAMPLES = (
    '--effect gyro_g_sensitivity --grade consumer --table table.yaml --output session',
    (
        '--replay recording --calibration result/calibration.yaml --table table.yaml --output'
        ' simulated'
    ),
)


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.common('--output', metavar='BAG', required=True, help='rosbag2 folder to make')
    parser.common(
        '--calibration',
        metavar='FILE',
        help='simulate with a fitted or extended model instead of a random IMU',
    )
    parser.common(
        '--replay',
        metavar='BAG',
        help=(
            'simulate the IMU of --calibration on the joints, stamps, temperature and noise of a'
            ' recording'
        ),
    )
    parser.common(
        '--effect',
        metavar='NAME',
        action='append',
        default=[],
        help='add an effect of the catalogue; may be repeated',
    )
    parser.expert(
        '--size',
        type=float,
        default=0.3,
        help='size of added effects as a share of the largest plausible one, default 0.3',
    )
    parser.add_effects(parser.expert)
    parser.common(
        '--profile',
        metavar='NAME',
        default='calibration',
        help='motion, default calibration; an unknown name lists all',
    )
    parser.common(
        '--grade',
        choices=sorted(GRADES),
        default='industrial',
        help='grade of the IMU, default industrial',
    )
    parser.common('--seed', type=int, default=0, help='seed of noise and motion, default 0')
    parser.expert(
        '--imu-seed',
        metavar='SEED',
        type=int,
        help='seed of the IMU itself, default the same: two sessions of one IMU share it',
    )
    parser.common('--duration', type=float, help='wanted length, s')
    parser.expert('--imu-rate', metavar='HZ', type=float, default=100.0, help='Hz, default 100')
    parser.expert('--joint-rate', metavar='HZ', type=float, default=100.0, help='Hz, default 100')
    parser.expert(
        '--encoder-resolution-deg',
        metavar='DEG',
        type=float,
        default=0.0,
        help='step of the joint positions, deg, default none',
    )
    parser.expert(
        '--stamp-jitter-us',
        metavar='US',
        type=float,
        default=0.0,
        help='standard deviation of the IMU stamps, microseconds, default none',
    )
    parser.expert(
        '--temperature', action='store_true', help='publish a temperature that warms up from 25 C'
    )
    parser.add_recording('default a three-axis table')
    parser.expert('--storage', choices=identifiers(), default='sqlite3', help='default sqlite3')
    parser.expert(
        '--compression',
        choices=('none', 'zstd', 'lz4'),
        default='none',
        help='of the chunks of an mcap, default none',
    )


def run(options: Options) -> VerbResult:
    """Simulate and write."""
    from imu_calibration.api.simulate import replay, simulate

    if options.replay is None:
        simulated = simulate(
            **options.arguments_for(simulate)
            | {
                'effects': options.effect,
                'table': options.stand(),
            }
        )
    else:
        if options.calibration is None:
            raise InputError(
                '--replay requires the IMU to simulate, no calibration was given; add --calibration'
                ' FILE',
                key='calibration',
                code='replay_without_calibration',
            )
        simulated = replay(
            options.replay,
            options.calibration,
            options.stand(),
            seed=options.seed,
            **options.choices(),
        )
    simulated.save(options.output, storage=options.storage, compression=options.compression)
    n_imu = len(simulated.samples.imu or ())
    n_joints = len(simulated.samples.joints or ())
    line = (
        f'written: {options.output} ({simulated.duration:.0f} s, {n_imu} Imu, {n_joints}'
        ' JointState), with truth.yaml and table.yaml'
    )
    if simulated.lost:
        line += f'; {simulated.lost} samples without known joints left out'
    print_line(line)
    return VerbResult(
        0,
        {
            'output': str(options.output),
            'seconds': simulated.duration,
            'imu': n_imu,
            'joints': n_joints,
            'lost': simulated.lost,
        },
    )
