"""No bad calibration is used as a good one: verdict and proof travel in the document, and who corrects looks at them."""

from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.calibration import trust
from imu_calibration.calibration.calibrate import calibrate
from imu_calibration.calibration.document import calibration_from_text, calibration_to_text
from imu_calibration.calibration.status import HELD
from imu_calibration.cli.main import main
from imu_calibration.errors import DocumentError
from imu_calibration.samples import ImuSamples, SampleBlock
from msg_adapters.write import write_session

from worlds.compensation_cases import random_calibration

PROOF = {'accelerometer': {'before': 0.2, 'after': 0.01, 'ci95': [0.03, 0.08], 'unit': 'm/s^2', 'windows': 8},
         'gyroscope': {'before': 0.02, 'after': 0.001, 'ci95': [0.03, 0.08], 'unit': 'rad/s', 'windows': 8}}
GOOD = random_calibration(1, verdict='good', verdict_reasons=('all is well',), proof=PROOF)


def with_proof(**changes):
    """A good calibration with a changed proof of its gyroscope."""
    return replace(GOOD, proof=PROOF | {'gyroscope': PROOF['gyroscope'] | changes})


def test_verdict_and_proof_travel_in_the_document():
    read = calibration_from_text(calibration_to_text(GOOD))
    assert (read.verdict, read.verdict_reasons, read.proof) == ('good', ('all is well',), PROOF)
    assert trust.objections(read) == trust.caveats(read) == []
    assert trust.standing(read) == 'good, proven on held-out data'


@pytest.mark.parametrize(('calibration', 'words'), (
    (replace(GOOD, verdict='bad', verdict_reasons=('the residuals are large',)), 'its verdict is bad: the residuals are large'),
    (replace(GOOD, verdict='bad', verdict_reasons=()), 'its verdict is bad'),
    (with_proof(after=0.03, ci95=[1.2, 1.8]), 'gyroscope error is 0.03 rad/s with it and 0.02 without'),
    (with_proof(after=0.019, ci95=[0.8, 1.1]), 'that it helps is not shown'),
    (with_proof(windows=0), 'on 0 windows'),
    (replace(GOOD, values=1e3 * GOOD.values), 'more than ten times what is known'),
), ids=('bad', 'bad without a reason', 'worse', 'not shown', 'nothing held out', 'implausible'))
def test_what_speaks_against_a_calibration_is_said(calibration, words):
    assert words in '; '.join(trust.objections(calibration))
    assert trust.refused_sensors(calibration)


def test_a_refusal_names_what_insists():
    with pytest.raises(DocumentError, match='calibrate again') as refusal:
        trust.usable(replace(GOOD, verdict='bad', verdict_reasons=('the residuals are large',)))
    assert '--anyway' in refusal.value.told({'anyway': '--anyway'}) and '\n' not in str(refusal.value)


def test_files_of_earlier_versions_stay_usable_and_say_so():
    old = calibration_from_text(calibration_to_text(replace(GOOD, verdict='', verdict_reasons=(), proof={})))
    assert trust.objections(old) == [] and 'carries no verdict' in trust.caveats(old)[0]
    assert trust.standing(old) == 'no verdict, no proof on held-out data'


def test_a_verdict_on_both_is_one_on_each_where_nobody_judged_them_apart():
    both = replace(GOOD, verdict='bad', verdict_reasons=('the residuals are large',))
    assert all(trust.objections(both, sensor) == ['its verdict is bad: the residuals are large'] for sensor in ('accelerometer', 'gyroscope'))


def test_a_weak_calibration_says_what_is_missing():
    weak = replace(GOOD, verdict='weak', status=(HELD,) * 2 + GOOD.status[2:])
    assert trust.caveats(weak) == ['its verdict is weak: 2 of 33 parameters not determined (accelerometer.bias.x, accelerometer.bias.y)']


def rest(seconds=8.0):
    """An IMU on a table that does nothing."""
    from worlds.live_sessions import make_session
    return make_session(3, seconds=seconds)


def test_a_rest_in_one_attitude_is_bad():
    from worlds.live_sessions import OPTIONS, TABLE
    imu, joints, _, _ = rest()
    found = calibrate([lambda: iter([SampleBlock(imu, joints)])], TABLE, OPTIONS).calibration
    assert found.verdict == 'bad' and 'says nothing about the accelerometer' in found.verdict_reasons[0]
    assert calibration_from_text(calibration_to_text(found)).verdict == 'bad'


def test_compensate_refuses_a_bad_calibration_unless_told(tmp_path, capsys):
    imu = ImuSamples(10**18 + 10_000_000 * np.arange(300), np.tile([0.0, 0.0, 9.8], (300, 1)), np.zeros((300, 3)), 'imu_link')
    write_session(tmp_path / 'drive', imu)
    (tmp_path / 'bad.yaml').write_text(calibration_to_text(replace(GOOD, verdict='bad', verdict_reasons=('a reason',))))
    command = ['compensate', str(tmp_path / 'drive'), '--calibration', str(tmp_path / 'bad.yaml'), '--output', str(tmp_path / 'out')]
    assert main(command) == 1
    error = capsys.readouterr().err
    assert 'its verdict is bad: a reason' in error and '(--anyway)' in error and error.count('\n') == 1 and not (tmp_path / 'out').exists()
    assert main([*command, '--anyway']) == 0
    assert 'note: its verdict is bad: a reason' in capsys.readouterr().out
