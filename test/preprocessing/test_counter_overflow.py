"""Clocks that step back: overflows of counters are undone, other parts are processed separately."""

from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.core.samples import ImuSamples, SampleBlock, TemperatureSamples
from imu_calibration.document.outcome import exit_code
from imu_calibration.preprocessing.checks import Preflight
from imu_calibration.preprocessing.counter_overflow import (
    OverflowSearch,
    longer_gaps,
    without_overflows,
)
from imu_calibration.preprocessing.sample_recording import read_recording
from msg_adapters.csv_log import read_csv

from worlds.calibrated_by_hand import calibrated
from worlds.hand_sessions import GRAVITY


def counted(stamp_ns, bits, tick_ns, before):
    """Return the stamps of a counter that overflows `before` ns after the first one."""
    ticks = (stamp_ns - stamp_ns[0]) // tick_ns
    return (ticks + 2**bits - before // tick_ns) % 2**bits * tick_ns


def regular(n=5000, rate=70.0):
    return np.round(np.arange(n) * 1e9 / rate).astype(np.int64)


@pytest.mark.parametrize(('bits', 'tick_ns'), [(32, 1), (32, 1_000), (16, 1_000_000), (24, 1_000)])
def test_an_overflow_is_undone_whatever_the_pieces(bits, tick_ns):
    true = regular() // tick_ns * tick_ns
    stamps = counted(true, bits, tick_ns, 2_000_000_000)
    assert (np.diff(stamps) < 0).any()
    for cut in (len(stamps), 211):
        search = OverflowSearch()
        parts = [search.removed(stamps[a : a + cut]) for a in range(0, len(stamps), cut)]
        assert np.array_equal(np.diff(np.concatenate(parts)), np.diff(true))
        assert search.count == np.count_nonzero(np.diff(stamps) < 0)


def test_other_steps_back_remain():
    stamps = regular()
    stamps[3000:] -= 17_300_000_000
    assert np.array_equal(OverflowSearch().removed(stamps), stamps)
    assert np.array_equal(without_overflows(stamps).stamp_ns, stamps)


def test_a_size_that_recurs_is_that_of_a_counter():
    """A counter of seconds that begins again at each minute."""
    true = regular(10_000)
    stamps = (true + 41_000_000_000) % 60_000_000_000
    found = without_overflows(stamps)
    assert found.n_overflows == 3
    assert np.diff(found.stamp_ns) == pytest.approx(np.diff(true), abs=20_000_000)


def test_stamps_of_a_bag_that_overflow_give_the_usual_result(clean, usual):
    stamps = counted(clean.stamp_ns, 32, 1_000, 33_000_000_000)
    found = calibrated(replace(clean, stamp_ns=stamps))
    away = found.calibration.values - usual.calibration.values
    assert (np.abs(away) <= 0.5 * found.calibration.sd).all()
    assert exit_code(found.calibration) == 0
    notes = read_recording(
        [SampleBlock(replace(clean, stamp_ns=stamps))], preflight=Preflight(GRAVITY)
    ).findings
    assert ('stamps', 'note') in [(f.check, f.severity) for f in notes]


def test_by_hand_the_parts_of_a_clock_that_was_set_are_used_separately(clean, usual):
    """Inspect promised it, and the calibration refused stamps that go backwards."""
    stamps = clean.stamp_ns.copy()
    at = len(stamps) // 2
    stamps[at:] -= 222_000_000_000
    found = calibrated(replace(clean, stamp_ns=stamps))
    away = found.calibration.values - usual.calibration.values
    assert (np.abs(away) <= 3 * found.calibration.sd).all()
    poses = usual.calibration.statistics['windows']['static']
    assert found.calibration.statistics['windows']['static'] in (poses, poses + 1)
    assert 'held' not in set(found.calibration.status)
    assert exit_code(found.calibration) == 0


def test_temperatures_follow_the_parts():
    imu = ImuSamples(regular(400), np.tile([0.0, 0, 9.8], (400, 1)), np.zeros((400, 3)), 'imu')
    stamps = imu.stamp_ns + 400_000_000_000
    stamps[200:] -= 300_000_000_000
    warm = TemperatureSamples(stamps.copy(), np.where(np.arange(400) < 200, 20.0, 30.0))
    found = read_recording([SampleBlock(replace(imu, stamp_ns=stamps), temperature=warm)])
    assert (np.diff(found.imu.stamp_ns) > 0).all()
    assert found.temperature_c[:200] == pytest.approx(20.0)
    assert found.temperature_c[200:] == pytest.approx(30.0)


def test_a_text_log_with_a_counter_that_overflows(tmp_path, clean):
    path = tmp_path / 'log.csv'
    ticks = counted(clean.stamp_ns, 32, 1_000, 9_000_000_000) // 1_000
    columns = [ticks, *clean.force_s.T, *clean.rate_s.T]
    header = 'time (us),ax (m/s^2),ay (m/s^2),az (m/s^2),gx (rad/s),gy (rad/s),gz (rad/s)'
    np.savetxt(path, np.column_stack(columns), '%.8g', ',', header=header, comments='')
    rows = path.read_text().splitlines()
    lines = [rows[0]]
    for tick, row in zip(ticks, rows[1:], strict=True):
        lines.append(','.join([str(tick), *row.split(',')[1:]]))
    path.write_text('\n'.join(lines) + '\n')
    log = read_csv(path)
    assert log.n_overflows == 1
    steps = np.diff(log.imu.stamp_ns)
    assert steps == pytest.approx(np.diff(clean.stamp_ns), abs=2_000)


@pytest.mark.parametrize(
    ('bits', 'tick_ns', 'gap'), [(32, 1e3, 7.0), (32, 1e6, 7.0), (16, 1e6, 0.9)]
)
def test_an_overflow_within_a_gap_is_undone_and_a_restart_is_not(bits, tick_ns, gap):
    rate = 50.0
    time = np.arange(2000) / rate
    time = time[(time < 21.3) | (time > 21.3 + gap)]
    size_ns = round(2**bits * tick_ns)
    counter_ns = (np.round(time * 1e9).astype(np.int64) + size_ns - 21_500_000_000) % size_ns
    found = without_overflows(10**18 + counter_ns, tick_ns, counter_ns.astype(float))
    stamp_ns = found.stamp_ns
    np.testing.assert_allclose((stamp_ns - stamp_ns[0]) * 1e-9, time, atol=1e-6)
    assert found.n_overflows == 1
    # The counter begins again long before its end.
    restart_ns = np.where(time < 21.3, time + 3.0, time - 21.0) * 1e9
    restarted = without_overflows(restart_ns.astype(np.int64), tick_ns, restart_ns)
    assert restarted.n_overflows == 0


@pytest.mark.parametrize('gap', [0.4, 2.2, 3.6, 4.0, 4.6, 5.0])
def test_gaps_of_a_counter_of_nanoseconds_are_known_up_to_its_size(gap):
    """32 bits of 1 ns last 4.29 s: a gap may hide a whole turn of the counter."""
    size_ns = 2**32
    time = np.arange(4000) / 100.0
    time = time[(time < 17.13) | (time > 17.13 + gap)]
    counter_ns = (np.round(time * 1e9).astype(np.int64) + 900_000_000) % size_ns
    late = counter_ns.copy()
    late[[2500, 2501]] = late[[2501, 2500]]  # one late sample is no overflow
    hidden_ns = size_ns if gap + 0.01 > size_ns * 1e-9 else 0
    for stamps in (counter_ns, late):
        found = without_overflows(10**18 + stamps, 1.0, stamps.astype(float))
        assert found.size_ns == size_ns
        true_ns = np.round(time * 1e9).astype(np.int64)
        true_ns[time > 17.13] -= hidden_ns
        steps = np.diff(found.stamp_ns - true_ns)
        assert np.count_nonzero(steps) == (0 if stamps is counter_ns else 3)
    assert '4.295 s' in longer_gaps(found.size_ns, 1)
    assert not longer_gaps(found.size_ns, 0)
    assert not longer_gaps(1000 * size_ns, 1)
