"""
The report of a diagnosis.

The finding, its evidence and its picture, on a recording with a hidden g-sensitivity.
"""

import json
import re
from dataclasses import replace
from html import unescape
from importlib import resources

import numpy as np
import pytest
from refusal import refused

from imu_calibration.calibration.diagnosis.diagnose import diagnose_recording
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import SampleBlock
from imu_calibration.document.decision import DECISION, PARAMETERS
from imu_calibration.document.outcome import exit_code
from imu_calibration.effects.catalogue import CATALOGUE, term
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.references.turntable.residuals.proposals import Proposal
from imu_calibration.references.turntable.table_reference import TableReference
from imu_calibration.report.diagnosis_page import (
    cause_of,
    diagnosis_report,
    draw_finding,
    explained_share,
    variables,
)
from imu_calibration.report.page import chance
from imu_calibration.selection.gain import APPLIED, Gain
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.sensor_noise import GRADES
from imu_calibration.simulation.session import SimulationOptions, random_values, simulate_session

from worlds.candidates import FEW
from worlds.tables import three_axis_table

TABLE = three_axis_table()
MODEL = SensorModel(gyroscope=('bias', 'matrix', 'gyro_g_sensitivity'))


@pytest.fixture(scope='module')
def result():
    """The diagnosis of a short session; without a temperature one candidate cannot be tested."""
    values = random_values(MODEL, 'industrial', 9)
    values[MODEL.slices['gyroscope', 'gyro_g_sensitivity']] = 8e-5 * np.array(
        [1, -0.5, 0.3, 0.2, 1, -0.4, 0.5, 0.1, -1]
    )
    imu, joints, _ = simulate_session(
        MODEL,
        values,
        TABLE,
        profile=make_profile('quick', 9, TABLE),
        options=SimulationOptions(50.0, 50.0, GRADES['industrial'].noise),
        seed=9,
    )
    block = SampleBlock(imu, joints)
    return diagnose_recording(
        [block],
        TableReference(TABLE),
        CalibrationOptions(catalogue=CATALOGUE.with_candidates(f'{FEW}+gyro_thermal_bias')),
        provenance={'bags': [{'name': 'session', 'sha256': '0'}]},
    )


@pytest.mark.long
def test_the_finding_is_told_drawn_and_measured(result):
    assert [f.effect for f in result.diagnosis.findings][:1] == ['gyro_g_sensitivity']
    assert result.lines[0].startswith('1. gyro_g_sensitivity')
    page = diagnosis_report(result)
    assert diagnosis_report(result) == page
    head = page[: page.index('<nav>')]
    assert 'cause found' in head or 'causes found' in head
    assert 'respond to specific force' in head
    assert page.count('<svg') == len(result.diagnosis.findings)
    plain = page.replace(
        resources.files('imu_calibration.report')
        .joinpath('templates/uPlot.iife.min.js')
        .read_text()
        .strip(),
        '',
    )
    assert 'Leon Sorokin' in plain  # the notice of the embedded library
    assert len(page) - len(plain) > 50_000 and page.count('<script>') == page.count('<script') == 1
    assert not re.search(r'https?://(?!www\.w3\.org)|\bsrc=|fetch\(|import\(', plain)
    assert len(page.encode()) < 4e6
    for section in (
        'findings',
        'unexplained',
        'simulation',
        'candidates',
        'untested',
        'parameters',
    ):
        assert f'<section id="{section}">' in page
    for row in result.diagnosis.candidates:
        assert row.effect.replace('_', ' ') in page


def test_it_is_drawn_against_its_cause(result):
    finding = result.diagnosis.findings[0]
    assert finding.gain.sensor == 'gyroscope'
    assert cause_of(result.diagnosis, finding.gain.sensor, finding.against)[1].startswith(
        'specific force'
    )


