"""One rule for the decision, the counts, the next step and the exit code of a calibration."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from imu_calibration.api.inspect import RecordingSummary
from imu_calibration.cli.main import main
from imu_calibration.core.errors import InputError
from imu_calibration.core.exit_codes import UNKNOWN_EXTENT, dropped_text
from imu_calibration.core.scales import scale_range
from imu_calibration.document.calibration import scale_questions, true_calibration
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.document.decision import HELPS, UNPROVEN
from imu_calibration.document.outcome import (
    exit_code,
    missing,
    parameter_count,
    shortcomings,
)
from imu_calibration.document.proof_entry import ProofEntry
from imu_calibration.document.reference_texts import ACCELEROMETER_AXES
from imu_calibration.document.trust import caveats, refused_sensors
from imu_calibration.document.verdict import judge
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.preprocessing.recording_evidence import NOTE, WARNING, CheckFinding
from imu_calibration.references.gravity.gravity_reference import GravityReference
from imu_calibration.references.turntable.table_reference import TableReference

PROOF = {
    sensor: ProofEntry(1.0, 0.1, (0.05, 0.2), unit=unit, windows=30)
    for sensor, unit in (('accelerometer', 'm/s^2'), ('gyroscope', 'rad/s'))
}


def proven(model=None, **changes):
    """Return a calibration that helps each sensor, with all parameters determined."""
    model = model or SensorModel(('bias', 'matrix'), ('bias', 'matrix'))
    values = changes.pop('values', model.start())
    found = true_calibration(model, values, 'imu', simulated={})
    covariance = np.eye(len(values)) * 1e-8
    return replace(
        found,
        covariance=covariance,
        proof=PROOF,
        decision={},
        decision_reasons={},
        **changes,
    )


def with_scale(scale, **changes):
    """Return a proven calibration with one scale factor of the accelerometer."""
    model = SensorModel(('bias', 'matrix'), ('bias', 'matrix'))
    values = model.start()
    values[model.param_names.index('accelerometer.matrix.xx')] = scale
    return proven(model, values=values, **changes)


def verdict_of(calibration):
    """Return its verdict with tolerances that all standard deviations meet."""
    return judge(calibration, np.ones(len(calibration.values)))


@pytest.mark.parametrize('count, code', [(4, 0), (150, 0), (170, 3)])
def test_few_dropped_samples_do_not_change_the_exit_code(count, code):
    found = proven(statistics={'dropped': {'imu spike': count}, 'samples_used': {'all': 16_000}})
    assert exit_code(found) == code
    assert [str(count) in line for line in shortcomings(found)] == [True] * (code == 3)
    assert bool(dropped_text({'imu spike': count}, 16_000)) == (code == 3)


@pytest.mark.parametrize('severity, code', [(WARNING, 3), (NOTE, 0)])
def test_a_contradiction_of_the_table_description_is_a_3_and_a_convention_is_not(severity, code):
    entry = CheckFinding('mount', severity, 'turned by 0.5 deg').to_mapping()
    assert exit_code(proven(statistics={'preflight': [entry]})) == code


@pytest.mark.parametrize(
    'statistics',
    [
        {'dropped': {'imu spike': 170}, 'samples_used': {'all': 16_000}},
        {'unusable_sensors': {'gyroscope': 'constant'}},
        {'preflight': [CheckFinding('mount', WARNING, 'turned by 5 deg').to_mapping()]},
    ],
)
def test_what_is_a_3_is_not_complete_and_its_next_step_is_not_to_compensate(statistics):
    good, found = verdict_of(proven()), verdict_of(proven(statistics=statistics))
    assert good.complete and any('compensate' in reason.next for reason in good.reasons)
    assert exit_code(proven(statistics=statistics)) == 3 and not found.complete
    assert not any('compensate' in reason.next for reason in found.reasons)


def test_a_sensor_that_compensation_refuses_never_helps():
    good, bad = with_scale(1.02), with_scale(3.0)
    assert set(good.decisions.values()) == {HELPS} and not refused_sensors(good)
    assert bad.decisions == {'accelerometer': UNPROVEN, 'gyroscope': HELPS}
    assert verdict_of(bad).decisions == bad.decisions and list(refused_sensors(bad)) == [
        'accelerometer'
    ]
    assert exit_code(good) == 0 and exit_code(bad) == 3
    steps = [
        [reason.next for reason in verdict_of(each).reasons if 'compensate' in reason.next]
        for each in (good, bad)
    ]
    assert [len(each) for each in steps] == [1, 0]
    stated = replace(bad, decision=dict.fromkeys(PROOF, 'helps'))  # as in an earlier file
    assert stated.decisions['accelerometer'] is UNPROVEN and exit_code(stated) == 3


@pytest.mark.parametrize(
    'scale, place',
    [(0.6, 'usual'), (1.7, 'usual'), (0.59, 'doubtful'), (2.5, 'doubtful')]
    + [(0.39, 'impossible'), (2.51, 'impossible'), (-0.49, 'impossible'), (np.nan, 'impossible')],
)
def test_one_table_of_scale_factors(scale, place):
    found = with_scale(scale)
    assert scale_range(scale) == place
    assert list(scale_questions(found)) == ['accelerometer'] * (place == 'doubtful')
    assert list(refused_sensors(found)) == ['accelerometer'] * (place == 'impossible')
    assert (exit_code(found) == 3) == (place == 'impossible')


def test_a_doubtful_scale_without_the_support_of_the_data_is_refused():
    found = with_scale(0.5)
    weak = replace(found, status=('weak',) * len(found.status))
    unproven = replace(found, proof={}, decision={})
    assert [list(refused_sensors(each)) for each in (found, weak, unproven)] == [
        [],
        ['accelerometer'],
        ['accelerometer'],
    ]
    assert scale_questions(found)['accelerometer'] in caveats(found)
    assert exit_code(found) == 0 and exit_code(weak) == 3


def test_by_hand_the_gyroscope_does_not_help_without_the_axes_of_the_accelerometer():
    bad = with_scale(3.0, gauge={'axes': ACCELEROMETER_AXES})
    assert set(bad.decisions.values()) == {UNPROVEN} == set(verdict_of(bad).decisions.values())
    assert set(refused_sensors(bad)) == set(PROOF)


def test_parameters_of_the_reference_do_not_count():
    model = SensorModel(
        ('bias', 'matrix'), ('bias', 'matrix'), reference=('time_offset', 'encoder_zero')
    )
    status = [
        'held' if name.startswith('reference.') else 'determined' for name in model.param_names
    ]
    found = proven(model, status=tuple(status))
    count = parameter_count(found)
    own = [name for name in model.param_names if not name.startswith('reference.')]
    assert (count.determined, count.requested) == (len(own), len(own))
    verdict = verdict_of(found)
    assert (verdict.within, verdict.requested) == (len(own), len(own)) and verdict.complete
    assert missing(found) == '' and caveats(found) == [] and exit_code(found) == 0
    assert f'{len(own)} determined' in repr(found) and 'held' not in repr(found)


def test_quiet_and_json_list_the_reasons_of_a_3(tmp_path, capsys):
    path = tmp_path / 'calibration.yaml'
    path.write_text(calibration_to_text(with_scale(3.0)))
    arguments = ['export', str(path), '--to', 'kalibr', '--output']
    assert main([*arguments, str(tmp_path / 'a.yaml'), '--json']) == 3
    reasons = json.loads(capsys.readouterr().out)['reasons']
    assert len(reasons) == 1 and 'accelerometer' in reasons[0]
    assert main([*arguments, str(tmp_path / 'b.yaml'), '--quiet']) == 3
    printed = capsys.readouterr()
    assert printed.out == '' and reasons[0] in printed.err


def test_a_loss_of_unknown_extent_is_a_reason_at_any_count():
    assert dropped_text({f'bytes {UNKNOWN_EXTENT}': 1}, 16_000)
    assert not dropped_text({f'bytes {UNKNOWN_EXTENT}': 0, 'imu spike': 1}, 16_000)


def test_a_warning_changes_the_code_of_inspect_only_without_a_complete_calibration():
    """`calibrate` gives 0 for a complete calibration, with any warning."""
    found = (CheckFinding('stamps', WARNING, 'some stamps repeat'),)
    look = RecordingSummary(None, {}, found, {}, None)
    complete = proven()
    weak = replace(complete, status=('weak',) * len(complete.status))
    whole, lacking = SimpleNamespace(calibration=complete), SimpleNamespace(calibration=weak)
    refusal = InputError('no interval at rest', code='no_rest')
    assert exit_code(complete) == 0
    by_hand = GravityReference()
    on_table = TableReference(SimpleNamespace())
    for reference, calibrated, code in (
        (by_hand, None, 3),
        (on_table, refusal, 1),
        (by_hand, refusal, 3),
        (on_table, whole, 0),
        (by_hand, whole, 0),
        (on_table, lacking, 3),
        (by_hand, lacking, 3),
    ):
        assert replace(look, calibrated=calibrated, reference=reference).exit_code == code
    on_table_reasons = replace(look, calibrated=lacking, reference=on_table).reasons
    assert on_table_reasons == shortcomings(weak)
    assert replace(look, findings=(), calibrated=lacking).exit_code == 0
