"""
Many units: one result each, the spread over them, and the same on a cluster.

Each unit has its result whatever happens to the remaining units, and the cluster does the same
work.
"""

import csv
from dataclasses import replace

import numpy as np
import pytest
import yaml
from refusal import refused

from imu_calibration.api.resources import config_file
from imu_calibration.cli.fleet_run import find_units, fleet_unit_rows, summary_html
from imu_calibration.cli.main import main
from imu_calibration.core.errors import InputError
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.files import read_calibration
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable.fleet import UnitResult, summarise
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.session import SimulationOptions, random_values, simulate_session
from msg_adapters.write import write_session

TABLE_FILE = config_file('table_simulated.yaml')
TABLE = Table.from_mapping(yaml.safe_load(TABLE_FILE.read_text(encoding='utf-8')))
MODEL = SensorModel(
    accelerometer=('bias', 'matrix', 'accel_size_effect'), joint_names=tuple(TABLE.joint_names)
)


SAMPLES = 75 * 25
"""75 s at 25 Hz."""


def session(seed, values):
    """Return (imu, joints) of a part of a short session."""
    imu, joints, _ = simulate_session(
        MODEL,
        values,
        TABLE,
        profile=make_profile('quick', seed, TABLE),
        options=SimulationOptions(25.0, 25.0),
        seed=seed,
    )
    return imu.select(slice(0, SAMPLES)), joints.select(slice(0, SAMPLES))


@pytest.fixture(scope='module')
def recordings(tmp_path_factory):
    """
    Two units, one of them with two recordings, and a file that is no bag; the values of each unit.
    """
    folder = tmp_path_factory.mktemp('fleet')
    truth = {
        name: random_values(MODEL, 'industrial', seed)
        for seed, name in enumerate(('unit_a', 'unit_b'))
    }
    write_session(folder / 'unit_a', *session(0, truth['unit_a']), storage='sqlite3')
    for part in (1, 2):
        write_session(
            folder / 'unit_b' / f'part_{part}', *session(part, truth['unit_b']), storage='mcap'
        )
    (folder / 'unit_c.mcap').write_bytes(b'no bag' * 100)
    return folder, truth


def run_fleet(folder, output, *more):
    """Run the verb without reports."""
    return main(
        [
            'fleet',
            str(folder),
            '--table',
            str(TABLE_FILE),
            '--output',
            str(output),
            '--no-report',
            '--model-as-asked',
            *more,
        ]
    )


def read_csv(path):
    """Return the rows of a table as dicts."""
    return list(csv.DictReader(path.read_text().splitlines()))


@pytest.fixture(scope='module')
def result(recordings, tmp_path_factory):
    """Exit code and folder of a fleet run in this process."""
    output = tmp_path_factory.mktemp('result')
    return run_fleet(recordings[0], output, '--jobs', '1'), output


@pytest.mark.long
def test_a_fleet_goes_on_past_a_bad_bag(result, capsys):
    """
    Good units have results, the bad one has its reason in one line.

    The exit code shows that something is missing.
    """
    code, output = result
    assert code == 3
    units = {row['name']: row for row in read_csv(output / 'units.csv')}
    assert list(units) == ['unit_a', 'unit_b', 'unit_c']
    assert units['unit_c']['decision'] == units['unit_c']['gyroscope'] == 'refused'
    assert 'unit_c.mcap' in units['unit_c']['error']
    assert '\n' not in units['unit_c']['error']
    assert not (output / 'unit_c').exists()
    page = (output / 'summary.html').read_text()
    # The style of all reports.
    assert 'unit_c' in page and ' of 3 units</p>' in page and '--accent' in page
    assert capsys.readouterr().err == ''


