"""Arrays in place of recordings, integer nanoseconds, and files that are not replaced silently."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from refusal import refused

import imu_calibration as imu
from imu_calibration.api.calibrate import Calibrated
from imu_calibration.api.resources import config_file
from imu_calibration.api.simulate import simulate
from imu_calibration.cli.main import main
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import SampleBlock
from imu_calibration.document import files
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.references.gravity.gravity_reference import GravityReference
from msg_adapters.write import write_session

from worlds.compensation_cases import random_calibration
from worlds.hand_sessions import simulate as hand_session

PERIOD_NS, COUNT = 10_000_000, 6_000


def at_rest(seed=0):
    """Return arrays of a minute at rest: time in ns from 1970, force, rate."""
    rng = np.random.default_rng(seed)
    time_ns = 1_700_000_000 * 10**9 + PERIOD_NS * np.arange(COUNT)
    force = np.array([0.0, 0.0, 9.81]) + 0.01 * rng.normal(size=(COUNT, 3))
    return {'time': time_ns, 'force': force, 'rate': 1e-3 * rng.normal(size=(COUNT, 3))}


@pytest.mark.parametrize('start', (0, 5, 1_700_000_000 * 10**9 + 123))
def test_integer_nanoseconds_are_exact(start):
    time_ns = start + PERIOD_NS * np.arange(5) + np.array([0, 1, 2, 3, 4])
    zeros = np.zeros((5, 3))
    stamps = SampleBlock.from_arrays(time_ns, zeros, zeros).imu.stamp_ns
    np.testing.assert_array_equal(stamps - stamps[0], time_ns - start)
    assert stamps[0] == start or start < 10
    seconds = SampleBlock.from_arrays(np.arange(5), zeros, zeros).imu.stamp_ns
    np.testing.assert_array_equal(np.diff(seconds), 10**9)


@pytest.mark.parametrize('kind', ('uint64', 'datetime64[ns]', 'object'))
def test_times_of_other_types_are_the_same(kind):
    arrays = at_rest()
    again = {**arrays, 'time': arrays['time'].astype(kind)}
    stamps = [SampleBlock.from_arrays(**each).imu.stamp_ns for each in (arrays, again)]
    np.testing.assert_array_equal(*stamps)


@pytest.mark.parametrize(
    ('scale', 'kind', 'step'),
    [
        (1.0, float, '1e+07'),
        (1e-3, np.int64, '1e-05'),
        (1e-6, np.int64, '10 s'),
        (1e-6, float, '10 s'),
    ],
)
def test_times_in_another_unit_are_refused(scale, kind, step):
    """Nanoseconds as floats, microseconds, milliseconds."""
    arrays = at_rest()
    arrays['time'] = (arrays['time'] * scale).astype(kind)
    with refused(InputError, 'time_unit', step):
        imu.inspect(**arrays)
    missing = np.append(np.datetime64('NaT', 'ns'), arrays['time'][1:].astype('datetime64[ns]'))
    with refused(InputError, 'time_not_finite', 1):
        imu.inspect(**{**arrays, 'time': missing})
    with refused(InputError, 'array_type', 'rate'):
        imu.inspect(**{**arrays, 'rate': np.full((COUNT, 3), 'fast')})


def test_readings_at_one_hertz_are_no_increments():
    arrays = at_rest()
    (summary,) = imu.inspect(**{**arrays, 'time': 1.0 * np.arange(COUNT)})
    assert not summary.refused


def test_the_noise_of_slow_readings_is_refused():
    block = SampleBlock.from_arrays(**at_rest())
    slow = replace(block.imu, stamp_ns=1000 * block.imu.stamp_ns).select(slice(0, 2000))
    with refused(InputError, 'rate_too_low', 10):
        imu.noise(SampleBlock(slow))


def test_noise_and_inspect_take_arrays():
    arrays = at_rest()
    found = imu.noise(**arrays)
    white = found.figures.densities('accelerometer').white
    assert white == pytest.approx(0.01 * np.sqrt(PERIOD_NS * 1e-9), rel=0.1)
    (summary,) = imu.inspect(**arrays)
    assert summary.streams['imu'].count == COUNT and not summary.refused
    with refused(InputError, 'recording_or_arrays', 'noise', 'time'):
        imu.noise(time=arrays['time'])


def test_compensate_and_check_take_arrays():
    calibration = random_calibration(2, ())
    arrays = at_rest()
    block = SampleBlock.from_arrays(**arrays)
    expected = imu.compensate(block, calibration).imu.force_s
    found = imu.compensate(calibration=calibration, **arrays).imu.force_s
    np.testing.assert_array_equal(found, expected)
    assert imu.check(calibration=calibration, **arrays).exit_code == 3  # one attitude
    with refused(InputError, 'calibration_missing', 'check'):
        imu.check(**arrays)


def test_a_folder_is_the_calibration_in_it(tmp_path):
    calibration = random_calibration(2, ())
    (tmp_path / 'calibration.yaml').write_text(calibration_to_text(calibration))
    np.testing.assert_array_equal(files.read_calibration(tmp_path).values, calibration.values)
    with refused(InputError, 'file_unreadable', 'calibration.yaml'):
        files.read_calibration(tmp_path.parent)


def test_results_of_other_inputs_are_replaced_only_by_force(tmp_path):
    first = imu.noise(**{name: array[: COUNT // 4] for name, array in at_rest().items()})
    provenance = first.figures.provenance | {'bags': [{'name': 'other', 'sha256': 16 * 'c'}]}
    second = replace(first, figures=replace(first.figures, provenance=provenance))
    first.save(tmp_path, report=False)
    before = (tmp_path / 'noise.yaml').read_bytes()
    first.save(tmp_path, report=False)
    with refused(InputError, 'other_result', 'noise.yaml'):
        second.save(tmp_path, report=False)
    assert (tmp_path / 'noise.yaml').read_bytes() == before
    second.save(tmp_path, report=False, force=True)
    assert (tmp_path / 'noise.yaml').read_bytes() != before
    one, other = (
        Calibrated(
            SimpleNamespace(calibration=random_calibration(2, (), provenance=provenance)),
            GravityReference(),
        )
        for provenance in (
            {'verb': 'calibrate', 'bags': [{'name': name, 'sha256': 16 * name}]} for name in 'ab'
        )
    )
    one.save(tmp_path, report=False)
    with refused(InputError, 'other_result', 'calibration.yaml'):
        other.save(tmp_path, report=False)
    other.save(tmp_path, report=False, force=True)


@pytest.mark.parametrize('verb', ('calibrate', 'diagnose', 'noise', 'plan', 'fleet'))
def test_the_report_of_another_verb_is_not_replaced(verb, tmp_path, capsys):
    """All reports have one name: a report without the document of this verb is not its own."""
    write_session(tmp_path / 'units' / 'still', SampleBlock.from_arrays(**at_rest()).imu)
    folder = tmp_path / 'out' / ('still' if verb == 'fleet' else '')
    folder.mkdir(parents=True)
    (folder / 'report.html').write_text('of another verb')
    inputs = {
        'fleet': [tmp_path / 'units', '--table', config_file('table_simulated.yaml')],
        'plan': ['--by-hand'],
    }.get(verb, [tmp_path / 'units' / 'still'])
    code = refused_code(capsys, verb, *inputs, '--output', tmp_path / 'out')
    assert code == 'file_exists'
    assert (folder / 'report.html').read_text() == 'of another verb'


def test_the_noise_of_another_recording_is_not_replaced_on_the_command_line(tmp_path, capsys):
    for seed in (0, 1):
        held = SampleBlock.from_arrays(**at_rest(seed)).imu
        write_session(tmp_path / f'still_{seed}', held.select(slice(0, COUNT // 4)))
    document = tmp_path / 'out' / 'noise.yaml'
    first, second = (
        ['noise', str(tmp_path / f'still_{seed}'), '--no-report', '--output', str(document.parent)]
        for seed in (0, 1)
    )
    assert main(first) in (0, 3)
    before = document.read_bytes()
    capsys.readouterr()
    assert main([*second, '--json']) == 1
    assert json.loads(capsys.readouterr().out)['error']['code'] == 'other_result'
    assert document.read_bytes() == before
    assert main([*second, '--force']) in (0, 3) and document.read_bytes() != before


def refused_code(capsys, *arguments):
    """Return the code of the error with which the command line refuses."""
    capsys.readouterr()
    assert main([*map(str, arguments), '--json']) == 1
    return json.loads(capsys.readouterr().out)['error']['code']


def test_an_imported_calibration_and_a_view_replace_a_file_only_by_force(tmp_path, capsys):
    known, other = tmp_path / 'calibration.yaml', tmp_path / 'imu.yaml'
    known.write_text(calibration_to_text(random_calibration(3)))
    assert main(['export', str(known), '--to', 'kalibr', '--output', str(other)]) == 0
    before = known.read_bytes()
    again = ['import', other, '--from', 'kalibr', '--output', known]
    assert refused_code(capsys, *again) == 'file_exists' and known.read_bytes() == before
    assert main([*map(str, again), '--force']) == 0 and known.read_bytes() != before

    pytest.importorskip('foxglove', reason='the extra view is not installed')
    picture = tmp_path / 'picture.mcap'
    picture.write_bytes(b'mine')
    drawn = ['view', known, '--output', picture]
    assert refused_code(capsys, *drawn) == 'file_exists' and picture.read_bytes() == b'mine'
    assert refused_code(
        capsys, 'diagnose', known, '--mcap', picture, '--output', tmp_path / 'd'
    ) == ('file_exists')
    assert main([*map(str, drawn), '--force']) in (0, 3) and picture.read_bytes() != b'mine'


def test_a_plan_is_replaced_only_by_force_and_keeps_no_old_trajectory(tmp_path, capsys):
    by_hand = ['plan', '--by-hand', '--no-report', '--output', tmp_path]
    (tmp_path / 'trajectory').mkdir()
    assert refused_code(capsys, *by_hand) == 'file_exists'
    assert [path.name for path in tmp_path.iterdir()] == ['trajectory']
    assert main([*map(str, by_hand), '--force']) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ['plan.yaml', 'trajectory.1']
    assert refused_code(capsys, *by_hand) == 'file_exists'


def test_a_fleet_does_not_replace_the_result_of_another_recording(tmp_path, capsys):
    units, out = tmp_path / 'units', tmp_path / 'out'
    write_session(units / 'unit', SampleBlock.from_arrays(**at_rest()).imu.select(slice(0, 100)))
    files.write_texts(
        out / 'unit',
        {'calibration.yaml': calibration_to_text(random_calibration(2, ()))},
    )
    before = (out / 'unit' / 'calibration.yaml').read_bytes()
    run = ['fleet', units, '--table', config_file('table_simulated.yaml'), '--output', out]
    assert refused_code(capsys, *run) == 'other_result'
    assert (out / 'unit' / 'calibration.yaml').read_bytes() == before
    assert sorted(path.name for path in out.iterdir()) == ['unit']


def test_check_reads_a_folder_and_compares_with_the_given_gravity(tmp_path, capsys):
    session, result = str(tmp_path / 'session'), str(tmp_path / 'result')
    held = hand_session(3, n_poses=20, still=3.0, force_sd=0.004, rate_sd=4e-4)[0]
    write_session(tmp_path / 'session', held)
    calibrate = ['calibrate', session, '--gravity', '9.80665', '--no-report', '--output', result]
    assert main(calibrate) == 0
    mean_errors = []
    for place in (['--gravity', '9.80665'], ['--gravity', '9.78033'], ['--latitude', '0']):
        capsys.readouterr()
        assert main(['check', session, '--calibration', result, *place, '--json']) in (0, 3)
        found = json.loads(capsys.readouterr().out)['result']
        mean_errors.append(found['proof']['accelerometer']['after'])
    # WGS 84 at the equator: 9.78033 m/s^2, which is 0.02632 below the gravity of the calibration
    right, given, of_latitude = mean_errors
    assert right < 0.002 and given == pytest.approx(0.0263, rel=0.05)
    assert of_latitude == pytest.approx(given, rel=0.01)
    both = ['--gravity', '9.8', '--latitude', '0', '--json']
    assert main(['check', session, '--calibration', result, *both]) == 1
    assert json.loads(capsys.readouterr().out)['error']['code'] == 'gravity_twice'
    # the folder without a calibration
    assert main(['check', session, '--calibration', session, '--json']) == 1
    assert json.loads(capsys.readouterr().out)['error']['code'] == 'file_unreadable'


def test_an_existing_export_needs_force(tmp_path, capsys):
    document, out = tmp_path / 'calibration.yaml', tmp_path / 'calibration.json'
    document.write_text(calibration_to_text(random_calibration(2, ())))
    out.write_text('mine')
    arguments = ['export', str(document), '--to', 'json', '--output', str(out)]
    assert main(arguments) == 1 and '--force' in capsys.readouterr().err
    assert out.read_text() == 'mine'
    assert main([*arguments, '--force']) == 0 and out.read_text() != 'mine'


def test_the_seed_of_the_imu_fixes_its_added_effects():
    first, second, other = (
        simulate(profile='quick', seed=seed, imu_seed=of_imu, effects=['gyro_quadratic']).truth
        for seed, of_imu in ((1, 7), (2, 7), (1, 8))
    )
    np.testing.assert_array_equal(first.values, second.values)
    part = first.model.slices['gyroscope', 'gyro_quadratic']
    assert not np.array_equal(first.values[part], other.values[part])
