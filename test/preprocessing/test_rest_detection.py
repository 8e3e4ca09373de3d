"""Rest found from the IMU alone, in any unit."""

import numpy as np
import pytest
from refusal import refused

from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples
from imu_calibration.preprocessing.rest_detection import find_still
from imu_calibration.preprocessing.window import WindowSettings

from worlds.cleaning import clean_samples
from worlds.hand_trials import vibration

HZ = 100


def by_hand(n_poses=8, hz=HZ, seed=0):
    """Poses of 4 s with turns of 2 s between them; returns samples and the true rests, s."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, 6 * n_poses, 1 / hz)
    part = np.clip((time % 6 - 4) / 2, 0, 1)
    blend = np.floor(time / 6) + part**3 * (10 - 15 * part + 6 * part**2)
    angle = 1.1 * blend
    force = 9.81 * np.stack(
        [np.sin(angle), np.cos(angle) * np.sin(0.7 * angle), np.cos(angle) * np.cos(0.7 * angle)],
        axis=1,
    )
    tremor = (part > 0) * rng.normal(0, 1, (3, len(time)))
    force += rng.normal(0, 0.02, force.shape) + 0.3 * tremor.T
    rate = (
        0.01
        + rng.normal(0, 0.002, force.shape)
        + np.gradient(angle, time)[:, None] * [0.8, 0.1, 0.5]
    )
    return ImuSamples(np.round(1e9 * time).astype(np.int64), force, rate), [
        (6.0 * k, 6.0 * k + 4) for k in range(n_poses)
    ]


@pytest.mark.parametrize('hz', [50, 100, 1000])
def test_poses_are_found_whole(hz):
    imu, true = by_hand(hz=hz)
    found = find_still(imu)
    assert len(found) == len(true)
    for piece, (low, high) in zip(found, true, strict=True):
        settling = 0.5 if low > 0 else 0.0
        assert piece.start / hz == pytest.approx(
            low + settling, abs=0.15
        ) and piece.stop / hz == pytest.approx(high, abs=0.15)
        assert piece.stop / hz < high + 0.1


def test_unit_does_not_matter():
    imu, _ = by_hand()
    counts = ImuSamples(
        imu.stamp_ns, 32768 + np.round(400 * imu.force_s), 32768 + np.round(4000 * imu.rate_s)
    )
    for piece, other in zip(find_still(imu), find_still(counts), strict=True):
        assert abs(piece.start - other.start) <= 2 and abs(piece.stop - other.stop) <= 2


def test_steady_turn_about_the_vertical_is_no_rest():
    imu, true = by_hand()
    imu.rate_s[int(6 * HZ) : int(10 * HZ), 2] += 0.5
    assert len(find_still(imu)) == len(true) - 1


def test_hole_divides_a_rest():
    imu, true = by_hand(4)
    time = imu.stamp_ns / 1e9
    found = find_still(imu.select((time < 7.6) | (time > 8.0)))
    assert len(found) == len(true) + 1


def test_shortest_rest_is_a_setting():
    imu, _ = by_hand()
    assert find_still(imu, WindowSettings(static_minimum=5.0)) == []


def test_constant_readings_are_rest():
    imu = ImuSamples(
        np.arange(500, dtype=np.int64) * 10**7,
        np.tile([0.0, 0.0, 9.81], (500, 1)),
        np.zeros((500, 3)),
    )
    assert find_still(imu) == [slice(0, 500)]


def test_too_little_is_no_rest():
    imu, _ = by_hand()
    assert [find_still(imu.select(slice(0, n))) for n in (0, 1, 5)] == [[], [], []]


def test_dirty_samples_are_refused():
    imu, _ = by_hand()
    with refused(InputError, 'stamps_backwards'):
        find_still(imu.select(slice(None, None, -1)))
    imu.force_s[7, 0] = np.nan
    with refused(InputError, 'not_finite'):
        find_still(imu)


# recording: topic, least and most intervals at rest (the numbers of poses are told with the
# recordings)
RECORDINGS = {
    'xsens_counts': ('/imu/data_raw', 38, 38),
    'mpu9150_0': ('/imu/data_raw', 17, 20),
    'mpu9150_3': ('/imu/data_raw', 17, 20),
    'ferraris': ('/imu/data_raw', 12, 14),
    'array_2': ('/imu_1/data_raw', 20, 24),
    'array_5': ('/imu_1/data_raw', 20, 21),
    'shaft_pitch_slow': ('/imu/data_raw', 0, 0),
}


@pytest.mark.real_data
@pytest.mark.parametrize('name', RECORDINGS)
def test_real_recordings(recordings, name):
    from msg_adapters.bag import open_recording

    topic, least, most = RECORDINGS[name]
    recording = open_recording(
        recordings / name, imu_topic=topic, want_joints=False, want_temperature=False
    )
    try:
        imu = ImuSamples.concatenate(
            [block.imu for block in recording.blocks() if block.imu is not None]
        )
    finally:
        recording.close()
    (imu,), _ = clean_samples(imu)
    assert least <= len(find_still(imu)) <= most


def test_rests_end_where_the_turn_begins_even_in_vibration():
    imu, ranges, _ = vibration(5, rests=16)
    found = find_still(imu)
    assert len(found) == len(ranges)
    late = [rest.stop - held.stop for rest, held in zip(found, ranges)]
    assert max(late) <= 3 and min(late) >= -12  # samples of 10 ms; up to 32 by the variance alone
    assert all(rest.start >= held.start for rest, held in zip(found, ranges))
