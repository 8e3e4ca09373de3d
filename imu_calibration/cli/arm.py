"""``imu_calibration arm``: where one IMU sits relative to another on the same rigid body."""

from argparse import Namespace

from imu_calibration.by_hand.workflow import read_imu
from imu_calibration.cli.parser import OneLineParser
from imu_calibration.cli.show import console, warn
from imu_calibration.errors import InputError
from imu_calibration.preflight.checks import Preflight, warnings
from imu_calibration.units import with_sd
from imu_calibration.use_cases.recordings import Topics, open_bag, source_of

NAME = 'arm'
HELP = 'Position of one IMU relative to another on the same rigid body, from their measurements in motion.'


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.add_argument('bag', metavar='BAG')
    parser.add_argument('--imu-topic', metavar='TOPIC', action='append', required=True, help='give it twice: first A, then B')


def run(options: Namespace) -> int:
    """Estimate and print."""
    from imu_calibration.by_hand.relative_arm import estimate_arm
    if len(options.imu_topic) != 2:
        raise InputError(f'--imu-topic must be given twice, A and B, it came {len(options.imu_topic)} times; name both IMUs')
    imus = []
    for topic in map(Topics, options.imu_topic):
        open_bag(options.bag, topic, want_joints=False).close()
        blocks = source_of(options.bag, topic)()
        preflight = Preflight()
        imus.append(read_imu(blocks, [preflight])[0])
        warn({'text': f'{topic.imu}: {finding.text}'} for finding in warnings(preflight.findings))
    first, second = imus
    result = estimate_arm(first, second)
    out = console()
    for axis, value, sd in zip('xyz', result.arm, result.arm_sd):
        shown, spread = with_sd(value * 1e3, sd * 1e3)
        out.print(f'{axis}: {shown} +- {spread} mm')
    for line in result.lines():
        out.print(line, soft_wrap=True)
    return 0
