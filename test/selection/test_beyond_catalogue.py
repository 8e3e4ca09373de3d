"""
Causes that no catalogue holds.

Where the rest sits, the formula that it follows, and the way of that formula into a model.
"""

import json
import re
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from imu_calibration.calibration.diagnosis.diagnosis_workflow import diagnosis_lines
from imu_calibration.cli.main import main
from imu_calibration.document import files
from imu_calibration.effects.expressions import ColumnGroup
from imu_calibration.references.turntable.applied_gain_of_windows import gains_of_formulas
from imu_calibration.references.turntable.diagnosis_of_windows import build_diagnosis
from imu_calibration.references.turntable.residuals import proposals
from imu_calibration.references.turntable.residuals.formulas import grammar
from imu_calibration.references.turntable.residuals.proposals import find_formulas, propose
from imu_calibration.references.turntable.residuals.residual_analysis import (
    ResidualAnalysis,
    without_superseded,
)
from imu_calibration.references.turntable.residuals.residual_blocks import (
    BlockFits,
    share_interval,
    share_removed,
)
from imu_calibration.references.turntable.residuals.window_regimes import find_regimes
from imu_calibration.references.turntable.residuals.window_variables import variables_of
from imu_calibration.references.turntable.selection.investigation import investigate
from imu_calibration.selection.gain import APPLIED, SAMPLES

from worlds import physics
from worlds.beyond_catalogue import judged, row_of
from worlds.candidates import with_candidates
from worlds.diagnosing import diagnose
from worlds.hiding import record
from worlds.misfit_coverage import COARSE
from worlds.no_reports import without_reports
from worlds.physics_beyond import Beyond

FEW = (
    'accel_quadratic+accel_cubic+accel_bias_drift+accel_thermal_bias+gyro_g_sensitivity+'
    'gyro_quadratic+gyro_bandwidth+gyro_bias_drift+gyro_thermal_bias+'
    'accel_thermal_bias_2+gyro_thermal_bias_2+gyro_thermal_scale+time_offset+'
    'load_compliance'
)
OF_MOTION = 'gyro_g_sensitivity+gyro_quadratic+gyro_thermal_scale+load_compliance'
"""Candidates beside a formula that is looked for."""
OF_RATES = 'gyro_g_sensitivity+gyro_quadratic+gyro_thermal_scale'
"""Candidates beside a formula that is known."""


@lru_cache(maxsize=None)
def recorded(kind=None, seed=5):
    """Return (recording, cause) of a session."""
    cause = Beyond(kind, seed) if kind else None
    recording = record(seed, None, through_bag=False, profile='quick', cause=cause)
    return recording, cause


@lru_cache(maxsize=None)
def looked(kind=None, seed=5):
    """Return (examination, sensor -> blocks, cause) of a session."""
    recording, cause = recorded(kind, seed)
    found = ResidualAnalysis.of(
        investigate(
            recording.windows, recording.table, with_candidates(recording.model, OF_MOTION)
        ),
    )
    return found, found.blocks, cause


def fits_of(found, blocks):
    space, used = found.problem.space, found.problem.search.indices(found.named)
    return BlockFits(blocks, used, prior_sd=space.prior_sd, prior_mean=space.prior_mean)


def proposed(found, blocks, fits):
    return propose(blocks, found.problem, fits, formulas=find_formulas(blocks, found.problem))


def test_the_grammar_is_arithmetic_with_units_and_speaks_of_what_it_says():
    formulas = grammar(3, True, 300.0)
    assert sum(len(formula.columns) for formula in formulas) > 1000 and len(set(formulas)) == len(
        formulas
    )
    by_text = {formula.columns[0]: formula for formula in formulas}
    assert (
        by_text['f_x * w_y'].unit('rad/s') == 'rad/s/(m/s^2)/(rad/s)'
        and by_text['w_x ** 3'].unit('rad/s') == 'rad/s/(rad/s)^3'
    )
    assert by_text['(temperature_c - temperature_ref_c) * f_z'].unit('m/s^2') == 'm/s^2/K/(m/s^2)'
    assert by_text['(temperature_c - temperature_ref_c) * f_z'].family == {'temperature', 'force'}
    assert (
        by_text['sign(f_x)'].unit('m/s^2') == by_text['cos(3 * angle_2)'].unit('m/s^2') == 'm/s^2'
    )
    assert {f.columns[0] for f in formulas if f.smooth} >= {
        '(temperature_c - temperature_ref_c) ** 2'
    } and not by_text['w_x'].smooth
    for formula in formulas:
        for column in formula.columns:
            assert ColumnGroup('c', (column,) if isinstance(column, str) else column).names, (
                'reads and speaks of something'
            )


