"""
Spikes: dropped and counted wherever a stream is cleaned.

Noise, motion, knocks and coarse readings are left alone.
"""

from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.samples import ImuSamples, SampleBlock
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.sample_recording import read_recording
from imu_calibration.preprocessing.spike_filter import SpikeFilter
from imu_calibration.references.gravity.hand_calibration import calibrate_by_hand
from imu_calibration.references.gravity.hand_parameters import HandOptions

from worlds.calibrated import calibrated_on_table
from worlds.candidates import FEW
from worlds.cleaning import clean_samples
from worlds.hand_sessions import GRAVITY
from worlds.physics import make_session
from worlds.physics_hand import hold_and_turn, with_corrupt_sample, with_spikes


@pytest.fixture(scope='module')
def session():
    """Fourteen poses and the turns between them."""
    return hold_and_turn(11)[0]


def cleaned(imu):
    (passed,), statistics = clean_samples(imu)
    return passed, statistics.dropped.get('spike', 0)


def gone(imu):
    """Indices of the samples that were dropped."""
    return np.flatnonzero(~np.isin(imu.stamp_ns, cleaned(imu)[0].stamp_ns))


def test_noise_and_turns_hold_no_spike(session):
    assert cleaned(session)[1] == 0


def test_spikes_are_dropped_and_counted_and_hardly_anything_else(session):
    spoiled = with_spikes(session, 0.01, 3)
    hit = np.any(spoiled.force_s != session.force_s, axis=1) | np.any(
        spoiled.rate_s != session.rate_s, axis=1
    )
    large = np.any(np.abs(spoiled.force_s - session.force_s) > 1.0, axis=1) | np.any(
        np.abs(spoiled.rate_s - session.rate_s) > 0.3, axis=1
    )
    dropped = np.zeros(len(session), bool)
    dropped[gone(spoiled)] = True
    assert dropped[large].mean() > 0.97
    assert np.count_nonzero(dropped & ~hit) <= 0.02 * np.count_nonzero(hit)


def test_one_corrupt_sample_is_dropped_wherever_it_is(session):
    for index in (0, 700, len(session) - 1):
        assert gone(with_corrupt_sample(session, index)).tolist() == [index]


def test_how_the_stream_is_cut_does_not_matter(session):
    spoiled = with_spikes(session.select(slice(0, 2000)), 0.01, 4)
    whole = read_recording([SampleBlock(spoiled)])
    for size in (1, 31, 500):
        pieces = read_recording(
            [SampleBlock(spoiled.select(slice(a, a + size))) for a in range(0, len(spoiled), size)]
        )
        np.testing.assert_array_equal(pieces.imu.stamp_ns, whole.imu.stamp_ns)
        assert pieces.counts == whole.counts


def test_a_knock_a_step_and_coarse_readings_are_no_spikes(session):
    """
    What several samples share is motion.

    A knock that rings for 50 ms, a stop from one sample to the next, a range that ended.
    """
    time = 0.01 * np.arange(20)
    ringing = 20 * np.exp(-time / 0.03) * np.cos(2 * np.pi * 12 * time)
    force, rate = session.force_s.copy(), session.rate_s.copy()
    force[100:120, 0] += ringing
    rate[250:, 1] += 1.0
    for imu in (
        replace(session, force_s=force, rate_s=rate),
        replace(session, force_s=np.round(session.force_s, 1), rate_s=np.round(session.rate_s, 2)),
        replace(session, rate_s=np.clip(session.rate_s, -0.8, 0.8)),
    ):
        assert cleaned(imu)[1] <= 2  # of 4000; the first reading of a knock may look like one


@pytest.mark.parametrize('size', [1, 7, 31])
def test_the_noise_of_a_chunk_does_not_depend_on_how_the_stream_is_cut(session, size):
    """The first row of the values that are kept had the second difference of its neighbour."""
    noises = []
    for length in (size, len(session)):
        filtered = SpikeFilter()
        for start in range(0, 3200, length):
            filtered.push(session.select(slice(start, min(start + length, 3200))))
        noises.append(filtered._noise_sds[-1])
    np.testing.assert_array_equal(*noises)


def test_knocks_of_one_reading_that_reach_several_axes_stay(session):
    """
    A bang on the table passes a wide filter.

    Nine tenths of it in one reading, the rest in the neighbours, on all axes.
    """
    rng, force, rate = np.random.default_rng(8), session.force_s.copy(), session.rate_s.copy()
    for at in range(60, len(session) - 60, 97):
        for values, size in ((force, 10.0), (rate, 1.0)):
            values[at - 1 : at + 3] += np.outer(
                [-0.05, 1.0, 0.1, -0.04], size * rng.uniform(0.5, 1.0, 3) * rng.choice([-1, 1], 3)
            )
    # Of 63; two thirds without the look at the other axes.
    assert cleaned(replace(session, force_s=force, rate_s=rate))[1] <= 3


def test_fast_twisting_at_a_low_rate_is_no_spike():
    time = 0.016 * np.arange(4000)
    rng = np.random.default_rng(2)
    twist = 20 * np.sin(2 * np.pi * 4 * time)
    imu = ImuSamples(
        (1e9 * time).astype(np.int64),
        rng.normal(0, 0.05, (4000, 3)) + 9.8,
        np.outer(twist, [0.3, 0.5, 0.8]) + rng.normal(0, 0.01, (4000, 3)),
    )
    assert cleaned(imu)[1] == 0


def test_one_per_cent_of_spikes_does_not_matter_by_hand(session):
    clean, spoiled = (
        calibrate_by_hand(read_recording([SampleBlock(imu)]).imu, HandOptions(GRAVITY))
        for imu in (session, with_spikes(session, 0.01, 5))
    )
    assert np.all(np.abs(spoiled.values - clean.values)[clean.sd > 0] < clean.sd[clean.sd > 0])
    # The scatter comes from few degrees of freedom.
    np.testing.assert_allclose(spoiled.sd[clean.sd > 0], clean.sd[clean.sd > 0], rtol=0.35)


def test_one_per_cent_of_spikes_does_not_matter_on_the_table():
    session = make_session(5, profile='quick', noise='white')
    table = Table.from_mapping(session.table)

    def result(imu):
        return calibrated_on_table(
            [[SampleBlock(imu, session.joints, session.temperature)]],
            table,
            CalibrationOptions(catalogue=CATALOGUE.with_candidates(FEW)),
        ).calibration

    clean, spoiled = result(session.imu), result(with_spikes(session.imu, 0.01, 6))
    known = clean.sd > 0
    assert np.median(np.abs(spoiled.values - clean.values)[known] / clean.sd[known]) < 0.5
    assert np.median(spoiled.sd[known] / clean.sd[known]) < 1.15
