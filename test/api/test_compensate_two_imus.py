"""Two IMUs in one stream: a text log with a column of the instance, and a topic."""

import json

import numpy as np
import pytest
from refusal import refused

from imu_calibration.api.compensate import compensate_recording
from imu_calibration.api.references import inputs_of
from imu_calibration.cli.main import main
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples
from imu_calibration.document.calibration_text import calibration_to_text
from msg_adapters.bag import list_topics, open_recording
from msg_adapters.csv_log import LogOptions
from msg_adapters.write import write_session

from worlds.compensation_cases import random_calibration

N = 2400
FORCE, RATE = np.array([0.4, -0.25, 0.2]), np.array([0.03, -0.02, 0.012])
"""Differences of the biases of the second IMU from those of the first one."""


def still(seed):
    """One IMU at rest."""
    rng = np.random.default_rng(seed)
    stamps = 10**18 + 10_000_000 * np.arange(N)
    force = rng.normal([0.1, 0.2, 9.81], 0.01, (N, 3))
    return ImuSamples(stamps, force, rng.normal(0, 1e-3, (N, 3)), 'imu_link')


def mixed():
    """Return the readings of two IMUs in alternation."""
    one, other = still(1), still(2)
    order = np.arange(2 * N).reshape(2, N).T.ravel()
    return ImuSamples(
        np.concatenate([one.stamp_ns, other.stamp_ns])[order],
        np.concatenate([one.force_s, other.force_s + FORCE])[order],
        np.concatenate([one.rate_s, other.rate_s + RATE])[order],
        'imu_link',
    )


@pytest.fixture
def log(tmp_path, monkeypatch):
    """A text log of two IMUs, a calibration, and the working folder of both."""
    monkeypatch.chdir(tmp_path)
    imu = mixed()
    seconds = (imu.stamp_ns - imu.stamp_ns[0]) * 1e-9
    columns = np.column_stack([seconds, np.arange(2 * N) % 2, imu.force_s, imu.rate_s])
    header = 't (s),I,ax (m/s^2),ay (m/s^2),az (m/s^2),gx (rad/s),gy (rad/s),gz (rad/s)'
    np.savetxt('log.csv', columns, delimiter=',', header=header, comments='', fmt='%.12g')
    text = calibration_to_text(random_calibration(5, (), (), sd=1e-5))
    (tmp_path / 'calibration.yaml').write_text(text)
    return tmp_path / 'log.csv'


CALIBRATION = ['--calibration', 'calibration.yaml']
VERBS = {
    'inspect': [],
    'calibrate': ['--output', 'out'],
    'diagnose': ['--output', 'out'],
    'noise': ['--output', 'out'],
    'check': CALIBRATION,
    'compensate': [*CALIBRATION, '--output', 'out.csv'],
}


@pytest.mark.parametrize('verb', VERBS)
def test_two_imus_in_a_text_log_are_refused_and_rows_can_be_chosen(verb, log, capsys):
    assert main([verb, 'log.csv', *VERBS[verb], '--json']) == 1
    error = json.loads(capsys.readouterr().out)['error']
    assert error['code'] == 'one_source' and '--where' in error['error']
    assert not log.with_name('out').exists() and not log.with_name('out.csv').exists()
    # A condition reaches the rows: a value that no row has.
    assert main([verb, 'log.csv', *VERBS[verb], '--where', 'I=5', '--json']) == 1
    assert json.loads(capsys.readouterr().out)['error']['code'] == 'where'


def test_the_chosen_rows_are_those_of_one_imu(log):
    other = still(2)
    (source,) = inputs_of([log], None, {'where': ['I=1']}).sources
    (imu,) = [block.imu for block in source]
    np.testing.assert_allclose(imu.force_s, other.force_s + FORCE, atol=1e-9)
    corrected = compensate_recording(log, 'calibration.yaml', where=['I=1'])
    expected = compensate_recording(imu, 'calibration.yaml')
    np.testing.assert_allclose(corrected.imu.force_s, expected.imu.force_s, atol=1e-9)
    compensate_recording(log, 'calibration.yaml', where=['I=1'], output='one.csv')
    assert len(log.with_name('one.csv').read_text().splitlines()) == N + 1
    compensate_recording(log, 'calibration.yaml', where=['I=0'], output='bag')
    with open_recording('bag', '/imu/data_corrected', want_joints=False) as recording:
        assert recording.message_counts['/imu/data_corrected'] == N


def test_compensate_refuses_two_imus_of_a_topic(log):
    """Before the bag is completed, and in memory."""
    write_session('both', mixed())
    with refused(InputError, 'one_source', '50 %'):
        compensate_recording('both', 'calibration.yaml', output='out')
    with refused(InputError, 'one_source'):
        compensate_recording('both', 'calibration.yaml')
    with refused(InputError, 'one_source'):
        compensate_recording(mixed(), 'calibration.yaml')
    assert sorted(path.name for path in log.parent.iterdir()) == [
        'both',
        'calibration.yaml',
        'log.csv',
    ]


def test_a_bag_has_no_rows(log):
    write_session('bag', still(1))
    with refused(InputError, 'where', 'I=1'):
        list_topics('bag', LogOptions(where=('I=1',)))