def test_the_sense_of_a_rate_is_not_that_of_the_rate_of_the_earth():
    """
    At rest the sign of a rate is that of 7.3e-5 rad/s, or of noise.

    A column of it would shake every bias there.
    """
    texts = [text for formula in grammar(3, True, 300.0) for text in np.ravel(formula.columns)]
    assert (
        any('tanh(w_x' in text for text in texts)
        and any('tanh(joint_rate_1' in text for text in texts)
        and 'sign(f_x)' in texts
    )
    assert not any('sign(w' in text or 'sign(joint' in text for text in texts)


@pytest.mark.parametrize('span, warms', [(None, False), (0.3, False), (4.0, True)])
def test_a_temperature_that_stays_is_no_cause(span, warms):
    _, blocks, _ = looked()
    changed = {
        sensor: replace(
            of,
            ref=replace(
                of.ref,
                temperature_c=None
                if span is None
                else np.linspace(25.0, 25.0 + span, len(of.ref.rate_s)),
            ),
        )
        for sensor, of in blocks.items()
    }
    for of in changed.values():
        assert of.warms is warms
        assert (
            any('temperature' in str(formula.columns) for formula in proposals._grammar(of))
            is warms
        )
        assert (
            any(
                'temperature' in variable.name
                for variable in variables_of(of, ('outer', 'middle', 'inner'))
            )
            is warms
        )


@pytest.mark.filterwarnings('error')
def test_a_recording_without_noise_is_judged_too():
    """
    As of a simulator whose noise is off.

    No sample is taken for exact, and nothing is divided by nothing.
    """
    recording = record(5, None, 'none', through_bag=False, profile='quick', **COARSE)
    found = diagnose(recording.windows, recording.table, recording.model, candidates=FEW)
    assert not found.findings and not found.unexplained['accelerometer'].significant
    assert found.unexplained['gyroscope'].proposal is None


def test_blocks_of_a_recording_that_hides_nothing_are_noise():
    found, blocks, _ = looked()
    for sensor in blocks:
        plain = fits_of(found, blocks[sensor]).fit()
        assert abs(plain.excess) < 5 * np.sqrt(2 * plain.locked_residual.size)


@pytest.mark.parametrize(
    'kind, text',
    [
        ('scale_under_load', 'f_'),
        ('gyro_cubic', '** 3'),
        ('stray_field_accel', 'sin('),
    ],
)
def test_a_formula_is_found_and_judged_on_windows_that_took_no_part(kind, text):
    found, blocks, cause = looked(kind)
    proposal = found.proposals[cause.kind.sensor]
    assert (
        text in proposal.columns[0]
        and proposal.family == cause.kind.family
        and set(proposal.axes) == cause.axes
    )
    assert proposal.share > 0.95 and proposal.ci95[0] > 0.9 and proposal.reduction > 0.8
    assert proposal.nearest[0] in proposal.sentence
    size = sum(proposal.sizes)
    assert size == pytest.approx(np.sqrt((cause.signal**2).sum(axis=1).mean()), rel=0.6), (
        'as large as what was hidden'
    )


def test_nothing_is_proposed_where_nothing_is_hidden_even_when_asked():
    found, blocks, _ = looked()
    for sensor in blocks:
        assert proposed(found, blocks[sensor], fits_of(found, blocks[sensor])) is None
        assert not find_regimes(
            blocks[sensor],
            found.problem,
            found.problem.search.indices([]),
            joint_names=('outer', 'middle', 'inner'),
        )


def test_a_formula_that_takes_little_off_held_out_windows_is_a_story(monkeypatch):
    found, blocks, cause = looked('scale_under_load')
    fits = fits_of(found, blocks['gyroscope'])
    monkeypatch.setattr(proposals, 'share_removed', lambda before, after: 0.5)
    assert proposed(found, blocks['gyroscope'], fits) is None


def test_halves_that_disagree_make_no_formula(monkeypatch):
    found, blocks, cause = looked('scale_under_load')
    sensor = blocks['gyroscope']
    late = sensor.time > np.median(sensor.time)
    turned = tuple(
        np.concatenate([part[:, :-1], np.where(late, -1.0, 1.0)[:, None] * part[:, -1:]], axis=1)
        for part in sensor.design
    )
    upset = replace(sensor, design=turned)
    told = proposed(found, upset, fits_of(found, upset))
    assert told is None or 'f_z * w' not in str(told.columns)


