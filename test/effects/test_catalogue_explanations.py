"""
Nothing is read out of an effect's name.

An effect that is added here alone goes through everything, as one of the catalogue's own does.
"""

import ast
import pickle
import re
import subprocess
import sys
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from refusal import refused

import imu_calibration as imu
from imu_calibration.compensation.kernel import make_kernel
from imu_calibration.compensation.stream import CompensationStream
from imu_calibration.core.errors import DocumentError, InputError
from imu_calibration.core.samples import ImuSamples, SampleBlock
from imu_calibration.document.calibration_text import calibration_from_text, calibration_to_text
from imu_calibration.effects.base import Effect
from imu_calibration.effects.catalogue import CATALOGUE, Catalogue, from_definition, term
from imu_calibration.effects.expressions import ColumnGroup
from imu_calibration.effects.forward_equations import (
    coefficient_jacobian,
    coefficients,
    sensor_output,
)
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.references.turntable.collector import from_bytes, require_columns, to_bytes
from tools.tolerance_file import rendered

from worlds.random_motion import random_reference

OTHERS = 'accel_quadratic+gyro_g_sensitivity+gyro_bias_drift'
"""Candidates beside the added effects."""
ROOT = Path(__file__).resolve().parents[2]
ALSO_WORDS = {'bias', 'matrix'}
"""Names that are plain words too: keys of documents and headings use them."""
KEYS_ELSEWHERE = {
    'allan': {'time_constant'},
    'core': {'time_constant'},
    'estimation': {'earth_rate'},
    'targets': {'time_offset'},
}
"""
Package -> words that are keys in its own documents, of noise, of units, of terms of a variance and
of other programs, and speak of no effect there.
"""


def spoken_of(path):
    """
    Return the words of a module in which an effect's name stands.

    They include the words with which a name would be asked for its meaning.
    """
    names = {name for _, name in CATALOGUE.effects()}
    cuts = [(name, k) for name in names for k, letter in enumerate(name) if letter == '_']
    parts = {name[k:] for name, k in cuts} | {name[: k + 1] for name, k in cuts} | {'time_constant'}
    found, texts, asked = [], [], set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Constant):
            if isinstance(node.value, str) and re.fullmatch(r'[\w.+:@]+', node.value):
                texts.append(node)
        elif (
            isinstance(node, ast.Compare)
            and isinstance(node.ops[0], (ast.In, ast.NotIn))
            and getattr(node.comparators[0], 'attr', '') not in ('uses', 'needs')
        ):
            asked.add(id(node.left))
    for node in texts:
        text = node.value
        words = re.split('[+.:@]', text)
        known = set(words) & names if words[0] not in ALSO_WORDS else set(words[1:]) & names
        if (
            known
            or set(words) & parts
            or id(node) in asked
            and len(text) > 3
            and any(text in name for name in names - {text})
        ):
            found.append(f'{path.relative_to(ROOT)}:{node.lineno}: {text}')
    return found


def test_no_effect_is_known_by_name_outside_its_package():
    files = [
        path
        for path in (ROOT / 'imu_calibration').rglob('*.py')
        if path.relative_to(ROOT).parts[1] != 'effects'
    ]
    found = [(path.parent.name, line) for path in files for line in spoken_of(path)]
    assert not [
        line
        for package, line in found
        if line.rpartition(': ')[2] not in KEYS_ELSEWHERE.get(package, ())
    ]
    looked_up = re.compile(
        rf"(slices|value|has|with_effect|find)[(\[][^()\[\]]*'({'|'.join(ALSO_WORDS)})'|=="
        rf" '({'|'.join(ALSO_WORDS)})'"
    )
    assert not [
        f'{path.name}: {found[0]}'
        for path in files
        if (found := looked_up.search(path.read_text()))
    ]