def test_a_figure_is_svg_pdf_axes_and_arrays(result, tmp_path):
    drawing = draw_finding(result.diagnosis, result.diagnosis.findings[0], 1)
    for name, head in (('p.pdf', b'%PDF-1.4'), ('p.svg', b'<svg '), ('p.png', b'\x89PNG')):
        drawing.save(tmp_path / name)
        assert (tmp_path / name).read_bytes().startswith(head)
    with refused(InputError, 'figure_suffix', 'p.jpg'):
        drawing.save(tmp_path / 'p.jpg')
    # The same figure may be written again; a file with other content is not replaced silently.
    drawing.save(tmp_path / 'p.pdf')
    other = tmp_path / 'other.svg'
    other.write_text('notes')
    with refused(InputError, 'file_exists', 'other.svg'):
        drawing.save(other)
    assert other.read_text() == 'notes'
    drawing.save(other, force=True)
    assert other.read_bytes().startswith(b'<svg ')
    assert drawing.bytes_as('pdf') == drawing.bytes_as('pdf')
    left, right = drawing.data
    axis, _, values = cause_of(result.diagnosis, 'gyroscope', ('force',))
    np.testing.assert_array_equal(left['lines'][0][1], values)
    np.testing.assert_allclose(
        right['lines'][0][2],
        np.rad2deg(result.diagnosis.traces.after['gyroscope'][:, axis]),
        rtol=1e-12,
    )
    assert left['x'].startswith('specific force') and [
        axes.get_xlabel() for axes in drawing.axes
    ] == [left['x'], right['x']]


def test_a_joint_goes_by_its_name(result):
    labels = variables(result.diagnosis.traces, result.diagnosis.baseline.model.joint_names)
    assert [label for label in labels if label.startswith('angle')] == [
        'angle of outer, deg',
        'angle of middle, deg',
        'angle of inner, deg',
    ]
    by_hand = replace(
        result.diagnosis.traces, position=np.empty((len(result.diagnosis.traces.time), 0))
    )
    assert not [
        label
        for label in variables(by_hand, ('outer', 'middle', 'inner'))
        if label.startswith('angle')
    ]


def test_the_document_and_the_calibration_agree(result):
    parameters = result.document['findings'][0]['parameters']
    for name, entry in parameters.items():
        assert result.calibration.values[
            result.calibration.param_names.index(name)
        ] == pytest.approx(entry['value'], rel=1e-9)
    assert exit_code(result.calibration) in (0, 3)


def test_the_share_that_a_variable_explains_is_one_for_its_function_and_none_for_noise():
    rng = np.random.default_rng(0)
    values = rng.uniform(-1, 1, 4000)
    assert explained_share(values, values**2) > 0.95
    assert explained_share(values, rng.normal(size=4000)) < 0.02
    assert explained_share(values, np.zeros(4000)) == 0.0


def test_chances_that_underflow_are_not_printed_as_nothing():
    assert chance(0.0) == 'below 10⁻⁹⁹'
    assert chance(0.02) == '0.020'


@pytest.fixture(scope='module')
def of_formula(result):
    """
    The same result with an unexplained residual of gyroscope y.

    The residual follows a formula, and there is no finding.
    """
    effect = term(
        'gyro_proposed_1',
        sensor='gyroscope',
        column='w_z ** 3',
        unit='rad/s/(rad/s)^3',
        tolerance=1e-5,
        text='A formula.',
    )
    proposal = Proposal(
        'gyroscope',
        (effect,),
        (np.array([0.0, 2e-4, 0.0]),),
        (np.full(3, 3e-6),),
        frozenset({'rate'}),
        ('y',),
        0.96,
        (0.91, 0.99),
        0.8,
        1e-30,
        ('w_z',),
        ('gyro_quadratic', 0.4),
        'turn about two axes',
    )
    diagnosis = result.diagnosis
    rest = replace(
        diagnosis.unexplained['gyroscope'],
        significant=True,
        rms=5e-4,
        axes=('y',),
        proposal=proposal,
    )
    return replace(
        result,
        diagnosis=replace(
            diagnosis,
            findings=(),
            unexplained={**diagnosis.unexplained, 'gyroscope': rest},
            formula_gains={
                'gyroscope': Gain(
                    'gyroscope', 'samples', 5e-3, 3e-3, (0.35, 0.45), 12, APPLIED, noise_rms=3e-3
                )
            },
        ),
    )


