"""
The file for Foxglove holds what the calibration says; the shipped layout asks for what is in it.

Without the package one sentence names it.
"""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from imu_calibration.api.calibrate import calibrate_recordings
from imu_calibration.api.diagnose import diagnose
from imu_calibration.api.view import (
    PARAMETERS_TOPIC,
    RESIDUAL_TOPIC,
    SPECTRUM_TOPIC,
    SPHERE_TOPIC,
    _from_x,
    residual_spectrum,
    scene_of,
    view,
)
from imu_calibration.calibration.coverage import label_of
from imu_calibration.cli.main import main
from imu_calibration.core.samples import SampleBlock
from imu_calibration.document.calibration import UNKNOWN_SD
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.effects.base import SENSORS
from imu_calibration.references.turntable.table_coverage import table_coverage

from worlds.candidates import FEW
from worlds.hand_sessions import GRAVITY, simulate

ROOT = Path(__file__).resolve().parents[2]
SESSION, TABLE = str(ROOT / 'bags/sample_session'), str(ROOT / 'bags/sample_session/table.yaml')


@pytest.fixture(scope='module')
def result():
    """The sample session, calibrated."""
    return calibrate_recordings(SESSION, TABLE, model_as_asked=True).result


def read(path):
    """Return topic -> (name of the schema, encoding, [(time in s, data)]) of an MCAP."""
    reader = pytest.importorskip('mcap.reader', reason='mcap is not installed')
    found = {}
    with open(path, 'rb') as file:
        for schema, channel, message in reader.make_reader(file).iter_messages():
            data = json.loads(message.data) if channel.message_encoding == 'json' else message.data
            found.setdefault(channel.topic, (schema.name, channel.message_encoding, []))[2].append(
                (1e-9 * message.log_time, data)
            )
    return found


@pytest.fixture(scope='module')
def written(tmp_path_factory):
    """The file that the verb makes of the sample session, read back."""
    pytest.importorskip('foxglove', reason='the extra view is not installed')
    path = tmp_path_factory.mktemp('view') / 'view.mcap'
    assert main(['view', SESSION, '--table', TABLE, '--model-as-asked', '--output', str(path)]) == 0
    return read(path)


def shown_of(written, topic):
    """Return what a topic shows, at the beginning and at the end alike."""
    [(start, shown), (end, again)] = written[topic][2]
    assert start == 0 and end >= 1 and shown == again
    return shown


def test_every_topic_has_its_schema(written):
    assert {topic: (name, encoding) for topic, (name, encoding, _) in written.items()} == {
        **{
            topic: (topic[1:].replace('/', '.'), 'json')
            for topic in (PARAMETERS_TOPIC, RESIDUAL_TOPIC, SPECTRUM_TOPIC)
        },
        SPHERE_TOPIC: ('foxglove.SceneUpdate', 'protobuf'),
    }


def test_residuals_are_those_of_the_windows_at_their_time(written, result):
    errors, windows = result.window_errors(), shown_of(written, RESIDUAL_TOPIC)['windows']
    order = np.argsort(errors.time, kind='stable')
    assert [row['time'] for row in windows] == list(errors.time[order]) and written[RESIDUAL_TOPIC][
        2
    ][1][0] == pytest.approx(errors.time.max())
    for which in ('before', 'after', 'floor'):
        for sensor in SENSORS:
            shown = np.array([[row[which][sensor][axis] for axis in 'xyz'] for row in windows])
            assert np.array_equal(shown, getattr(errors, which)[sensor][order]), (which, sensor)


def test_parameters_have_value_band_and_tolerance(written, result):
    rows, calibration = shown_of(written, PARAMETERS_TOPIC)['parameters'], result.calibration
    assert [row['name'] for row in rows] == list(calibration.param_names)
    assert [row['ratio'] for row in rows] == pytest.approx(calibration.sd / result.tolerances)
    for name, wanted in (
        ('value', calibration.values),
        ('sd', calibration.sd),
        ('tolerance', result.tolerances),
        ('low', calibration.values - 1.96 * calibration.sd),
        ('high', calibration.values + 1.96 * calibration.sd),
    ):
        assert np.allclose(
            [row[name] for row in rows], wanted, rtol=0, atol=1e-4 * calibration.sd
        ), name
    assert {row['unit'] for row in rows if row['name'].startswith('gyroscope.bias')} == {'rad/s'}


def test_the_sphere_says_what_is_next_and_shows_every_cell_and_rest(written, result):
    scene = shown_of(written, SPHERE_TOPIC)
    found = table_coverage(result)
    drawn = str(scene_of(found, 'imu_link'))
    assert (
        scene == scene_of(found, result.calibration.frame_id).encode()
        and label_of(found)[2].encode() in scene
    )
    assert drawn.count('SpherePrimitive') == 26 + (result.window_errors().kind == 'static').sum()


def test_spectrum_is_that_of_the_residuals(written, result):
    shown = shown_of(written, SPECTRUM_TOPIC)
    frequency, density = residual_spectrum(result, result.gathered.kept)
    assert [line['frequency'] for line in shown['lines']] == list(frequency) and len(frequency) > 30
    assert np.array_equal(
        [[line['gyroscope'][axis] for axis in 'xyz'] for line in shown['lines']],
        density['gyroscope'],
    )


