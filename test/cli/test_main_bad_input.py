"""
Bad input through the command line: one line that says what must hold, what came and what to do.

Exit code 1; nothing half written.
"""

import json
import os
from dataclasses import replace

import numpy as np
import pytest
import yaml

from imu_calibration.cli.main import main
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.table import Table
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.sensor_noise import GRADES
from imu_calibration.simulation.session import SimulationOptions, random_values, simulate_session
from msg_adapters.write import write_session

JOINTS = [
    {'name': 'outer', 'axis': [0, 0, 1]},
    {'name': 'middle', 'axis': [0, 1, 0]},
    {'name': 'inner', 'axis': [1, 0, 0]},
]
DESCRIPTION = {'joints': JOINTS, 'up': [0, 0, 1], 'latitude': 48.8}
TABLE = Table.from_mapping(DESCRIPTION)
G = 9.80665


@pytest.fixture(scope='module')
def session():
    """A short session: (ImuSamples, JointSamples)."""
    model = SensorModel()
    options = SimulationOptions(50.0, 50.0, GRADES['industrial'].noise)
    return simulate_session(
        model,
        random_values(model, 'industrial', 2),
        TABLE,
        profile=make_profile('quick', 2, TABLE),
        options=options,
        seed=2,
    )[:2]


@pytest.fixture(scope='module')
def home(tmp_path_factory, session):
    """A folder with the good recording `bag`, its table and a calibration."""
    folder = tmp_path_factory.mktemp('bad_input')
    write_session(str(folder / 'bag'), *session)
    (folder / 'table.yaml').write_text(yaml.safe_dump(DESCRIPTION))
    assert (
        main(
            [
                'calibrate',
                str(folder / 'bag'),
                '--table',
                str(folder / 'table.yaml'),
                '--output',
                str(folder / 'good'),
                '--no-report',
                '--model-as-asked',
            ]
        )
        == 0
    )
    return folder


def refused(capsys, *arguments):
    """Run a verb that must refuse; return its one line."""
    capsys.readouterr()
    try:
        code = main([str(a) for a in arguments])
    except SystemExit as stop:
        code = stop.code
    printed = capsys.readouterr()
    assert code == 1
    assert printed.out == ''
    lines = printed.err.splitlines()
    assert len(lines) == 1, printed.err
    assert lines[0].startswith(f'imu_calibration {arguments[0]}: ')
    assert 'Traceback' not in printed.err
    return lines[0]


def calibrate_refused(capsys, tmp_path, bag, table, *more):
    """Calibrate into a folder that must stay as it was; return the line."""
    line = refused(capsys, 'calibrate', bag, '--table', table, '--output', tmp_path / 'out', *more)
    assert not (tmp_path / 'out').exists()
    return line


def rewritten(folder, imu, joints):
    """Write a recording and return its folder."""
    write_session(str(folder / 'changed'), imu, joints)
    return folder / 'changed'


def described(folder, **changes):
    """Write a table description with changes and return its path."""
    (folder / 'changed.yaml').write_text(yaml.safe_dump({**DESCRIPTION, **changes}))
    return folder / 'changed.yaml'


@pytest.mark.parametrize('option', ('--imu-topic', '--joint-topic'))
def test_an_unknown_topic(capsys, tmp_path, home, option):
    line = calibrate_refused(
        capsys, tmp_path, home / 'bag', home / 'table.yaml', option, '/nowhere'
    )
    assert '/nowhere' in line and ('/imu/data_raw' in line or '/joint_states' in line)


def test_a_topic_of_another_type(capsys, tmp_path, home):
    line = calibrate_refused(
        capsys, tmp_path, home / 'bag', home / 'table.yaml', '--imu-topic', '/joint_states'
    )
    assert '/joint_states' in line and 'Imu' in line


def test_no_joint_states(capsys, tmp_path, home, session):
    line = calibrate_refused(
        capsys, tmp_path, rewritten(tmp_path, session[0], None), home / 'table.yaml'
    )
    assert 'JointState' in line


def test_joint_names_that_do_not_match(capsys, tmp_path, home):
    joints = [dict(JOINTS[0], name='yaw'), *JOINTS[1:]]
    line = calibrate_refused(capsys, tmp_path, home / 'bag', described(tmp_path, joints=joints))
    assert 'yaw' in line and 'outer' in line


