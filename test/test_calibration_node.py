"""A bag through both nodes over DDS: the live calibration is the offline one, the corrected stream is the truth."""

import numpy as np
import pytest

from imu_calibration.documents import calibration_from_text
from imu_calibration.profiles import make_profile
from imu_calibration.turntable import reference_motion
from live_sessions import OPTIONS, TABLE, assert_same, make_session
from imu_calibration import workflow
from imu_calibration.simulation import START_NS
from msg_adapters.bag import open_recording
from msg_adapters.write import write_session

pytest.importorskip('rclpy')
from live_station import Station, taken  # noqa: E402

pytestmark = pytest.mark.dds
RATE = 10.0


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    """Two sessions of one IMU: one to calibrate with, and one of another motion to correct, an hour later."""
    folder = tmp_path_factory.mktemp('bags')
    for name, profile in (('session', 'quick'), ('drive', 'tumbling')):
        imu, joints, values, model = make_session(3, profile=profile)
        write_session(folder / name, imu, joints)
    return folder


def test_a_bag_through_both_nodes(bags, tmp_path):
    with Station() as station:
        documents = station.watch_documents()
        corrected, residuals = station.watch_imu('imu/data_corrected'), station.watch_imu('imu/residual')
        station.watch_diagnostics()
        station.calibration_node(tmp_path, reliable=True, resume=True)
        compensator = station.start('compensator_node', {'reliable': True})
        player = station.play(bags / 'session', RATE, subscribers=1)
        station.until(lambda: player.poll() is not None, 'the end of the recording')
        answer = station.call('/calibration_node/save')
        assert answer.success, answer.message
        live = calibration_from_text((tmp_path / 'calibration.yaml').read_text())
        with open_recording(bags / 'session') as recording:
            expected = workflow.calibrate([lambda: recording.blocks(TABLE.joint_names)], TABLE, OPTIONS).calibration
        check_the_answer(station, live, expected)
        assert sorted(path.name for path in tmp_path.iterdir()) == ['calibration.accumulator.npz', 'calibration.yaml']

        late = station.watch_documents()
        station.until(lambda: late, 'the latched calibration for a late joiner')
        assert late[-1] == documents[-1] == (tmp_path / 'calibration.yaml').read_text()
        check_residuals(taken(residuals), live)

        taken(corrected)
        station.processes.end(next(p for p in station.processes.running if 'calibration_node' in p.args[2]))
        player = station.play(bags / 'drive', RATE, subscribers=1, topics='/imu/data_raw')
        station.until(lambda: player.poll() is not None, 'the end of the drive')
        station.spin_for(0.5)
        check_the_stream(taken(corrected), bags / 'drive')
        assert station.processes.end(compensator) == 0


def check_the_answer(station, live, expected):
    """Every message was used, and the answer is that of the offline tool on the same messages."""
    used = {key: sum(calibration.statistics['samples_used'].values()) for key, calibration in (('live', live), ('offline', expected))}
    assert used['live'] == used['offline'] and live.statistics['dropped'] == expected.statistics['dropped'] == {}
    assert_same(live, expected)
    groups = {name: status for name, status in station.status.items() if 'calibration_node: ' in name}
    assert groups['calibration_node: accelerometer bias'].level == b'\0'
    assert any('still needed' in message for _, _, message in station.history)


def check_residuals(residuals, live):
    """Residuals are there, and as small as the noise."""
    noise = live.noise('gyroscope')[0]
    assert len(residuals) > 50 and np.all(np.median(np.abs(residuals.rate_s), axis=0) < 3 * noise)


def check_the_stream(corrected, bag):
    """One-second means of the corrected stream lie within a tenth of the raw errors of the truth."""
    with open_recording(bag) as recording:
        raw = next(recording.blocks()).imu
    time = (corrected.stamp_ns - START_NS) * 1e-9
    truth = reference_motion(TABLE, make_profile('tumbling', 1, TABLE).at(time))
    _, here, there = np.intersect1d(corrected.stamp_ns, raw.stamp_ns, return_indices=True)
    assert len(here) == len(corrected) > 0.99 * len(raw)
    for name in ('force_s', 'rate_s'):
        after = means(getattr(corrected, name)[here] - getattr(truth, name)[here])
        before = means(getattr(raw, name)[there] - getattr(truth, name)[here])
        assert np.sqrt((after**2).mean()) < 0.1 * np.sqrt((before**2).mean())


def means(error, length=100):
    """Means over one second at 100 Hz."""
    return error[:len(error) // length * length].reshape(-1, length, 3).mean(axis=1)
