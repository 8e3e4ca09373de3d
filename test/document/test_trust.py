"""
The decision per sensor travels in the document, and whatever applies a calibration follows it.
"""

from dataclasses import replace

import numpy as np
import pytest
from refusal import refused

from imu_calibration.cli.main import main
from imu_calibration.core.errors import DocumentError
from imu_calibration.core.samples import ImuSamples, SampleBlock
from imu_calibration.document import decision, trust
from imu_calibration.document.calibration_text import (
    calibration_from_text,
    calibration_mapping,
    calibration_to_text,
    from_mapping,
)
from imu_calibration.document.decision import (
    HARMS,
    HELPS,
    NO_PROOF,
    UNPROVEN,
    decide,
    most_cautious,
    reason_of,
)
from imu_calibration.document.proof_entry import ProofEntry
from imu_calibration.document.reference_texts import ACCELEROMETER_AXES
from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.solution import HELD
from msg_adapters.write import write_session

from worlds.calibrated import calibrated_on_table
from worlds.compensation_cases import random_calibration

ENTRY = ProofEntry(0.2, 0.01, (0.03, 0.08), unit='m/s^2', windows=8)
INTERVALS = {HELPS: (0.03, 0.08), UNPROVEN: (0.8, 1.1), HARMS: (1.2, 1.8)}
PLAIN = random_calibration(1, decision={})


def proven(accelerometer, gyroscope, **changes):
    """Return a calibration with the proof for these decisions; None: no entry."""
    words = {'accelerometer': accelerometer, 'gyroscope': gyroscope}
    return replace(
        PLAIN,
        proof={
            sensor: replace(ENTRY, ci95=INTERVALS[word]) for sensor, word in words.items() if word
        },
        **changes,
    )


@pytest.mark.parametrize(
    ('interval', 'word'),
    [((0.1, 0.999), HELPS), ((0.1, 1.0), UNPROVEN), ((1.0, 2.0), UNPROVEN), ((1.001, 2.0), HARMS)],
)
def test_the_decision_follows_from_the_interval(interval, word):
    entry = replace(ENTRY, ci95=interval)
    assert decide(entry) is word
    assert decide(replace(entry, windows=0)) is UNPROVEN and decide(None) is UNPROVEN
    assert (decision._cause(entry) in reason_of(entry)) == (word is not HELPS) and reason_of(
        None
    ) == NO_PROOF
    assert most_cautious([HELPS, word]) is word


def test_a_file_without_a_decision_derives_it_and_one_with_a_decision_cannot_hide_its_proof():
    for words in ((HELPS, HARMS), (UNPROVEN, None)):
        document = calibration_mapping(proven(*words))
        assert 'decision' not in document
        assert list(from_mapping(document).decisions.values()) == [
            word or UNPROVEN for word in words
        ]
        assert from_mapping(document | {'decision': {'gyroscope': 'helps'}}).decisions[
            'gyroscope'
        ] is (words[1] or HELPS)
        assert (
            from_mapping(document | {'decision': {'accelerometer': 'harms'}}).decisions[
                'accelerometer'
            ]
            is HARMS
        )
    with refused(DocumentError, 'part_value', 'decision.accelerometer', 'good'):
        from_mapping(document | {'decision': {'accelerometer': 'good'}})


CASES = [
    (first, second, anyway, live)
    for first in (HELPS, UNPROVEN, HARMS)
    for second in (HELPS, UNPROVEN, HARMS)
    for anyway in (False, True)
    for live in (False, True)
]


@pytest.mark.parametrize(('first', 'second', 'anyway', 'live'), CASES)
def test_what_is_applied(first, second, anyway, live):
    """
    Offline unproven with a caution, harms with consent; live unproven with consent, harms never.
    """
    applied = {HELPS: True, UNPROVEN: anyway or not live, HARMS: anyway and not live}
    known = proven(first, second)
    if not applied[first] and not applied[second]:
        with refused(DocumentError, 'no_sensor_helps') as refusal:
            trust.usable(known, anyway=anyway, live=live)
        assert (refusal.value.key == 'anyway') == (
            not live or UNPROVEN in (first, second)
        ) and '\n' not in str(refusal.value)
        return
    found = trust.usable(known, anyway=anyway, live=live)
    assert found.refused.keys() == {
        sensor for sensor, word in zip(SENSORS, (first, second), strict=True) if not applied[word]
    }
    assert len(found.cautions) == sum(
        applied[word] and word is not HELPS for word in (first, second)
    )
    assert len(found.lines) == sum(word is not HELPS for word in (first, second))
    assert (found.calibration is known) == (not found.refused)


