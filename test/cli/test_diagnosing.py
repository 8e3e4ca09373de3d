"""
From a recording to a diagnosis on disk: the verb `diagnose`, its files, and what they are good for.
"""

import json

import pytest

from imu_calibration.cli.main import main
from imu_calibration.document.calibration_text import calibration_from_text

from worlds.candidates import FEW

pytestmark = [pytest.mark.slow, pytest.mark.long]


@pytest.fixture(scope='module')
def outcome(tmp_path_factory):
    """A session whose gyroscopes feel gravity, and its diagnosis."""
    folder = tmp_path_factory.mktemp('diagnosis')
    assert (
        main(
            [
                'simulate',
                '--profile',
                'quick',
                '--effect',
                'gyro_g_sensitivity',
                '--seed',
                '11',
                '--imu-rate',
                '50',
                '--joint-rate',
                '50',
                '--output',
                str(folder / 'bag'),
            ]
        )
        == 0
    )
    code = main(
        [
            'diagnose',
            str(folder / 'bag'),
            '--table',
            str(folder / 'bag' / 'table.yaml'),
            '--output',
            str(folder / 'out'),
            '--candidates',
            f'{FEW}+accel_size_effect',
        ]
    )
    assert code in (0, 3)
    return folder


def test_the_hidden_effects_are_found_and_measured(outcome):
    """
    The arms of the simulated IMU and its g-sensitivity are the findings.

    Every value lies within 4.5 sd of the truth.
    """
    document = json.loads((outcome / 'out' / 'diagnosis.json').read_text())
    assert document['format'] == 'imu_calibration/diagnosis/1'
    found = {finding['effect']: finding for finding in document['findings']}
    assert set(found) == {'accel_size_effect', 'gyro_g_sensitivity'}
    truth = calibration_from_text((outcome / 'bag' / 'truth.yaml').read_text())
    values = dict(zip(truth.param_names, truth.values))
    for name, entry in found['gyro_g_sensitivity']['parameters'].items():
        assert abs(entry['value'] - values[name]) < 4.5 * entry['sd']
    for finding in found.values():
        assert finding['p_value'] < 0.01
        assert finding['gain']['ci95'][0] > 0.3


def test_the_extended_calibration_is_accepted_everywhere(outcome):
    """`compensate` takes the file as it is, and `simulate --calibration` runs it."""
    calibration = str(outcome / 'out' / 'calibration.yaml')
    assert (
        main(
            [
                'compensate',
                str(outcome / 'bag'),
                '--calibration',
                calibration,
                '--output',
                str(outcome / 'corrected'),
            ]
        )
        == 0
    )
    again = main(
        [
            'simulate',
            '--table',
            str(outcome / 'bag' / 'table.yaml'),
            '--profile',
            'quick',
            '--calibration',
            calibration,
            '--output',
            str(outcome / 'again'),
        ]
    )
    assert again == 0
    found = calibration_from_text((outcome / 'out' / 'calibration.yaml').read_text())
    assert found.has('gyroscope', 'gyro_g_sensitivity')


def test_the_report_tells_it(outcome):
    """The page carries the finding in words."""
    page = (outcome / 'out' / 'report.html').read_text()
    assert 'gyro_g_sensitivity' in page and 'accel_size_effect' in page
