"""
The calibration document.

Any calibration survives YAML whole, and what is no calibration is refused.
"""

import copy

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from refusal import refused

from imu_calibration.core import documents
from imu_calibration.core.errors import DocumentError, InputError
from imu_calibration.document.calibration import Calibration, implausible
from imu_calibration.document.calibration_text import (
    calibration_from_text,
    calibration_mapping,
    calibration_to_text,
    from_mapping,
)
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import DETERMINED, HELD, WEAK, Status

ACCELEROMETER = (
    'accel_quadratic',
    'accel_cubic',
    'accel_cross_product',
    'accel_scale_asymmetry',
    'accel_size_effect',
    'lever_arm',
    'accel_thermal_bias',
    'accel_thermal_scale',
    'accel_bias_drift',
    'accel_bandwidth',
)
GYROSCOPE = (
    'gyro_g_sensitivity',
    'gyro_rate_product',
    'gyro_quadratic',
    'gyro_scale_asymmetry',
    'gyro_thermal_bias',
    'gyro_thermal_scale',
    'gyro_bias_drift',
    'gyro_bandwidth',
)
REFERENCE = (
    'table_tilt',
    'axis_non_orthogonality',
    'encoder_zero',
    'encoder_harmonic',
    'time_offset',
    'earth_rate',
)
IN_DOCUMENT_REFERENCE = ('accel_bandwidth', 'gyro_bandwidth')
numbers = st.floats(-1e3, 1e3, allow_nan=False).map(lambda x: x + 0.0)
texts = st.text(
    st.characters(blacklist_categories=('Cs', 'Cc'), blacklist_characters='\u2028\u2029\x85\ufeff'),
    max_size=12,
)


@st.composite
def models(draw):
    """Any model of the catalogue."""

    def some(names):
        return tuple(draw(st.lists(st.sampled_from(names), unique=True, max_size=3)))

    joints = tuple(
        draw(
            st.lists(
                st.text('abcxyz_', min_size=1, max_size=6), unique=True, min_size=1, max_size=4
            )
        )
    )
    sensors = [
        ('bias', 'matrix') + tuple(n for n in some(names)) for names in (ACCELEROMETER, GYROSCOPE)
    ]
    # a sensor's lag stands under `reference` in the document and comes back as the last effect of
    # its sensor
    sensors = [
        tuple(sorted(names, key=lambda n: n in IN_DOCUMENT_REFERENCE + ('lever_arm',)))
        for names in sensors
    ]
    known = [name for name in REFERENCE if ('reference', name) in CATALOGUE.effects(joints)]
    return SensorModel(*sensors, some(known), joints, draw(st.floats(-40, 85)))


@st.composite
def any_calibration(draw):
    """Any calibration with sound matrices."""
    model = draw(models())
    count = len(model.param_names)
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    values = rng.normal(0, 1, count) * 10.0 ** rng.integers(-9, 3, count)
    for sensor in ('accelerometer', 'gyroscope'):
        values[model.slices[sensor, 'matrix']] = (
            np.eye(3) + rng.uniform(-0.2, 0.2, (3, 3))
        ).ravel()
    root = rng.normal(0, 1e-3, (count, count))
    status = tuple(rng.choice([DETERMINED, WEAK, HELD], count).tolist())
    undetermined = tuple(
        draw(
            st.lists(
                st.fixed_dictionaries(
                    {
                        'parameters': st.dictionaries(
                            st.sampled_from(model.param_names), numbers, max_size=3
                        ),
                        'needs': texts,
                    }
                ),
                max_size=2,
            )
        )
    )
    extra = st.dictionaries(
        texts.filter(bool),
        st.one_of(
            numbers, texts, st.integers(), st.none(), st.booleans(), st.lists(numbers, max_size=3)
        ),
        max_size=3,
    )
    return Calibration(
        model.at(values),
        values,
        root @ root.T,
        status,
        draw(texts),
        {'origin': 'mount', 'axes': 'mount'},
        undetermined,
        draw(extra),
        draw(extra),
        draw(extra),
    )


@given(any_calibration())
def test_any_calibration_survives_yaml_whole(calibration):
    text = calibration_to_text(calibration)
    read = calibration_from_text(text)
    assert set(read.param_names) == set(calibration.param_names)
    order = [read.param_names.index(name) for name in calibration.param_names]
    assert np.array_equal(read.values[order], calibration.values)
    assert np.array_equal(read.covariance[np.ix_(order, order)], calibration.covariance)
    assert tuple(read.status[k] for k in order) == calibration.status
    for name in ('frame_id', 'gauge', 'undetermined', 'statistics', 'conditions', 'provenance'):
        assert getattr(read, name) == getattr(calibration, name), name
    assert (read.model.joint_names, read.model.temperature_ref_c) == (
        calibration.model.joint_names,
        calibration.model.temperature_ref_c,
    )
    once = calibration_to_text(read)
    assert calibration_to_text(calibration_from_text(once)) == once


def plain():
    """Return the mapping of a simple calibration."""
    model = SensorModel()
    return calibration_mapping(
        Calibration(model, model.start(), 1e-6 * np.eye(24), (DETERMINED,) * 24)
    )


def test_the_document_has_the_published_layout():
    document = yaml.safe_load(documents.to_text(plain()))
    assert document['format'] == 'imu_calibration/1'
    assert list(document)[:6] == [
        'format',
        'frame_id',
        'gauge',
        'accelerometer',
        'gyroscope',
        'reference',
    ]
    assert document['accelerometer']['bias'] == {
        'value': [0.0] * 3,
        'sd': [0.001] * 3,
        'unit': 'm/s^2',
        'status': ['determined'] * 3,
    }
    assert len(document['covariance']['matrix']) == len(document['covariance']['names']) == 24


