"""The verdict on a calibration: each statement alone, on a calibration that has none without it."""

from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.document.calibration import Calibration, parameter_rows
from imu_calibration.document.decision import DECISION, HELPS, NOTE, PARAMETERS, UNPROVEN, WARNING
from imu_calibration.document.outcome import exit_code
from imu_calibration.document.proof_entry import ProofEntry, RegimeErrors
from imu_calibration.document.verdict import incomplete_windows, judge, judged, motion_misfits
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import (
    DETERMINED,
    EXCESS_REMEDY,
    HELD,
    WEAK,
    tolerances_of,
)

MODEL = SensorModel(reference=('table_tilt',))
NAMES = list(MODEL.param_names)
TOLERANCES = tolerances_of(MODEL, {})
SPIN = 'spin about the z axis'
ENTRY = ProofEntry(2.0, 1.0, (0.4, 0.6), unit='rad/s', windows=9)
PROOF = {'accelerometer': ENTRY, 'gyroscope': ENTRY}


def calibration(**changes):
    """
    Return a calibration with nothing against it.

    Every sd a third of its tolerance, residuals as at rest.
    """
    sensor = {
        'noise_sd': [1e-3] * 3,
        'between_window_sd': 0.0,
        'wander_sd': 0.0,
        'chi2_per_dof': {'means': 50.0, 'spin': 1.0},
    }
    statistics = {
        'accelerometer': dict(sensor),
        'gyroscope': dict(sensor),
        'windows': {'static': 9, 'spin': 3},
        'dropped': {},
        'samples_used': {'all': 1000},
    }
    whole = Calibration(
        MODEL,
        MODEL.start(),
        np.diag((TOLERANCES / 3) ** 2),
        (DETERMINED,) * len(NAMES),
        statistics=statistics,
    )
    return replace(whole, **changes)


def with_status(status, *names, **changes):
    return calibration(
        status=tuple(status if name in names else DETERMINED for name in NAMES), **changes
    )


def with_statistics(sensor=None, **changes):
    base = calibration().statistics
    return calibration(
        statistics=base | (changes if sensor is None else {sensor: base[sensor] | changes})
    )


def words(found, *kinds):
    """Return the kinds of the statements, of some kinds only where given."""
    return [
        reason.word
        for reason in found.reasons
        if reason.word is not DECISION and (not kinds or reason.word in kinds)
    ]


def test_a_complete_calibration_names_the_limiting_parameter():
    covariance = calibration().covariance.copy()
    place = NAMES.index('gyroscope.bias.y')
    covariance[place, place] = (0.9 * TOLERANCES[place]) ** 2
    found = judge(calibration(covariance=covariance, proof=PROOF), TOLERANCES)
    assert found.word is HELPS and found.complete and found.within == found.requested == 24
    assert found.limiting == ('gyroscope.bias.y', pytest.approx(0.9)) and words(found) == [
        PARAMETERS
    ]
    document = judged(calibration(covariance=covariance, proof=PROOF), TOLERANCES)
    assert document.statistics['parameters'] == {
        'requested': 24,
        'determined': 24,
        'limiting': 'gyroscope.bias.y',
        'sd_over_tolerance': pytest.approx(0.9),
    }
    assert (
        document.decision == {'accelerometer': 'helps', 'gyroscope': 'helps'}
        and len(document.decision_reasons) == 2
    )


@pytest.mark.parametrize('status', [WEAK, HELD])
def test_a_parameter_that_is_not_determined_is_counted_and_has_the_motion_of_its_weak_direction(
    status,
):
    weak = (
        {'parameters': {'gyroscope.matrix.xx': 0.2, 'gyroscope.matrix.zz': 1.0}, 'needs': SPIN},
        {'parameters': {'gyroscope.matrix.zz': 0.3}, 'needs': 'something else'},
    )
    found = judge(
        with_status(status, 'gyroscope.matrix.zz', undetermined=weak, proof=PROOF), TOLERANCES
    )
    assert found.word is HELPS and not found.complete and found.within == 23
    statement = found.reasons[3]
    assert (statement.word, statement.next, statement.sensors) == (PARAMETERS, SPIN, ('gyroscope',))
    assert statement.what.startswith('gyroscope.matrix.zz: ')


