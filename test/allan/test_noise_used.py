"""
Noise that was measured apart, where it is used.

Bias processes of the windows, the reports, the covariances of corrected readings.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from refusal import refused
from test_copying import raw_messages
from test_live_calibration import blocks

from imu_calibration.allan.document import noise_to_text, position_budget
from imu_calibration.allan.figures import AxisFigures, NoiseFigures, bias_processes
from imu_calibration.allan.processes import FLICKER, RANDOM_WALK, allan_variance, gauss_markov
from imu_calibration.allan.terms import TIME_KEY, Term
from imu_calibration.calibration.live import LiveSettings
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.cli.main import main
from imu_calibration.compensation.stream import CompensationStream, SampleCompensation
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples
from imu_calibration.document import files
from imu_calibration.document.trust import with_measured_noise
from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.rows import Rows
from imu_calibration.estimation.sensor_noise import BiasProcess
from imu_calibration.estimation.solution import DETERMINED, HELD
from imu_calibration.kinematics.table import Table
from imu_calibration.references.gravity.live_poses import LiveByHand
from imu_calibration.references.turntable.estimation.noise_search import estimate_offsets
from imu_calibration.references.turntable.live_diagnosis import question_about
from imu_calibration.references.turntable.live_windows import LiveCalibration
from imu_calibration.references.turntable.noise_model import NoiseModel
from msg_adapters.imu import FIELDS
from validation.imu_messages import parse_imu

from worlds import physics
from worlds.compensation_cases import random_calibration
from worlds.noise_worlds import flicker

BAG = Path(__file__).parents[2] / 'bags' / 'sample_session'


def axis_of(**figures):
    """An axis with these figures, nothing else."""
    terms = {
        name: Term(name, value, (0.9 * value, 1.1 * value), DETERMINED)
        for name, value in figures.items()
    }
    terms.setdefault('random_walk', Term('random_walk', None, (0.0, 1e-9), HELD))
    form = tuple(name for name in figures if name not in ('white_noise', TIME_KEY))
    return AxisFigures(terms, form)


def noise_of(force, rate, sampling=100.0):
    """Three equal axes of each sensor."""
    return NoiseFigures(
        (axis_of(**force),) * 3,
        (axis_of(**rate),) * 3,
        sampling,
        'imu_link',
        {'seconds_at_rest': 1.0},
    )


@pytest.mark.parametrize(
    'name, process', [('bias_instability', FLICKER), ('random_walk', RANDOM_WALK)]
)
def test_sums_of_processes_have_the_allan_variance_of_the_noise(name, process):
    """
    Within 7 % in variance from some windows to sessions.

    Flicker has no faster parts and ripples, a walk forgets after hours.
    """
    figures = noise_of({'white_noise': 1e-3, name: 0.7}, {'white_noise': 1e-5})
    found, tau = bias_processes(figures), np.geomspace(50.0, 1500.0, 12)
    summed = sum(
        part.sd**2 * allan_variance(gauss_markov(part.time), tau) for part in found['accelerometer']
    )
    np.testing.assert_allclose(summed, 0.49 * allan_variance(process, tau), rtol=0.07)
    assert found['gyroscope'] == ()  # a bound is no measurement


def test_a_gauss_markov_process_stays_as_it_is():
    figures = noise_of(
        {'white_noise': 1e-3, 'gauss_markov': 0.2, TIME_KEY: 90.0}, {'white_noise': 1e-5}
    )
    (process,) = bias_processes(figures)['accelerometer']
    assert process.time == pytest.approx(90.0) and process.sd == pytest.approx(0.2)


def test_what_a_bias_does_over_days_is_not_its_scatter_within_a_session():
    slow, fast = BiasProcess(3.0, 36_000.0), BiasProcess(2.0, 100.0)
    noise = NoiseModel(np.ones(3), np.ones(3), bias_processes=(slow, fast))
    assert noise.bias_variance == pytest.approx(4.0 + 0.9)


def wandering(seed, size, count=20):
    """Mean rows of windows every 20 s: one bias, white noise of 1e-4, flicker of an instability."""
    rng, times = np.random.default_rng(seed), 20.0 * np.arange(count)
    wander = np.column_stack(
        [flicker(20 * count, 1.0, size, rng).reshape(count, 20).mean(axis=1) for _ in range(3)]
    )
    rows = np.stack([np.ones((count, 3)), 1e-4 * rng.standard_normal((count, 3)) + wander], axis=2)
    return Rows(equations=rows, variance=np.full((count, 3), 1e-8), time=times)


def offsets_of(rows, known):
    return estimate_offsets(replace(rows, processes=known))


def test_known_processes_are_taken_and_the_rest_is_not_blamed_on_the_bias():
    """
    Twenty windows of known flicker.

    No offset to speak of, and no other process than the known ones.
    """
    known = bias_processes(
        noise_of({'white_noise': 1e-5, 'bias_instability': 1e-3}, {'white_noise': 1e-5})
    )['accelerometer']
    for seed in range(2):
        found = offsets_of(wandering(seed, 1e-3), known)
        assert found['bias_processes'] == known and found['offset_sd'] < 6e-4


def test_a_bias_that_moves_much_more_than_was_measured_is_believed():
    known = (BiasProcess(1e-5, 100.0),)
    found = offsets_of(wandering(5, 3e-3, 60), known)
    assert (
        found['bias_processes'][:1] == known
        and len(found['bias_processes']) == 2
        and found['bias_processes'][1].sd > 1e-3
    )


@pytest.fixture(scope='module')
def noise_file(tmp_path_factory):
    """A noise.yaml with walks that the sample session's windows are too short to see."""
    figures = noise_of(
        {'white_noise': 2e-4, 'random_walk': 2e-5}, {'white_noise': 1e-5, 'bias_instability': 3e-5}
    )
    path = tmp_path_factory.mktemp('noise') / 'noise.yaml'
    path.write_text(noise_to_text(figures))
    return path


