"""The JSON document of every verb follows docs/cli.schema.json."""

import json
import shutil
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import jsonschema
import numpy as np
import pytest

from imu_calibration.cli import parser, watch
from imu_calibration.cli.main import json_text, main
from imu_calibration.cli.watch import NodeStatus

from worlds.candidates import searching_few
from worlds.no_reports import without_reports
from worlds.noise_worlds import identifying

ROOT = Path(__file__).resolve().parents[2]
SESSION, TABLE, TRUTH = (
    f'{ROOT}/bags/sample_session{name}' for name in ('', '/table.yaml', '/truth.yaml')
)
with open(f'{ROOT}/docs/cli.schema.json', encoding='utf8') as schema_file:
    SCHEMA = json.load(schema_file)
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)
QUICK = {
    'inspect': [SESSION],
    'compare': [TRUTH, TRUTH],
    'effects': [],
    'export': [TRUTH, '--to', 'kalibr', '--output', 'kalibr.yaml'],
    'import': ['kalibr.yaml', '--from', 'kalibr', '--output', 'imported.yaml'],
    'simulate': ['--profile', 'six_faces', '--seed', '3', '--output', 'simulated'],
    'plan': ['--by-hand', '--no-report', '--output', 'plan'],
    'convert': [
        'log.csv',
        '--columns',
        'time=t:s',
        'force=ax,ay,az:m/s^2',
        'rate=gx,gy,gz:rad/s',
        '--output',
        'converted',
    ],
}
"""Verb -> arguments, in an order in which each finds the files of those before."""
LONG = {
    'diagnose': [SESSION, '--table', TABLE, '--output', 'diagnosed'],
    'noise': [SESSION, '--no-report', '--output', 'noise'],
    'view': [SESSION, '--table', TABLE, '--model-as-asked', '--output', 'view.mcap'],
    'fleet': [
        'units',
        '--table',
        TABLE,
        '--model-as-asked',
        '--no-report',
        '--jobs',
        '1',
        '--output',
        'fleet',
    ],
    'plan': ['--table', TABLE, '--no-report', '--no-bound', '--output', 'plan_table'],
}
SEARCHED = 'accel_quadratic+gyro_g_sensitivity'
"""Effects that are tested in the sample session."""
ELSEWHERE = {'arm', 'calibrate', 'check', 'compensate', 'watch'}
"""Verbs whose documents other tests compare with the schema: those below, and test_pages.py."""


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """A text log and a folder with one unit."""
    place = tmp_path_factory.mktemp('json')
    rows = [f'{k / 100:.2f},0,0,9.81,0,0,0' for k in range(500)]
    (place / 'log.csv').write_text('\n'.join(['t,ax,ay,az,gx,gy,gz', *rows]))
    shutil.copytree(SESSION, place / 'units/first')
    return place


def document_of(arguments, capsys):
    """Return the document that a verb prints; it must follow the schema."""
    with without_reports():
        code = main([*searching_few(arguments, SEARCHED), '--json'])
    document = json.loads(capsys.readouterr().out)
    VALIDATOR.validate(document)
    assert document['exit_code'] == code and code in (0, 3)
    return document


def test_each_verb_is_described_and_tried():
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    assert SCHEMA['properties']['verb']['enum'] == list(parser.VERBS) and {
        *QUICK,
        *LONG,
        *ELSEWHERE,
    } == set(parser.VERBS)
    assert [part['then']['properties']['result']['$ref'] for part in SCHEMA['allOf']] == [
        f'#/$defs/{verb}' for verb in parser.VERBS
    ]


def test_quick_verbs(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    for verb, arguments in QUICK.items():
        document_of([verb, *arguments], capsys)


@pytest.mark.long
def test_other_verbs(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    for verb, arguments in LONG.items():
        # The extra view is not among the oldest versions.
        if verb != 'view' or find_spec('foxglove'):
            with identifying(0):
                document_of([verb, *arguments], capsys)


@pytest.mark.long
@pytest.mark.real_data
def test_arm(recordings, capsys):
    """Both gyroscopes reach their limit, which the warnings say."""
    bag = str(recordings / 'array_2')
    topics = ['--imu-topic', '/imu_1/data_raw', '--imu-topic', '/imu_7/data_raw']
    assert main(['arm', bag, *topics, '--json']) == 0
    printed = capsys.readouterr()
    VALIDATOR.validate(json.loads(printed.out))
    assert printed.err.count('34.87 rad/s') == 2


def test_watch(capsys):
    node = SimpleNamespace(
        complete=True,
        name='calibration_node',
        statuses={'streams': NodeStatus(0, 'Imu messages', {'rate [Hz]': '100'})},
        screen=str,
    )
    result = watch._watch(node, SimpleNamespace(patience=1.0, once=True, json=True))
    VALIDATOR.validate(json.loads(json_text('watch', result.exit_code, result.document)))


def test_an_error_is_described(capsys):
    assert main(['compare', TRUTH, 'nowhere.yaml', '--json']) == 1
    document = json.loads(capsys.readouterr().out)
    VALIDATOR.validate(document)
    assert (document['exit_code'], document['error']['code']) == (1, 'file_unreadable')


@pytest.mark.parametrize(
    ('verb', 'code', 'document'),
    [
        ('arm', 0, {'arm': [1.0, 2.0], 'sd': [1.0, 1.0, 1.0], 'unit': 'm', 'notes': []}),
        ('check', 0, {'proof': {}}),
        ('compare', 0, {'rows': [], 'lines': [], 'more': 1}),
        ('compare', 0, {'error': 'text', 'key': None}),
        ('compar', 0, {'rows': [], 'lines': []}),
        ('import', 0, {'output': 'x', 'held': np.array([1.5])}),
    ],
)
def test_another_document_is_refused(verb, code, document):
    assert not VALIDATOR.is_valid(json.loads(json_text(verb, code, document)))