def test_shares_are_of_the_locked_windows():
    found, blocks, cause = looked('gyro_cubic')
    fits = fits_of(found, blocks['gyroscope'])
    before = fits.fit()
    true = np.stack(
        [
            np.interp(blocks['gyroscope'].time, cause.time, cause.signal[:, axis])
            for axis in range(3)
        ],
        axis=1,
    )[:, None]
    after = fits.fit(true)
    assert len(before.window) == blocks['gyroscope'].locked.sum() and set(before.window) == set(
        np.flatnonzero(found.problem.locked)
    )
    low, high = share_interval(before, after, np.random.default_rng(0))
    assert low <= share_removed(before, after) <= high


@pytest.mark.long
def test_the_place_is_found():
    cause = Beyond('cable_in_an_arc', 6)
    row, known = row_of(6, 'cable_in_an_arc', 'white', cause, candidates=FEW)
    assert row['flagged'] and row['f1'] > 0.7 and row['axis'] and not row['found'], row
    assert len(known) == 24 and all(sd > 0 for _, sd in known.values())


def hidden_rms(cause, found):
    """Return the rms of the hidden signal over the samples of the locked windows and the axes."""
    time = np.concatenate(
        [window.time for window, locked in zip(found.used, found.problem.locked) if locked]
    )
    signal = [np.interp(time, cause.time, column) for column in cause.signal.T]
    return float(np.sqrt(np.mean(np.square(signal))))


def test_the_gain_of_a_formula_is_that_of_corrected_readings():
    """
    Beyond the noise at rest the error before is the hidden signal, all samples of locked windows.

    It is a root mean square over the axes; the bias that the fit absorbs is within 10 %.
    """
    (_, cause), (found, _, _) = recorded('scale_under_load'), looked('scale_under_load')
    proposal = found.proposals['gyroscope']
    gain = gains_of_formulas(found, [proposal])['gyroscope']
    hidden = hidden_rms(cause, found)
    before, after = gain.beyond_noise
    assert (gain.of, gain.measure) == (APPLIED, SAMPLES)
    assert before == pytest.approx(hidden, rel=0.1)
    assert after < 0.3 * before  # a noise variance known to 4 % is a fifth of the noise here
    assert gain.ci95[0] > 0.0


def test_the_formula_is_printed():
    (_, cause), (found, _, _) = recorded('scale_under_load'), looked('scale_under_load')
    lines = '\n'.join(diagnosis_lines(build_diagnosis(without_superseded(found))))
    assert all(
        part in lines
        for part in ('f_z * w', f'axis {min(cause.axes)}', found.proposals['gyroscope'].sentence)
    )
    # The printed error beyond noise is that of the hidden signal in the held-out windows, exactly.
    printed = re.search(r'beyond the noise at rest ([\d.e-]+) deg/s before', lines)
    assert float(printed[1]) * np.pi / 180 == pytest.approx(hidden_rms(cause, found), rel=0.25)


def test_a_mount_that_bends_is_named_in_both_sensors():
    arcmin_per_g = 2.97e-5
    recording = record(
        3,
        {'load_compliance': 0.5 * arcmin_per_g * np.random.default_rng(3).normal(size=(3, 3))},
        through_bag=False,
        profile='quick',
        **COARSE,
    )
    found = diagnose(recording.windows, recording.table, recording.model, candidates=OF_MOTION)
    assert [finding.effect for finding in found.findings] == ['load_compliance']
    assert not any(rest.significant for rest in found.unexplained.values())


def test_a_cause_of_the_table_that_spoils_the_other_sensor_is_no_cause(monkeypatch):
    found, blocks, cause = looked('scale_under_load', 6)
    search = found.problem.search
    question = next(q for q in found.problem.questions if q.name == 'load_compliance')
    assert not search.shows_alike([question], question) and not found.named


