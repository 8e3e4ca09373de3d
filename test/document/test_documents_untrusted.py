"""Documents with parts that are missing, of another kind, or not finite: used or refused."""

import csv
import io
from collections import Counter

import numpy as np
import pytest
import yaml
from fuzz import readers
from refusal import refused

from imu_calibration.allan.document import noise_from_text
from imu_calibration.cli.fleet_run import csv_text
from imu_calibration.core.errors import DocumentError, InputError
from imu_calibration.document.exports.affine import imu_of_corrections
from imu_calibration.document.exports.export import find_target
from imu_calibration.document.exports.loss import import_file
from imu_calibration.effects.expressions import as_text
from imu_calibration.references.turntable.collector import _SavedNumbers, _unpacked
from imu_calibration.report.page import render
from msg_adapters.decode import OTHER_FRAME, FrameChoice


@pytest.fixture(scope='module')
def noise():
    """The text of a noise document."""
    return readers.noise_seeds(None)[0].decode()


@pytest.mark.parametrize(
    'value', [-1.0, float('inf'), float('nan'), 10**40, True, 'text', '1.5', [1.0], {'a': 1.0}]
)
@pytest.mark.parametrize('part', ['excess', 'sample_sd', 'shortest_averaging_time', 'value'])
def test_a_figure_of_another_kind_is_refused(noise, part, value):
    document = yaml.safe_load(noise)
    section = document['gyroscope']
    place = section['white_noise']['value'] if part == 'value' else section[part]
    place[1] = value
    with pytest.raises(DocumentError) as error:
        noise_from_text(yaml.safe_dump(document))
    assert error.value.code == 'figure_not_a_number'
    assert noise_from_text(noise).rate > 0


def test_names_that_are_no_texts_are_refused(noise):
    document = yaml.safe_load(noise)
    document['gyroscope']['slow_part'][0] = [{'a': 1}]
    with pytest.raises(DocumentError) as error:
        noise_from_text(yaml.safe_dump(document))
    assert error.value.code == 'not_a_text'


def test_a_saved_session_has_no_more_values_than_its_size_allows():
    """465 bytes with 10^7 empty arrays in each column needed 1.4 GB."""
    with pytest.raises(ValueError, match='at most 1000 values'):
        _unpacked(
            ['tuple', 1, [['array', [10**7, 0]], ['array', [10**7, 0]]], ['plain', []]],
            _SavedNumbers(b'', 1000),
        )
    with pytest.raises(ValueError, match='at most 1000 values'):
        _unpacked(['tuple', 600, [['array', [600, 0]]], ['plain', []]], _SavedNumbers(b'', 1000))
    (rows,) = _unpacked(['array', [1, 2]], _SavedNumbers(np.arange(2.0).tobytes(), 1000))
    np.testing.assert_array_equal(rows, [0.0, 1.0])


def test_a_px4_file_without_the_default_parameters_is_imported(tmp_path):
    """Parameter files omit parameters at their defaults."""
    lines = ['1\t1\tTC_A_ENABLE\t1\t6', '1\t1\tTC_G_ENABLE\t1\t6']
    lines += ['1\t1\tCAL_ACC0_XOFF\t0.25\t9', '1\t1\tCAL_GYRO0_XOFF\t0.01\t9']
    lines += ['1\t1\tTC_A0_X1_0\t0.01\t9']
    found = import_file(
        find_target('px4'),
        ('\n'.join(lines) + '\n').encode(),
        tmp_path / 'absent',
        frame_id='imu_link',
    )
    assert found.model.temperature_ref_c == 25.0


def import_px4(folder, **parameters):
    """Return the calibration of a parameter file in which both sensors have a slope."""
    slopes = {'TC_A_ENABLE': 1, 'TC_G_ENABLE': 1, 'TC_A0_X1_0': 0.01, 'TC_G0_X1_0': 0.002}
    slopes |= {'CAL_ACC0_XOFF': 0.0, 'CAL_GYRO0_XOFF': 0.0}
    lines = [f'1\t1\t{name}\t{value}\t9\n' for name, value in (slopes | parameters).items()]
    return import_file(
        find_target('px4'), ''.join(lines).encode(), folder / 'absent', frame_id='imu_link'
    )


def test_px4_sensors_with_other_reference_temperatures_share_one(tmp_path):
    """That of the gyroscope counted for both sensors."""
    found = import_px4(tmp_path, TC_A0_TREF=40.0, TC_G0_TREF=35.0, TC_G0_TMIN=10.0)
    assert found.model.temperature_ref_c == 40.0
    values = dict(zip(found.model.param_names, found.values, strict=True))
    assert values['accelerometer.bias.x'] == 0
    assert values['gyroscope.bias.x'] == pytest.approx(0.002 * 5.0)
    assert found.conditions['temperature_range_c'] == [10.0, 100.0]


@pytest.mark.parametrize('value', ['inf', 'nan'])
@pytest.mark.parametrize('name', ['TC_A0_TREF', 'TC_G0_TREF', 'TC_A0_TMIN'])
def test_a_px4_temperature_that_is_not_finite_is_refused(tmp_path, name, value):
    with pytest.raises(InputError):
        import_px4(tmp_path, **{name: value})


def test_a_correction_matrix_without_an_inverse_is_refused():
    with refused(InputError, 'matrix_singular', 'gyroscope'):
        imu_of_corrections({'gyroscope': (np.diag([1.0, 1.0, 0.0]), np.zeros(3))})


@pytest.mark.parametrize('value', [float('inf'), float('nan'), -float('inf')])
def test_a_coefficient_that_overflows_is_refused_before_it_becomes_a_name(value):
    with refused(InputError, 'column_overflows', 'finite'):
        as_text({('ux',): 1.0, (): value})


@pytest.mark.parametrize(
    ('formula', 'written'),
    [
        ('=1+1', "'=1+1"),
        (' =1+1', "' =1+1"),
        ('  +1', "'  +1"),
        ('\t@x', '?@x'),
        ('a\r=1+1', 'a?=1+1'),
    ],
)
def test_text_that_a_spreadsheet_calculates_begins_with_a_quote(formula, written):
    (_, (cell,)) = csv.reader(io.StringIO(csv_text([{'name': formula}]), newline=''))
    assert cell == written


def test_pages_forbid_everything_from_outside():
    page = render('base.html', title='t', headline='h')
    policy = page.partition('http-equiv="Content-Security-Policy" content="')[2].partition('"')[0]
    assert "default-src 'none'" in policy and 'http' not in policy
    assert 'unsafe-eval' not in policy


class CountedFrames(Counter):
    """Counts of frames that record each look at all of them."""

    n_walks = 0

    def values(self):
        """All counts."""
        self.n_walks += 1
        return super().values()


def test_frames_of_a_topic_are_counted_without_a_walk_for_each_message():
    choice = FrameChoice('/imu')
    choice.counts = CountedFrames()
    for k in range(300):
        assert choice.wants(f'frame{k}')
    assert choice.counts.n_walks == 0
    choice.wants('frame0', OTHER_FRAME)
    with refused(InputError, 'frame_ambiguous', '/imu'):
        choice.wants('frame1', OTHER_FRAME)
