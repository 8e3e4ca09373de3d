"""
The Allan variance of a stream.

What allantools gives, however the stream is cut, with holes, in bounded memory.
"""

import numpy as np
import pytest

from imu_calibration.allan.curve import FULL, AllanSums, SampleGrid, averaging_factors, on_grid

from worlds.noise_worlds import overlapping_allan_variance

PERIOD = 0.01


def record(n, seed, columns=1):
    """Gravity, white noise and a random walk."""
    rng = np.random.default_rng(seed)
    return (
        9.81
        + 1e-2 * rng.standard_normal((n, columns))
        + 1e-5 * np.cumsum(rng.standard_normal((n, columns)), axis=0)
    )


def in_pieces(values, factors, seed, present=None):
    """The variance of a stream that comes in pieces of random length."""
    sums, rng, start = AllanSums(factors, values.shape[1]), np.random.default_rng(seed), 0
    while start < len(values):
        stop = start + int(rng.integers(1, 9000))
        sums.push(values[start:stop], None if present is None else present[start:stop])
        start = stop
    sums.end_stretch()
    return sums


@pytest.mark.parametrize('n', (7, 1000, 99_991))
def test_deviations_are_those_of_allantools(n):
    allantools = pytest.importorskip(
        'allantools', reason='pip install --no-deps -r constraints/oracles-alone.txt'
    )
    values, factors = record(n, n), averaging_factors(n)
    taus, theirs, _, terms = allantools.oadev(
        values[:, 0], rate=1 / PERIOD, data_type='freq', taus=factors * PERIOD
    )
    ours = in_pieces(values, factors, n)
    # Theirs leaves out what has a single term.
    assert len(taus) >= len(factors) - 1 and np.all(factors <= FULL)
    deviations = np.sqrt(ours.variance()[: len(taus), 0])
    print(
        f'largest difference from allantools {np.max(np.abs(deviations / theirs - 1)):.1e}, wanted'
        ' 1e-12'
    )
    np.testing.assert_allclose(deviations, theirs, rtol=1e-12)
    np.testing.assert_array_equal(ours.terms[: len(taus)], terms)


def test_beyond_the_full_overlap_the_rate_is_halved_and_nothing_is_lost(monkeypatch):
    """
    At a limit of 64 the halved rates take over early.

    They agree with allantools on the halved record, and with every position closely.
    """
    allantools = pytest.importorskip(
        'allantools', reason='pip install --no-deps -r constraints/oracles-alone.txt'
    )
    monkeypatch.setattr('imu_calibration.allan.curve.FULL', 64)
    values = record(40_000, 3)
    factors = averaging_factors(len(values))
    ours = np.sqrt(in_pieces(values, factors, 1).variance()[:, 0])
    full = [
        allantools.oadev(values[:, 0], rate=1.0, data_type='freq', taus=[float(factor)])[1][0]
        for factor in factors[factors <= 4000]
    ]
    # positions a 32nd of the averaging time apart or less: far below the sampling error of ten per
    # cent
    np.testing.assert_allclose(ours[factors <= 4000], full, rtol=5e-3)
    halved = values[:, 0].reshape(-1, 2).mean(axis=1)
    k = int(np.flatnonzero((factors > 64) & (factors <= 128))[0])
    _, theirs, _, _ = allantools.oadev(halved, rate=1.0, data_type='freq', taus=[factors[k] / 2])
    np.testing.assert_allclose(ours[k], theirs[0], rtol=1e-12)


def test_the_outcome_does_not_depend_on_the_pieces():
    values = record(50_000, 4, 6)
    factors = averaging_factors(len(values))
    np.testing.assert_allclose(
        in_pieces(values, factors, 1).variance(),
        overlapping_allan_variance(values, factors),
        rtol=1e-11,
    )


def test_memory_does_not_grow_with_the_record():
    sums = AllanSums(averaging_factors(10**7), 1)
    held = []
    for k in range(40):
        sums.push(record(FULL, k))
        held.append(sum(level.sums.nbytes for level in sums._levels))
    assert held[-1] == max(held) <= 8 * 2 * (2 * FULL + 1 + FULL) * len(sums._levels)


