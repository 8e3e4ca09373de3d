"""What a result says of its origin, and that it does not replace the result of other inputs."""

import hashlib
import os
import re
from pathlib import Path

import pytest
import yaml
from refusal import refused

from imu_calibration.api.choices import made_from, provenance_with, require_same_inputs
from imu_calibration.api.recordings import Arm
from imu_calibration.api.resources import config_file
from imu_calibration.cli.main import main
from imu_calibration.core.errors import InputError
from imu_calibration.document import files

ROOT = Path(__file__).resolve().parents[2]
SESSION, TABLE = ROOT / 'bags/sample_session', ROOT / 'bags/sample_session/table.yaml'


@pytest.fixture(scope='module')
def place(tmp_path_factory):
    """A folder with the result of the sample session, with serial number and operator."""
    folder = tmp_path_factory.mktemp('place')
    (folder / 'table.yaml').write_bytes(TABLE.read_bytes())
    assert main(calibrate(folder, '--serial', 'A-17', '--operator', 'Ada', '--model-as-asked')) == 0
    return folder


def calibrate(folder, *more, verb='calibrate'):
    return [
        verb,
        str(SESSION),
        '--table',
        str(folder / 'table.yaml'),
        '--output',
        str(folder / 'out'),
        '--quiet',
        *more,
    ]


def test_a_result_names_verb_options_files_serial_number_and_operator(place):
    found = yaml.safe_load((place / 'out/calibration.yaml').read_text())['provenance']
    assert (found['verb'], found['serial'], found['operator']) == ('calibrate', 'A-17', 'Ada')
    assert found['options'] == {
        'model_as_asked': True,
        'table': {'name': 'table.yaml', 'sha256': files.hash_of(TABLE)},
        'tolerances': {
            'name': 'tolerances.yaml',
            'sha256': files.hash_of(config_file('tolerances.yaml')),
        },
    }
    assert re.fullmatch('[0-9a-f]{64}', found['bags'][0]['sha256'])
    page = (place / 'out/report.html').read_text()
    assert 'A-17' in page and 'Ada' in page


def test_a_result_of_other_inputs_is_not_replaced(place, capsys):
    before = (place / 'out/calibration.yaml').read_bytes()
    assert main(calibrate(place, verb='diagnose')) == 1 and '--force' in capsys.readouterr().err
    same = provenance_with('calibrate', [SESSION], {}, stand=place / 'table.yaml')
    require_same_inputs(place / 'out', lambda: same)
    require_same_inputs(place / 'elsewhere', dict)
    for changes, part in (
        ({'verb': 'diagnose'}, 'verb'),
        ({'bags': [{'name': 'b', 'sha256': '0'}]}, 'recordings'),
        ({'options': {'table': {'name': 'table.yaml', 'sha256': '0'}}}, 'reference'),
    ):
        with refused(InputError, 'other_result', part):
            require_same_inputs(place / 'out', lambda changes=changes: same | changes)
    assert (place / 'out/calibration.yaml').read_bytes() == before


@pytest.mark.parametrize('text', ['no: document', '{', 'provenance: 3'])
def test_a_file_that_is_no_result_is_not_replaced(text, tmp_path):
    (tmp_path / 'calibration.yaml').write_text(text)
    with refused(InputError, 'other_result', 'recordings'):
        require_same_inputs(tmp_path, lambda: provenance_with('calibrate', [TABLE], {}))


def test_options_in_memory_and_robots_are_named(tmp_path):
    (tmp_path / 'arm.urdf').write_text('<robot/>')
    options = provenance_with(
        'calibrate',
        (),
        {
            'gravity': 9.81,
            'tolerances': {'gyroscope': {'bias': 1.0}},
            'setting': {'settling': 1.0},
            'serial': None,
            'model_as_asked': True,
        },
        stand=Arm(tmp_path / 'arm.urdf', 'imu_link', up=(0, 0, 1)),
    )['options']
    assert (
        options['gravity'] == 9.81
        and options['setting'] == ['settling=1.0']
        and options['up'] == [0, 0, 1]
    )
    assert (
        options['urdf'] == {'name': 'arm.urdf', 'sha256': files.hash_of(tmp_path / 'arm.urdf')}
        and options['model_as_asked'] is True
    )
    assert (
        options['tolerances']['name'] == 'in memory'
        and len(options['tolerances']['sha256']) == 64
        and 'serial' not in options
    )


def test_a_file_is_read_again_for_its_hash_only_after_a_change(tmp_path):
    (path := tmp_path / 'a').write_bytes(b'a')
    before, state = files.hash_of(path), path.stat()
    path.write_bytes(b'b')
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert files.hash_of(path) == before
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns + 1))
    assert files.hash_of(path) == hashlib.sha256(b'b').hexdigest()


def test_hashes_of_earlier_versions_are_recognised():
    assert made_from({'bags': [{'sha256': '0123456789abcdef' + 48 * '7'}]}) == made_from(
        {'bags': [{'sha256': '0123456789abcdef'}]}
    )
    assert made_from({'bags': 3 * [None]}) == made_from({}) == set()