def test_a_line_stands_at_its_frequency_and_white_noise_at_its_density():
    """
    A tone of 12 Hz with white noise of 0.01 per sample at 100 Hz.

    The one-sided density of the noise is 0.01 * sqrt(2 / 100).
    """
    rng, time = np.random.default_rng(1), np.arange(4096) / 100
    noise = 0.01 * rng.normal(size=(4096, 3))
    tone = noise + np.outer(0.2 * np.sin(2 * np.pi * 12 * time), [1, 0, 0])
    windows = [
        type('Long', (), {'kind': 'spin', 'period': 0.01, '__len__': lambda self: 4096})()
        for _ in range(2)
    ]
    frequency, density = residual_spectrum(
        SimpleNamespace(residuals_of=lambda _: {'accelerometer': tone + 3.0, 'gyroscope': noise}),
        windows,
    )
    assert (
        frequency[np.argmax(density['accelerometer'][:, 0])] == pytest.approx(12, abs=0.1)
        and frequency[0] > 0
    )
    assert np.sqrt(np.mean(density['gyroscope'] ** 2)) == pytest.approx(
        0.01 * np.sqrt(2 / 100), rel=0.05
    )


@pytest.mark.parametrize(
    'along', [(1, 0, 0), (0, 1, 0), (0, 0, -1), (-1, 0, 0), (0.6, -0.48, 0.64)]
)
def test_an_arrow_points_where_it_shall(along):
    from scipy.spatial.transform import Rotation

    assert np.allclose(Rotation.from_quat(_from_x(np.array(along, float))).apply([1, 0, 0]), along)


def test_of_imported_values_no_band_is_shown(tmp_path, result):
    imported = replace(
        result.calibration, provenance=result.calibration.provenance | {'uncertainty': UNKNOWN_SD}
    )
    (tmp_path / 'calibration.yaml').write_text(calibration_to_text(imported))
    [shown] = view(tmp_path).contents.values()
    assert len(shown['parameters']) == len(imported.values) and not {
        'sd',
        'low',
        'high',
        'ratio',
    } & set(shown['parameters'][0])


def test_by_hand_there_are_poses_and_a_sphere_but_no_spectrum():
    shown = view(SampleBlock(simulate(3)[0]), gravity=GRAVITY)
    assert (
        set(shown.contents) == {PARAMETERS_TOPIC, RESIDUAL_TOPIC}
        and len(shown.contents[RESIDUAL_TOPIC]['windows']) == len(shown.coverage.seen) >= 9
    )
    assert 'spectrum' in shown.lacks[0]


def test_of_a_calibration_file_the_parameters_alone_are_shown(tmp_path, result, capsys):
    pytest.importorskip('foxglove', reason='the extra view is not installed')
    (tmp_path / 'calibration.yaml').write_text(calibration_to_text(result.calibration))
    assert main(['view', str(tmp_path), '--output', str(tmp_path / 'view.mcap')]) == 0
    assert 'warning: ' in capsys.readouterr().err
    assert set(read(tmp_path / 'view.mcap')) == {PARAMETERS_TOPIC}
    assert (
        main(['view', str(tmp_path), '--table', TABLE, '--output', str(tmp_path / 'other.mcap')])
        == 1
    )
    assert 'recording' in capsys.readouterr().err and not (tmp_path / 'other.mcap').exists()


def test_without_the_package_one_sentence_names_it_before_any_work(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, 'foxglove', None)
    assert main(['view', 'no-such-bag', '--output', str(tmp_path / 'view.mcap')]) == 1
    out, err = capsys.readouterr()
    assert (
        out == ''
        and err
        == 'imu_calibration view: a view needs foxglove-sdk, which is not installed; install'
        ' imu_calibration[view]\n'
    )
    assert not list(tmp_path.iterdir())


def test_the_layout_asks_for_what_the_file_holds(written):
    """As the layout classes of foxglove-sdk 0.30 wrote it; the app itself was not run."""
    text = (ROOT / 'config/view.foxglove.json').read_text()
    asked = set(re.findall(r'"(/imu/[^"]+)"', text))
    assert {path.partition('.')[0] for path in asked} == set(written)
    for path in asked - {SPHERE_TOPIC}:
        topic, *names = path.replace('[:]', '').split('.')
        found = shown_of(written, topic)
        for name in names:
            found = found[name]
            found = found[0] if isinstance(found, list) else found
        assert names and found is not None
    assert set(re.findall(r'"panelType": "(\w+)"', text)) == {'ThreeDee', 'Plot', 'Table'}


def test_the_overlay_of_a_diagnosis_contains_its_segments_residuals_spectra_and_histograms(
    tmp_path,
):
    pytest.importorskip('foxglove', reason='the extra view is not installed')
    found = diagnose(SESSION, TABLE, candidates=FEW)
    found.save_overlay(tmp_path / 'overlay.mcap')
    written, traces = read(tmp_path / 'overlay.mcap'), found.result.diagnosis.traces
    segment = traces.segments['gyroscope'][2]
    times, rows = zip(*written['/overlay/gyroscope/z'][2])
    assert np.allclose(times, segment.time, rtol=0, atol=1e-9)
    for name in ('measured', 'simulated before', 'simulated after'):
        assert [row[name.replace(' ', '_')] for row in rows] == segment.signals[name].tolist()
    residual = written['/residual/accelerometer'][2]
    assert [row['after']['y'] for _, row in residual] == traces.after['accelerometer'][
        :, 1
    ].tolist()
    assert set(residual[0][1]['angle']) == {'outer', 'middle', 'inner'}
    [(start, spectrum), (end, _)] = written['/residual_spectrum/accelerometer'][2]
    assert (start, end) == pytest.approx((0.0, traces.time[-1])) and len(
        spectrum['frequency']
    ) == len(spectrum['after']['x']) > 5
    histogram = written['/residual_histogram/gyroscope/x'][2][0][1]
    assert (
        0.9 * len(traces.time) < sum(histogram['before']) <= len(traces.time)
        and len(histogram['residual']) == 40
    )