def test_the_headline_of_a_formula_states_its_share(of_formula):
    page = diagnosis_report(of_formula)
    headline = page.partition('<p class="word">')[2].partition('</p>')[0]
    assert '96 %' in headline and 'gyroscope' in headline
    # Advice once.
    assert 'section id="formulas"' in page and page.lower().count('turn about two axes') == 1
    assert not any('nothing found' in line for line in of_formula.lines)


def test_the_gain_of_a_formula_is_printed_with_and_without_the_noise(of_formula):
    """Of 5 mrad/s and 3 mrad/s, noise 3 mrad/s: 4 mrad/s and nothing beyond the noise."""
    gain = of_formula.document['unexplained']['gyroscope']['proposals'][0]['gain']
    assert (gain['heldout_rms_before'], gain['heldout_rms_after']) == (5e-3, 3e-3)
    assert gain['beyond_noise_before'] == pytest.approx(4e-3, rel=1e-12)
    assert gain['beyond_noise_after'] == 0.0
    assert any(
        all(size in line for size in ('0.286 deg/s', '0.172 deg/s', '0.229 deg/s', '35 to 45 %'))
        for line in of_formula.lines
    )
    page = diagnosis_report(of_formula)
    assert '0.286' in page and '0.172' in page


def test_the_distance_agrees_with_the_held_out_gain(result):
    """The reduction on all windows and that on held-out windows have overlapping intervals."""
    gain = result.diagnosis.gain
    of_all = result.diagnosis.traces.distances[gain.sensor].gains[gain.measure]
    assert gain.ci95[0] < of_all.ci95[1] and of_all.ci95[0] < gain.ci95[1]
    assert of_all.reduction == pytest.approx(gain.reduction, abs=0.08)
    bands = result.document['simulation_distance']['gyroscope']['bands']
    assert max(bands[0]['after']) < 0.2 * max(bands[0]['before'])


def test_the_segments_are_measured_and_simulated(result):
    """
    Over a segment the extended model's simulation differs from measurement by noise.

    The simulation of the baseline differs by more.
    """
    for segment in result.diagnosis.traces.segments['gyroscope']:
        assert 5.0 < np.ptp(segment.time) < 11.0 and len(segment.time) <= 800
        before, after = (
            np.mean(segment.signals['measured'] - segment.signals[f'simulated {when}'])
            for when in ('before', 'after')
        )
        assert abs(after) < 0.6 * abs(before)


def test_the_charts_have_the_data_of_each_sensor_and_axis(result):
    """
    Five rows of three axes for each sensor, the same numbers as the traces.

    The cause is the first variable.
    """
    charts = [
        json.loads(unescape(each))
        for each in re.findall(r'data-chart="([^"]*)"', diagnosis_report(result))
    ]
    assert [chart['title'] for chart in charts[:3]] == [
        'accelerometer x',
        'accelerometer y',
        'accelerometer z',
    ] and len(charts) == 30
    overlay, difference = charts[15:18], charts[18:21]
    for segment, signals, errors in zip(
        result.diagnosis.traces.segments['gyroscope'], overlay, difference
    ):
        assert signals['names'] == ['measured', 'simulated before', 'simulated after'] and errors[
            'names'
        ] == ['before', 'after']
        np.testing.assert_allclose(
            signals['data'][1], np.rad2deg(segment.signals['measured']), rtol=1e-4, atol=1e-12
        )
        np.testing.assert_allclose(
            errors['data'][2],
            np.rad2deg(segment.signals['measured'] - segment.signals['simulated after']),
            rtol=1e-4,
            atol=1e-12,
        )
    assert charts[21]['kind'] == 'points' and charts[21]['x'].startswith('specific force')
    assert charts[24]['kind'] == 'log' and sum(charts[27]['data'][1]) > 0.95 * len(
        result.diagnosis.traces.time
    )


def test_the_extended_calibration_has_its_decisions_and_the_motions_for_undetermined_parameters(
    result,
):
    reasons = [
        reason
        for reason in result.calibration.judgement.reasons
        if reason.word in (DECISION, PARAMETERS)
    ]
    assert {reason.word for reason in reasons} == {DECISION, PARAMETERS}
    section = unescape(diagnosis_report(result)).partition('<section id="parameters">')[2]
    assert all(
        text[1:] in section for reason in reasons for text in (reason.what, reason.advice()) if text
    )
