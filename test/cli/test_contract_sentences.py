"""
The sentences that users and their scripts see most often.

Every other test asserts codes, keys and numbers.
"""

from dataclasses import replace

import pytest

from imu_calibration.calibration.check_result import CheckResult
from imu_calibration.core.errors import InputError, with_hint
from imu_calibration.document import trust
from imu_calibration.document.calibration_text import calibration_from_text
from imu_calibration.document.decision import NO_PROOF, reason_of
from imu_calibration.document.exports.export import find_target, loss_lines
from imu_calibration.document.exports.loss import Loss
from imu_calibration.document.proof_entry import ProofEntry

from worlds.compensation_cases import random_calibration

ENTRY = ProofEntry(0.2, 0.01, (0.03, 0.08), unit='m/s^2', windows=8)
HARMED = replace(ENTRY, after=0.3, ci95=(1.2, 1.8))
PLAIN = random_calibration(1, decision={})


def refusal(function, *arguments):
    """Return the text of an error."""
    with pytest.raises(InputError) as caught:
        function(*arguments)
    return str(caught.value)


def checked(**proof):
    """Return the first line of `check` for a proof."""
    return str(CheckResult(proof)).splitlines()[0]


def calibrated(**proof):
    """Return a calibration with a proof."""
    return replace(PLAIN, proof=proof)


SENTENCES = {
    'check_helps': (lambda: checked(accelerometer=ENTRY, gyroscope=ENTRY), 'the calibration helps'),
    'check_helps_one': (
        lambda: checked(accelerometer=HARMED, gyroscope=ENTRY),
        'it helps the gyroscope only',
    ),
    'check_helps_none': (
        lambda: checked(accelerometer=HARMED, gyroscope=HARMED),
        'it helps no sensor',
    ),
    'decision': (
        lambda: reason_of(ENTRY),
        'error 20.4 mg to 1.02 mg on held-out data (8 windows, after / before 0.03 to 0.08)',
    ),
    'no_proof': (lambda: reason_of(None), NO_PROOF),
    'not_corrected': (
        lambda: (
            trust.usable(calibrated(accelerometer=HARMED, gyroscope=ENTRY))
            .lines[0]
            .partition(': error')[0]
        ),
        'the accelerometer is not corrected: harms',
    ),
    'no_sensor_helps': (
        lambda: refusal(trust.usable, calibrated(accelerometer=HARMED, gyroscope=HARMED)).partition(
            ': '
        )[0],
        'a calibration must help a sensor on held-out data to be applied, this one does not',
    ),
    'document_format': (
        lambda: refusal(calibration_from_text, 'format: x'),
        "a calibration document must have 'format: imu_calibration/1', got 'x'; "
        "give a file written by 'imu_calibration calibrate'",
    ),
    'document_newer': (
        lambda: refusal(calibration_from_text, 'format: imu_calibration/2'),
        'a calibration document must not be newer than '
        "'imu_calibration/1', got 'imu_calibration/2'; update imu_calibration",
    ),
    'hint': (
        lambda: with_hint('give the local gravity', 'gravity', {'gravity': '--gravity'}),
        'give the local gravity (--gravity)',
    ),
    'nothing_lost': (
        lambda: loss_lines(
            find_target('px4'), Loss((), (), {'accelerometer': 0.0, 'gyroscope': 0.0}, {}, '')
        ),
        ['lost: nothing'],
    ),
}
"""Key -> (function that makes the sentence, sentence)."""


@pytest.mark.parametrize('key', SENTENCES)
def test_a_sentence_of_the_contract(key):
    made, sentence = SENTENCES[key]
    assert made() == sentence
