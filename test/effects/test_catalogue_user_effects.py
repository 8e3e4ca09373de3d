"""
A file adds an effect.

Every verb and the node take it, a result carries it, and nothing but arithmetic passes.
"""

import random
import string
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from refusal import refused

from imu_calibration.api.calibrate import calibrate_recordings
from imu_calibration.calibration.diagnosis.diagnosis_result import ParameterEstimate
from imu_calibration.calibration.diagnosis.findings import sentence
from imu_calibration.cli.main import main
from imu_calibration.core import documents
from imu_calibration.core.errors import ImuCalibrationError, InputError
from imu_calibration.core.samples import SampleBlock
from imu_calibration.document import files
from imu_calibration.effects.catalogue import CATALOGUE, term
from imu_calibration.effects.expressions import PLACES, ColumnGroup, read
from imu_calibration.effects.sensor_model import BASE, SensorModel
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.sensor_noise import GRADES
from imu_calibration.simulation.session import (
    SimulationOptions,
    hidden_effect,
    random_values,
    simulate_session,
)

from worlds.random_motion import random_reference
from worlds.stands import stand

MINE = """
effects:
  gyro_warm_force:
    sensor: gyroscope
    column: "f_x * (temperature_c - 25)"
    unit: (rad/s)/(m/s^2)/K
    tolerance: 1.0e-6
    largest: 1.0e-4
    text: The gyroscopes respond to the force along x, the more the warmer they are.
"""


@pytest.fixture
def mine(tmp_path):
    (tmp_path / 'mine.yaml').write_text(MINE)
    return tmp_path / 'mine.yaml'


@pytest.mark.long
def test_it_is_simulated_calibrated_compensated_and_checked_from_files_alone(
    mine, tmp_path, capsys
):
    bag, out = tmp_path / 'bag', tmp_path / 'out'
    assert (
        main(
            [
                'simulate',
                '--effects',
                str(mine),
                '--effect',
                'gyro_warm_force',
                '--size',
                '0.5',
                '--profile',
                'quick',
                '--imu-rate',
                '50',
                '--joint-rate',
                '50',
                '--seed',
                '5',
                '--output',
                str(bag),
            ]
        )
        == 0
    )
    model = ['--gyroscope-model', 'bias+matrix+gyro_warm_force', '--model-as-asked']
    table = ['--table', str(bag / 'table.yaml')]
    calibrate = ['calibrate', str(bag), *table, *model]
    assert main([*calibrate, '--effects', str(mine), '--output', str(out)]) in (0, 3)
    mine.unlink()  # from here on the calibration is all there is
    found, truth = (
        files.read_calibration(path) for path in (out / 'calibration.yaml', bag / 'truth.yaml')
    )
    value, true = (each.value('gyroscope', 'gyro_warm_force') for each in (found, truth))
    np.testing.assert_allclose(
        value, true, atol=4 * found.sd[found.model.slices['gyroscope', 'gyro_warm_force']].max()
    )
    assert (
        np.abs(true).min() > 20 * found.sd[found.model.slices['gyroscope', 'gyro_warm_force']].max()
    )
    assert main(
        [
            'compensate',
            str(bag),
            '--calibration',
            str(out / 'calibration.yaml'),
            '--anyway',
            '--output',
            str(tmp_path / 'bag2'),
        ]
    ) in (0, 3)
    assert main(['check', str(bag), '--calibration', str(out / 'calibration.yaml'), *table]) == 0
    again, definitions = tmp_path / 'again', ['--effects', str(out / 'calibration.yaml')]
    assert main([*calibrate, *definitions, '--no-report', '--output', str(again)]) in (0, 3)
    np.testing.assert_array_equal(
        files.read_calibration(again / 'calibration.yaml').values, found.values
    )
    assert 'gyro_warm_force' in (out / 'report.html').read_text()
    assert 'Traceback' not in capsys.readouterr().err


