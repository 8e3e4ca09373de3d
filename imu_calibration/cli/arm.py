"""``imu_calibration arm``: where one IMU sits relative to another on the same rigid body."""

from typing import TYPE_CHECKING

from imu_calibration.cli.parser import BAG, OneLineParser, Options, VerbResult, print_line
from imu_calibration.core.errors import InputError

if TYPE_CHECKING:
    from imu_calibration.api.recordings import Topics

EXAMPLES = (
    'session --imu-topic /imu_a/data_raw --imu-topic /imu_b/data_raw',
    'session --imu-topic /imus --frame-id front --imu-topic /imus --frame-id rear',
)


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.add_argument('bag', metavar='BAG', help=BAG)
    parser.common(
        '--imu-topic',
        metavar='TOPIC',
        action='append',
        required=True,
        help='give it twice: first A, then B',
    )
    parser.common(
        '--frame-id',
        metavar='FRAME',
        action='append',
        default=[],
        help='frame_id of A, then of B; for a topic with several',
    )
    parser.add_readings()
    parser.add_exclusion()
    parser.add_rows()


def run(options: Options) -> VerbResult:
    """Estimate and print."""
    from imu_calibration.api.choices import log_options, readings_of
    from imu_calibration.api.recordings import open_bag, source_of, sources_without
    from imu_calibration.between_imus.arm import estimate_arm
    from imu_calibration.cli.show import warn
    from imu_calibration.core.units import with_sd
    from imu_calibration.preprocessing.checks import Preflight, visible_findings
    from imu_calibration.preprocessing.sample_recording import read_recording

    # Read both IMUs, with their faults; joints are not used.
    topics_of_both = _topics_of_both(options)
    choices = options.choices()
    readings = readings_of(choices)
    log = log_options(readings, choices)
    imus = []
    for topics in topics_of_both:
        topics = topics._replace(log=log)
        open_bag(options.bag, topics, want_joints=False).close()  # refuses a missing topic
        (source,) = sources_without(
            [source_of(options.bag, topics)], [options.bag], options.exclude
        )
        recording = read_recording(source, readings, Preflight())
        imus.append(recording.imu)
        findings = visible_findings(recording.findings)
        warn(finding.named(str(topics.imu)).to_mapping() for finding in findings)

    # The arm from A to B, in mm as on a drawing.
    first, second = imus
    result = estimate_arm(first, second)
    for axis, value, sd in zip('xyz', result.arm, result.arm_sd):
        shown, spread = with_sd(value * 1e3, sd * 1e3)
        print_line(f'{axis}: {shown} +- {spread} mm')
    for line in result.lines():
        print_line(line)
    return VerbResult(
        0, {'arm': result.arm, 'sd': result.arm_sd, 'unit': 'm', 'notes': list(result.lines())}
    )


def _topics_of_both(options: Options) -> list['Topics']:
    """Return the topics of A and of B: two Imu topics, or two frames on one of them."""
    from imu_calibration.api.recordings import Topics

    if len(options.imu_topic) != 2:
        raise InputError(
            f'--imu-topic must be given twice, A and B, got {len(options.imu_topic)}; name both'
            ' IMUs'
        )
    frames = options.frame_id or [None, None]
    if len(frames) != 2:
        raise InputError(
            f'--frame-id must be given twice, for A and B, or omitted, got {len(frames)}; name both'
            ' frames'
        )
    topics = []
    distinct = set()
    for topic, frame in zip(options.imu_topic, frames):
        topics.append(Topics(imu=topic, frame=frame))
        distinct.add((topic.lstrip('/'), frame))
    if len(distinct) == 1:
        raise InputError(
            f'A and B must be two IMUs, got {options.imu_topic[0]} twice; name another topic, or a'
            ' frame_id for each',
            key='frame_id',
            code='same_imu',
        )
    return topics
