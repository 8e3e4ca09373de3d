"""
A bag through both nodes over DDS.

The live calibration is the offline one, the corrected stream is the truth.
"""

import time
from dataclasses import replace

import numpy as np
import pytest
import yaml
from test_hand_calibration import GRAVITY, simulate
from without_search import candidates_in_scripts

from imu_calibration.calibration.diagnosis.diagnose import diagnose_recording
from imu_calibration.core.samples import ImuSamples
from imu_calibration.document.calibration_text import calibration_from_text, calibration_to_text
from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable.table_reference import TableReference
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.session import SESSION_START_NS
from msg_adapters.bag import open_recording
from msg_adapters.write import write_session

from worlds import physics
from worlds.calibrated import calibrated_by_hand, calibrated_on_table
from worlds.live_sessions import OPTIONS, TABLE, assert_same, make_session

pytest.importorskip('rclpy')

from ros.live_station import Station, taken

pytestmark = pytest.mark.live
RATE = 20.0
CANDIDATES = 'accel_quadratic+accel_scale_asymmetry+gyro_g_sensitivity'
"""Effects that the search tests, in the node and in the verb."""
SAMPLE_RATE = 25.0


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    """
    Two sessions of one IMU.

    One to calibrate with, also in two parts, and one of another motion to correct, an hour later.
    """
    folder = tmp_path_factory.mktemp('bags')
    for name, profile in (('session', 'quick'), ('drive', 'tumbling')):
        imu, joints, values, model = make_session(3, SAMPLE_RATE, profile=profile)
        write_session(folder / name, imu, joints)
        if name == 'session':
            cut = imu.stamp_ns[len(imu) * 4 // 5]
            write_session(
                folder / 'beginning',
                *(samples.select(samples.stamp_ns < cut) for samples in (imu, joints)),
            )
            write_session(
                folder / 'ending',
                *(samples.select(samples.stamp_ns >= cut) for samples in (imu, joints)),
            )
    return folder


@pytest.mark.long
def test_a_bag_through_both_nodes(bags, tmp_path):
    """Without a search for effects, which the next test has."""
    with Station() as station:
        documents = station.watch_documents()
        corrected, residuals = (
            station.watch_imu('imu/data_corrected'),
            station.watch_imu('imu/residual'),
        )
        station.watch_diagnostics()
        # The residuals are those of solutions on the way.
        station.calibration_node(tmp_path, resume=True, model_as_asked=True, solve_share=0.2)
        compensator = station.start('compensator_node')
        for part in ('beginning', 'ending'):
            player = station.play(bags / part, RATE, subscribers=1)
            station.until(
                lambda: player.poll() is not None and documents,
                'the end of the part and a calibration, which the residuals need',
            )
        answer = station.call('/calibration_node/save')
        assert answer.success, answer.message
        live = calibration_from_text((tmp_path / 'calibration.yaml').read_text())
        with open_recording(bags / 'session') as recording:
            expected = calibrated_on_table(
                [list(recording.blocks(TABLE.joint_names))], TABLE, OPTIONS
            ).calibration
        check_the_answer(station, live, expected)
        assert sorted(path.name for path in tmp_path.iterdir()) == [
            'calibration.accumulator.npz',
            'calibration.yaml',
        ]

        late = station.watch_documents()
        station.until(lambda: late, 'the latched calibration for a late joiner')
        assert late[-1] == documents[-1] == (tmp_path / 'calibration.yaml').read_text()
        check_residuals(taken(residuals), live)

        corrected.flush()  # readings that were corrected with an earlier document, if any
        station.processes.end(
            next(p for p in station.processes.running if 'calibration_node' in p.args[2])
        )
        player = station.play(bags / 'drive', RATE, subscribers=1, topics='/imu/data_raw')
        station.until(lambda: player.poll() is not None, 'the end of the drive')
        station.spin_for(0.5)
        check_the_stream(taken(corrected), bags / 'drive')
        assert station.processes.end(compensator) == 0


def check_the_answer(station, live, expected):
    """Every message was used, and the answer is that of the offline tool on the same messages."""
    used = {
        key: sum(calibration.statistics['samples_used'].values())
        for key, calibration in (('live', live), ('offline', expected))
    }
    assert (
        used['live'] == used['offline']
        and live.statistics['dropped'] == expected.statistics['dropped'] == {}
    )
    assert_same(live, expected)
    groups = {
        name: status for name, status in station.status.items() if 'calibration_node: ' in name
    }
    assert groups['calibration_node: accelerometer bias'].level == b'\0'
    assert not values_of(station, 'accelerometer bias')['needs'] and any(
        level == 1 for _, level, _ in station.history
    )


def check_residuals(residuals, live):
    """Residuals are there, and as small as the noise."""
    noise = live.noise('gyroscope')[0]
    assert len(residuals) > 50 and np.all(np.median(np.abs(residuals.rate_s), axis=0) < 3 * noise)


def check_the_stream(corrected, bag):
    """
    One-second means of the corrected stream lie within a tenth of the raw errors of the truth.
    """
    with open_recording(bag) as recording:
        raw = next(recording.blocks()).imu
    time = (corrected.stamp_ns - SESSION_START_NS) * 1e-9
    truth = reference_motion(TABLE, make_profile('tumbling', 1, TABLE).at(time))
    _, here, there = np.intersect1d(corrected.stamp_ns, raw.stamp_ns, return_indices=True)
    assert len(here) == len(corrected) > 0.99 * len(raw)
    for name in ('force_s', 'rate_s'):
        after = means(getattr(corrected, name)[here] - getattr(truth, name)[here])
        before = means(getattr(raw, name)[there] - getattr(truth, name)[here])
        assert np.sqrt((after**2).mean()) < 0.1 * np.sqrt((before**2).mean())


def means(error, length=int(SAMPLE_RATE)):
    """Means over one second."""
    return error[: len(error) // length * length].reshape(-1, length, 3).mean(axis=1)


def values_of(station, name):
    """The details of a diagnostic status."""
    status = station.status.get(f'calibration_node: {name}')
    return {pair.key: pair.value for pair in status.values} if status else {}


@pytest.mark.long
def test_a_hidden_effect_is_named_live(tmp_path):
    """
    Quadratic terms that the model lacks.

    Diagnostics say so, as the verb does of the same bag, and the calibration is the verb's.
    """
    session = physics.make_session(
        3, {'accel_quadratic': None}, profile='quick', imu_rate=SAMPLE_RATE, joint_rate=SAMPLE_RATE
    )
    physics.write_bag(session, tmp_path / 'bag')
    (tmp_path / 'table.yaml').write_text(yaml.safe_dump(session.table))
    table = Table.from_mapping(session.table)
    with open_recording(tmp_path / 'bag') as recording, candidates_in_scripts(CANDIDATES):
        offline = diagnose_recording(
            recording.blocks(table.joint_names), TableReference(table), OPTIONS
        )
    expected = offline.diagnosis
    first = expected.findings[0]
    with Station() as station:
        documents = station.watch_documents()
        station.watch_diagnostics()
        station.calibration_node(
            tmp_path,
            table_file=tmp_path / 'table.yaml',
            diagnosis_period=600.0,
            candidates=CANDIDATES,
        )
        station.until(
            lambda: values_of(station, 'diagnosis').get('outcome') == 'waiting',
            'the first diagnostics',
        )
        player = station.play(tmp_path / 'bag', 20.0, subscribers=1)
        station.until(lambda: player.poll() is not None, 'the end of the recording')
        asked = time.monotonic()
        assert station.call('/calibration_node/solve').success
        answered = time.monotonic() - asked
        station.until(
            lambda: values_of(station, 'diagnosis').get('windows') == str(expected.windows),
            'the diagnosis of all windows',
        )
        found, status = (
            values_of(station, 'diagnosis'),
            station.status['calibration_node: diagnosis'],
        )
        station.until(lambda: 'accel_quadratic' in documents[-1], 'a calibration with it')
        assert station.call('/calibration_node/save').success
        live = calibration_from_text((tmp_path / 'calibration.yaml').read_text())
        station.until(
            lambda: 'calibration_node: accelerometer accel_quadratic' in station.status,
            'its diagnostics',
        )
        group = station.status['calibration_node: accelerometer accel_quadratic']
    # The document has the common arm last.
    assert_same(live, calibration_from_text(calibration_to_text(offline.calibration)))
    assert (
        live.statistics['added'] == offline.calibration.statistics['added'] and group.level == b'\0'
    )
    print(f'diagnosed live: {status.message}; solve answered after {answered:.1f} s')
    assert first.effect == 'accel_quadratic'
    assert (
        found['outcome'] == 'found'
        and found['effect'] == first.effect
        and found['p-value'] == f'{first.p_value:.2g}'
    )
    assert (
        found['held-out reduction'] == f'{first.gain.reduction:.3f}'
        and found['explanation'] == first.explanation
    )
    assert status.level == b'\1'


@pytest.mark.parametrize('by_hand', [True, False])
def test_two_imus_on_one_topic_are_refused(tmp_path, by_hand):
    """A second driver remapped to the same topic: nothing is saved, and the cause is named."""
    if by_hand:
        imu, joints = simulate(2, n_poses=8, still=1.5)[0], None
    else:
        imu, joints, _, _ = make_session(3, SAMPLE_RATE)
        imu = imu.select(slice(0, int(30 * SAMPLE_RATE)))
        joints = joints.select(joints.stamp_ns <= imu.stamp_ns[-1])
    second = replace(
        imu,
        stamp_ns=imu.stamp_ns + 3_000_000,
        force_s=imu.force_s + [0.31, -0.22, 0.18],
        rate_s=imu.rate_s + [0.02, -0.03, 0.015],
    )
    both = ImuSamples.concatenate([imu, second])
    both = both.select(np.argsort(both.stamp_ns, kind='stable'))
    write_session(tmp_path / 'bag', both, joints)
    options = {'table_file': '', 'gravity': GRAVITY} if by_hand else {}
    with Station() as station:
        station.watch_diagnostics()
        station.calibration_node(tmp_path, **options)
        player = station.play(tmp_path / 'bag', 8.0, subscribers=1)
        station.until(lambda: player.poll() is not None, 'the end of the recording')
        for service in ('solve', 'save'):
            answer = station.call(f'/calibration_node/{service}')
            assert not answer.success and 'two' in answer.message, answer.message
    assert not (tmp_path / 'calibration.yaml').exists()


@pytest.mark.long
def test_poses_by_hand_through_the_node(tmp_path):
    """
    No table, no joint states.

    Poses are counted, the direction that is missing is named, the document is that of the offline
    tool. `LiveByHand` has a real recording (test_live_by_hand.py).
    """
    from sensor_msgs.msg import Imu

    bag, rate = tmp_path / 'bag', 8.0
    write_session(bag, simulate(1)[0])
    options = {'table_file': '', 'gravity': GRAVITY}
    with Station() as station:
        documents, residuals = station.watch_documents(), station.watch_imu('imu/residual')
        station.watch_diagnostics()
        node = station.calibration_node(tmp_path, **options)
        station.start('compensator_node')
        station.until(lambda: 'calibration_node: poses' in station.status, 'the first diagnostics')
        assert 'JointState' not in station.status['calibration_node: streams'].message
        player = station.play(bag, rate, subscribers=2)
        station.until(lambda: player.poll() is not None, 'the end of the recording')
        answer = station.call('/calibration_node/save')
        assert answer.success, answer.message
        live = calibration_from_text((tmp_path / 'calibration.yaml').read_text())
        with open_recording(bag, want_joints=False) as recording:
            expected = calibrated_by_hand(
                [recording.blocks()], replace(OPTIONS, gravity=GRAVITY)
            ).calibration
        assert (
            live.statistics['samples_used'] == expected.statistics['samples_used']
            and live.gauge == expected.gauge
        )
        assert live.param_names == expected.param_names and live.status == expected.status
        free = expected.sd > 0
        assert np.max(np.abs(live.values - expected.values)[free] / expected.sd[free]) < 1e-6
        check_the_poses(station, expected)
        assert documents and len(taken(residuals)) >= 1
        resumed(station, node, tmp_path, options, live)
        # On a busy machine the recording is over before the compensator has a document: it is
        # played again.
        corrected = []
        station.subscriptions.append(
            station.node.create_subscription(Imu, 'imu/data_corrected', corrected.append, 1000)
        )
        player = station.play(bag, rate, subscribers=2)
        station.until(lambda: len(corrected) > 100, 'corrected messages')
        station.processes.end(player)


def check_the_poses(station, expected):
    """Diagnostics counted up to what the recording holds, and asked for directions on the way."""
    messages = [
        message for name, _, message in station.history if name == 'calibration_node: poses'
    ]
    assert len(messages) >= 3  # on the way
    windows = expected.statistics['windows']

    def counted():
        figures = values_of(station, 'poses')
        return (int(figures['poses']), int(figures['turns'])) == (
            windows['static'],
            windows['turns'],
        )

    station.until(counted, 'the poses and turns of the recording')
    station.until(
        lambda: station.status['calibration_node: accelerometer bias'].level == b'\0',
        'a bias that is determined',
    )
    print(f'by hand, live: {messages[0]} ... {messages[-1]}')


def resumed(station, node, folder, options, live):
    """A new node goes on with the poses that were saved; a reset forgets them."""
    station.processes.end(node)
    station.status.clear()
    station.calibration_node(folder, resume=True, **options)
    station.until(
        lambda: (
            station.figure('poses', 'calibration_node: poses')
            == live.statistics['windows']['static']
        ),
        'the poses of before',
    )
    assert station.call('/calibration_node/solve').success
    assert station.call('/calibration_node/reset').success
    station.until(lambda: values_of(station, 'poses').get('poses') == '0', 'no poses after a reset')
    answer = station.call('/calibration_node/solve')
    assert not answer.success and '4' in answer.message
