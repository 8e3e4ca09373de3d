"""
Range limits of driven joints: declared, endless or missing; doubtful units.

Restricted turns and the way back.
"""

import numpy as np
import yaml
from refusal import refused

from imu_calibration.cli.main import main
from imu_calibration.core.errors import InputError
from imu_calibration.kinematics.joint_motion import rest_at
from imu_calibration.kinematics.motion_limits import (
    limit_words,
    limits_of,
    missing_ranges,
    range_warnings,
)
from imu_calibration.kinematics.table import Table
from imu_calibration.kinematics.urdf import table_from_urdf
from imu_calibration.planning.campaign import Campaign, CampaignSettings
from imu_calibration.planning.planner import Decision, make_planner
from imu_calibration.planning.planning_problem import noise_of_grade
from imu_calibration.simulation.sensor_noise import GRADES
from imu_calibration.simulation.table_controller import limit_excess, trajectory_from

from worlds.arms import SIX_AXES

NOISE = noise_of_grade(GRADES['industrial'].noise, 100.0)


def table(**limits):
    """Two joints with these keys each."""
    axes = {'outer': [0, 0, 1], 'inner': [1, 0, 0]}
    return Table.from_mapping(
        {
            'joints': [{'name': name, 'axis': axes[name], **keys} for name, keys in limits.items()],
            'gravity': 9.81,
        }
    )


def test_a_joint_has_a_range_or_is_endless_or_is_listed():
    assert missing_ranges(table(outer={'endless': True}, inner={'range_deg': [-90, 90]})) == ()
    assert missing_ranges(table(outer={}, inner={'speed_deg_s': 10.0})) == ('outer', 'inner')
    slide = {'joints': [{'name': 'x', 'axis': [1, 0, 0], 'type': 'prismatic'}], 'gravity': 9.81}
    assert missing_ranges(Table.from_mapping(slide)) == ('x',)
    arm = table_from_urdf(SIX_AXES, 'imu_link')
    assert missing_ranges(arm) == () and limits_of(arm).endless.tolist() == [False] * 5 + [True]
    # Not radians as URDF wants.
    degrees = SIX_AXES.replace('lower="-2.9" upper="2.9"', 'lower="-166" upper="166"', 1)
    assert missing_ranges(table_from_urdf(degrees, 'imu_link')) == ('pan',)
    unlimited = SIX_AXES.replace('lower="-2.9" upper="2.9"', '', 1)
    assert missing_ranges(table_from_urdf(unlimited, 'imu_link')) == ('pan',)
    wide = {
        'name': 'robot',
        'axis': [1, 0, 0],
        'mimic': {'joint': 'outer'},
        'range_deg': [-3600, 3600],
    }
    follower = Table.from_mapping(
        {'joints': [{'name': 'outer', 'axis': [0, 0, 1]}, wide], 'gravity': 9.81}
    )
    # The table file gives this range, whatever the joint is called.
    assert missing_ranges(follower) == ()


def test_a_site_overrides_what_a_robot_description_says_of_the_range():
    site = {
        'gravity': 9.81,
        'joints': [{'name': 'wrist_3', 'range_deg': [-170, 0]}, {'name': 'pan', 'endless': True}],
    }
    joints = {
        joint.name: joint.limits for joint in table_from_urdf(SIX_AXES, 'imu_link', site).joints
    }
    assert joints['pan'].endless and joints['pan'].lower is None
    assert not joints['wrist_3'].endless and joints['wrist_3'].upper == 0.0
    with refused(InputError, 'range_and_endless', 'outer'):
        table(outer={'endless': True, 'range_deg': [0, 1]}, inner={})
    with refused(InputError, 'not_true_or_false', 'outer', 1):
        table(outer={'endless': 1}, inner={})
    again = table(outer={'endless': True}, inner={'range_deg': [-90, 90]})
    assert Table.from_mapping(again.to_mapping()) == again


def test_each_limit_is_printed_with_its_origin():
    site = {'gravity': 9.81, 'joints': [{'name': 'pan', 'speed_deg_s': 60.0}]}
    arm = table_from_urdf(SIX_AXES, 'imu_link', site)
    words = limit_words(arm, limits_of(arm).wound(np.zeros(6), 1.0))
    assert (
        words[0]
        == 'pan: -166.2 to 166.2 deg (robot description), 60 deg/s (table file), 300 deg/s^2'
        ' (default)'
    )
    assert (
        words[5]
        == 'wrist_3: endless, here -360 to 360 deg (robot description), 150 deg/s (default), 300'
        ' deg/s^2 (default)'
    )
    bare = table(outer={}, inner={'range_deg': [-90, 90]})
    assert limit_words(bare, limits_of(bare))[0].startswith('outer: no range, 150 deg/s (default)')


