"""A clock of another rate is named with its rate."""

import pytest

from imu_calibration.selection import investigation
from imu_calibration.selection.investigation import investigate
from imu_calibration.selection.questions import testable_effects as find_testable_effects

from worlds.clocks import Clock
from worlds.hiding import record


def test_a_clock_of_another_rate_is_named(monkeypatch):
    """Few effects are tested, so that a recording is reduced in less than a second."""
    def some(*arguments):
        effects, lacking = find_testable_effects(*arguments)
        return [effect for effect in effects if effect.name in ('time_offset', 'clock_rate', 'encoder_zero', 'table_tilt')], lacking
    monkeypatch.setattr(investigation, 'testable_effects', some)
    recording = record(6, None, 'realistic', through_bag=False, cause=Clock(rate=200e-6))
    found = investigate(recording.windows, recording.table, recording.model)
    assert [question.name for question in found.named] == ['clock_rate']
    value, = found.attempt.values(found.named)[list(found.named[0].parameters)]
    assert value == pytest.approx(200e-6 / (1 + 200e-6), abs=1e-7)   # stamps run at this rate by themselves
