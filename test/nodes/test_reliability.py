"""
What goes wrong on a robot, over real DDS.

Losses, disorder, clocks, silence, kills, signals, other QoS, two IMUs at once.
"""

import signal
from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.core.samples import ImuSamples
from imu_calibration.document.calibration_text import calibration_from_text

from worlds.live_sessions import assert_same, errors_in_sd, make_session, offline

pytest.importorskip('rclpy')
from ros.live_station import Publisher, Station
from ros.soak import GROWTH_MB, soak

pytestmark = pytest.mark.live
RATE = 25.0
"""Messages of a topic per second of the sessions."""
SIGMA = 5.0
"""Errors of some thirty parameters stay below so many reported standard deviations."""


@pytest.fixture(scope='module')
def session():
    """IMU, joints, true values, model."""
    return make_session(3, RATE)


def beginning(session, seconds=80.0):
    """The first part of a session: enough for most parameters, in half the time."""
    imu, joints, values, model = session
    end = imu.stamp_ns[0] + int(seconds * 1e9)
    return (*(s.select(s.stamp_ns < end) for s in (imu, joints)), values, model)


@pytest.fixture
def station(tmp_path):
    """A domain of its own."""
    with Station(tmp_path / 'nodes.txt') as made:
        made.watch_diagnostics()
        yield made


