"""Requirements of documents: what each accepts and refuses, with the place of the value."""

import numpy as np
import pytest
from refusal import refused

from imu_calibration.core import schema
from imu_calibration.core.errors import DocumentError, InputError

NUMBER = schema.number(0.0, 2.0)


def document(parts, **codes):
    """A document type for tests."""
    return schema.Document('a test document', parts, 'correct it', codes)


@pytest.mark.parametrize(
    ('requirement', 'accepted', 'refused_values'),
    [
        (NUMBER, [0, 2.0, np.float64(1.0)], [-1, 3, True, '1', None, np.nan, 10**400, [1.0]]),
        (schema.number(0.0, above=True), [1e-9], [0.0, -1.0]),
        (schema.number(finite=False), [np.inf, np.nan, 3], [True, 10**400, 'nan']),
        (schema.whole(0, 5), [0, 5], [6, -1, 1.0, True, None]),
        (schema.text(), ['', 'a'], [None, b'a', 1]),
        (schema.text('a', 'b'), ['b'], ['c', '']),
        (schema.flag(), [True, False], [0, 'true', None]),
        (schema.equal('m/s'), ['m/s'], ['m', None]),
        (schema.maybe(NUMBER), [None, 1.0], ['', 3.0]),
        (schema.list_of(NUMBER), [[], [1.0], (1, 2)], ['ab', {}, None, [3.0], 1.0]),
        (schema.list_of(NUMBER, 2), [[1.0, 1.0], np.ones(2)], [[1.0], [1.0] * 3]),
        (schema.list_of(NUMBER, rising=True), [[1.0, 1.0, 2.0]], [[2.0, 1.0]]),
        (schema.list_of(schema.text(), most=1), [['a']], [['a', 'b']]),
        (schema.list_of(schema.text(), distinct=True), [['a', 'b']], [['a', 'a']]),
        (schema.list_of(schema.text(), including=['a']), [['b', 'a']], [['b']]),
        (schema.one_or_each(NUMBER, 3), [1.0, [1.0] * 3], [[1.0] * 2, 'a', [[1.0] * 3]]),
        (
            schema.array((2, 1), NUMBER),
            [[[1.0], [2.0]], np.ones((2, 1))],
            [[1.0, 2.0], 1.0, [[1.0], [3.0]], [[1.0], ['a']], [[1.0], [1.0, 2.0]]],
        ),
        (schema.mapping({'a': NUMBER}), [{'a': 1}, {'a': 1, 'b': None}], [{}, [], {'a': None}]),
        (schema.mapping(optional={'a': NUMBER}), [{}, {'a': 1}], [{'a': 'b'}]),
        (schema.mapping(optional={'a': NUMBER}, closed=True), [{'a': 1}], [{'b': 1}]),
        (schema.mapping(each=NUMBER), [{'a': 1}], [{'a': 1, 'b': 3}]),
    ],
)
def test_a_requirement_accepts_and_refuses(requirement, accepted, refused_values):
    for value in accepted:
        schema.require(value, document(requirement))
    for value in refused_values:
        with pytest.raises(DocumentError) as error:
            schema.require(value, document(requirement))
        assert error.value.code in ('shape', *schema.CODES.values()), value


def test_an_error_has_the_path_the_value_and_the_code():
    nested = schema.mapping({'a': schema.mapping(each=schema.list_of(NUMBER, 2))})
    with refused(DocumentError, 'part_range', "'a.b[1]'", '[0, 2]', 7):
        schema.require({'a': {'b': [1, 7]}}, document(nested))
    with refused(DocumentError, 'mine', 'a.b', '1 values'):
        schema.require({'a': {'b': [1]}}, document(nested, length='mine'))
    with refused(InputError, 'key_unknown', "'lenght'", 'length'):
        closed = schema.mapping({'length': NUMBER}, closed=True)
        schema.require({'lenght': 1}, document(closed))
    with refused(DocumentError, 'own', 'x'):
        schema.require('x', document(schema.number(code='own'), type='mine'))


def test_an_error_is_one_short_line_whatever_the_document_contains():
    value = {'k\n' * 900: {'v\n' * 900: 'x\n' * 900}}
    with pytest.raises(DocumentError) as error:
        schema.require(value, document(schema.mapping(each=schema.mapping(each=NUMBER))))
    assert '\n' not in str(error.value) and len(str(error.value)) < 400