@pytest.mark.long
def test_the_formula_goes_into_a_model_that_simulates_calibrates_compensates_and_is_diagnosed(
    tmp_path, capsys
):
    session = physics.make_session(
        5,
        None,
        'white',
        cause=Beyond('scale_under_load', 5),
        profile='quick',
        **COARSE,
    )
    physics.write_bag(session, tmp_path / 'bag')
    from imu_calibration.core import documents

    (tmp_path / 'table.yaml').write_text(documents.to_text(session.table))
    table = ['--table', str(tmp_path / 'table.yaml')]
    assert main(
        [
            'diagnose',
            str(tmp_path / 'bag'),
            *table,
            '--output',
            str(tmp_path / 'out'),
            '--candidates',
            OF_RATES,
        ]
    ) in (
        0,
        3,
    )
    assert 'extended.yaml' in capsys.readouterr().out
    extended = tmp_path / 'out' / 'extended.yaml'
    entry = json.loads((tmp_path / 'out' / 'diagnosis.json').read_text())['unexplained'][
        'gyroscope'
    ]['proposals'][0]
    name = entry['terms'][0]['name']
    known = files.read_calibration(extended)
    np.testing.assert_allclose(
        known.value('gyroscope', name),
        entry['terms'][0]['value'],
        atol=5 * np.max(entry['terms'][0]['sd']),
    )
    assert name in (tmp_path / 'out' / 'report.html').read_text()
    model = ['--effects', str(extended), '--gyroscope-model', f'bias+matrix+{name}']
    with without_reports():
        assert main(
            [
                'diagnose',
                str(tmp_path / 'bag'),
                *table,
                *model,
                '--output',
                str(tmp_path / 'again'),
                '--candidates',
                OF_RATES,
            ]
        ) in (0, 3)
    again = json.loads((tmp_path / 'again' / 'diagnosis.json').read_text())
    assert not again['unexplained']['gyroscope']['significant'] and not again['findings']
    with without_reports():
        assert main(
            [
                'diagnose',
                str(tmp_path / 'bag'),
                *table,
                '--effects',
                str(extended),
                '--output',
                str(tmp_path / 'named'),
                '--candidates',
                OF_RATES,
            ]
        ) in (0, 3)
    assert [
        f['effect']
        for f in json.loads((tmp_path / 'named' / 'diagnosis.json').read_text())['findings']
    ] == [name]
    assert (
        main(
            [
                'simulate',
                '--calibration',
                str(extended),
                *table,
                '--profile',
                'quick',
                '--imu-rate',
                '50',
                '--output',
                str(tmp_path / 'bag2'),
            ]
        )
        == 0
    )
    assert main(
        [
            'compensate',
            str(tmp_path / 'bag'),
            '--calibration',
            str(extended),
            '--anyway',
            '--output',
            str(tmp_path / 'bag3'),
        ]
    ) in (0, 3)


def diagnosed(seed, cause, candidates):
    """Return the diagnosis of a session with a cause."""
    recording = record(seed, None, 'realistic', through_bag=False, cause=cause, **COARSE)
    return diagnose(recording.windows, recording.table, recording.model, candidates=candidates)


@pytest.mark.long
def test_a_finding_that_a_formula_does_without_is_withdrawn_and_one_that_is_there_stays():
    """
    A scale that settles while it warms up looks like a thermal one.

    What is there stays beside another cause.
    """
    settling = Beyond('gyro_scale_settling', 141)
    found = diagnosed(141, settling, 'gyro_thermal_scale')
    assert not found.findings and judged(found, settling)['family']
    warm = Beyond('sticks_when_warm', 81013)
    found = diagnosed(81013, warm, 'accel_thermal_bias+accel_thermal_bias_2')
    row = judged(found, warm)
    assert not found.findings and row['flagged'] and row['axis'] and row['f1'] > 0.999, (
        'a step when it is warm looks like a curve of the temperature'
    )
    recording = record(
        5,
        {'gyro_g_sensitivity': None},
        through_bag=False,
        cause=Beyond('gyro_cubic', 5, 0.3),
        profile='quick',
        **COARSE,
    )
    found = diagnose(recording.windows, recording.table, recording.model, candidates=OF_RATES)
    assert [finding.effect for finding in found.findings] == [
        'gyro_g_sensitivity'
    ] and found.unexplained['gyroscope'].proposal is not None


@pytest.mark.long
def test_a_formula_of_the_session_is_not_written_into_a_model_for_other_sessions(tmp_path, capsys):
    session = physics.make_session(
        5,
        None,
        'white',
        cause=Beyond('gyro_scale_settling', 5),
        profile='quick',
        **COARSE,
    )
    physics.write_bag(session, tmp_path / 'bag')
    from imu_calibration.core import documents

    (tmp_path / 'table.yaml').write_text(documents.to_text(session.table))
    options = ['--table', str(tmp_path / 'table.yaml'), '--output', str(tmp_path / 'out')]
    arguments = ['diagnose', str(tmp_path / 'bag'), *options, '--candidates', 'gyro_thermal_scale']
    assert main(arguments) in (0, 3)
    document = json.loads((tmp_path / 'out' / 'diagnosis.json').read_text())
    terms = [
        term['definition']['column']
        for rest in document['unexplained'].values()
        for proposal in rest['proposals']
        for term in proposal['terms']
    ]
    assert any('time' in str(column) for column in terms)
    assert not (tmp_path / 'out' / 'extended.yaml').exists()
    assert 'left out of extended.yaml' in capsys.readouterr().out