def disturbed(samples, rng):
    """Lose 5 %, send 5 % twice, let 5 % overtake their neighbour."""
    index = np.flatnonzero(rng.random(len(samples)) > 0.05)
    index = np.sort(np.concatenate([index, rng.choice(index, len(index) // 20, replace=False)]))
    early = rng.choice(len(index) - 1, len(index) // 20, replace=False)
    for k in early:
        index[k], index[k + 1] = index[k + 1], index[k]
    return samples.select(index)


def with_nan_burst(imu, start, seconds=2.0):
    """Readings that are NaN for a while."""
    force = imu.force_s.copy()
    inside = (imu.stamp_ns >= imu.stamp_ns[0] + int(start * 1e9)) & (
        imu.stamp_ns < imu.stamp_ns[0] + int((start + seconds) * 1e9)
    )
    force[inside] = np.nan
    return replace(imu, force_s=force)


def received(station):
    """Imu and JointState messages that calibration_node has used or dropped."""
    return [
        station.figure(f'{name} messages', 'calibration_node: streams')
        for name in ('imu', 'joints')
    ]


def send_all(station, publisher, imu, joints):
    """Publish, and wait until the node has everything."""
    before = received(station)
    publisher.send(imu, joints)
    station.until(
        lambda: received(station) == [before[0] + len(imu), before[1] + len(joints)],
        'every message to arrive',
    )


def answer_of(station, folder):
    """Ask the node to save, and return the calibration."""
    answer = station.call('/calibration_node/save')
    assert answer.success, answer.message
    return calibration_from_text((folder / 'calibration.yaml').read_text())


@pytest.mark.long
def test_losses_disorder_nan_foreign_frames_clock_jumps_and_silence(station, session, tmp_path):
    session = beginning(session)
    imu, joints, values, model = session
    rng = np.random.default_rng(5)
    node = station.calibration_node(tmp_path)
    publisher = Publisher(station)
    publisher.wait()

    sent = disturbed(imu, rng), disturbed(joints, rng)
    send_all(station, publisher, *sent)
    live = answer_of(station, tmp_path)
    assert_same(live, offline(sent))
    assert live.statistics['dropped'].get('imu repeated stamp', 0) > 0.02 * len(imu)
    assert np.max(np.abs(errors_in_sd(live, model, values))) < SIGMA

    assert station.call('/calibration_node/reset').success
    check_bursts_and_foreign_frames(station, publisher, session, tmp_path)

    assert station.call('/calibration_node/reset').success
    check_clock_jump_and_silence(station, publisher, session, tmp_path)
    assert station.processes.end(node, signal.SIGTERM) == 0


def check_bursts_and_foreign_frames(station, publisher, session, folder):
    """
    NaN and messages of another frame are dropped, counted and told; the rest gives the answer.
    """
    imu, joints, values, model = session
    burst = with_nan_burst(imu, 30.0)
    first, last = int(40 * RATE), int(44 * RATE)
    foreign = replace(
        imu.select(slice(first, last)), force_s=imu.force_s[first:last] + 5.0, frame_id='other_link'
    )
    before = received(station)
    parts = [burst.select(slice(0, last)), foreign, burst.select(slice(last, None))]
    cuts = [0, last, last, len(joints)]
    for part, ends in zip(parts, zip(cuts, cuts[1:])):
        publisher.send(part, joints.select(slice(*ends)))
    station.until(
        lambda: received(station) == [before[0] + len(imu), before[1] + len(joints)],
        'every message of the frame',
    )
    live = answer_of(station, folder)
    assert live.statistics['dropped']["Imu message of another frame than 'imu_link'"] == len(
        foreign
    )
    assert live.statistics['dropped']['imu not finite'] == 2.0 * RATE
    assert np.max(np.abs(errors_in_sd(live, model, values))) < SIGMA
    station.until(
        lambda: any('imu_link' in message for _, level, message in station.history if level == 1),
        'a warning',
    )


def check_clock_jump_and_silence(station, publisher, session, folder):
    """
    A clock set back and joint states that stop are reported.

    They cost no more than the samples concerned.
    """
    imu, joints, values, model = session
    half = imu.stamp_ns[len(imu) // 2]
    back = int(3600e9)
    halves = [
        [s.select(s.stamp_ns < half) for s in (imu, joints)],
        [s.select(s.stamp_ns >= half) for s in (imu, joints)],
    ]
    halves[1] = [replace(s, stamp_ns=s.stamp_ns - back) for s in halves[1]]
    send_all(station, publisher, *halves[0])
    send_all(station, publisher, *halves[1])
    last = halves[1][0].stamp_ns[-1]
    n = int(8 * RATE)
    still = (np.repeat(values[-1:], n, 0) for values in (imu.force_s, imu.rate_s))
    alone = ImuSamples(last + int(1e9 / RATE) * np.arange(1, n + 1), *still, 'imu_link')
    publisher.send(alone, joints.select(slice(0, 0)), per_second=50)
    station.until(
        lambda: any('JointState' in message for _, level, message in station.history if level == 1),
        'a warning',
    )
    live = answer_of(station, folder)
    assert (live.statistics['stream'] | live.statistics['dropped'])['imu clock reset'] == 1
    used = sum(live.statistics['samples_used'].values())
    assert used > 0.9 * sum(offline((imu, joints)).statistics['samples_used'].values())
    assert np.max(np.abs(errors_in_sd(live, model, values))) < SIGMA


@pytest.mark.long
def test_killed_in_mid_session_it_goes_on_where_it_was_saved(station, session, tmp_path):
    imu, joints, values, model = beginning(session, 110.0)
    half = imu.stamp_ns[0] + int(60e9)
    first = station.calibration_node(tmp_path, autosave_period=0.3)
    publisher = Publisher(station)
    publisher.wait()
    send_all(station, publisher, *(s.select(s.stamp_ns < half) for s in (imu, joints)))
    saved = tmp_path / 'calibration.accumulator.npz'
    station.until(lambda: station.figure('windows') > 4 and saved.is_file(), 'windows to be saved')
    station.spin_for(1.0)
    n_saved = station.figure('windows')
    killed = publisher.subscriptions()
    assert station.processes.end(first, signal.SIGKILL) == -signal.SIGKILL

    second = station.calibration_node(tmp_path, resume=True)
    station.status.clear()
    station.until(lambda: station.figure('windows') == n_saved, 'the saved windows')
    publisher.wait(ended=killed)
    send_all(station, publisher, *(s.select(s.stamp_ns >= half) for s in (imu, joints)))
    live = answer_of(station, tmp_path)
    assert sum(live.statistics['windows'].values()) > n_saved + 5
    assert np.max(np.abs(errors_in_sd(live, model, values))) < SIGMA
    assert station.processes.end(second) == 0


@pytest.mark.long
def test_signals_in_mid_session_leave_whole_files_and_exit_code_zero(station, session, tmp_path):
    imu, joints, _, _ = session
    topics = {'imu/data_raw': '/imu/data_raw', 'joint_states': '/joint_states'}
    numbers = {'left': signal.SIGINT, 'right': signal.SIGTERM}
    nodes = {
        side: station.calibration_node(
            tmp_path / side, autosave_period=0.1, namespace=f'/{side}', remappings=topics
        )
        for side in numbers
    }
    compensator = station.start('compensator_node')
    publisher = Publisher(station)
    publisher.wait(2)
    publisher.send(*(s.select(s.stamp_ns < imu.stamp_ns[0] + int(50e9)) for s in (imu, joints)))
    station.until(
        lambda: all(
            station.figure('windows', f'{side}/calibration_node: calibration') for side in numbers
        ),
        'windows',
    )
    for side, number in numbers.items():
        assert station.processes.end(nodes[side], number) == 0
        assert {path.name for path in (tmp_path / side).iterdir()} <= {
            'calibration.accumulator.npz',
            'calibration.yaml',
        }
    assert station.processes.end(compensator, signal.SIGTERM) == 0


@pytest.mark.long
def test_two_imus_by_namespace_from_best_effort_publishers(station, session, tmp_path):
    sessions = {'left': beginning(session), 'right': beginning(make_session(4, RATE))}
    sent, documents = {}, {}
    for side, (imu, joints, _, _) in sessions.items():
        station.calibration_node(tmp_path / side, namespace=f'/{side}')
        documents[side] = station.watch_documents(f'/{side}/imu/calibration')
        sent[side] = Publisher(
            station, f'/{side}/imu/data_raw', f'/{side}/joint_states', reliable=False
        )
    for publisher in sent.values():
        publisher.wait()
    for part in range(30):
        for side, (imu, joints, _, _) in sessions.items():
            sent[side].send(
                *(
                    s.select(slice(part * len(s) // 30, (part + 1) * len(s) // 30))
                    for s in (imu, joints)
                )
            )
    for side, (_, _, values, model) in sessions.items():
        answer = station.call(f'/{side}/calibration_node/solve')
        assert answer.success, answer.message
        station.until(lambda: documents[side], 'the document')
        live = calibration_from_text(documents[side][-1])
        errors, others = (
            errors_in_sd(live, model, v)
            for v in (values, sessions['left' if side == 'right' else 'right'][2])
        )
        assert np.max(np.abs(errors)) < SIGMA < 0.1 * np.max(np.abs(others))


@pytest.mark.long
def test_four_minutes_of_data_leave_no_memory_behind(tmp_path):
    # On a busy machine alone it would take so long that a diagnosis begins.
    found = soak(240.0, 20.0, tmp_path, 50.0, 50.0, diagnosis_period=0.0)
    for name, (middle, last, _, n_imu) in found.items():
        assert last - middle <= GROWTH_MB, f'{name} grew from {middle:.1f} to {last:.1f} MB'
        assert n_imu >= 12_000