def test_stretches_are_not_connected():
    """
    Two stretches with different constants give the mean of their own variances.

    The mean is weighted with their terms.
    """
    one, two = record(3000, 5), record(5000, 6) + 100.0
    factors = averaging_factors(3000)
    sums = AllanSums(factors, 1)
    for stretch in (one, two):
        sums.push(stretch)
        sums.end_stretch()
    terms = [np.maximum(len(stretch) - 2 * factors + 1, 0)[:, None] for stretch in (one, two)]
    parts = [overlapping_allan_variance(stretch, factors) for stretch in (one, two)]
    np.testing.assert_allclose(
        sums.variance(),
        (terms[0] * parts[0] + terms[1] * parts[1]) / (terms[0] + terms[1]),
        rtol=1e-9,
    )
    assert sums.lengths == [3000, 5000]


def test_lost_samples_leave_holes_and_no_bias():
    """A hundredth of the samples lost: white noise keeps its variance at all averaging times."""
    rng = np.random.default_rng(7)
    values, present = rng.standard_normal((200_000, 1)), rng.random(200_000) > 0.01
    present[5000:5300] = False
    factors = averaging_factors(3000)
    found = in_pieces(np.where(present[:, None], values, np.nan), factors, 2, present)
    # means of 99 % of the samples: 1 % more variance; the rest is chance, 3 % at a thousand samples
    # per mean
    np.testing.assert_allclose(found.variance()[:, 0] * factors, 1.0, rtol=0.15)
    np.testing.assert_allclose(found.variance()[:8, 0] * factors[:8], 1.0, rtol=0.02)
    assert np.all(found.terms[:2] < 200_000 * 0.985)


def test_a_constant_hole_changes_nothing_before_and_after_it():
    values = record(20_000, 8)
    present = np.ones(20_000, bool)
    present[9000:9400] = False
    factors = averaging_factors(100)
    together = in_pieces(values, factors, 3, present)
    apart = AllanSums(factors, 1)
    for stretch in (values[:9000], values[9400:]):
        apart.push(stretch)
        apart.end_stretch()
    full = factors <= 10  # longer means may miss a tenth of their samples
    np.testing.assert_allclose(together.variance()[full], apart.variance()[full], rtol=1e-2)
    assert np.all(together.terms >= apart.terms)


def grid_steps(stamps):
    grid = SampleGrid(PERIOD)
    return np.concatenate([grid.steps(part) for part in np.array_split(stamps, 3)])


def regular(n):
    return np.arange(n) * 10_000_000 + 10**18


def test_lost_samples_are_counted_from_the_stamps():
    keep = np.ones(3000, bool)
    keep[[100, 500, 501, 502, 2000]] = False
    steps = grid_steps(regular(3000)[keep])
    assert steps.sum() == 3000 and np.flatnonzero(steps > 1).size == 3 and steps.max() == 4


@pytest.mark.parametrize('kind', ('jitter', 'packets', 'milliseconds'))
def test_stamps_that_jitter_lose_nothing(kind):
    rng, stamps = np.random.default_rng(9), regular(4000)
    if kind == 'jitter':
        stamps = stamps + rng.normal(0, 1e6, 4000).astype(np.int64)
    elif kind == 'packets':  # eight samples arrive together
        stamps = np.repeat(stamps[7::8], 8) + np.tile(np.arange(8) * 20_000, 500)
    else:
        stamps = stamps // 3_000_000 * 3_000_000
    assert np.array_equal(grid_steps(stamps), np.ones(4000))


def test_a_loss_among_packets_is_still_found():
    stamps = np.repeat(regular(4000)[7::8], 8) + np.tile(np.arange(8) * 20_000, 500)
    keep = np.ones(4000, bool)
    keep[1600:1640] = False  # five packets
    assert abs(grid_steps(stamps[keep]).sum() - 4000) <= 2


def test_samples_are_spread_over_the_periods():
    values, present = on_grid(np.array([[1.0], [2.0], [3.0]]), np.array([1, 3, 1]))
    np.testing.assert_array_equal(present, [True, False, False, True, True])
    np.testing.assert_array_equal(values[present, 0], [1.0, 2.0, 3.0])