@pytest.mark.parametrize(
    'line',
    [
        "x.endswith('_bias_drift')",
        "name == 'lever_arm'",
        "'gyro_' + name",
        "['bias+matrix+accel_cubic']",
        "c.param_names.index('gyroscope.matrix.xx')",
        "'thermal' in text",
    ],
)
def test_the_search_for_names_finds_them(tmp_path, monkeypatch, line):
    monkeypatch.setattr(sys.modules[__name__], 'ROOT', tmp_path)
    (tmp_path / 'module.py').write_text(line)
    assert spoken_of(tmp_path / 'module.py')


# Effects that no catalogue holds: the gyroscopes' elements bend under specific force, so that
# products of its components act (anisoelasticity); the accelerometers respond to all three
# components at once; and the gyroscopes' scale factors settle after turn-on.
# settle after turn-on.
MILLI_G = 9.80665e-3
ADDED = {
    'gyro_anisoelasticity': {
        'sensor': 'gyroscope',
        'column': ['f_y * f_z', 'f_z * f_x', 'f_x * f_y'],
        'unit': '(rad/s)/(m/s^2)^2',
        'tolerance': 1e-6,
        'largest': 1e-4,
        'text': 'The gyroscopes respond to products of specific force.',
    },
    'accel_triple_product': {
        'sensor': 'accelerometer',
        'column': 'f_x * f_y * f_z',
        'unit': '(m/s^2)^-2',
        'tolerance': 2e-5,
        'largest': 1e-3,
        'text': 'The accelerometers respond to the product of all three components.',
    },
    'gyro_scale_settling': {
        'sensor': 'gyroscope',
        'column': ['w_x * exp(-time / tau)', 'w_y * exp(-time / tau)', 'w_z * exp(-time / tau)'],
        'unit': '1',
        'tolerance': 1e-3,
        'largest': 0.05,
        'text': 'The gyroscope scale factors settle after turn-on.',
    },
}
MINE = CATALOGUE.with_effects(*(term(name, **definition) for name, definition in ADDED.items()))
FORMULA = {
    'gyro_anisoelasticity': lambda f, w, t, v: (
        v * np.stack([f[:, 1] * f[:, 2], f[:, 2] * f[:, 0], f[:, 0] * f[:, 1]], axis=1)
    ),
    'accel_triple_product': lambda f, w, t, v: f.prod(axis=1)[:, None] * v,
    'gyro_scale_settling': lambda f, w, t, v: v[:3] * w * np.exp(-t / v[3])[:, None],
}
"""What the effects do, written without the catalogue."""
SENSOR = {name: definition['sensor'] for name, definition in ADDED.items()}


def with_values(name, share=1.0):
    """Return (model of bias, matrix and an added effect, values)."""
    model = SensorModel(catalogue=MINE).with_effect(SENSOR[name], name)
    values = model.start()
    part = model.slices[SENSOR[name], name]
    values[part][:3] = share * ADDED[name]['largest'] * np.array([1.0, -0.6, 0.8])
    return model, values


@pytest.mark.parametrize('name', ADDED)
def test_an_added_effect_does_what_its_text_says(name):
    (model, values), ref, sensor = with_values(name), random_reference(40, seed=3), SENSOR[name]
    plain = SensorModel()
    change = sensor_output(model, sensor, values, ref=ref) - sensor_output(
        plain, sensor, plain.start(), ref=ref
    )
    np.testing.assert_allclose(
        change,
        FORMULA[name](ref.force_s, ref.rate_s, ref.time, values[model.slices[sensor, name]]),
        rtol=1e-9,
        atol=1e-12,
    )


@pytest.mark.parametrize('name', ADDED)
def test_its_derivative_is_that_of_differences(name):
    (model, values), ref, sensor = with_values(name), random_reference(40, seed=3), SENSOR[name]
    at = model.at(values)
    design = np.concatenate(
        [group.columns(ref, at.full_point()) for group in at.layout(sensor).groups.values()], axis=1
    )
    slopes = np.einsum('nc,cap->nap', design, coefficient_jacobian(at, sensor, values))
    for k in range(model.slices[sensor, name].start, model.slices[sensor, name].stop):
        step = np.zeros(len(values))
        step[k] = 1e-4 * max(abs(values[k]), 1e-3)
        ends = [
            sensor_output(model.at(values + sign * step), sensor, values + sign * step, ref=ref)
            for sign in (1, -1)
        ]
        np.testing.assert_allclose(
            slopes[:, :, k], (ends[0] - ends[1]) / (2 * step[k]), rtol=1e-6, atol=1e-9
        )