@pytest.mark.parametrize(('what', 'name'), (('rates', 'deg/s'), ('joints', 'degrees')))
def test_degrees_where_radians_belong(capsys, tmp_path, home, session, what, name):
    imu, joints = session
    if what == 'rates':
        imu = replace(imu, rate_s=np.rad2deg(imu.rate_s))
    else:
        joints = replace(
            joints, position=np.rad2deg(joints.position), velocity=np.rad2deg(joints.velocity)
        )
    line = calibrate_refused(
        capsys, tmp_path, rewritten(tmp_path, imu, joints), home / 'table.yaml'
    )
    assert name in line and 'rad' in line


def test_g_where_metres_per_second_squared_belong(capsys, tmp_path, home, session):
    imu = replace(session[0], force_s=session[0].force_s / G)
    line = calibrate_refused(
        capsys, tmp_path, rewritten(tmp_path, imu, session[1]), home / 'table.yaml'
    )
    assert 'm/s^2' in line and '--accelerometer-unit g' in line


def test_g_by_hand(capsys, tmp_path, session):
    imu = replace(session[0], force_s=session[0].force_s / G)
    line = refused(
        capsys, 'calibrate', rewritten(tmp_path, imu, None), '--output', tmp_path / 'out'
    )
    assert 'm/s^2' in line and 'g' in line
    assert not (tmp_path / 'out').exists()


def test_an_empty_bag(capsys, tmp_path, home, session):
    nothing = [samples.select(slice(0, 0)) for samples in session]
    line = calibrate_refused(capsys, tmp_path, rewritten(tmp_path, *nothing), home / 'table.yaml')
    assert 'must' in line


def test_a_bag_that_is_not_there(capsys, tmp_path, home):
    assert 'correct the path' in calibrate_refused(
        capsys, tmp_path, tmp_path / 'nothing', home / 'table.yaml'
    )


def test_a_file_that_is_no_bag(capsys, tmp_path, home):
    (tmp_path / 'notes.txt').write_text('no bag')
    calibrate_refused(capsys, tmp_path, tmp_path / 'notes.txt', home / 'table.yaml')


@pytest.mark.parametrize(
    ('changes', 'words'),
    (
        ({'joints': [dict(JOINTS[0], axis=[0, 0, 0]), *JOINTS[1:]]}, ('axis', 'outer', 'zero')),
        ({'latitude': None}, ('gravity', 'latitude')),
        ({'joints': []}, ('joint',)),
        ({'gravity': 'much'}, ('gravity', 'much')),
        ({'colour': 'grey'}, ('colour', 'gravity')),
    ),
)
def test_a_table_description_that_does_not_hold(capsys, tmp_path, home, changes, words):
    line = calibrate_refused(capsys, tmp_path, home / 'bag', described(tmp_path, **changes))
    assert [word for word in words if word not in line] == []


@pytest.mark.parametrize('text', ('joints: [unclosed', '- a list', '', '\x00'))
def test_a_table_file_that_is_no_mapping(capsys, tmp_path, home, text):
    (tmp_path / 'table.yaml').write_text(text)
    calibrate_refused(capsys, tmp_path, home / 'bag', tmp_path / 'table.yaml')


def test_a_calibration_from_a_newer_format(capsys, tmp_path, home):
    text = (
        (home / 'good' / 'calibration.yaml')
        .read_text()
        .replace('imu_calibration/1', 'imu_calibration/2')
    )
    (tmp_path / 'newer.yaml').write_text(text)
    line = refused(
        capsys,
        'compensate',
        home / 'bag',
        '--calibration',
        tmp_path / 'newer.yaml',
        '--output',
        tmp_path / 'out',
    )
    assert 'imu_calibration/2' in line
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize('damage', ('cut', 'foreign', 'singular'))
def test_a_calibration_that_cannot_be_used(capsys, tmp_path, home, damage):
    document = yaml.safe_load((home / 'good' / 'calibration.yaml').read_text())
    if damage == 'cut':
        del document['accelerometer']['matrix']['value']
    elif damage == 'foreign':
        document = {'camera_matrix': [1, 2, 3]}
    else:
        document['gyroscope']['matrix']['value'] = [[1.0, 1.0, 1.0]] * 3
    (tmp_path / 'damaged.yaml').write_text(yaml.safe_dump(document))
    refused(capsys, 'compare', home / 'good' / 'calibration.yaml', tmp_path / 'damaged.yaml')