@pytest.mark.parametrize(
    'text, code, values',
    [
        ('a: 1', 'effects_file', ['a']),
        ('effects: 3', 'effects_count', [3]),
        ('effects: [1]', 'effects_count', ['[1]']),
        ('effects:\n  mine: 3', 'definition_keys', ["'mine'", 3]),
        ('effects:\n  effects: ' + MINE[10:].split(':', 1)[0], 'definition_keys', ["'effects'"]),
        (
            MINE.replace('f_x', 'f_q'),
            'not_arithmetic',
            ["'gyro_warm_force'", "'f_q'", ' 1: ', "'f_q * (temperature_c - 25)'"],
        ),
        (MINE.replace('- 25', '- 25 ** 0.5'), 'not_arithmetic', [' 9 ', ' 30: ']),
        (MINE.replace('- 25)', '- 25'), 'not_arithmetic', [' 7: ']),
        (MINE.replace('gyro_warm_force', 'gyro_quadratic'), 'effect_name', ["'gyro_quadratic'"]),
        (MINE.replace('gyro_warm_force', 'effects'), 'effect_name', ["'effects'"]),
        (MINE + 'other: 1', 'effects_file', ['other']),
        (MINE.replace('tolerance', 'tolerence'), 'definition_keys', ['tolerence']),
        ('effects:\n' + ''.join(f'  e{k}: {{}}\n' for k in range(60)), 'effects_count', [50, 60]),
    ],
)
def test_a_file_is_refused_in_one_line_that_names_it(tmp_path, text, code, values):
    (tmp_path / 'wrong.yaml').write_text(text)
    with refused(InputError, code, 'wrong.yaml', *values) as caught:
        files.read_effects(tmp_path / 'wrong.yaml')
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(
    'text, shown',
    [
        ('A remark without its stop', 'A remark without its stop.'),
        ('Said in full.', 'Said in full.'),
        ('', 'The gyroscope output follows f_x.'),
    ],
)
def test_what_is_said_of_it_is_a_sentence(text, shown):
    effect = term(
        'mine', sensor='gyroscope', column='f_x', unit='(rad/s)/(m/s^2)', tolerance=1e-6, text=text
    )
    assert (
        sentence(
            effect, {'gyroscope.mine.x': ParameterEstimate(2.7902e-4, 3.1e-7, 'strange')}, None
        )
        == f'{shown} Its size is 0.00027902 +- 0.00000031 strange.'
    )


@pytest.mark.parametrize(
    'z_of_y, said',
    [
        (5.0, 'Its size is 5.0 +- 1.0 strange (largest: y).'),
        (1.5, 'Its size is known here in combinations only, none of its values by itself: '),
    ],
)
def test_what_cannot_be_told_from_another_is_no_size(z_of_y, said):
    """
    An asymmetry on one axis that a recording holds against the bias was told wrongly.

    Of this asymmetry 40 +- 90 was told, and the 5 +- 1 of the other axis was not.
    """
    effect = term('mine', sensor='gyroscope', column='w_x', unit='1', tolerance=1e-6, text='Mine.')
    values = {
        f'gyroscope.mine.{axis}': ParameterEstimate(value, sd, 'strange')
        for axis, value, sd in zip('xyz', (40.0, z_of_y, 0.1), (90.0, 1.0, 3.0))
    }
    assert said in sentence(effect, values, None)


def test_one_of_unknown_size_cannot_be_simulated_by_name_and_what_to_write_is_said():
    catalogue = CATALOGUE.with_effects(
        term(
            'mine',
            sensor='gyroscope',
            column='f_x',
            unit='(rad/s)/(m/s^2)',
            tolerance=1e-6,
            text='Mine.',
        )
    )
    with refused(InputError, 'size_unknown', 'mine'):
        hidden_effect(SensorModel(catalogue=catalogue), 'mine')


def test_a_choice_may_be_a_mapping_too():
    from imu_calibration.api.choices import catalogue_of

    found = catalogue_of(documents.from_text(MINE)['effects'])
    assert ('gyroscope', 'gyro_warm_force') in found.effects() and catalogue_of(None) is not found
    assert catalogue_of(CATALOGUE) is CATALOGUE


@pytest.mark.parametrize(
    'column',
    [
        '9**9**9',
        '(((9**9)**9)**9)**9',
        '1/0',
        'f_x / (1 - 1)',
        '1e300 * 1e300',
        'log(-1)',
        'sqrt(0 - 2)',
        'exp(999)',
        '1' * 200,
    ],
)
def test_numbers_cannot_grow_without_end(column):
    with refused(InputError, 'not_arithmetic'):
        read(column)


@pytest.mark.parametrize(
    'column',
    [
        'f_x / (time - time)',
        'log(f_x)',
        'sqrt(f_x)',
        '1 / (temperature_ref_c - temperature_ref_c)',
        'exp(exp(f_x ** 9))',
        'f_x / (w_x - w_x)',
    ],
)
def test_a_column_without_a_value_is_refused_in_one_line(column):
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        with refused(InputError, 'column_not_finite', 'mine'):
            ColumnGroup('mine', (column,)).columns(random_reference(50, seed=1), {})


