"""Tones in the rest: what they are fixed to, and what is none."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import imu_calibration as imu
from imu_calibration.core.units import DEG
from imu_calibration.effects.catalogue import term
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable.diagnosis_of_windows import build_diagnosis
from imu_calibration.references.turntable.residuals.residual_analysis import ResidualAnalysis
from imu_calibration.references.turntable.residuals.spectrum import (
    EvenStretch,
    _stretches_of_time,
    _without,
    find_tones,
    of_stretches,
)
from imu_calibration.references.turntable.selection.investigation import investigate
from imu_calibration.report.figures import draw_tones
from imu_calibration.selection.unexplained import IN_MOTION

from worlds.candidates import with_candidates
from worlds.hiding import record
from worlds.physics import make_session
from worlds.physics_beyond import Machine
from worlds.physics_cause import Cause
from worlds.physics_draw import ARCMIN, MG

STEP = 0.01
ONE = 'accel_quadratic'
"""Candidates where the search for effects is not the subject."""
COARSE = {'imu_rate': 50.0, 'joint_rate': 50.0}


def stretches(amplitudes, frequency=23.7, noise=1.0):
    """
    Return stretches of noise in which axis y carries a tone of each amplitude.

    Each tone is in a phase of its own.
    """
    rng, time = np.random.default_rng(3), STEP * np.arange(400)
    return [
        EvenStretch(
            noise * rng.normal(size=(400, 3))
            + np.outer(size * np.sin(2 * np.pi * frequency * time + k), [0, 1, 0]),
            step=STEP,
            highest=45.0,
        )
        for k, size in enumerate(amplitudes)
    ]


def test_a_tone_is_found_where_it_is_with_its_amplitude():
    (tone,) = of_stretches('gyroscope', stretches([0.8] * 30), None)
    assert (
        tone.axis == 'y'
        and tone.frequency == pytest.approx(23.7, abs=0.11)
        and tone.amplitude == pytest.approx(0.8, rel=0.1)
    )
    assert tone.p_value < 1e-20 and tone.share > 0.9


@pytest.mark.parametrize('amplitudes', [[0.0] * 40, [30.0] * 5 + [0.0] * 35, [0.8] * 4])
def test_noise_what_some_motions_do_and_too_few_stretches_are_no_tone(amplitudes):
    """
    A large line in an eighth of the stretches is that of their motion; four stretches are few.
    """
    assert not [
        tone
        for tone in of_stretches('gyroscope', stretches(amplitudes), None)
        if tone.share <= 0.5 or tone.p_value * 3 < 1e-4
    ]


class TimedWindow(SimpleNamespace):
    """A window of which the spectrum needs the times only."""

    def __len__(self):
        """Return the number of samples."""
        return len(self.time)


@pytest.mark.parametrize('frequency', [46.3, 48.9, 49.7])
@pytest.mark.parametrize('size', [0.8, 0.0])
def test_a_tone_just_below_half_of_the_rate_is_found(frequency, size):
    rng, time = np.random.default_rng(7460), STEP * np.arange(40 * 400)
    rest = rng.normal(size=(len(time), 3))
    rest[:, 1] += size * np.sin(2 * np.pi * frequency * time)
    windows = []
    for part in np.split(np.arange(len(time)), 40):
        windows.append(TimedWindow(time=time[part], rows=part))
    parts = [rest[window.rows] for window in windows]
    tones = list(of_stretches('gyroscope', _stretches_of_time(windows, parts), None))
    found = [tone for tone in tones if tone.p_value * 3 < 1e-4]
    assert len(found) == (size > 0.0)
    if found:
        assert found[0].axis == 'y' and found[0].frequency == pytest.approx(frequency, abs=0.11)


def test_noise_that_is_not_white_is_no_tone():
    rng = np.random.default_rng(1)
    walks = [
        EvenStretch(np.cumsum(rng.normal(size=(600, 3)), axis=0), step=STEP, highest=45.0)
        for _ in range(40)
    ]
    assert not list(of_stretches('gyroscope', walks, None))


def test_a_fixed_frequency_is_removed_before_orders_are_searched():
    time, rng = STEP * np.arange(700), np.random.default_rng(2)
    other, line = (
        np.sin(2 * np.pi * 11.0 * time) + 0.1 * rng.normal(size=len(time)),
        np.sin(2 * np.pi * 31.04 * time + 1.0),
    )
    left = _without(31.0, time, other + 3.0 * line)
    assert np.std(left - other) < 0.05 and abs(left @ line) / len(time) < 1e-3


def test_a_hum_stays_in_seconds_and_teeth_stay_in_turns():
    kind = {'profile': 'random_short'}
    recording = record(5, None, 'realistic', through_bag=False, cause=Machine(), **kind)
    model = with_candidates(recording.model, ONE)
    found = investigate(recording.windows, recording.table, model)
    tones = find_tones(found)
    (hum,), (teeth,) = tones['accelerometer'], tones['gyroscope']
    assert (hum.joint, hum.axis) == (None, 'z') and hum.frequency == pytest.approx(
        Machine.hum_hz, abs=0.1
    )
    assert (
        hum.amplitude == pytest.approx(9.8e-3, rel=0.1)
        and '23.7 Hz' in hum.text
        and 'accelerometer z' in hum.text
    )
    assert (teeth.joint, teeth.axis) == ('outer', 'x') and teeth.frequency == pytest.approx(
        Machine.teeth, abs=0.2
    )
    assert (
        'outer' in teeth.text
        and 'gyroscope x' in teeth.text
        and teeth.to_mapping()['joint'] == 'outer'
    )

    # A motion may have a fixed frequency too; only rests show that the tone does not need one.
    assert hum.rested
    assert replace(hum, rested=False).text != hum.text
    assert 'independent' not in replace(hum, rested=False).text
    mesh = term(
        'mesh',
        sensor='gyroscope',
        column=f'sin({Machine.teeth} * angle_1)',
        unit='rad/s',
        tolerance=1e-5,
        text='Teeth of the gear.',
    )
    formula = SimpleNamespace(effects=[mesh], values=[np.array([0.2 * DEG, 0.0, 0.0])])
    assert [tone.sensor for tones in find_tones(found, [formula]).values() for tone in tones] == [
        'accelerometer'
    ]

    class Rest:
        tones = (teeth, hum)

    drawn = draw_tones('gyroscope', Rest)
    assert 'of the gyroscope' in drawn and 'mathdefault' not in drawn
    Rest.tones = ()
    assert draw_tones('gyroscope', Rest) == ''


class Loud(Cause):
    """
    A tone of 31 Hz in accelerometer z, and noise of gyroscope y in proportion to the rate.

    0.5 at a rate of 1.
    """

    def delivered(self, time, outputs, rate_s):
        """Return both."""
        tone = self.size * 20 * MG * np.sin(2 * np.pi * 31.0 * time)
        noise = (
            0.5
            * self.size
            * np.random.default_rng(1).normal(size=len(time))
            * np.linalg.norm(rate_s, axis=1)
        )
        return [outputs[0] + np.outer(tone, [0, 0, 1]), outputs[1] + np.outer(noise, [0, 1, 0])]


@pytest.mark.parametrize('size', [1.0, 0.0])
def test_a_loud_tone_and_the_scatter_of_one_axis_in_motion_are_unexplained(size):
    """
    Both are random to least squares, whose noise they increase.

    The diagnosis of either was "nothing found".
    """
    kind = {'profile': 'quick', **COARSE}
    recording = record(5, None, 'realistic', through_bag=False, cause=Loud(size), **kind)
    model = with_candidates(recording.model, ONE)
    found = build_diagnosis(investigate(recording.windows, recording.table, model)).unexplained
    assert [found[sensor].significant for sensor in ('accelerometer', 'gyroscope')] == [
        size > 0
    ] * 2
    tones = found['accelerometer'].tones + found['gyroscope'].tones
    assert bool(tones) == (size > 0)
    if size:
        assert [(rest.axes, rest.correlates_with) for rest in found.values()] == [
            (('z',), None),
            (('y',), IN_MOTION),
        ]
        # A mean over three axes, as of other residuals.
        assert found['accelerometer'].rms == pytest.approx(20 * MG / np.sqrt(6), rel=0.1)


@pytest.mark.long
def test_calibrate_reports_the_same_unexplained_residuals_as_diagnose():
    """Tones and the scatter of one axis were tested by `diagnose` only."""
    kind = {'profile': 'quick', **COARSE}
    session = make_session(5, None, 'realistic', cause=Loud(1.0), **kind)
    # A diagnosis calibrates first, as `calibrate` does.
    result = imu.diagnose(session.block, Table.from_mapping(session.table), candidates=ONE).result
    reported = result.calibration.statistics['unexplained']
    found = result.diagnosis.unexplained
    assert reported == {
        sensor: {'rms': pytest.approx(rest.rms), 'axes': list(rest.axes)}
        for sensor, rest in found.items()
        if rest.significant
    }
    assert {sensor: rest['axes'] for sensor, rest in reported.items()} == {
        'accelerometer': ['z'],
        'gyroscope': ['y'],
    }


class Sway(Cause):
    """The floor tilts to and fro by 3 arcmin with a period of 21 s, about a level axis."""

    PERIOD, ANGLE = 21.0, 3.0 * ARCMIN

    def added(self, world, temperature_c, force_s, rate_s, alpha_s):
        """Return the change of the specific force and the rate of the floor, in s."""
        phase = 2 * np.pi * world.time / self.PERIOD + 0.7
        axis = self.size * self.ANGLE * np.array([0.8, -0.6, 0.0])
        tilt = np.outer(np.sin(phase), axis)
        rate = np.outer(2 * np.pi / self.PERIOD * np.cos(phase), axis)
        # the level frame turns by the tilt: its vectors seen from the sensor turn back
        return -world.to_sensor(np.cross(tilt, world.force_n)), world.to_sensor(rate)


@pytest.mark.long
def test_a_sway_of_the_floor_is_named_with_its_period_and_size():
    recording = record(7461, None, 'realistic', through_bag=False, cause=Sway(1.0), **COARSE)
    model = with_candidates(recording.model, ONE)
    found = investigate(recording.windows, recording.table, model)
    tones = ResidualAnalysis.of(found).unexplained['accelerometer'].tones
    (sway,) = [tone for tone in tones if tone.tilts]
    assert 1 / sway.frequency == pytest.approx(Sway.PERIOD, rel=0.03)
    assert sway.amplitude / 9.8 == pytest.approx(Sway.ANGLE, rel=0.2)
    assert sway.p_value < 1e-6