@pytest.mark.parametrize(
    ('change', 'code', 'values'),
    (
        (
            lambda d: d.update(format='imu_calibration/2'),
            'document_newer',
            ['imu_calibration/1', 'imu_calibration/2'],
        ),
        (lambda d: d.update(format='imu_calibration/x'), 'document_format', ['imu_calibration/x']),
        (lambda d: d.pop('format'), 'document_format', ['None']),
        (lambda d: d['accelerometer'].pop('bias'), 'document_parts', ['bias']),
        (
            lambda d: d['accelerometer']['bias'].update(value=[0.0, 1.0]),
            'shape',
            ['bias', (3,), (2,)],
        ),
        (
            lambda d: d['accelerometer']['bias'].update(value=[0.0, 1.0, float('nan')]),
            'not_finite',
            [],
        ),
        (
            lambda d: d['accelerometer']['bias'].update(value=['a', 'b', 'c']),
            'document_parts',
            ['accelerometer.bias.value[0]', "'a'"],
        ),
        (lambda d: d['accelerometer']['bias'].update(sd=[0.1, -0.1, 0.1]), 'negative_sd', ['bias']),
        (lambda d: d['accelerometer']['bias'].update(unit='mg'), 'unit', ['m/s^2', 'mg']),
        (
            lambda d: d['accelerometer']['bias'].update(status=['good'] * 3),
            'status_unknown',
            ['bias', *Status],
        ),
        (lambda d: d['gyroscope']['effects'].append('bias'), 'effect_repeated', ['bias']),
        (lambda d: d['gyroscope']['effects'].append('magic'), 'document_parts', ['magic']),
        (
            lambda d: d['gyroscope'].update(effects=['bias']),
            'effect_missing',
            ['gyroscope', 'matrix'],
        ),
        (lambda d: d.update(gyroscope=[]), 'not_a_mapping', ['gyroscope']),
        (
            lambda d: d.update(reference_temperature_c=2000.0),
            'part_value',
            ['reference_temperature_c', 2000.0],
        ),
        (
            lambda d: [
                d[sensor]['matrix'].update(value=[[1.0, 0.0, 0.0]] * 3)
                for sensor in ('accelerometer', 'gyroscope')
            ],
            'ill_conditioned',
            [20],
        ),
        (lambda d: d['covariance']['matrix'][0].__setitem__(0, -1.0), 'negative_variance', []),
        (lambda d: d['covariance']['matrix'][0].__setitem__(1, 1.0), 'not_a_covariance', []),
        (lambda d: d['covariance']['matrix'][0].__setitem__(0, 1e19), 'too_large', ['1e+09']),
        (lambda d: d['covariance']['names'].pop(), 'document_parts', []),
    ),
)
def test_an_invalid_document_is_refused_in_one_line(change, code, values):
    document = copy.deepcopy(plain())
    change(document)
    with refused(InputError, code, *values) as refusal:
        from_mapping(document)
    assert '\n' not in str(refusal.value)


@pytest.mark.parametrize(
    ('text', 'code'),
    (
        ('', 'not_a_mapping'),
        ('a: [', 'not_yaml'),
        ('[]', 'not_a_mapping'),
        ('\x00', 'not_yaml'),
        ('7', 'not_a_mapping'),
        ('a: !!python/object/apply:os.getcwd []', 'not_yaml'),
    ),
)
def test_a_text_that_is_not_a_document_is_refused_in_one_line(text, code):
    with refused(DocumentError, code) as refusal:
        calibration_from_text(text)
    assert '\n' not in str(refusal.value)


def test_implausible_values_are_named():
    model = SensorModel()
    values = model.start()
    assert (
        implausible(Calibration(model, values, np.eye(24), (DETERMINED,) * 24), 'accelerometer')
        == []
    )
    values[1] = 50.0
    lines = implausible(Calibration(model, values, np.eye(24), (DETERMINED,) * 24), 'accelerometer')
    assert len(lines) == 1 and 'accelerometer bias' in lines[0] and '50' in lines[0]


@pytest.mark.parametrize(
    ('text', 'code', 'value'),
    (
        ('a: ' + '[' * 25 + ']' * 25, 'document_limit', 20),
        ('a: &x [1]\nb: *x', 'yaml_alias', '*x'),
        ('a: ' + 'x' * 6000, 'document_limit', 5000),
        ('a: 1' + '0' * 200, 'document_limit', 100),
        ('a: [' + '1,' * 70_000 + ']', 'document_limit', 60000),
        ('a: 1\n' + '# ' + 'x' * 2_000_000, 'document_limit', 2000000),
    ),
)
def test_a_text_that_takes_long_to_read_is_refused(text, code, value):
    """One limit at a time: the text is within all others."""
    with refused(InputError, code, value):
        documents.from_text(text)


@pytest.mark.parametrize(
    ('text', 'value'),
    [
        ('1e-6', 1e-6),
        ('-2E3', -2e3),
        ('1.e5', 1e5),
        ('.5e+3', 500.0),
        ('0x1e5', 485),
        ('"1e-6"', '1e-6'),
        ('1e5x', '1e5x'),
    ],
)
def test_a_number_with_an_exponent_is_a_number(text, value):
    """PyYAML follows YAML 1.1, in which 1e-6 is a text."""
    found = documents.from_text(f'value: {text}')['value']
    assert found == value and type(found) is type(value)


@pytest.mark.parametrize('value', ['1e-6', '12345678e901', 1e-6, 1e300])
def test_texts_and_numbers_with_an_exponent_come_back_as_written(value):
    assert documents.from_text(documents.to_text({'value': value})) == {'value': value}