@pytest.fixture(scope='module')
def calibrated(noise_file, tmp_path_factory):
    """A folder with the sample session calibrated with known noise."""
    folder = tmp_path_factory.mktemp('with_noise')
    assert (
        main(
            [
                'calibrate',
                str(BAG),
                '--table',
                str(BAG / 'table.yaml'),
                '--noise',
                str(noise_file),
                '--output',
                str(folder),
                '--model-as-asked',
                '--no-report',
            ]
        )
        == 0
    )
    return folder


@pytest.mark.long
def test_calibrate_takes_the_measured_noise_and_says_so(calibrated, noise_file):
    document = yaml.safe_load((calibrated / 'calibration.yaml').read_text())
    walk = 2e-5 * np.sqrt(3600.0 / 2)  # what counts within an hour
    assert document['statistics']['accelerometer']['wander_sd'] == pytest.approx(walk, rel=1e-6)
    assert document['provenance']['options']['noise']['name'] == 'noise.yaml'


def test_live_the_measured_noise_is_used_by_the_solution_and_the_diagnosis(noise_file):
    """On a table the biases move as was measured; by hand the noise is refused as it is offline."""
    session, options = (
        physics.make_session(
            3, profile='random_short', duration=180.0, imu_rate=50.0, joint_rate=50.0
        ),
        CalibrationOptions(noise=files.read_noise(noise_file)),
    )
    live = LiveCalibration(Table.from_mapping(session.table), options)
    for block in blocks(session.imu, session.joints):
        live.push(block)
    known = live.solve(pending=True).solution.noise
    assert {
        sensor: known[sensor].bias_processes[: len(wanted)]
        for sensor, wanted in options.bias_processes.items()
    } == options.bias_processes
    assert question_about(live).snapshot.options.bias_processes == options.bias_processes
    with refused(InputError, 'table_only'):
        LiveByHand(options, LiveSettings())


def test_by_hand_the_noise_is_refused_in_one_line(noise_file, tmp_path, capsys):
    assert (
        main(['calibrate', str(BAG), '--noise', str(noise_file), '--output', str(tmp_path / 'out')])
        == 1
    )
    error = capsys.readouterr().err
    assert '--table' in error and error.count('\n') == 1 and not (tmp_path / 'out').exists()


def test_a_noise_file_that_is_none_is_refused_with_its_name(tmp_path, capsys):
    wrong = tmp_path / 'wrong.yaml'
    wrong.write_text('format: imu_calibration/1\n')
    assert (
        main(
            [
                'calibrate',
                str(BAG),
                '--table',
                str(BAG / 'table.yaml'),
                '--noise',
                str(wrong),
                '--output',
                str(tmp_path / 'out'),
            ]
        )
        == 1
    )
    error = capsys.readouterr().err
    assert 'wrong.yaml' in error and 'imu_calibration/noise/1' in error and error.count('\n') == 1


def test_readings_carry_the_measured_noise_at_their_own_rate(noise_file):
    """
    Recorded at 100 Hz, used at 500 Hz.

    Five times the variance, offline and, once the rate is known, live.
    """
    plain = random_calibration(2, ())
    known = with_measured_noise(
        replace(plain, covariance=np.zeros_like(plain.covariance)), files.read_noise(noise_file)
    )
    count, unknown = 200, np.zeros((3, 3))
    imu = ImuSamples(
        10**18 + 2_000_000 * np.arange(count),
        np.tile([0.0, 0.0, 9.81], (count, 1)),
        np.zeros((count, 3)),
        'imu_link',
    )
    offline, live = CompensationStream(known), SampleCompensation(known)
    offline.correct(imu)
    first = live.covariances(unknown, unknown)
    for stamp, force, rate in zip(imu.stamp_ns, imu.force_s, imu.rate_s):
        live.correct(int(stamp), *rate, *force)
    for k, (sensor, density) in enumerate(zip(SENSORS, (2e-4, 1e-5))):
        inverse = np.linalg.inv(plain.value(sensor, 'matrix'))
        wanted = density**2 * inverse @ inverse.T
        np.testing.assert_allclose(first[k], 100.0 * wanted, rtol=1e-6, atol=1e-4 * density**2)
        for found in (offline.propagate(None, None), live.covariances(unknown, unknown)):
            np.testing.assert_allclose(found[k], 500.0 * wanted, rtol=1e-6, atol=1e-4 * density**2)


