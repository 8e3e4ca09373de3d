"""
Options and behaviour that all verbs share.

Help, JSON, quiet, verbose, suggestions, interruption, light start.
"""

import json
import subprocess
import sys

import pytest

from imu_calibration.cli import main as main_module
from imu_calibration.cli import parser
from imu_calibration.cli.main import main
from imu_calibration.core.progress import listening, report, reported

from worlds.small_bags import write_small_bag

ROOT = parser.__file__.rsplit('/imu_calibration/', 1)[0]
SESSION, TABLE, TRUTH = (
    f'{ROOT}/bags/sample_session{name}' for name in ('', '/table.yaml', '/truth.yaml')
)


HELP_NEEDS = {verb: {'numpy'} for verb in ('simulate', 'plan', 'convert', 'check')}
"""Heavy modules that the help of a verb may import, by verb; others import none."""


@pytest.mark.live
@pytest.mark.parametrize('verb', ['--version', *parser.VERBS])
def test_help_imports_no_heavy_module(verb):
    program = (
        'import sys\nfrom imu_calibration.cli.main import main\ntry:\n   '
        ' main(sys.argv[1:])\nexcept SystemExit:\n    pass\nprint(*{name.partition(".")[0] for name'
        ' in sys.modules}, file=sys.stderr)'
    )
    done = subprocess.run(
        [sys.executable, '-c', program, verb, '--help'],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    found = set(done.stderr.split()) & {
        'numpy',
        'scipy',
        'matplotlib',
        'tqdm',
        'yaml',
        'rosbags',
        'jinja2',
        'rclpy',
    }
    assert found <= HELP_NEEDS.get(verb, set())


READINGS_OPTIONS = {
    *('--accelerometer-unit', '--gyroscope-unit', '--increments', '--axes', '--nominal'),
    *('--gyroscope-topic', '--exclude', '--where', '--imu-topic', '--frame-id'),
    '--temperature-topic',
}
WITHOUT_READINGS = {'simulate', 'compare', 'plan', 'import', 'effects', 'watch'}
"""Verbs that read no recording."""
LACKING = {
    # Its two topics have both sensors each.
    'arm': {'--gyroscope-topic', '--temperature-topic'},
    # It converts a log as it is, with units in --columns; verbs that read the bag have the rest.
    'convert': READINGS_OPTIONS - {'--where'},
    # Its document describes the readings.
    'export': {'--accelerometer-unit', '--gyroscope-unit', '--increments', '--nominal'},
}
"""Verbs that read recordings with fewer options."""


@pytest.mark.parametrize('verb', sorted(set(parser.VERBS) - WITHOUT_READINGS))
def test_verbs_that_read_readings_share_their_options(verb):
    made = parser.make_parser(verb)
    (verbs,) = (action.choices for action in made._actions if action.dest == 'verb')
    options = set(verbs[verb].get_default('verb_options'))
    assert READINGS_OPTIONS - options == LACKING.get(verb, set())


@pytest.mark.live
def test_an_inspection_imports_neither_the_search_nor_slow_libraries():
    program = (
        'import sys\nfrom imu_calibration.cli.main import'
        ' main\nmain(sys.argv[1:])\nprint(*sys.modules, file=sys.stderr)'
    )
    done = subprocess.run(
        [sys.executable, '-c', program, 'inspect', SESSION],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert not set(done.stderr.split()) & {
        'scipy.interpolate',
        'scipy.optimize',
        'scipy.stats',
        'scipy.signal',
        'matplotlib',
        'rclpy',
        'jinja2',
        'imu_calibration.references.gravity.model_selection',
        'imu_calibration.api.calibrate',
    }


@pytest.mark.parametrize('verb', parser.VERBS)
def test_help_fits_a_screen_and_has_two_examples(verb, capsys, monkeypatch):
    monkeypatch.setenv('COLUMNS', '80')
    with pytest.raises(SystemExit):
        main([verb, '--help'])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) < 65
    examples = lines[lines.index('examples:') + 1 :]
    assert len(examples) == 2
    for example in examples:  # each option exists, and all that are required are there
        words = example.split()
        assert words[:2] == ['imu_calibration', verb]
        parser.make_parser(verb).parse_args(words[1:])


@pytest.mark.parametrize(
    ('arguments', 'closest'),
    [
        (['calibrat', 'x'], 'calibrate'),
        (['check', 'x', '--calibraton', 'y', '--calibration', 'z'], '--calibration'),
    ],
)
def test_the_closest_name_is_suggested(arguments, closest, capsys):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    error = capsys.readouterr().err
    assert ended.value.code == 1 and error.count('\n') == 1 and f'did you mean {closest}?' in error


@pytest.mark.parametrize(
    ('arguments', 'closest'),
    [
        (
            [
                'calibrate',
                SESSION,
                '--table',
                TABLE,
                '--output',
                'never',
                '--accelerometer-model',
                'bias+matrx',
            ],
            'matrix',
        ),
        (
            [
                'calibrate',
                SESSION,
                '--table',
                TABLE,
                '--output',
                'never',
                '--accelerometer-model',
                'size_efect',
            ],
            'size_effect',
        ),
        (
            [
                'calibrate',
                SESSION,
                '--table',
                TABLE,
                '--output',
                'never',
                '--imu-topic',
                '/imu/dat_raw',
            ],
            '/imu/data_raw',
        ),
        (['simulate', '--output', 'never', '--effect', 'accel_bandwith'], 'accel_bandwidth'),
        (['simulate', '--output', 'never', '--profile', 'calibratin'], 'calibration'),
        (['export', TRUTH, '--to', 'kalib', '--output', 'never'], 'kalibr'),
    ],
)
def test_the_closest_model_effect_topic_profile_or_program_is_suggested(
    arguments, closest, capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 1
    assert (
        f'; did you mean {closest}?;' in capsys.readouterr().err and list(tmp_path.iterdir()) == []
    )


def test_quiet_prints_no_result(capsys):
    assert main(['effects', '--quiet']) == 0
    assert capsys.readouterr() == ('', '')


def test_numbers_that_are_not_finite_become_null():
    from imu_calibration.cli.main import json_text

    assert json.loads(json_text('x', 0, {'a': float('nan'), 'b': [float('inf'), 1.5]}))[
        'result'
    ] == {'a': None, 'b': [None, 1.5]}


def test_verbose_prints_each_phase_with_its_time(capsys, tmp_path):
    bag = str(write_small_bag(tmp_path / 'bag'))
    assert main(['inspect', bag, '--verbose', '--quiet']) == 0
    quiet = capsys.readouterr()
    assert main(['inspect', bag, '--verbose']) == 0
    assert 'reading bag: ' in capsys.readouterr().err and quiet.err == ''


@pytest.mark.parametrize(
    ('arguments', 'phases'),
    [
        (['simulate', '--profile', 'six_faces'], ['simulating', 'writing output']),
        (['plan', '--by-hand'], ['drawing the report']),
    ],
)
def test_verbs_without_a_recording_name_their_phases_too(
    arguments, phases, capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert main([*arguments, '--output', 'output', '--verbose']) == 0
    names = [line.partition(': ')[0] for line in capsys.readouterr().err.splitlines()]
    assert [phase for phase in phases if phase not in names] == []


def test_a_listener_gets_each_step_and_only_in_its_context():
    seen = []
    with listening(lambda *step: seen.append(step)):
        assert list(reported('counting', 'ab', 2)) == ['a', 'b']
    report('counting', 3, 3)
    assert seen == [('counting', 0, 2), ('counting', 1, 2), ('counting', 2, 2)]


@pytest.mark.parametrize('place', ['run', 'parse'])
def test_an_interruption_ends_with_130(place, monkeypatch, capsys):
    def interrupt(*_):
        raise KeyboardInterrupt

    from imu_calibration.cli import effects

    monkeypatch.setattr(
        *((effects, 'run') if place == 'run' else (parser, 'make_parser')), interrupt
    )
    assert main_module.main(['effects']) == 130
    assert capsys.readouterr().err.count('\n') == 1