@pytest.mark.parametrize('verb', ('calibrate', 'diagnose'))
def test_an_output_folder_that_cannot_be_written(capsys, tmp_path, home, verb):
    """A file stands where the folder should be (permissions do not stop an administrator)."""
    (tmp_path / 'taken').write_text('mine')
    line = refused(
        capsys, verb, home / 'bag', '--table', home / 'table.yaml', '--output', tmp_path / 'taken'
    )
    assert str(tmp_path / 'taken') in line
    assert (tmp_path / 'taken').read_text() == 'mine'


@pytest.mark.skipif(os.geteuid() == 0, reason='an administrator may write everywhere')
def test_an_output_folder_without_permission(capsys, tmp_path, home):
    (tmp_path / 'closed').mkdir(mode=0o500)
    assert str(tmp_path / 'closed') in refused(
        capsys,
        'calibrate',
        home / 'bag',
        '--table',
        home / 'table.yaml',
        '--output',
        tmp_path / 'closed',
    )


def test_an_output_bag_that_exists(capsys, home):
    line = refused(
        capsys,
        'compensate',
        home / 'bag',
        '--calibration',
        home / 'good' / 'calibration.yaml',
        '--output',
        home / 'good',
    )
    assert str(home / 'good') in line


@pytest.mark.parametrize(
    'more',
    (
        ('--setting', 'settling=soon'),
        ('--setting', 'colour=1'),
        ('--setting', 'settling=-1'),
        ('--accelerometer-model', 'bias+magic'),
        ('--gyroscope-model', 'bias'),
        ('--reference-model', 'table_tlit'),
    ),
)
def test_options_that_do_not_fit(capsys, tmp_path, home, more):
    calibrate_refused(capsys, tmp_path, home / 'bag', home / 'table.yaml', *more)


def test_no_verb_and_no_arguments_are_one_line_too(capsys):
    for arguments in ([], ['calibrate'], ['teach']):
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        assert stop.value.code == 1
        assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_truncated_bag_gives_what_came_before_the_damage(capsys, tmp_path, home, session):
    write_session(str(tmp_path / 'whole'), *session, storage='mcap')
    file = next((tmp_path / 'whole').glob('*.mcap'))
    content = file.read_bytes()
    file.write_bytes(content[: int(0.93 * len(content))])
    code = main(
        [
            'calibrate',
            str(tmp_path / 'whole'),
            '--table',
            str(home / 'table.yaml'),
            '--output',
            str(tmp_path / 'out'),
            '--no-report',
            '--model-as-asked',
        ]
    )
    printed = capsys.readouterr()
    assert code == 3
    document = yaml.safe_load((tmp_path / 'out' / 'calibration.yaml').read_text())
    assert document['statistics']['dropped']
    assert 'dropped' in printed.out
    assert sum(document['statistics']['samples_used'].values()) > 2500


def test_what_was_there_survives_a_refusal(capsys, tmp_path, home):
    (tmp_path / 'out').mkdir()
    (tmp_path / 'out' / 'calibration.yaml').write_text('the one before')
    refused(
        capsys,
        'calibrate',
        home / 'bag',
        '--table',
        home / 'table.yaml',
        '--imu-topic',
        '/nowhere',
        '--output',
        tmp_path / 'out',
    )
    assert [p.name for p in (tmp_path / 'out').iterdir()] == ['calibration.yaml']
    assert (tmp_path / 'out' / 'calibration.yaml').read_text() == 'the one before'


@pytest.mark.parametrize('verb', ['calibrate', 'check', 'diagnose', 'inspect', 'plan'])
def test_a_latitude_that_contradicts_the_table_is_refused(home, tmp_path, capsys, verb):
    options = ['--table', str(home / 'table.yaml'), '--latitude', '0', '--json']
    if verb == 'check':
        options += ['--calibration', str(home / 'good')]
    elif verb != 'inspect':
        options += ['--output', str(tmp_path / 'out')]
    recordings = [] if verb == 'plan' else [str(home / 'bag')]
    assert main([verb, *recordings, *options]) == 1
    error = json.loads(capsys.readouterr().out)['error']
    # WGS 84 at 48.8 deg and at the equator
    assert error['code'] == 'gravity_twice'
    assert '9.80963' in error['error'] and '9.78033' in error['error']
