"""
What a notebook sees.

A package that imports at once, functions that take bags or samples, and results that print, draw
and save themselves.
"""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from refusal import refused
from without_search import candidates_in_scripts

import imu_calibration as imu
from imu_calibration.cli.main import main
from imu_calibration.compensation.stream import CompensationStream
from imu_calibration.core.errors import DocumentError, InputError
from imu_calibration.core.samples import ImuSamples, SampleBlock, TemperatureSamples
from imu_calibration.document import files
from msg_adapters.bag import open_recording

FEW = 'accel_quadratic+gyro_g_sensitivity'

ROOT = Path(__file__).resolve().parents[2]
SESSION = ROOT / 'bags' / 'sample_session'
TABLE = SESSION / 'table.yaml'
HEAVY = {
    'numpy',
    'scipy',
    'yaml',
    'rosbags',
    'rclpy',
    'matplotlib',
    'jinja2',
    'tqdm',
    'ament_index_python',
    'sensor_msgs',
}


@pytest.fixture(scope='module')
def found():
    """The sample session, calibrated."""
    return imu.calibrate(SESSION, TABLE, candidates=FEW)


PLAIN = {'accelerometer_model': 'bias+matrix', 'model_as_asked': True}


@pytest.fixture(scope='module')
def plain():
    """The sample session, calibrated without arms and without a search."""
    return imu.calibrate(SESSION, TABLE, **PLAIN)


@pytest.fixture(scope='module')
def samples():
    """The sample session in memory."""
    with open_recording(SESSION) as recording:
        blocks = list(recording.blocks())
    return SampleBlock(
        *(
            type(getattr(blocks[0], name)).concatenate([getattr(block, name) for block in blocks])
            for name in ('imu', 'joints')
        )
    )