def test_parameters_of_the_table_do_not_count():
    found = judge(
        with_status(HELD, 'reference.table_tilt.x', 'reference.table_tilt.y', proof=PROOF),
        TOLERANCES,
    )
    assert found.complete and found.requested == 24


@pytest.mark.parametrize(
    ('factor', 'kinds'), [(10.1, [WARNING]), (9.9, [NOTE]), (2.1, [NOTE]), (1.9, [])]
)
def test_residuals_in_motion_against_the_noise_at_rest(factor, kinds):
    found = judge(
        with_statistics('gyroscope', chi2_per_dof={'means': 1e3, 'spin': factor}), TOLERANCES
    )
    assert [
        r.word for r in found.reasons if f'{np.sqrt(factor):.1f} times the noise at rest' in r.what
    ] == kinds
    assert found.word is UNPROVEN  # without a proof, whatever the residuals are


@pytest.mark.parametrize(
    ('slow_over_fast', 'windows', 'kinds', 'keys'),
    [
        (0.9, {'static': 9, 'spin': 3}, [NOTE], [None]),  # louder, and white
        (1.5, {'static': 9, 'spin': 3}, [WARNING], ['diagnose']),
        (0.9, {'spin': 3}, [WARNING], ['diagnose']),  # without rests the slow part is the reference
    ],
)
def test_only_residuals_with_structure_show_an_incomplete_model(
    slow_over_fast, windows, kinds, keys
):
    statistics = with_statistics(
        'gyroscope', chi2_per_dof={'spin': 20.0}, slow_over_fast={'spin': slow_over_fast}
    ).statistics
    statistics = statistics | {'windows': windows}
    found = motion_misfits(calibration(statistics=statistics))
    assert [reason.word for reason in found] == kinds
    assert [reason.key for reason in found] == keys
    assert bool(incomplete_windows(statistics, 'gyroscope')) == (keys == ['diagnose'])


def test_a_regime_in_which_the_error_grows_is_a_warning_and_leaves_the_decision():
    regimes = {
        'turns': RegimeErrors(1.0, 2.0, (1.5, 2.5), unit='rad/s'),
        'rest': RegimeErrors(2.0, 1.0, (0.4, 0.6), unit='rad/s'),
    }
    found = judge(
        calibration(proof=PROOF | {'gyroscope': replace(ENTRY, regimes=regimes)}),
        TOLERANCES,
    )
    assert found.decisions['gyroscope'] is HELPS
    warnings = [reason for reason in found.reasons if reason.word is WARNING]
    assert (
        len(warnings) == 1 and 'turns' in warnings[0].what and warnings[0].sensors == ('gyroscope',)
    )


def test_without_rest_large_residuals_leave_it_unproven():
    """Stamps that are late by a period of the motion have the same errors on held-out windows."""
    base = replace(with_statistics('gyroscope', chi2_per_dof={'spin': 20.0}), proof=PROOF)
    restless = replace(base, statistics=base.statistics | {'windows': {'spin': 3}})
    assert judge(base, TOLERANCES).word is HELPS and judge(restless, TOLERANCES).decisions == {
        'accelerometer': HELPS,
        'gyroscope': UNPROVEN,
    }
    assert (
        judged(restless, TOLERANCES).decisions['gyroscope'] is UNPROVEN
        and 'period' in judged(restless, TOLERANCES).decision_reasons['gyroscope']
    )


def test_a_sensor_that_the_recording_does_not_determine_is_a_warning():
    gyroscope = [name for name in NAMES if name.startswith('gyroscope')]
    assert words(judge(with_status(HELD, *gyroscope), TOLERANCES), WARNING) == [WARNING]
    assert words(judge(with_status(HELD, *gyroscope[1:]), TOLERANCES), WARNING) == []