def test_the_verb_and_the_node_take_the_noise(noise_file, tmp_path):
    """
    Twice the noise is four times the variance.

    To this is added how far the angular acceleration is off at this motion.
    """
    adoption = pytest.importorskip('imu_calibration.nodes.adoption')
    twice, truth = tmp_path / 'twice.yaml', BAG / 'truth.yaml'
    twice.write_text(noise_to_text(noise_of({'white_noise': 4e-4}, {'white_noise': 2e-5})))
    text, of_bags, of_nodes = truth.read_text(), [], []
    for file in (noise_file, twice):
        output = tmp_path / file.stem
        # Nothing proves truth.yaml.
        assert (
            main(
                [
                    'compensate',
                    str(BAG),
                    '--calibration',
                    str(truth),
                    '--anyway',
                    '--noise',
                    str(file),
                    '--output',
                    str(output),
                ]
            )
            == 3
        )
        of_bags.append(
            parse_imu(raw_messages(output, '/imu/data_corrected')[-1][1]).doubles[
                FIELDS['force_cov']
            ][0]
        )
        settings = adoption.CompensatorSettings(noise_file=str(file), anyway=True)
        live = adoption.adopt(text, 'here', settings, frames=None).compensation
        for k in range(200):  # until the slope is known
            live.correct(10**18 + 5_000_000 * k, 0.0, 0.0, 0.0, 0.0, 0.0, 9.81)
        of_nodes.append(live.covariances(np.zeros((3, 3)), np.zeros((3, 3)))[0][0, 0])
    assert of_bags[1] / of_bags[0] == pytest.approx(4.0, rel=0.05) and of_nodes[1] / of_nodes[
        0
    ] == pytest.approx(4.0, rel=0.02)
    with refused(InputError, 'file_unreadable', 'missing.yaml'):
        adoption.adopt(
            text, 'here', replace(settings, noise_file=str(tmp_path / 'missing.yaml')), frames=None
        )


def test_the_noise_becomes_metres():
    """
    White noise of the accelerometer alone.

    N sqrt(t^3 / 3 + t^4 / (4 T)) with the bias from T = 60 s.
    """
    figures = noise_of({'white_noise': 2e-3}, {'white_noise': 1e-12})
    for seconds, shares in position_budget(figures):
        expected = 2e-3 * np.sqrt(seconds**3 / 3 + seconds**4 / 4 / 60.0)
        assert shares['accelerometer'] == pytest.approx(expected, rel=0.02)


def test_white_noise_that_may_be_none_counts_with_its_bound():
    axis = AxisFigures(
        {'white_noise': Term('white_noise', 0.0, (0.0, 3e-4), 'weak', 'may be none')}
    )
    assert axis.white == 3e-4


def test_an_axis_that_allows_any_walk_is_not_the_worst():
    """A vibration can hide a walk of any size; filters want a number, which the other axes have."""
    open_end = axis_of(white_noise=1e-4)
    open_end.terms['random_walk'] = Term('random_walk', None, (0.0, np.inf), HELD)
    axes = (open_end, axis_of(white_noise=1e-4), axis_of(white_noise=1e-4))
    assert NoiseFigures(axes, axes, 100.0).densities('gyroscope').walk == 1e-9


def test_the_noise_of_the_gyroscope_alone_is_used_at_the_rate_of_the_readings(noise_file):
    """Recorded at 100 Hz, used live at 500 Hz: five times the variance of the gyroscope only."""
    plain = random_calibration(2, ())
    plain = replace(plain, covariance=np.zeros_like(plain.covariance))
    figures = replace(files.read_noise(noise_file), accelerometer=())
    live = SampleCompensation(with_measured_noise(plain, figures))
    unknown = np.zeros((3, 3))
    force_first, rate_first = live.covariances(unknown, unknown)
    for k in range(200):
        live.correct(10**18 + 2_000_000 * k, 0.0, 0.0, 0.0, 0.0, 0.0, 9.81)
    force, rate = live.covariances(unknown, unknown)
    np.testing.assert_allclose(rate, 5.0 * rate_first, rtol=1e-6, atol=1e-16)
    np.testing.assert_allclose(force, force_first, rtol=1e-6, atol=1e-16)
