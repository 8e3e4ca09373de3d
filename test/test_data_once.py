"""Data go through once: a sample is cleaned once, whoever looks at it, and a recording is read no oftener than its answer needs."""

from collections import Counter
from pathlib import Path

import pytest

from imu_calibration import files
from imu_calibration.by_hand.workflow import calibrate_without_table
from imu_calibration.calibration.calibrate import calibrate
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.errors import ImuCalibrationError
from imu_calibration.samples import ImuSamples
from imu_calibration.segmentation.stream_cleaning import StreamCheck
from imu_calibration.use_cases.inspect import inspect
from imu_calibration.use_cases.recordings import Topics, source_of
from msg_adapters.bag import Recording

BAG = Path(__file__).resolve().parents[1] / 'bags' / 'sample_session'
PLAIN = CalibrationOptions(reference_model='none')
"""Nothing is linearised anew, which would take another pass."""


@pytest.fixture
def table():
    return files.read_table(BAG / 'table.yaml')


@pytest.fixture
def seen(monkeypatch):
    """Return counters: passes over the bag, its Imu samples, and samples that were cleaned."""
    found, blocks, push = Counter(), Recording.blocks, StreamCheck.push

    def counted_blocks(self, *arguments, **options):
        found['passes'] += 1
        for block in blocks(self, *arguments, **options):
            found['samples'] += 0 if block.imu is None else len(block.imu)
            yield block

    def counted_push(self, samples):
        found['cleaned'] += len(samples) if isinstance(samples, ImuSamples) else 0
        return push(self, samples)
    monkeypatch.setattr(Recording, 'blocks', counted_blocks)
    monkeypatch.setattr(StreamCheck, 'push', counted_push)
    return found


def test_calibration_cleans_each_sample_once_for_windows_and_checks(table, seen):
    calibrate([source_of(BAG, Topics(), table.joint_names)], table, PLAIN)
    assert seen['passes'] == 1 and seen['cleaned'] == seen['samples'] > 0


def test_calibration_by_hand_cleans_each_sample_once(seen):
    try:
        calibrate_without_table([source_of(BAG, Topics(), want_joints=False)])
    except ImuCalibrationError:
        pass   # what matters here was read
    assert seen['passes'] == 1 and seen['cleaned'] == seen['samples'] > 0


@pytest.mark.parametrize('with_table', [True, False], ids=['table', 'no table'])
def test_inspect_reads_a_recording_once_for_streams_checks_and_motions(table, seen, with_table):
    (look,) = inspect(BAG, [Topics()], table if with_table else None, PLAIN)
    assert seen['passes'] == 1 and seen['cleaned'] == seen['samples'] == look.streams['imu'].count
    assert (look.calibrated is not None) == with_table