def _random_column(rng):
    """Return arithmetic, Python, and noise, mixed."""
    atoms = [
        *PLACES,
        '1',
        '2.5',
        '1e9',
        '__import__',
        "'os'",
        'eval',
        'open',
        'lambda',
        'f_x.real',
        '__builtins__',
        '[',
        ']',
        '{',
        '}',
        ':=',
        'if',
        'else',
        'for',
        'in',
        'abs',
        'sqrt',
        'exp',
        '0x10',
        '1j',
        'True',
        'None',
        '"',
        '#',
        '\\',
        '\n',
        ';',
        '\x00',
        'é',
        '９',
    ]
    glue = ['+', '-', '*', '/', '**', '(', ')', ',', ' ', '.', '=', '<', '@', '//', '%', '~', '&']
    if rng.random() < 0.3:
        return ''.join(rng.choice(string.printable) for _ in range(rng.randint(0, 40)))
    if rng.random() < 0.5:
        return (
            ''.join(
                rng.choice(list(PLACES))
                + rng.choice(['+', '-', '*', '/', '**2*', '*sin(2)+', '+(', ')*', '**'])
                for _ in range(rng.randint(1, 12))
            )
            + '1'
        )
    return ''.join(rng.choice(rng.choice([atoms, glue])) for _ in range(rng.randint(1, 30)))


def test_whatever_a_file_says_it_does_arithmetic_or_nothing():
    """
    Ten thousand random columns: read and worked out to finite numbers, or refused in one line.

    Nothing is called or imported.
    """
    called, armed = [], False

    def watch(event, _arguments):
        if armed and event.split('.')[0] in (
            'open',
            'import',
            'os',
            'subprocess',
            'socket',
            'shutil',
            'ctypes',
        ):
            called.append(event)

    sys.addaudithook(watch)
    rng, ref, passed = random.Random(1), random_reference(50, seed=1), 0
    point = {'mine': np.array([0.0, 0.0, 0.0, 300.0])}
    ColumnGroup('mine', ('sin(f_x)',), 'mine').columns(ref, point)
    armed = True
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        for _ in range(10_000):
            text = _random_column(rng)
            try:
                columns = ColumnGroup('mine', (text,), 'mine').columns(ref, point)
            except InputError as error:
                assert '\n' not in str(error) and isinstance(error, ImuCalibrationError)
            else:
                passed += 1
                assert columns.shape[0] == len(ref)
    armed = False
    assert not called and passed > 150


@pytest.mark.live
def test_the_node_reads_the_file(mine):
    program = (
        'import sys, rclpy\nfrom imu_calibration.nodes.calibration_node import'
        ' CalibrationNode\nfrom imu_calibration.api.resources import config_file\ngiven ='
        ' {"effects_file": sys.argv[1], "table_file": config_file("table_simulated.yaml"),\n       '
        '  "gyroscope_model": "bias+matrix+gyro_warm_force"}\nrclpy.init(args=["--ros-args", *(part'
        ' for name, value in given.items() for part in ("-p", f"{name}:={value}"))])\nnode ='
        ' CalibrationNode()\n'
        'print(node._options.catalogue.definitions(["gyro_warm_force"]).keys())\nnode.close();'
        ' node.destroy_node(); rclpy.shutdown()'
    )
    done = subprocess.run(
        [sys.executable, '-c', program, str(mine)], capture_output=True, text=True, timeout=120
    )
    assert "dict_keys(['gyro_warm_force'])" in done.stdout, done.stderr


def test_the_example_file_is_a_catalogue_whose_effects_are_found():
    """
    Each effect of the example, hidden in a session on a table, is added.

    It is added by a calibration that knows the file, with its true values.
    """
    example, table = (
        Path(__file__).resolve().parents[2] / 'config/effects_example.yaml',
        stand('three axes'),
    )
    catalogue = files.read_effects(example)
    names = {effect.name: effect.sensor for effect in catalogue.added}
    # 2e-6 is a number.
    assert len(names) == 2 and all(effect.tolerance < 1e-3 for effect in catalogue.added)
    model = SensorModel(
        (*BASE, 'accel_rate_coupling'),
        (*BASE, 'gyro_scale_by_force'),
        joint_names=table.joint_names,
        catalogue=catalogue,
    )
    truth = random_values(model, 'industrial', 3)
    for name in names:
        truth[model.slices[hidden_effect(model, name, 3)[0], name]] = hidden_effect(model, name, 3)[
            1
        ]
    samples = simulate_session(
        model,
        truth,
        table,
        profile=make_profile('quick', 3, table),
        options=SimulationOptions(50.0, 50.0, GRADES['industrial'].noise),
        seed=3,
    )
    found = calibrate_recordings(
        SampleBlock(*samples), table, catalogue=example, candidates='none'
    ).calibration
    for name, sensor in names.items():
        where = found.model.slices[sensor, name]
        np.testing.assert_allclose(
            found.values[where], truth[model.slices[sensor, name]], atol=4 * found.sd[where].max()
        )
        assert found.sd[where].max() < 0.1 * np.abs(found.values[where]).max()