def modules_after(statement):
    """Modules that a fresh interpreter holds after a statement."""
    code = f'import sys; before = set(sys.modules); {statement}; print(*set(sys.modules) - before)'
    done = subprocess.run(
        [sys.executable, '-c', code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return set(done.stdout.split())


@pytest.mark.live
def test_the_package_alone_imports_nothing_heavy():
    assert not modules_after('import imu_calibration') & HEAVY


@pytest.mark.live
def test_its_functions_come_without_ros_and_without_a_screen():
    assert not modules_after('import imu_calibration as imu; imu.calibrate, imu.load') & {
        'rclpy',
        'rosbags',
        'matplotlib',
        'tqdm',
        'sensor_msgs',
    }


@pytest.mark.live
def test_the_compensator_node_keeps_the_memory_of_filters_windows_and_noise_models_free():
    assert not modules_after('import imu_calibration.nodes.compensator_node') & {
        'scipy.ndimage',
        'imu_calibration.allan',
        'imu_calibration.preprocessing.window_finder',
    }


def test_the_names_are_those_that_a_type_checker_sees():
    tree = ast.parse((ROOT / 'imu_calibration/__init__.py').read_text())
    (guarded,) = (node for node in tree.body if isinstance(node, ast.If))
    assert sorted(alias.name for node in guarded.body for alias in node.names) == imu.__all__
    assert set(imu.__all__) <= set(dir(imu)) and all(
        callable(getattr(imu, name)) for name in imu.__all__
    )
    with pytest.raises(AttributeError, match="no attribute 'calibrat'"):
        imu.calibrat


def test_the_page_of_contents_lists_every_package():
    contents = imu.__doc__[imu.__doc__.index('Contents\n') :]
    listed = {name for line in contents.splitlines() for name in re.findall(r'`(\w+)`', line[:18])}
    packages = {path.parent.name for path in (ROOT / 'imu_calibration').glob('*/__init__.py')}
    assert (
        packages <= listed
        and [
            name for name in listed - packages if not (ROOT / f'imu_calibration/{name}.py').exists()
        ]
        == []
    )


@pytest.mark.long
def test_two_lines_give_what_the_command_line_writes(found, tmp_path):
    found.save(tmp_path / 'notebook')
    assert (
        main(
            [
                'calibrate',
                str(SESSION),
                '--table',
                str(TABLE),
                '--output',
                str(tmp_path / 'verb'),
                '--candidates',
                FEW,
            ]
        )
        == found.exit_code
        == 0
    )
    for name in ('calibration.yaml', 'report.html'):
        assert (tmp_path / 'notebook' / name).read_bytes() == (
            tmp_path / 'verb' / name
        ).read_bytes()


def test_samples_in_memory_are_as_good_as_a_bag(plain, samples):
    again = imu.calibrate(samples, files.read_table(TABLE), **PLAIN)
    np.testing.assert_allclose(
        again.calibration.values, plain.calibration.values, atol=1e-9 * plain.calibration.sd.min()
    )
    (bag,) = again.calibration.provenance['bags']
    assert bag['name'] == 'samples in memory' and re.fullmatch('[0-9a-f]{64}', bag['sha256'])


def test_without_a_table_gravity_is_the_reference(samples):
    by_hand = imu.calibrate(
        samples, gravity=9.8089, gyroscope_model='bias+matrix', model_as_asked=True
    )
    assert (
        by_hand.calibration.gauge['axes'] == 'accelerometer_lower_triangular'
        and by_hand.calibration.conditions['gravity'] == 9.8089
    )
    assert {
        name: by_hand.calibration.provenance['options'][name]
        for name in ('gravity', 'gyroscope_model')
    } == {'gravity': 9.8089, 'gyroscope_model': 'bias+matrix'}


def test_everything_that_is_known_is_printed(found):
    text, page = str(found), found._repr_html_()
    for name, status in zip(found.calibration.param_names, found.calibration.status, strict=True):
        assert (
            re.search(rf'^{re.escape(name)} .* {status}$', text, flags=re.M)
            and f'<td style="text-align:left">{name}</td>' in page
        )
    assert (
        'accelerometer helps: error' in text
        and '<b>helps</b>' in page
        and ' mg ' in text
        and 'deg/s' in text
    )
    assert (
        repr(found)
        == repr(found.calibration)
        == f'<Calibration of imu_link: helps, {found.verdict.requested} determined>'
    )
    assert all(text.count(line) for line in found.verdict.lines())


def test_html_of_a_strange_frame_is_safe(found):
    from dataclasses import replace

    assert '<script>' not in replace(found.calibration, frame_id='<script>')._repr_html_()


def test_load_gives_what_was_saved(found, tmp_path):
    found.save(tmp_path, report=False)
    assert os.listdir(tmp_path) == ['calibration.yaml']
    loaded = imu.load(tmp_path / 'calibration.yaml')
    np.testing.assert_array_equal(loaded.values, found.calibration.values)
    assert str(loaded) == str(found.calibration)
    (tmp_path / 'broken.yaml').write_text('format: something')
    with refused(DocumentError, 'document_format', 'something'):
        imu.load(tmp_path / 'broken.yaml')


def test_a_calibration_compensates_arrays_as_the_stream_does(found, samples):
    raw = samples.imu.select(slice(2000, 2600))
    expected = CompensationStream(found.calibration).correct(raw)
    whole = found.calibration.compensate(raw)
    force, rate = found.calibration.compensate(
        raw.force_s, raw.rate_s, time=1e-9 * (raw.stamp_ns - raw.stamp_ns[0])
    )
    for ours in (whole.force_s, force):
        # Seconds in a float against nanoseconds.
        np.testing.assert_allclose(ours, expected.force, atol=1e-6)
    for ours in (whole.rate_s, rate):
        np.testing.assert_allclose(ours, expected.rate, atol=1e-9)
    assert whole.frame_id == raw.frame_id and np.array_equal(whole.stamp_ns, raw.stamp_ns)


def test_arms_need_times_and_a_model_without_them_does_not(found, plain):
    readings = np.tile([0.1, 0.2, 9.8], (5, 1)), np.zeros((5, 3))
    with refused(InputError, 'time_missing'):
        found.calibration.compensate(*readings)
    without = plain.calibration
    force, _ = without.compensate(*readings)
    bias, matrix = (
        without.values[without.model.slices['accelerometer', name]] for name in ('bias', 'matrix')
    )
    np.testing.assert_allclose(force @ matrix.reshape(3, 3).T + bias, readings[0], rtol=1e-12)


@pytest.mark.parametrize(
    ('arguments', 'values'),
    [
        ((np.zeros(3), np.zeros((1, 3))), ['force', '(2, 3)', '(3,)']),
        ((np.zeros((2, 3)),), ['rate', '(2, 3)']),
        ((np.zeros((2, 3)), np.zeros((3, 3))), ['rate', '(2, 3)', '(3, 3)']),
        ((np.zeros((2, 3)), np.zeros((2, 3)), [0.0]), ['force', '(1, 3)', '(2, 3)']),
    ],
)
def test_arrays_that_do_not_fit_are_refused(found, arguments, values):
    with refused(InputError, 'array_shape', *values):
        found.calibration.compensate(
            *arguments[:2], time=arguments[2] if len(arguments) > 2 else [0.0, 0.01]
        )


def test_thermal_calibrations_take_one_temperature_or_many():
    session = imu.simulate('quick', effects=['accel_thermal_bias'], seed=2)
    raw = session.samples.imu.select(slice(0, 50))
    one, many = (
        session.truth.compensate(raw, temperature_c=t).force_s for t in (31.0, np.full(50, 31.0))
    )
    topic = session.truth.compensate(
        raw, temperature_c=TemperatureSamples(raw.stamp_ns[:1], np.array([31.0]))
    ).force_s
    np.testing.assert_array_equal(one, many)
    np.testing.assert_array_equal(one, topic)
    assert np.abs(one - session.truth.compensate(raw, temperature_c=25.0).force_s).max() > 1e-4
    with refused(InputError, 'temperature_missing'):
        session.truth.compensate(raw)


def test_a_simulated_step_occurs_after_the_first_half_of_the_session():
    session = imu.simulate('quick', effects=['clock_step'], seed=2)
    assert session.truth.values[-1] == pytest.approx(0.6 * session.duration)


def test_compensating_a_bag_in_memory_and_into_a_bag_is_the_same(found, samples, tmp_path):
    inside = imu.compensate(SESSION, found.calibration)
    memory = imu.compensate(samples.imu, found.calibration)
    written = imu.compensate(SESSION, found.calibration, output=tmp_path / 'out')
    assert written.imu is None and inside.count == memory.count == written.count == len(samples.imu)
    with open_recording(tmp_path / 'out', imu_topic='/imu/data_corrected') as recording:
        read = ImuSamples.concatenate(
            [block.imu for block in recording.blocks(['outer', 'middle', 'inner'])]
        )
    np.testing.assert_array_equal(memory.imu.force_s, inside.imu.force_s)
    # The filter's period is the median step of the first block.
    np.testing.assert_allclose(read.force_s, inside.imu.force_s, atol=1e-6)
    np.testing.assert_array_equal(read.rate_s, inside.imu.rate_s)
    with refused(InputError, 'exists_already', tmp_path / 'out'):
        imu.compensate(SESSION, found.calibration, output=tmp_path / 'out')


def test_errors_speak_of_arguments_that_the_function_has(tmp_path):
    session = imu.simulate('quick', seed=2)
    from msg_adapters.write import write_session

    write_session(
        tmp_path / 'bag', session.samples.imu.select(slice(0, 9)), imu_topic='/imu/data_corrected'
    )
    with refused(InputError, 'corrected_already', '/imu/data_corrected', '(argument imu_topic)'):
        imu.compensate(tmp_path / 'bag', session.truth)
    with refused(
        InputError, 'topic_unknown', '/none', '/imu/data_corrected', '(argument imu_topic)'
    ):
        imu.calibrate(tmp_path / 'bag', session.table, imu_topic='/none')
    with refused(InputError, 'choice_unknown', 'gravty', 'gravity'):
        imu.calibrate(tmp_path / 'bag', gravty=9.8)


def test_a_simulated_session_is_saved_with_its_truth(tmp_path):
    session = imu.simulate('quick', seed=4)
    session.save(tmp_path / 'bag', storage='mcap')
    assert (
        repr(session) == f'<Simulated: {session.duration:.0f} s, {len(session.samples.imu)} Imu,'
        f' {len(session.samples.joints)} JointState>'
    )
    assert yaml.safe_load((tmp_path / 'bag/table.yaml').read_text()) == session.table.to_mapping()
    again = imu.compensate(tmp_path / 'bag', tmp_path / 'bag/truth.yaml').imu
    np.testing.assert_array_equal(again.stamp_ns, session.samples.imu.stamp_ns)
    np.testing.assert_allclose(
        again.force_s, imu.compensate(session.samples, session.truth).imu.force_s, atol=1e-12
    )


def cells(path):
    """The code of each cell of a notebook in percent format."""
    parts = re.split(r'^# %%(.*)\n', path.read_text(), flags=re.M)
    return [
        code for head, code in zip(parts[1::2], parts[2::2], strict=True) if 'markdown' not in head
    ]


@pytest.mark.long
def test_the_notebook_runs_cell_by_cell_and_shows_its_plots(capsys):
    """
    As a notebook does it: each cell is run, and its last expression is shown.

    What it prints is what it prints as a script.
    """
    names, shown = {}, []
    for code in cells(ROOT / 'examples/notebook.py'):
        tree = ast.parse(code)
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        with candidates_in_scripts(f'{FEW}+accel_size_effect'):
            exec(compile(tree, 'cell', 'exec'), names)
            value = (
                None
                if last is None
                else eval(compile(ast.Expression(last.value), 'cell', 'eval'), names)
            )
        shown.append(value._repr_html_() if hasattr(value, '_repr_html_') else repr(value))
    assert (
        sum('<svg' in value for value in shown) == 3
        and sum('<table' in value for value in shown) == 1
    )
    assert names['found'].verdict.complete
    assert {finding.effect for finding in names['diagnosis'].findings} == {
        'accel_size_effect',
        'gyro_g_sensitivity',
    }
    assert max(map(abs, names['error'].values())) < 4.5
    assert re.match(
        r'\d+ parameters, largest error \d\.\d sd, rms [01]\.\d\d sd\n', capsys.readouterr().out
    )


@pytest.mark.parametrize('verb', [imu.calibrate, imu.diagnose])
def test_a_bag_that_does_not_exist_is_refused_in_one_line(verb, tmp_path):
    with refused(InputError, 'bag_missing', tmp_path / 'none'):
        verb(tmp_path / 'none')