def test_a_range_in_radians_is_questioned():
    lines = range_warnings(
        table(outer={'range_deg': [-1.57, 1.57]}, inner={'range_deg': [-90, 90]})
    )
    assert len(lines) == 1 and "'outer'" in lines[0] and '[-90.0, 90.0]' in lines[0]


def test_an_endless_joint_keeps_to_its_turns_and_is_unwound_at_the_end(start=1000.0):
    turntable = table(outer={'endless': True}, inner={'range_deg': [-90, 90]})
    position = np.array([start, 0.0])
    limits = limits_of(turntable).wound(position, 1.0)
    assert limits_of(turntable).wound(position, 0.0).endless[0]
    planner = make_planner(turntable, noise=NOISE, limits=limits)
    reached, at = [], position
    for number in np.random.default_rng(1).permutation(len(planner.problem.motions))[:60]:
        points = planner.problem.motions[number].points(at)
        if len(points):
            assert limit_excess(trajectory_from(rest_at(at[None]), points), limits)[0] <= 1e-9, (
                planner.problem.motions[number].words
            )
            reached.append(points.position[:, 0])
            at = points.position[-1]
    assert (
        np.ptp(np.concatenate(reached)) > 2 * np.pi
        and np.abs(np.concatenate(reached) - start).max() <= 2 * np.pi
    )
    planner.next_motion = lambda position: Decision(why='done')
    campaign = Campaign(planner, CampaignSettings(separations=0), unwind=planner.unwinding)
    wound = np.array([start + 6.0, 0.3])
    decision = campaign.decide(wound, 0.0)
    np.testing.assert_allclose(decision.motion.points(wound).position[-1], [start, 0.3])
    assert campaign.decide(wound, 1e9).motion is not None  # also when the time is over
    assert campaign.decide(np.array([start, 0.3]), 0.0).motion is None


def test_a_plan_without_limits_warns_and_exits_with_3(tmp_path, capsys):
    description = {
        'joints': [
            {'name': name, 'axis': axis}
            for name, axis in (('outer', [0, 1, 0]), ('inner', [0, 0, 1]))
        ],
        'gravity': 9.81,
    }
    codes, texts = [], []
    for k, keys in enumerate(({}, {'endless': True})):
        for joint in description['joints']:
            joint.update(keys)
        (tmp_path / 'table.yaml').write_text(yaml.safe_dump(description))
        codes.append(
            main(
                [
                    'plan',
                    '--table',
                    str(tmp_path / 'table.yaml'),
                    '--output',
                    str(tmp_path / str(k)),
                    '--no-bound',
                    '--no-report',
                ]
            )
        )
        texts.append(capsys.readouterr().out)
        assert (
            'collisions' in texts[-1]
            and 'collisions' in (tmp_path / str(k) / 'plan.yaml').read_text()
        )
    assert codes == [3, 0]
    assert 'outer, inner' in texts[0] and 'outer, inner' not in texts[1]


def test_a_plan_keeps_to_the_neighbourhood_of_a_pose(tmp_path, capsys):
    pose = dict(outer=20.0, inner=100.0)
    joints = [
        {'name': 'outer', 'axis': [0, 1, 0], 'range_deg': [-170, 170]},
        {'name': 'inner', 'axis': [0, 0, 1], 'endless': True},
    ]
    (tmp_path / 'table.yaml').write_text(yaml.safe_dump({'joints': joints, 'gravity': 9.81}))
    arm = [
        'plan',
        '--table',
        str(tmp_path / 'table.yaml'),
        '--no-bound',
        '--no-report',
        '--output',
        str(tmp_path / 'out'),
    ]
    # Every joint, or it is no pose.
    assert main([*arm, '--around', 'outer=20', '--reach', '15']) == 1
    assert main([*arm, '--reach', '15']) == main([*arm, '--around', 'outer:20']) == 1
    assert len(capsys.readouterr().err.splitlines()) == 3
    assert main(
        [
            *arm,
            '--around',
            ','.join(f'{name}={value}' for name, value in pose.items()),
            '--reach',
            '15',
        ]
    ) in (0, 3)
    trajectory = yaml.safe_load((tmp_path / 'out/trajectory.yaml').read_text())
    away = np.degrees([point['positions'] for point in trajectory['points']]) - [
        pose[name] for name in trajectory['joint_names']
    ]
    assert 5.0 < np.abs(away).max() <= 15.0 + 1e-4
    assert (
        'inner: endless, here 85 to 115 deg'
        in yaml.safe_load((tmp_path / 'out/plan.yaml').read_text())['provenance']['limits']
    )
