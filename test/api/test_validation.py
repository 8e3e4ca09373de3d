"""
The fast part of `make validate`.

The figures of the real recordings that are known, and the means of comparison themselves.
"""

import sys
from pathlib import Path

import numpy as np
import pytest
from without_search import candidates_in_scripts

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from validation import (
    arm_live,
    ferraris,
    held_out,
    run,
    simulated_table,
)
from validation.hand_peers import _other_turns
from validation.recordings import load, reference
from validation.second_opinions import Forward, fit_norm
from validation.section import Section

G = 9.81


def a_sensor(seed, n_poses, noise=0.0):
    """Return (bias, lower triangular matrix, mean readings at rest) of a made-up accelerometer."""
    rng = np.random.default_rng(seed)
    bias, matrix = rng.normal(0, 0.3, 3), np.eye(3) + np.tril(rng.normal(0, 0.02, (3, 3)))
    up = rng.normal(size=(n_poses, 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    return bias, matrix, bias + G * up @ matrix.T + rng.normal(0, noise, (n_poses, 3))


# the means of comparison


def test_the_plain_norm_fit_gives_the_sensor_back():
    bias, matrix, force = a_sensor(1, 15)
    found = fit_norm(force, G)
    np.testing.assert_allclose(found.bias, bias, atol=1e-8)
    np.testing.assert_allclose(found.matrix, matrix, atol=1e-9)
    np.testing.assert_allclose(found.norm_errors(force, G), 0, atol=1e-8)


def test_a_turn_left_out_is_used_by_no_peer():
    rests = [slice(0, 10), slice(20, 30), slice(40, 50), slice(60, 70)]
    up = np.eye(4, 3)
    for without, kept in (
        (None, [0, 1, 2]),
        (slice(25, 45), [0, 2]),
        (slice(5, 25), [1, 2]),
        (slice(15, 55), []),
    ):
        turns, first, last = _other_turns(['a', 'b', 'c'], up, rests, without)
        assert turns == ['abc'[k] for k in kept]
        np.testing.assert_array_equal(first, up[kept].reshape(-1, 3))
        np.testing.assert_array_equal(last, up[np.add(kept, 1).astype(int)].reshape(-1, 3))


def test_a_pose_left_out_leaves_nothing_behind():
    from imu_calibration.core.samples import ImuSamples

    values = np.arange(60.0).reshape(20, 3)
    imu = ImuSamples(10**9 + 10**7 * np.arange(20), values, values)
    rest, ranges = held_out.without(imu, [slice(2, 5), slice(8, 12), slice(15, 20)], [1])
    assert len(rest) == 16 and not np.isin(values[8:12, 0], rest.force_s[:, 0]).any()
    for before, after in zip((slice(2, 5), slice(15, 20)), ranges, strict=True):
        np.testing.assert_array_equal(rest.force_s[after], values[before])


def test_intervals_of_differences_hold_what_they_say(monkeypatch):
    """
    Two methods of equal error: the interval holds zero about 95 times in 100; a worse one is seen.
    """
    monkeypatch.setattr(held_out, 'DRAWS', 1000)
    rng = np.random.default_rng(2)
    pairs = [rng.normal(0, 1, (2, 30)) for _ in range(150)]
    inside = [
        low < 0 < high for low, high in (held_out.bootstrap_difference(a, b, rng) for a, b in pairs)
    ]
    # 95 % less what a bootstrap of 30 lacks, four sd of 150 trials.
    assert 0.86 < np.mean(inside) <= 1.0
    assert held_out.bootstrap_difference(pairs[0][0], 4 * pairs[0][1], rng)[0] > 0


def test_a_section_shows_what_does_not_hold(tmp_path):
    section = Section('Title')
    section.claim('first', '1', '1.0', True)
    section.claim('second', '2', '3.0 | 4', False)
    text = run.document([section])
    assert (
        '1 of 2 claims hold. Those that do not:' in text
        and text.count('| second | 2 | 3.0 \\| 4 | **no** |') == 2
    )


def test_the_evidence_quotes_the_document():
    """
    Every figure of the table in docs/claims.md is in docs/validation.md; only a run writes both.
    """
    part = (ROOT / 'docs' / 'claims.md').read_text()
    written = (ROOT / 'docs' / 'validation.md').read_text()
    rows = [line.split('|') for line in part.splitlines() if line.startswith('| ')][2:]
    assert len(rows) >= 5
    for row in rows:
        assert row[3].strip() in written, (
            f'{row[3].strip()!r} of docs/claims.md is not in docs/validation.md'
        )
    date = written.partition('one run on ')[2][:10]
    assert date in part


# recordings with known facts


@pytest.mark.real_data
def test_ferraris_agrees_with_imucal(recordings):
    """
    All 18 parameters within three of our sd.

    They share the data, so that they should be closer than that.
    """
    pytest.importorskip('imucal', reason='imucal is not installed; `make validate` installs it')
    imu, known = load(recordings, 'ferraris'), reference(recordings, 'ferraris')
    angle = np.radians(known['turn_deg'])
    found, order = ferraris.calibrate_sections(imu, known['sections'], angle)
    sign = np.sign(ferraris.known_turns(imu, known['sections'], angle)[0].angle)
    info = ferraris.ferraris(
        imu, known['sections'], ferraris.RATE_HZ, ferraris.GRAVITY, sign * angle
    )
    apart = np.array([(b - a) / sd for _, _, a, b, sd in ferraris.comparable(found, info)])
    print(f'ferraris against imucal: largest difference {np.max(np.abs(apart)):.1f} sd wanted 3')
    assert len(apart) == 18 and np.max(np.abs(apart)) < 3
    bias, matrix = ferraris.imucal_from_ours(found, ferraris.faces_as_they_lay(found, order))
    theirs = ferraris.accelerometer_of(info)
    np.testing.assert_allclose(bias, theirs.bias, atol=1e-3)
    np.testing.assert_allclose(matrix, theirs.matrix, atol=1e-4)


def test_norm_errors_are_zero_for_the_true_sensor():
    bias, matrix, force = a_sensor(4, 8)
    np.testing.assert_allclose(Forward(bias, matrix).norm_errors(force, G), 0, atol=1e-12)


# another simulator, and live


@pytest.mark.slow
def test_the_truth_of_python_ins_is_recovered():
    pytest.importorskip('pyins', reason='python-ins is not installed; `make validate` installs it')
    rows = [
        row
        for row in simulated_table.compare(
            simulated_table.calibrate_through_a_bag(*simulated_table.record())
        )
        if row[-1] != 'held'
    ]
    ratio = np.array([(value - true) / sd for _, value, true, sd, _ in rows])
    spread, largest = np.sqrt(np.mean(ratio**2)), np.abs(ratio).max()
    print(
        f'python-ins: {len(rows)} parameters, rms error {spread:.2f} sd, largest {largest:.1f} sd'
        ' wanted 1, 4'
    )
    assert len(rows) >= 24 and largest < 4 and 0.5 < spread < 1.5


@pytest.mark.long
@pytest.mark.live
@pytest.mark.real_data
def test_one_imu_predicts_another_live(recordings, monkeypatch):
    pytest.importorskip('rclpy')
    from ros.forked_nodes import ForkedNodes

    monkeypatch.setattr(arm_live, 'NodeProcesses', ForkedNodes)
    with candidates_in_scripts('none'):
        case = arm_live.prepare(recordings, 'array_2', 'array_5', seconds=25.0)
    came = arm_live.play(case, speed=5.0, domain_id=arm_live.DOMAIN + 1)
    assert [max(messages) for messages in came.values()] == 2 * [case.imu_a.stamp_ns[-1]]
    found, count = arm_live.residuals(case, came)
    before, after = arm_live.rms(found['turned']), arm_live.rms(found['moved'])
    print(
        f'live: one IMU from another, {len(found["moved"])} samples, {before:.2f} m/s^2, with the'
        f' arm {after:.2f} wanted 0.65 of it'
    )
    # The recording begins in violent motion: the unit of a window of a second is checked first.
    withheld = len(case.imu_a) - min(count.values())
    assert set(count.values()) == {len(case.imu_a) - withheld} and withheld < 100
    assert len(found['moved']) > 300
    assert after < 0.65 * before
    below = case.imu_a.rate_s[case.usable][-len(found['moved']) :]
    calm = np.linalg.norm(below, axis=1) < 15
    assert arm_live.typical(found['moved'][calm]) < 0.35 * arm_live.typical(found['turned'][calm])