@lru_cache(maxsize=None)
def session(*names):
    """Return a simulated session of an IMU with added effects."""
    # A minute determines effects of force; a scale that settles and work by hand need two.
    profile = 'six_faces' if names == INVERTED else 'quick'
    return imu.simulate(
        profile, effects=names, size=0.5, seed=5, catalogue=MINE, imu_rate=50.0, joint_rate=50.0
    )


ASKED = {'accelerometer': 'bias+matrix+accel_size_effect', 'gyroscope': 'bias+matrix'}


def models(*names):
    return {
        f'{sensor}_model': '+'.join([base, *(name for name in names if SENSOR[name] == sensor)])
        for sensor, base in ASKED.items()
    }


INVERTED = ('gyro_anisoelasticity', 'accel_triple_product')


def test_they_are_simulated_calibrated_and_reported():
    made = session(*INVERTED)
    found = imu.calibrate(
        made.samples, made.table, catalogue=MINE, model_as_asked=True, **models(*INVERTED)
    )
    page = found.report
    for name in INVERTED:
        value, truth = (
            calibration.value(SENSOR[name], name) for calibration in (found.calibration, made.truth)
        )
        sd = found.calibration.sd[found.calibration.model.slices[SENSOR[name], name]]
        assert np.all(np.abs(value - truth) < 4 * sd) and np.all(sd < 0.2 * np.abs(truth)), name
        assert name in page and ADDED[name]['text'] in page


