"""What a compensator takes over from a document, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest
from refusal import refused

from imu_calibration.compensation.plausible_change import implausible_change
from imu_calibration.core.errors import DocumentError
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.document.proof_entry import ProofEntry
from imu_calibration.nodes import adoption
from imu_calibration.nodes.adoption import CompensatorSettings, adopt, with_settings

from worlds.compensation_cases import random_calibration

GOOD = random_calibration(1, frame_id='imu_link')
SETTINGS = CompensatorSettings()


def test_another_sensor_does_not_take_the_place_of_this_one():
    before = adopt(calibration_to_text(GOOD), 'a file', SETTINGS, frames=None)
    assert (
        adopt(
            calibration_to_text(replace(GOOD, values=GOOD.values + 1e-4)),
            'the topic',
            SETTINGS,
            frames=None,
            before=before,
        ).source
        == 'the topic'
    )
    with refused(DocumentError, 'other_sensor', 'imu_link', 'another_link'):
        adopt(
            calibration_to_text(replace(GOOD, frame_id='another_link')),
            'the topic',
            SETTINGS,
            frames=None,
            before=before,
        )


HELPS = ProofEntry(0.1, 0.01, (0.05, 0.2), unit='m/s^2', windows=12)
UNPROVEN = replace(HELPS, after=0.1, ci95=(0.8, 1.2))
HARMS = replace(HELPS, after=0.2, ci95=(1.5, 2.5))


def test_an_unproven_sensor_needs_consent_and_a_harmful_one_is_never_corrected():
    insisting = replace(SETTINGS, anyway=True)
    for change, excluded in ((UNPROVEN, set()), (HARMS, {'accelerometer'})):
        text = calibration_to_text(
            replace(GOOD, proof={'accelerometer': change, 'gyroscope': HELPS})
        )
        assert adopt(text, 'a file', SETTINGS, frames=None).used.refused.keys() == {'accelerometer'}
        found = adopt(text, 'a file', insisting, frames=None)
        assert found.used.refused.keys() == excluded and len(found.caveats) == 1
    both = calibration_to_text(replace(GOOD, proof={'accelerometer': HARMS, 'gyroscope': HARMS}))
    for settings in (SETTINGS, insisting):
        with refused(DocumentError, 'no_sensor_helps') as refusal:
            adopt(both, 'a file', settings, frames=None)
        assert refusal.value.key is None


def test_a_refused_sensor_is_not_corrected_and_the_other_one_is():
    text = calibration_to_text(replace(GOOD, proof={'accelerometer': UNPROVEN, 'gyroscope': HELPS}))
    adopted, whole = (
        adopt(text, 'a file', replace(SETTINGS, anyway=flag), frames=None) for flag in (False, True)
    )
    assert adopted.used.refused.keys() == {'accelerometer'} and adopted.used.refused[
        'accelerometer'
    ].startswith('unproven')
    assert adopted.used.refused['accelerometer'] in adopted.caveats[0]
    assert (
        not whole.used.refused
        and whole.caveats[0] == whole.used.cautions[0]
        and adopted.must_be_reported_after(whole)
    )
    sample = (0, 0.1, 0.2, 0.3, 1.0, 2.0, 9.0)
    corrected, both = (each.compensation.correct(*sample) for each in (adopted, whole))
    np.testing.assert_allclose(corrected[3:], sample[4:], rtol=0, atol=1e-12)
    assert (
        np.abs(np.subtract(both[3:], sample[4:])).max() > 1e-3
        and np.abs(np.subtract(corrected[:3], sample[1:4])).max() > 1e-4
    )
    assert with_settings(adopted, SETTINGS, None).used is adopted.used


PROVEN = {'accelerometer': HELPS, 'gyroscope': HELPS}


def changed(sensor, effect, values):
    """The calibration with copied proofs and other values of one effect."""
    new = GOOD.values.copy()
    new[GOOD.model.slices[sensor, effect]] = np.ravel(values)
    return calibration_to_text(replace(GOOD, values=new, proof=PROVEN))


@pytest.mark.parametrize(
    ('sensor', 'effect', 'values'),
    (
        ('gyroscope', 'matrix', -np.eye(3)),
        ('gyroscope', 'matrix', 3 * np.eye(3)),
        ('accelerometer', 'matrix', np.diag([1.0, 1.0, 0.1])),
        ('accelerometer', 'matrix', np.eye(3) + 0.6 * np.eye(3, k=1)),
        ('accelerometer', 'bias', [0, 0, 200.0]),
        ('gyroscope', 'bias', [80.0, 0, 0]),
    ),
)
@pytest.mark.parametrize('source', ('file a', 'topic a'))
def test_values_of_no_instrument_are_refused_per_sensor_whatever_the_proof(
    sensor, effect, values, source
):
    """A gyroscope matrix of -I with a copied proof was adopted as proven."""
    for settings in (SETTINGS, replace(SETTINGS, anyway=True)):
        assert adopt(
            changed(sensor, effect, values), source, settings, frames=None
        ).used.refused.keys() == {sensor}


def test_a_document_whose_sensors_both_have_values_of_no_instrument_is_refused():
    both = replace(GOOD, values=-GOOD.values, proof=PROVEN)
    with refused(DocumentError, 'no_sensor_helps') as refusal:
        adopt(calibration_to_text(both), 'a file', replace(SETTINGS, anyway=True), frames=None)
    assert refusal.value.key is None


def test_an_unproven_document_with_most_parameters_undetermined_is_never_adopted():
    for share, adopted in ((0.4, True), (0.6, False)):
        status = tuple(
            'weak' if k % 10 < 10 * share else 'determined' for k in range(len(GOOD.status))
        )
        text = calibration_to_text(replace(GOOD, status=status, decision={}))
        if adopted:
            assert not adopt(
                text, 'a file', replace(SETTINGS, anyway=True), frames=None
            ).used.refused
        else:
            with refused(DocumentError, 'no_sensor_helps'):
                adopt(text, 'a file', replace(SETTINGS, anyway=True), frames=None)


def test_whatever_a_document_does_becomes_one_line(monkeypatch):
    """An error that nobody thought of refuses the document; it does not end the node."""

    def fails(*given):
        raise IndexError('list index out of range')

    monkeypatch.setattr(adoption, '_make_compensation', fails)
    with refused(DocumentError, 'not_usable', 'IndexError', 'list index out of range'):
        adopt(calibration_to_text(GOOD), 'the topic', SETTINGS, frames=None)


def test_only_what_changed_by_more_than_its_sd_is_worth_a_line():
    before, sd = (
        adopt(calibration_to_text(GOOD), 'the topic', SETTINGS, frames=None),
        np.sqrt(np.diag(GOOD.covariance)),
    )
    little, much = (
        adopt(
            calibration_to_text(replace(GOOD, values=GOOD.values + share * sd)),
            'the topic',
            SETTINGS,
            frames=None,
        )
        for share in (0.1, 3.0)
    )
    assert not little.must_be_reported_after(before) and much.must_be_reported_after(before)


def near(**bias):
    """A document with copied decisions: these biases, and identity matrices."""
    values = np.zeros(len(GOOD.values))
    for sensor in PROVEN:
        values[GOOD.model.slices[sensor, 'matrix']] = np.eye(3).ravel()
        values[GOOD.model.slices[sensor, 'bias']] = bias.get(sensor, 0.0)
    return replace(GOOD, values=values, proof=PROVEN)


def scaled(size):
    document = near()
    values = document.values.copy()
    values[GOOD.model.slices['accelerometer', 'matrix']] = size * np.eye(3).ravel()
    return replace(document, values=values)


FAR = {
    'scale 0.5': scaled(0.5),
    'bias 0.6 m/s^2': near(accelerometer=0.6),
    'gyroscope 0.15 rad/s': near(gyroscope=0.15),
}


@pytest.mark.parametrize('document', FAR.values(), ids=FAR)
@pytest.mark.parametrize('in_use', (None, near(accelerometer=0.01)), ids=('first', 'second'))
def test_a_far_document_from_the_topic_needs_consent_and_a_file_none(document, in_use):
    """Scale 0.5 or a bias of 0.6 m/s^2 with a copied decision was adopted at once."""
    before = in_use and adopt(calibration_to_text(in_use), 'a file', SETTINGS, frames=None)
    text = calibration_to_text(document)
    with refused(DocumentError, 'implausible_change') as refusal:
        adopt(text, 'the topic', SETTINGS, frames=None, before=before, from_topic=True)
    assert refusal.value.key == 'anyway'
    insisting = replace(SETTINGS, anyway=True)
    for settings, from_topic in ((insisting, True), (SETTINGS, False)):
        adopted = adopt(text, 'x', settings, frames=None, before=before, from_topic=from_topic)
        assert adopted.anchor is adopted.used.calibration


def test_many_small_changes_from_the_topic_do_not_add_up():
    adopted = None
    for bias in (0.2, 0.4, 0.6):
        adopted = adopt(
            calibration_to_text(near(accelerometer=bias)),
            'the topic',
            SETTINGS,
            frames=None,
            before=adopted,
            from_topic=True,
        )
    with refused(DocumentError, 'implausible_change'):
        adopt(
            calibration_to_text(near(accelerometer=0.8)),
            'the topic',
            SETTINGS,
            frames=None,
            before=adopted,
            from_topic=True,
        )


@pytest.mark.parametrize('effect', ('accel_quadratic', 'accel_thermal_bias', 'gyro_g_sensitivity'))
def test_the_change_by_any_effect_is_limited(effect):
    """The limits hold for readings: a large coefficient of another effect is found too."""
    further = random_calibration(
        1,
        accelerometer=('accel_quadratic', 'accel_thermal_bias'),
        gyroscope=('gyro_g_sensitivity',),
        frame_id='imu_link',
    )
    sensor = 'gyroscope' if effect.startswith('gyro') else 'accelerometer'
    part = further.model.slices[sensor, effect]
    assert not implausible_change(further, None)
    values = further.values.copy()
    values[part] = 0.05
    assert implausible_change(replace(further, values=values), None)
