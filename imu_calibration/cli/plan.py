"""``imu_calibration plan``: the motions that bring every parameter within its tolerance."""

from pathlib import Path
from typing import TYPE_CHECKING

from imu_calibration.cli.parser import OneLineParser, Options, VerbResult, print_line
from imu_calibration.core.errors import InputError
from imu_calibration.simulation.sensor_noise import GRADES
from msg_adapters.storages import identifiers

if TYPE_CHECKING:
    from imu_calibration.api.plan import Planned
    from imu_calibration.api.recordings import Stand

EXAMPLES = ('--table table.yaml --output plan', '--by-hand --output plan')


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.common(
        '--output',
        metavar='DIR',
        required=True,
        help='folder for plan.yaml, the trajectory and report.html',
    )
    parser.add_stand('with limits')
    parser.common(
        '--by-hand',
        action='store_true',
        help='without a table: poses and turns in text and pictures',
    )
    parser.common(
        '--calibration',
        '--known',
        metavar='FILE',
        help='known already: calibration.yaml or .accumulator.npz',
    )
    parser.common(
        '--around',
        metavar='NAME=DEG,...',
        default='',
        help='pose that the motion keeps near, every joint (sliding: m)',
    )
    parser.common(
        '--reach',
        metavar='DEG',
        type=float,
        help='largest angle from that pose; sliding joints do not move',
    )
    parser.expert(
        '--motion',
        choices=('any', 'yaw-only'),
        default='any',
        help='yaw-only: turns by known angles about the vertical',
    )
    parser.expert(
        '--separate',
        metavar='A,B',
        default='',
        help='separate these effects; the first is in --calibration',
    )
    parser.expert(
        '--diagnosis',
        metavar='FILE',
        help='diagnosis.json: separate the effects that it names together',
    )
    parser.expert(
        '--grade',
        choices=sorted(GRADES),
        default='industrial',
        metavar='GRADE',
        help=f'of the IMU: {", ".join(sorted(GRADES))}',
    )
    parser.expert('--noise', metavar='FILE', help='noise.yaml of this IMU in place of a grade')
    parser.expert(
        '--tolerances', metavar='FILE', help='largest sd of a determined parameter, by effect'
    )
    parser.expert('--imu-rate', type=float, default=100.0, metavar='HZ', help='default 100')
    parser.add_gravity()
    parser.expert('--accelerometer-model', metavar='MODEL', help='default size_effect')
    parser.expert('--gyroscope-model', metavar='MODEL', help='default bias+matrix')
    parser.expert('--reference-model', metavar='MODEL', help='default table_tilt')
    parser.add_effects(parser.expert)
    parser.expert(
        '--storage',
        choices=identifiers(),
        default='sqlite3',
        help='of the trajectory, default sqlite3',
    )
    parser.add_force('replace an existing plan; its trajectory is moved to trajectory.1')
    parser.expert(
        '--no-bound',
        action='store_true',
        help='no lower bound on the time (saves most of the run time)',
    )
    parser.expert('--no-report', action='store_true', help='no report.html')


def run(options: Options) -> VerbResult:
    """Plan into a folder that can be written, print the prediction, return the exit code."""
    from imu_calibration.api.plan import by_hand, plan, require_no_plan
    from imu_calibration.document import files
    from imu_calibration.planning.planner import plan_to_mapping

    require_no_plan(options.output, report=not options.no_report, force=options.force)
    with files.output_folder(options.output) as folder:
        if options.by_hand and options.motion == 'any':
            planned = by_hand(grade=options.grade, imu_rate=options.imu_rate, **options.choices())
        else:
            planned = plan(
                _stand(options),
                calibration=options.calibration,
                grade=options.grade,
                imu_rate=options.imu_rate,
                with_bound=not options.no_bound,
                separate=[name for name in options.separate.split(',') if name],
                diagnosis=options.diagnosis,
                around=_pose(options.around),
                reach=options.reach,
                **options.choices(),
            )
        planned.save(
            folder,
            report=not options.no_report,
            storage=options.storage,
            force=options.force,
        )
    _show(planned, folder)
    document = plan_to_mapping(planned.plan, planned.provenance)
    return VerbResult(planned.exit_code, document, planned.reasons)


def _pose(text: str) -> dict[str, float]:
    """Return joint -> number of 'NAME=NUMBER,...'."""
    pose = {}
    try:
        for part in text.split(','):
            if part:
                name, value = part.split('=')
                pose[name.strip()] = float(value)
    except ValueError:
        raise InputError(
            f"a pose must be NAME=DEG,..., got '{text}'; name every joint once"
        ) from None
    return pose


def _stand(options: Options) -> 'Stand | None':
    """Return the table or arm of the options; for yaw-only one axis that is vertical."""
    from imu_calibration.kinematics.rotations import local_gravity
    from imu_calibration.planning.motion_library import yaw_table

    if options.motion == 'yaw-only':
        gravity, _ = local_gravity(options.gravity, options.latitude, options.height)
        return yaw_table(gravity)
    return options.stand()


def _show(planned: 'Planned', folder: Path) -> None:
    """Print the first motions with their ends, the prediction, and where the files are."""
    from imu_calibration.api.plan import plan_summary

    plan = planned.plan
    limit = plan.most_printed  # None: all motions are printed
    for end, motion in list(zip(plan.ends, plan.motions, strict=True))[:limit]:
        print_line(f'until {end:6.1f} s  {motion.words}', ' ' * 16)
    if limit is not None and len(plan.motions) > limit:
        print(f'... and {len(plan.motions) - limit} more, in plan.yaml')
    for line in [*plan_summary(plan), *planned.notes]:
        print_line(line, '    ')
    trajectory = ' and the trajectory' if plan.moved_joints else ''
    print_line(f'written: plan.yaml{trajectory} in {folder}')