def test_compensation_takes_it_out_offline_and_live():
    from imu_calibration.nodes.message_compensation import LiveCompensation
    from msg_adapters.imu import FIELDS
    from msg_adapters.write import encode_imu
    from validation.imu_messages import parse_imu

    truth = replace(session(*INVERTED).truth, frame_id='')
    ref = random_reference(400, seed=3)
    model, values = truth.model, truth.values
    measured = [
        sensor_output(model, sensor, values, ref=replace(ref, alpha_s=np.zeros((400, 3))))
        for sensor in ('accelerometer', 'gyroscope')
    ]
    kernel = make_kernel(truth)
    got = np.array([kernel(*f, *w, 0.0, 0.0, 0.0, 0.0) for f, w in zip(*measured, strict=True)])
    np.testing.assert_allclose(got, np.hstack([ref.force_s, ref.rate_s]), atol=1e-9)
    # Without arms no slope is needed.
    still = replace(truth, values=np.where(['size' in n for n in model.param_names], 0.0, values))
    samples = ImuSamples(10**18 + 10**7 * np.arange(400), *measured, '')
    live = LiveCompensation(still)
    out = [parse_imu(live(row.tobytes())).doubles for row in encode_imu(samples)]
    offline = CompensationStream(still).correct(samples)
    for name, wanted in (('force_s', offline.force), ('rate_s', offline.rate)):
        np.testing.assert_allclose([np.array(d[FIELDS[name]]) for d in out], wanted, atol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize(
    'names', [INVERTED, pytest.param(('gyro_scale_settling',), marks=pytest.mark.long)]
)
def test_diagnosis_finds_and_names_them(names):
    made = session(*names)
    found = imu.diagnose(
        made.samples,
        made.table,
        catalogue=MINE,
        candidates=OTHERS,
        accelerometer_model=ASKED['accelerometer'],
    )
    assert {finding.effect for finding in found.findings} == set(names)
    for name in names:
        value, truth = (
            calibration.value(SENSOR[name], name) for calibration in (found.calibration, made.truth)
        )
        sd = found.calibration.sd[found.calibration.model.slices[SENSOR[name], name]]
        assert np.all(np.abs(value - truth) < 4 * sd) and np.all(sd < 0.2 * np.abs(truth)), name
        assert ADDED[name]['text'] in found.report


@pytest.mark.long
def test_by_hand_it_is_found_too(name='gyro_anisoelasticity'):
    made = session(name)
    samples = SampleBlock(made.samples.imu)
    calibrated = imu.calibrate(
        samples,
        catalogue=MINE,
        model_as_asked=True,
        **{key: text.replace('+accel_size_effect', '') for key, text in models(name).items()},
    )
    truth = made.truth.value(SENSOR[name], name)
    assert np.all(
        np.abs(calibrated.calibration.value(SENSOR[name], name) - truth) < 0.2 * np.abs(truth)
    )
    found = imu.diagnose(samples, catalogue=MINE, candidates='gyro_g_sensitivity')
    assert (
        name in [finding.effect for finding in found.findings]
        and ADDED[name]['text'] in found.report
    )


@pytest.mark.live
def test_documents_and_processes_carry_it(tmp_path):
    truth = session(*INVERTED).truth
    text = calibration_to_text(truth)
    again = calibration_from_text(text)
    assert calibration_to_text(again) == text
    assert 'gyro_scale_settling' not in text, 'only what the model has travels'
    (tmp_path / 'calibration.yaml').write_text(text)
    program = (
        'import sys, numpy as np, imu_calibration as imu\nforce, rate ='
        ' imu.load(sys.argv[1]).compensate([[1., 2., 9.]], [[.1, .2, .3]],'
        ' time=[0.])\nprint(repr(np.hstack([force, rate])[0].tolist()))'
    )
    done = subprocess.run(
        [sys.executable, '-c', program, tmp_path / 'calibration.yaml'],
        capture_output=True,
        text=True,
        cwd=ROOT,
        timeout=60,
    )
    here = np.hstack(truth.compensate([[1.0, 2.0, 9.0]], [[0.1, 0.2, 0.3]], time=[0.0]))[0]
    np.testing.assert_allclose(ast.literal_eval(done.stdout), here, rtol=1e-12)


def test_pickles_and_saved_sessions_carry_it():
    model, values = with_values('gyro_scale_settling')
    sent = pickle.loads(pickle.dumps(model.at(values)))
    assert sent.definitions == model.definitions and sent.param_names == model.param_names
    np.testing.assert_array_equal(
        coefficients(sent, 'gyroscope', values), coefficients(model.at(values), 'gyroscope', values)
    )
    made = session('gyro_anisoelasticity')
    found = imu.calibrate(
        made.samples,
        made.table,
        catalogue=MINE,
        model_as_asked=True,
        **models('gyro_anisoelasticity'),
    ).result
    data = to_bytes(found.gathered, found.data.model)
    assert len(from_bytes(data)[0].accumulator.rows) == len(found.gathered.accumulator.rows)
    other = replace(
        found.data.model,
        catalogue=CATALOGUE.with_effects(
            term('gyro_anisoelasticity', **ADDED['gyro_anisoelasticity'] | {'unit': '1'})
        ),
    )
    with refused(DocumentError, 'other_model'):
        require_columns(from_bytes(data)[1], other)


def test_the_package_knows_nothing_of_what_others_added():
    assert not any(name in ADDED for _, name in CATALOGUE.effects())
    with refused(InputError, 'effect_unknown', 'gyro_anisoelasticity'):
        SensorModel().with_effect('gyroscope', 'gyro_anisoelasticity').param_names


@pytest.mark.parametrize(
    'column',
    [
        "__import__('os').system('true')",
        'f_x.real',
        'f_x[0]',
        '(lambda: f_x)()',
        'f_x if f_y else f_z',
        'f_w',
        'f_x ** 99',
        'f_x ** f_y',
        'abs(f_x, f_y)',
        "'f_x'",
        'f_x and f_y',
        'f_x < 3',
        '[f_x]',
        'print(f_x)',
        '1e999',
        '+'.join(['f_x'] * 300),
        '(' * 300 + 'f_x' + ')' * 300,
        '',
        'f_x := 2',
        'True',
    ],
)
def test_a_column_is_arithmetic_and_nothing_else(column):
    with refused(InputError, 'not_arithmetic', 'mine'):
        term('mine', sensor='gyroscope', column=column, unit='1', tolerance=1.0, text='')


@pytest.mark.parametrize(
    'changed, code, value',
    [
        ({'sensor': 'thermometer'}, 'sensor_unknown', 'thermometer'),
        ({'column': ['f_x', 'f_y']}, 'column_count', 2),
        ({'tolerance': -1.0}, 'tolerance_value', -1.0),
        ({'tolerance': '1'}, 'tolerance_value', "'1'"),
        ({'unit': None}, 'not_a_text', None),
        ({'colour': 'red'}, 'definition_keys', 'colour'),
    ],
)
def test_a_definition_is_refused_in_one_line(changed, code, value):
    with refused(InputError, code, 'mine', value) as caught:
        CATALOGUE.with_definitions({'mine': ADDED['gyro_anisoelasticity'] | changed})
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize('name', ['bias', 'lever_arm', 'not a name', '', 3])
def test_a_name_must_be_free(name):
    with refused(InputError, 'effect_name'):
        CATALOGUE.with_effects(replace(term('mine', **ADDED['gyro_anisoelasticity']), name=name))


def by_code(**changed):
    """Return an effect that is made of code, to be undone, with one column."""
    fields = {
        'name': 'mine',
        'sensor': 'gyroscope',
        'components': ('all',),
        'shape': (1,),
        'unit': '1',
        'tolerance': 1.0,
        'prior_sd': 1.0,
        'explanation': '',
        'motion': ('static_poses',),
        'compensation': 'exact',
        'groups': (ColumnGroup('mine', ('f_x * w_x',)),),
        'coefficients': lambda effect, values, point: {'mine': np.tile(values['mine'], 3)[None]},
    }
    return Effect(**fields | changed)


def test_what_a_single_sample_does_not_tell_cannot_be_undone():
    """
    Columns that compensation cannot know are refused.

    They are refused when the effect is declared, and by the kernel itself.
    """
    late = by_code(groups=(ColumnGroup('mine', ('f_x * time',)),))
    with refused(InputError, 'time_unavailable', 'mine'):
        CATALOGUE.with_effects(late)
    model = SensorModel(catalogue=Catalogue((late,))).with_effect('gyroscope', 'mine')
    values = model.start()
    values[-1] = 1.0
    with refused(InputError, 'variable_unavailable', 'time', 'none'):
        make_kernel(replace(session('accel_triple_product').truth, model=model, values=values))


def test_one_name_for_two_kinds_of_columns_is_refused():
    clash = by_code(
        groups=(ColumnGroup('rate', ('f_x',)),),
        coefficients=lambda effect, values, point: {'rate': np.tile(values['mine'], 3)[None]},
    )
    model = SensorModel(catalogue=CATALOGUE.with_effects(clash)).with_effect('gyroscope', 'mine')
    with refused(InputError, 'column_name_taken', 'rate'):
        model.layout('gyroscope')


def test_an_effect_of_code_cannot_be_written_into_a_document():
    with refused(InputError, 'made_of_code', 'mine'):
        CATALOGUE.with_effects(by_code()).definitions({'mine'})


def test_a_definition_says_all():
    for name, definition in ADDED.items():
        again = from_definition(name, from_definition(name, definition).definition)
        assert (
            again.definition.items() >= definition.items()
            and again.groups == term(name, **definition).groups
        )


def test_the_file_of_tolerances_is_the_catalogue():
    assert (ROOT / 'config' / 'tolerances.yaml').read_text() == rendered(), 'run make config'
