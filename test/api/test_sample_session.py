"""The sample recording, replayed end to end through the verbs that a user types."""

import json
from pathlib import Path

import numpy as np
import pytest

from imu_calibration.cli.main import main
from imu_calibration.core import documents
from imu_calibration.document.calibration_text import calibration_from_text

BAG = Path(__file__).parents[2] / 'bags' / 'sample_session'


def load(path):
    """Return the calibration in a file."""
    return calibration_from_text(Path(path).read_text())


@pytest.fixture(scope='module')
def output(tmp_path_factory):
    """Folder of a calibration of the sample recording."""
    folder = tmp_path_factory.mktemp('sample')
    assert (
        main(['calibrate', str(BAG), '--table', str(BAG / 'table.yaml'), '--output', str(folder)])
        == 0
    )
    return folder


def test_size():
    """The sample stays small."""
    assert sum(f.stat().st_size for f in BAG.iterdir()) < 5_000_000


def test_truth_is_found_within_the_reported_standard_deviations(output):
    """
    Every parameter lies within 4.5 sd of the truth (36 parameters: chance 2e-4).

    The errors are small in themselves.
    """
    found, truth = load(output / 'calibration.yaml'), load(BAG / 'truth.yaml')
    names = [name for name in truth.param_names if name in found.param_names]
    a, b = ([c.param_names.index(name) for name in names] for c in (found, truth))
    ratio = np.abs(found.values[a] - truth.values[b]) / found.sd[a]
    print(
        f'sample session: largest error {ratio.max():.2f} sd, rms {np.sqrt((ratio**2).mean()):.2f}'
        f' sd over {len(names)} parameters'
    )
    assert ratio.max() < 4.5
    assert set(found.requested.values()) == {'determined'}
    for sensor, effect, bound in (
        ('accelerometer', 'bias', 2e-3),
        ('accelerometer', 'matrix', 2e-4),
        ('accelerometer', 'accel_size_effect', 3e-4),
        ('gyroscope', 'bias', 1e-4),
        ('gyroscope', 'matrix', 1e-4),
    ):
        assert np.max(np.abs(found.value(sensor, effect) - truth.value(sensor, effect))) < bound


def test_an_inspection_by_hand_gives_the_status_of_the_calibration(tmp_path, capsys):
    """
    The same parameters are determined and fixed, though an inspection holds out no data.
    """
    assert main(['inspect', str(BAG), '--json']) == 0
    (looked_at,) = json.loads(capsys.readouterr().out)['result']['imu']
    main(['calibrate', str(BAG), '--no-report', '--output', str(tmp_path)])
    found = load(tmp_path / 'calibration.yaml')
    assert looked_at['status'] == {name: found.status_by_name[name] for name in found.param_names}
    assert set(looked_at['status'].values()) == {'determined', 'fixed'}


def test_compare_with_the_truth(output, capsys):
    """The verb says that calibration and truth agree."""
    assert main(['compare', str(output / 'calibration.yaml'), str(BAG / 'truth.yaml')]) == 0
    assert 'the calibrations agree' in capsys.readouterr().out


def test_compensated_bag(output, tmp_path):
    """The corrected topic stands beside the others and is closer to the reference."""
    from examples.error_figures import before_and_after
    from imu_calibration.kinematics.table import Table
    from imu_calibration.preprocessing.window_finder import session_truth
    from msg_adapters.bag import open_recording

    corrected = tmp_path / 'corrected'
    assert (
        main(
            [
                'compensate',
                str(BAG),
                '--calibration',
                str(output / 'calibration.yaml'),
                '--output',
                str(corrected),
            ]
        )
        == 0
    )
    with open_recording(corrected, imu_topic='/imu/data_corrected') as recording:
        assert {topic.name for topic in recording.topics} == {
            '/imu/data_raw',
            '/imu/data_corrected',
            '/joint_states',
        }
        table = Table.from_mapping(documents.from_text((BAG / 'table.yaml').read_text()))
        imu, reference = session_truth(recording.blocks(table.joint_names), table)
    still = np.linalg.norm(reference.rate_s, axis=1) < 1e-3
    error = imu.force_s[still].reshape(-1, 3) - reference.force_s[still]
    assert np.abs(error.mean(axis=0)).max() < 2e-3
    with open_recording(BAG) as recording:
        raw = session_truth(recording.blocks(table.joint_names), table)
    before, after = before_and_after(*raw, load(output / 'calibration.yaml'))
    print(
        f'sample session: {before.force} -> {after.force} m/s^2, {before.rate} -> {after.rate}'
        ' rad/s'
    )
    assert after.force < 0.1 * before.force and after.rate < 0.1 * before.rate