def test_each_unit_has_its_own_values(recordings, result):
    """
    Biases and matrices are within 4.5 reported sd of what the unit was simulated with (43 values).
    """
    units = {row['name']: row for row in read_csv(result[1] / 'units.csv')}
    for name, truth in recordings[1].items():
        for index, parameter in enumerate(MODEL.param_names):
            if '.bias.' in parameter or '.matrix.' in parameter:
                value, sd = float(units[name][parameter]), float(units[name][f'{parameter}.sd'])
                assert abs(value - truth[index]) < 4.5 * sd, (name, parameter)
        document = yaml.safe_load((result[1] / name / 'calibration.yaml').read_text())
        assert len(document['provenance']['bags']) == (2 if name == 'unit_b' else 1)


def test_the_summary_is_that_of_the_units(result):
    """Mean and spread of the printed table follow from the values of the units."""
    units = [row for row in read_csv(result[1] / 'units.csv') if row['decision'] != 'refused']
    summary = {row['parameter']: row for row in read_csv(result[1] / 'summary.csv')}
    values = np.array([float(row['gyroscope.matrix.zz']) for row in units])
    found = summary['gyroscope.matrix.zz']
    np.testing.assert_allclose(
        [float(found['mean']), float(found['spread'])],
        [values.mean(), values.std(ddof=1)],
        rtol=1e-12,
    )
    assert found['highest_unit'] == units[int(np.argmax(values))]['name']
    assert float(found['spread_over_sd']) > 10, (
        'units of one grade differ by far more than a calibration is uncertain'
    )


def test_a_folder_and_a_file_that_differ_in_their_suffix_have_names_of_their_own(tmp_path):
    for run in ('run_1', 'run_2'):
        (tmp_path / 'units/a' / run).mkdir(parents=True)
        (tmp_path / 'units/a' / run / 'metadata.yaml').touch()
    (tmp_path / 'units/a.mcap').touch()
    units = dict(find_units(tmp_path / 'units', tmp_path / 'output'))
    assert {name: len(bags) for name, bags in units.items()} == {'a': 2, 'a.mcap': 1}


def test_a_unit_has_the_word_of_each_sensor(result):
    known = read_calibration(result[1] / 'unit_a' / 'calibration.yaml')
    unit = UnitResult(
        'unit_d', replace(known, decision={'accelerometer': 'harms', 'gyroscope': 'helps'}), 'harms'
    )
    row = fleet_unit_rows([unit])[0]
    assert (row['decision'], row['accelerometer'], row['gyroscope']) == ('harms', 'harms', 'helps')
    assert isinstance(row['exit_code'], int) and all(
        isinstance(value, float) for name, value in row.items() if '.' in name
    )
    page = summary_html([unit], summarise([unit]))
    assert '<span class="tag harms">' in page


@pytest.mark.live
@pytest.mark.long
@pytest.mark.slow
def test_a_fleet_excludes_the_times_of_all_units_and_of_one(recordings, tmp_path, capsys):
    folder = recordings[0]
    arguments = ['fleet', str(folder), '--table', str(TABLE_FILE), '--no-report', '--jobs', '1']
    arguments += ['--model-as-asked', '--output', str(tmp_path / 'fleet')]
    main([*arguments, '--exclude', '0:2,unit_b=4:7'])
    dropped = {}
    for unit in ('unit_a', 'unit_b'):
        calibration = read_calibration(tmp_path / 'fleet' / unit / 'calibration.yaml')
        dropped[unit] = calibration.statistics['dropped']['imu excluded']
    # 25 Hz, two recordings of unit_b
    assert dropped == {'unit_a': 50, 'unit_b': 250}
    capsys.readouterr()
    assert main([*arguments, '--exclude', 'unit_d=4:7']) == 1
    assert "'unit_d=4:7'" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.live
def test_processes_give_the_same_bytes(recordings, result, tmp_path):
    """Two units at a time write what one after the other writes."""
    assert run_fleet(recordings[0], tmp_path, '--jobs', '2') == result[0]
    assert_same_files(tmp_path, result[1])


