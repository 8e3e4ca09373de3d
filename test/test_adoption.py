"""What a compensator takes over from a document, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.calibration.document import calibration_to_text
from imu_calibration.errors import DocumentError
from imu_calibration.nodes import adoption
from imu_calibration.nodes.adoption import adopt
from imu_calibration.nodes.compensator_settings import CompensatorSettings

from worlds.compensation_cases import random_calibration

GOOD = random_calibration(1, verdict='good', verdict_reasons=('all is well',), frame_id='imu_link')
SETTINGS = CompensatorSettings()


def test_another_sensor_does_not_take_the_place_of_this_one():
    before = adopt(calibration_to_text(GOOD), 'a file', SETTINGS, frames=None)
    assert adopt(calibration_to_text(replace(GOOD, values=GOOD.values + 1e-4)), 'the topic', SETTINGS, frames=None, before=before).source == 'the topic'
    with pytest.raises(DocumentError, match="the same sensor, 'imu_link', this one is for 'another_link'"):
        adopt(calibration_to_text(replace(GOOD, frame_id='another_link')), 'the topic', SETTINGS, frames=None, before=before)


def test_what_speaks_against_itself_is_refused_unless_told():
    text = calibration_to_text(replace(GOOD, verdict='bad', verdict_reasons=('the residuals are large',)))
    with pytest.raises(DocumentError, match='the residuals are large'):
        adopt(text, 'a file', SETTINGS, frames=None)
    assert 'its verdict is bad' in adopt(text, 'a file', replace(SETTINGS, anyway=True), frames=None).caveats[0]


def test_whatever_a_document_does_becomes_one_line(monkeypatch):
    """An error that nobody thought of refuses the document; it does not end the node."""
    def fails(*given):
        raise IndexError('list index out of range')
    monkeypatch.setattr(adoption, '_prepared', fails)
    with pytest.raises(DocumentError, match='must be usable, this one is not: IndexError: list index out of range'):
        adopt(calibration_to_text(GOOD), 'the topic', SETTINGS, frames=None)


def test_only_what_changed_by_more_than_its_sd_is_worth_a_line():
    before, sd = adopt(calibration_to_text(GOOD), 'the topic', SETTINGS, frames=None), np.sqrt(np.diag(GOOD.covariance))
    little, much = (adopt(calibration_to_text(replace(GOOD, values=GOOD.values + share * sd)), 'the topic', SETTINGS, frames=None) for share in (0.1, 3.0))
    assert not little.says_more_than(before) and much.says_more_than(before)
