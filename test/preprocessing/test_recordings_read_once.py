"""
Data go through once.

A sample is cleaned once, whoever looks at it, and a recording is read no oftener than its answer
needs.
"""

from collections import Counter
from pathlib import Path

import pytest
from refusal import refused

from imu_calibration.api.inspect import inspect_recording
from imu_calibration.api.recordings import Topics, source_of
from imu_calibration.calibration.diagnosis.diagnose import diagnose_recording
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.errors import ImuCalibrationError
from imu_calibration.core.samples import ImuSamples
from imu_calibration.document import files, verdict
from imu_calibration.preprocessing.stream_cleaning import StreamCheck
from imu_calibration.references.gravity.gravity_reference import GravityReference
from imu_calibration.references.turntable import needs
from imu_calibration.references.turntable.table_reference import TableReference
from msg_adapters.bag import Recording

from worlds.calibrated import calibrated_by_hand, calibrated_on_table

BAG = Path(__file__).resolve().parents[2] / 'bags' / 'sample_session'
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
    calibrated_on_table([source_of(BAG, Topics(), table.joint_names)], table, PLAIN)
    assert seen['passes'] == 1 and seen['cleaned'] == seen['samples'] > 0


def test_calibration_by_hand_cleans_each_sample_once(seen):
    try:
        calibrated_by_hand([source_of(BAG, Topics())])
    except ImuCalibrationError:
        pass  # what matters here was read
    assert seen['passes'] == 1 and seen['cleaned'] == seen['samples'] > 0


@pytest.mark.parametrize('with_table', [True, False], ids=['table', 'no table'])
def test_inspect_reads_a_recording_once_for_streams_checks_and_motions(table, seen, with_table):
    reference = TableReference(table) if with_table else GravityReference()
    (look,) = inspect_recording(BAG, [Topics()], reference, options=PLAIN)
    assert seen['passes'] == 1 and seen['cleaned'] == seen['samples'] == look.streams['imu'].count
    assert look.calibrated is not None


def test_diagnosis_takes_its_windows_from_the_pass_that_calibrates(table, seen, monkeypatch):
    def enough(windows, *arguments, **options):
        assert len(windows) >= 10
        raise ImuCalibrationError(code='enough')

    monkeypatch.setattr('imu_calibration.references.turntable.window_search.inquire', enough)
    with refused(ImuCalibrationError, 'enough'):
        diagnose_recording(source_of(BAG, Topics(), table.joint_names), TableReference(table))
    assert seen['passes'] == 1 and seen['cleaned'] == seen['samples'] > 0


def counting(monkeypatch, module, name):
    """Count the calls of a function of a module."""
    calls, function = [], getattr(module, name)

    def counted(*arguments, **options):
        calls.append(arguments)
        return function(*arguments, **options)

    monkeypatch.setattr(module, name, counted)
    return calls


def test_verdict_and_needed_motions_are_worked_out_once_per_solution(table, monkeypatch):
    judged, needed = (
        counting(monkeypatch, verdict, 'judge'),
        counting(monkeypatch, needs, 'needed_motions'),
    )
    result = calibrated_on_table(
        [source_of(BAG, Topics(), table.joint_names)],
        table,
        CalibrationOptions(reference_model='table_tilt'),
    )
    assert result.verdict.lines() and result.needed is not None
    assert len(judged) == len(needed) == 1