@pytest.mark.live
@pytest.mark.long
def test_a_cluster_gives_the_same_bytes(recordings, result, tmp_path):
    """A scheduler whose worker is another process does the same work."""
    distributed = pytest.importorskip('dask.distributed', reason='the extra dask is not installed')
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address=None, host='127.0.0.1'
    ) as cluster:
        assert (
            run_fleet(recordings[0], tmp_path, '--scheduler', cluster.scheduler_address)
            == result[0]
        )
    assert_same_files(tmp_path, result[1])


def assert_same_files(first, second):
    """Compare two folders file by file."""
    names = sorted(path.relative_to(second) for path in second.rglob('*') if path.is_file())
    assert sorted(path.relative_to(first) for path in first.rglob('*') if path.is_file()) == names
    for name in names:
        assert (first / name).read_bytes() == (second / name).read_bytes(), name


def test_folders_without_units_are_refused(tmp_path, capsys):
    """
    One line says what must be in the folder, or that no unit could be used; nothing is written.
    """
    (tmp_path / 'empty').mkdir()
    for folder in ('missing', 'empty'):
        assert run_fleet(tmp_path / folder, tmp_path / 'out') == 1
        error = capsys.readouterr().err
        assert folder in error and error.count('\n') == 1
    (tmp_path / 'empty' / 'unit.mcap').write_bytes(b'nothing')
    assert run_fleet(tmp_path / 'empty', tmp_path / 'out') == 1
    error = capsys.readouterr().err
    assert 'unit.mcap' in error and error.count('\n') == 1
    assert not any(path.is_file() for path in (tmp_path / 'out').rglob('*'))


def test_several_recordings_that_do_not_belong_together_are_refused(recordings, tmp_path, capsys):
    """
    Another frame, another table, or a file that is no bag.

    One line with the name of the recording at fault.
    """
    folder, truth = recordings
    imu, joints = session(3, truth['unit_a'])
    write_session(
        tmp_path / 'other_frame', replace(imu, frame_id='second_imu'), joints, storage='mcap'
    )
    write_session(
        tmp_path / 'other_table', imu, replace(joints, names=('a', 'b', 'c')), storage='mcap'
    )
    for bad, expected in (
        (tmp_path / 'other_frame', "'second_imu'"),
        (tmp_path / 'other_table', 'a, b, c'),
        (folder / 'unit_c.mcap', 'readable bag'),
    ):
        code = main(
            [
                'calibrate',
                str(folder / 'unit_a'),
                str(bad),
                '--table',
                str(TABLE_FILE),
                '--output',
                str(tmp_path / 'out'),
                '--no-report',
                '--jobs',
                '1',
            ]
        )
        error = capsys.readouterr().err
        assert code == 1 and bad.name in error and expected in error and error.count('\n') == 1
    assert not (tmp_path / 'out' / 'calibration.yaml').exists()


def unit(name, bias, status='determined'):
    """Return the result of a unit with one bias and an sd of 2."""
    model = SensorModel()
    values = model.start()
    values[0] = bias
    statuses = (status,) + ('held',) * (len(values) - 1)
    return UnitResult(
        name, Calibration(model, values, 4.0 * np.eye(len(values)), statuses), 'good', 0
    )


def test_spread_leaves_out_what_is_held():
    """Units that know nothing of a parameter do not enter its mean; refused units enter nothing."""
    first, second = summarise(
        [unit('a', 1.0), unit('b', 5.0), unit('c', 100.0, 'held'), UnitResult('d', error='broken')]
    )[:2]
    assert (first.count, first.mean, first.typical_sd, first.lowest, first.highest) == (
        2,
        3.0,
        2.0,
        (1.0, 'a'),
        (5.0, 'b'),
    )
    np.testing.assert_allclose([first.spread, first.ratio], [np.sqrt(8), np.sqrt(2)])
    assert second.count == 0 and np.isnan(second.mean)


def test_no_unit_at_all_is_refused():
    """The first reason is told."""
    with refused(InputError, 'no_unit_calibrated', 1, 'broken'):
        summarise([UnitResult('d', error='broken')])