def test_by_hand_the_gyroscope_is_not_applied_without_the_accelerometer():
    gauge = {'axes': ACCELEROMETER_AXES}
    assert trust.usable(proven(HELPS, HARMS, gauge=gauge)).refused.keys() == {'gyroscope'}
    with refused(DocumentError, 'no_sensor_helps', HARMS):
        trust.usable(proven(HARMS, HELPS, gauge=gauge))


def test_parameters_that_are_not_determined_are_named():
    weak = replace(PLAIN, status=(HELD,) * 2 + PLAIN.status[2:])
    (line,) = trust.caveats(weak)
    assert (
        all(value in line for value in ('2', '33', 'accelerometer.bias.x', 'accelerometer.bias.y'))
        and 'accelerometer.bias.z' not in line
    )
    assert trust.caveats(PLAIN) == []


def test_a_document_with_one_ill_conditioned_sensor_loads_for_the_other():
    """The matrix of condition number 33 is not applied, not even with consent."""
    document = calibration_mapping(proven(HELPS, HELPS))
    document['accelerometer']['matrix']['value'] = [
        [1.0, 0.0, 0.0],
        [0.0, 1.0, 0.0],
        [0.0, 0.0, 0.03],
    ]
    found = from_mapping(document)
    assert (
        found.decisions == {'accelerometer': HARMS, 'gyroscope': HELPS}
        and '33.' in found.decision_reasons['accelerometer']
    )
    np.testing.assert_array_equal(
        found.value('gyroscope', 'matrix'), PLAIN.value('gyroscope', 'matrix')
    )
    np.testing.assert_array_equal(found.value('accelerometer', 'matrix'), np.eye(3))
    assert calibration_from_text(calibration_to_text(found)).decisions == found.decisions
    document['gyroscope']['matrix']['value'] = np.zeros((3, 3)).tolist()
    with refused(DocumentError, 'ill_conditioned', 20, 33.3):
        from_mapping(document)


def test_a_rest_in_one_attitude_is_unproven():
    from worlds.live_sessions import OPTIONS, TABLE, make_session

    imu, joints, _, _ = make_session(3, seconds=8.0)
    found = calibrated_on_table([[SampleBlock(imu, joints)]], TABLE, OPTIONS).calibration
    assert set(found.decisions.values()) == {UNPROVEN}
    assert any('accelerometer' in line for line in found.notes)
    assert calibration_from_text(calibration_to_text(found)).decisions == found.decisions


@pytest.mark.parametrize(
    ('words', 'plain', 'insisted'),
    [
        ((HARMS, HARMS), 1, 3),
        ((UNPROVEN, HELPS), 3, 3),
        ((HELPS, HARMS), 3, 3),
        ((HELPS, HELPS), 0, 0),
    ],
)
def test_exit_codes_of_compensate(words, plain, insisted, tmp_path, capsys):
    imu = ImuSamples(
        10**18 + 10_000_000 * np.arange(300),
        np.tile([0.0, 0.0, 9.8], (300, 1)),
        np.zeros((300, 3)),
        'imu_link',
    )
    write_session(tmp_path / 'drive', imu)
    (tmp_path / 'known.yaml').write_text(calibration_to_text(proven(*words)))
    command = [
        'compensate',
        str(tmp_path / 'drive'),
        '--calibration',
        str(tmp_path / 'known.yaml'),
        '--output',
    ]
    assert main([*command, str(tmp_path / 'plain')]) == plain
    error = capsys.readouterr().err
    assert ('--anyway' in error and error.count('\n') == 1) == (plain == 1) and (
        tmp_path / 'plain'
    ).exists() == (plain != 1)
    assert main([*command, str(tmp_path / 'insisted'), '--anyway']) == insisted
    assert capsys.readouterr().out.count('note: ') == sum(word is not HELPS for word in words)