def test_a_value_beyond_any_instrument_is_a_warning():
    values = MODEL.start()
    values[NAMES.index('accelerometer.bias.y')] = 1000.0
    found = judge(calibration(values=values, proof=PROOF), TOLERANCES)
    assert found.decisions['accelerometer'] is UNPROVEN and [
        'check the units' in reason.next for reason in found.reasons if reason.word is WARNING
    ] == [True]


def test_decisions_come_first_then_parameters_and_warnings():
    base = with_status(WEAK, 'accelerometer.bias.x')
    found = judge(
        replace(
            base, statistics=with_statistics('gyroscope', chi2_per_dof={'spin': 20.0}).statistics
        ),
        TOLERANCES,
    )
    assert [reason.word for reason in found.reasons] == [
        DECISION,
        DECISION,
        PARAMETERS,
        PARAMETERS,
        WARNING,
    ]
    assert any(line.startswith('warning: ') for line in found.lines())


def test_an_uncertain_gravity_by_hand_is_one_parameter_in_addition_to_the_others():
    common = {'sd': 2e-3, 'tolerance': 1e-3, 'status': 'weak'}
    known, base = calibration(), with_statistics(by_hand={'common_scale': common})
    share = np.where([name.startswith('accelerometer.matrix') for name in NAMES], 2e-3**2, 0.0)
    base = replace(
        base, covariance=base.covariance + np.diag(share), covariance_terms={'gravity': share}
    )
    assert np.allclose(base.own_sd, known.sd, rtol=1e-12)
    found, without = judge(base, TOLERANCES), judge(known, TOLERANCES)
    assert [reason.key for reason in found.reasons if reason.key] == ['gravity'] and not any(
        reason.key for reason in without.reasons
    )
    assert (found.within, found.requested) == (
        without.within,
        without.requested + 1,
    ) and not found.complete
    assert found.limiting == ('accelerometer.common_scale', 2.0)
    assert [row[0] for row in parameter_rows(base)] == [*NAMES, 'accelerometer.common_scale']
    assert [row[:4] for row in parameter_rows(base)][:-1] == [
        row[:4] for row in parameter_rows(known)
    ]


def test_a_bias_that_moves_more_than_its_tolerance_is_a_note():
    tolerance = TOLERANCES[NAMES.index('gyroscope.bias.x')]
    for share, kinds in ((1.1, [NOTE]), (0.9, [])):
        found = judge(
            with_statistics(
                'gyroscope',
                between_window_sd=0.8 * share * tolerance,
                wander_sd=0.6 * share * tolerance,
            ),
            TOLERANCES,
        )
        assert words(found, NOTE, WARNING) == kinds


def test_many_lost_samples_are_worth_a_look():
    for count, word in ((20, WARNING), (5, NOTE)):
        note = judge(with_statistics(dropped={'imu late': count}), TOLERANCES).reasons[-1]
        assert note.word == word and f'{count} imu late' in note.what
        assert bool(note.next) == (word is WARNING)


def test_a_sensor_with_held_parameters_helps_in_the_recorded_motions_only():
    """Held-out data of tilts about one axis do not show the scale of that axis either."""
    names = ('accelerometer.matrix.xx', 'accelerometer.bias.x')
    held = tuple(HELD if name in names else DETERMINED for name in NAMES)
    complete = judged(calibration(proof=PROOF), TOLERANCES)
    incomplete = judged(calibration(proof=PROOF, status=held), TOLERANCES)
    assert incomplete.decisions == complete.decisions
    reasons = incomplete.decision_reasons
    count = sum(name.startswith('accelerometer') for name in complete.requested)
    assert f'2 of its {count}' in reasons['accelerometer']
    assert f'2 of its {count}' not in complete.decision_reasons['accelerometer']
    assert reasons['gyroscope'] == complete.decision_reasons['gyroscope']
    # An error of the model is no lack of motions.
    cause = ({'parameters': dict.fromkeys(names, 3.0), 'needs': EXCESS_REMEDY},)
    of_model = judged(
        calibration(proof=PROOF, status=held, undetermined=cause), TOLERANCES
    ).decision_reasons
    assert of_model['accelerometer'] == complete.decision_reasons['accelerometer']
    assert (exit_code(complete), exit_code(incomplete)) == (0, 3)
