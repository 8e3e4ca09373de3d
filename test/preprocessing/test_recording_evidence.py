"""
Pre-flight: each fault that a driver can make is named by one check.

Good recordings are left in peace.
"""

import re
from collections import deque
from contextlib import redirect_stderr
from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
import yaml
from refusal import refused

from imu_calibration.cli.main import main
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import SampleBlock
from imu_calibration.document.calibration_text import calibration_from_text
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.checks import Preflight
from imu_calibration.preprocessing.joint_checks import check_force
from imu_calibration.preprocessing.on_table import match_axes, signed_permutations
from imu_calibration.preprocessing.recording_evidence import GOOD, NOTE, REFUSE, WARNING
from imu_calibration.preprocessing.stream_cleaning import BlockCleaner
from imu_calibration.preprocessing.value_checks import force_error
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.session import random_values, simulate_session
from msg_adapters.bag import open_recording
from msg_adapters.bag_writer import BagWriter
from msg_adapters.definitions import standard_definition
from msg_adapters.imu import IMU_TYPE
from msg_adapters.layout import Packed
from msg_adapters.write import encode_imu, write_session

from worlds.physics import make_session, write_bag
from worlds.physics_hand import hold_and_turn

G = 9.80665


@pytest.fixture(scope='module')
def session():
    """A session without faults: a hundred and fifty seconds on a three-axis table."""
    return make_session(3, profile='quick', noise='realistic', grade='industrial')


@pytest.fixture(scope='module')
def coarse(session):
    """Every second sample of it, for calibrations that do not ask for the rate."""
    imu, joints = (
        samples.select(slice(None, None, 2)) for samples in (session.imu, session.joints)
    )
    return replace(session, imu=imu, joints=joints)


@pytest.fixture(scope='module')
def table(tmp_path_factory, session):
    """Its table file."""
    path = tmp_path_factory.mktemp('preflight') / 'table.yaml'
    path.write_text(yaml.safe_dump(session.table))
    return path


def findings(samples, nominal=None, gravity=None, cut=None):
    """Look at samples as one block, or cut into pieces of `cut` samples."""
    imu, joints, temperature = samples
    blocks = [SampleBlock(imu, joints, temperature)]
    if cut is not None:
        blocks = [SampleBlock(imu.select(slice(a, a + cut))) for a in range(0, len(imu), cut)] + [
            SampleBlock(None, joints, temperature)
        ]
    preflight = Preflight(gravity, strict=False)
    deque(BlockCleaner(nominal=nominal, watchers=[preflight]).all_of(blocks), maxlen=0)
    return preflight.findings


def trouble(found):
    """The findings beyond notes, as (check, severity)."""
    return sorted({(f.check, f.severity) for f in found if f.severity in (REFUSE, WARNING)})


# What a driver can do wrong
# --------------------------------------------------------------------------------------------------


def in_g(imu, joints, temperature):
    return replace(imu, force_s=imu.force_s / G), joints, temperature


def in_mg(imu, joints, temperature):
    return replace(imu, force_s=imu.force_s / G * 1000), joints, temperature


def in_counts(imu, joints, temperature):
    return (
        replace(
            imu,
            force_s=np.round(imu.force_s * 415 + 32768),
            rate_s=np.round(imu.rate_s * 4770 + 32768),
        ),
        joints,
        temperature,
    )


def in_degrees(imu, joints, temperature):
    return replace(imu, rate_s=np.rad2deg(imu.rate_s)), joints, temperature


def twice_converted(imu, joints, temperature):
    return replace(imu, rate_s=np.deg2rad(imu.rate_s)), joints, temperature


def mirrored_gyroscope(imu, joints, temperature):
    return replace(imu, rate_s=imu.rate_s * [1.0, -1.0, 1.0]), joints, temperature


def gyroscope_axes_swapped(imu, joints, temperature):
    return replace(imu, rate_s=imu.rate_s[:, [1, 0, 2]]), joints, temperature


def gyroscope_turned(imu, joints, temperature):
    return replace(imu, rate_s=imu.rate_s[:, [1, 0, 2]] * [1.0, -1.0, 1.0]), joints, temperature


def dead_axis(imu, joints, temperature):
    return replace(imu, force_s=imu.force_s * [1.0, 0.0, 1.0]), joints, temperature


def dead_gyroscope(imu, joints, temperature):
    return replace(imu, rate_s=np.zeros_like(imu.rate_s)), joints, temperature


def stuck_axis(imu, joints, temperature):
    rate = imu.rate_s.copy()
    moving = np.argmax(np.convolve(np.abs(rate[:, 0]), np.ones(600), 'valid'))
    rate[moving : moving + 600, 1] = rate[moving, 1]
    return replace(imu, rate_s=rate), joints, temperature


def frozen(samples, start, seconds, *names):
    """Hold the readings at `start` seconds."""
    first, last = np.searchsorted(
        samples.stamp_ns, samples.stamp_ns[0] + np.array([start, start + seconds]) * 10**9
    )
    columns = {name: getattr(samples, name).copy() for name in names}
    for column in columns.values():
        column[first:last] = column[first]
    return replace(samples, **columns)


def imu_frozen_for_a_time(imu, joints, temperature):
    return frozen(imu, 40, 30, 'force_s', 'rate_s'), joints, temperature


def gyroscope_frozen_for_a_time(imu, joints, temperature):
    return frozen(imu, 40, 8, 'rate_s'), joints, temperature


def gyroscope_frozen_at_its_largest(imu, joints, temperature):
    largest = float(imu.stamp_ns[np.argmax(imu.rate_s[:, 2])] - imu.stamp_ns[0]) * 1e-9
    return frozen(imu, largest, 8, 'rate_s'), joints, temperature


def joints_frozen_for_a_time(imu, joints, temperature):
    moving = np.linalg.norm(imu.rate_s, axis=1) > 0.2
    longest = np.argmax(np.convolve(moving, np.ones(1000), 'valid'))
    return (
        imu,
        frozen(
            joints, float(imu.stamp_ns[longest] - imu.stamp_ns[0]) * 1e-9, 6, 'position', 'velocity'
        ),
        temperature,
    )


def half_a_g_off(imu, joints, temperature):
    return replace(imu, force_s=imu.force_s + [0.47 * G, 0.0, 0.0]), joints, temperature


def fast_at_rest(imu, joints, temperature):
    return replace(imu, rate_s=imu.rate_s + [0.0, 1.4, 0.0]), joints, temperature


def clipped_gyroscope(imu, joints, temperature):
    return replace(imu, rate_s=np.clip(imu.rate_s, -1.0, 1.0)), joints, temperature


def repeated_stamps(imu, joints, temperature):
    stamps = imu.stamp_ns.copy()
    stamps[50::100] = stamps[49::100][: len(stamps[50::100])]
    return replace(imu, stamp_ns=stamps), joints, temperature


def no_stamps(imu, joints, temperature):
    return replace(imu, stamp_ns=np.zeros_like(imu.stamp_ns)), joints, temperature


def late_samples(imu, joints, temperature):
    stamps = imu.stamp_ns.copy()
    stamps[100::500] -= 25_000_000
    return replace(imu, stamp_ns=stamps), joints, temperature


def jumping_clock(imu, joints, temperature):
    stamps = imu.stamp_ns.copy()
    stamps[len(stamps) // 2 :] -= 20_000_000_000
    return replace(imu, stamp_ns=stamps), joints, temperature


def two_clocks(imu, joints, temperature):
    return (
        imu,
        replace(joints, stamp_ns=joints.stamp_ns - joints.stamp_ns[0] + 5_000_000_000),
        temperature,
    )


def late_joints(imu, joints, temperature):
    return imu, replace(joints, stamp_ns=joints.stamp_ns + 60_000_000_000), temperature


def lost_samples(imu, joints, temperature):
    keep = np.random.default_rng(1).random(len(imu)) > 0.1
    return imu.select(keep), joints, temperature


def holes(imu, joints, temperature):
    keep = (np.arange(len(imu)) % 3000) > 300
    return imu.select(keep), joints, temperature


def not_finite(imu, joints, temperature):
    force = imu.force_s.copy()
    force[::1000, 2] = np.nan
    return replace(imu, force_s=force), joints, temperature


def without_gravity(imu, joints, temperature):
    length = np.linalg.norm(imu.force_s, axis=1, keepdims=True)
    return replace(imu, force_s=imu.force_s * (1 - G / length)), joints, temperature


def wrong_gravity(imu, joints, temperature):
    return replace(imu, force_s=imu.force_s * 1.05), joints, temperature


def published_twice(imu, joints, temperature):
    pairs = np.arange(len(imu)) // 2 * 2
    return replace(imu, force_s=imu.force_s[pairs], rate_s=imu.rate_s[pairs]), joints, temperature


def in_kelvin(imu, joints, temperature):
    return imu, joints, replace(temperature, temperature_c=temperature.temperature_c + 273.15)


FAULTS = (
    (in_g, 'force_unit', REFUSE, (1.0, 'g')),
    (in_mg, 'force_unit', REFUSE, (1000.0, 'mg')),
    (in_counts, 'force_unit', REFUSE, ()),
    (in_counts, 'rate_unit', REFUSE, ()),
    (without_gravity, 'without_gravity', REFUSE, ()),
    (in_degrees, 'rate_unit', REFUSE, (56.1, 'deg')),
    (twice_converted, 'rate_unit', REFUSE, ()),
    (mirrored_gyroscope, 'handedness', REFUSE, ('gyroscope', 'accelerometer', 'y')),
    (gyroscope_axes_swapped, 'handedness', REFUSE, ('gyroscope', 'accelerometer', 'x', 'y')),
    (gyroscope_turned, 'handedness', REFUSE, ('gyroscope', 'accelerometer', 'x', 'y')),
    (dead_axis, 'frozen', REFUSE, ('accelerometer', 'y')),
    (dead_gyroscope, 'frozen', REFUSE, ('gyroscope',)),
    (stuck_axis, 'frozen', WARNING, ('gyroscope', 'y')),
    (imu_frozen_for_a_time, 'frozen', WARNING, ('IMU', 40.0, 70.0)),
    (gyroscope_frozen_for_a_time, 'frozen', WARNING, ('gyroscope', 40.0)),
    (gyroscope_frozen_at_its_largest, 'frozen', WARNING, ('gyroscope',)),
    (joints_frozen_for_a_time, 'frozen', WARNING, ('joint',)),
    (half_a_g_off, 'bias', WARNING, (0.47,)),
    (fast_at_rest, 'bias', WARNING, (80.0,)),
    (clipped_gyroscope, 'clipping', WARNING, ('gyroscope', 1.0, 57.0)),
    (repeated_stamps, 'stamps', WARNING, ('Imu', 149.0)),
    (no_stamps, 'stamps_equal', REFUSE, ()),
    (late_samples, 'stamps', WARNING, (30.0,)),
    (jumping_clock, 'stamps', WARNING, ('Imu',)),
    (not_finite, 'stamps', WARNING, (15.0,)),
    (two_clocks, 'clocks', REFUSE, ('Imu',)),
    (late_joints, 'clocks', WARNING, (60.0, 'Imu')),
    (lost_samples, 'sampling', WARNING, (100.0, 90.0)),
    (holes, 'gaps', WARNING, (4.0, 12.0, 3.0)),
    (wrong_gravity, 'gravity', WARNING, (4.6,)),
    (published_twice, 'repeated_readings', WARNING, (50.0,)),
    (in_kelvin, 'temperature', WARNING, (300.0,)),
)
"""Fault, check, severity, and names and numbers that a finding must have."""
IDS = [f'{fault.__name__}-{check}' for fault, check, *_ in FAULTS]
THROUGH_A_BAG = (
    no_stamps,
    jumping_clock,
    not_finite,
    two_clocks,
    in_kelvin,
)


def lacks(text, wanted):
    """Return the names and numbers (to 2 %) that a text lacks."""
    words, numbers = (
        set(re.findall(r'[A-Za-z]+', text)),
        [float(number) for number in re.findall(r'\d+\.?\d*', text)],
    )
    return [
        value
        for value in wanted
        if not (
            value in words if isinstance(value, str) else pytest.approx(value, rel=0.02) in numbers
        )
    ]


@pytest.mark.parametrize(('fault', 'check', 'severity', 'wanted'), FAULTS, ids=IDS)
def test_a_fault_is_named_by_its_check(session, fault, check, severity, wanted):
    texts = [
        f.text
        for f in findings(fault(session.imu, session.joints, session.temperature))
        if (f.check, f.severity) == (check, severity)
    ]
    assert texts and lacks(' '.join(texts), wanted) == []


@pytest.mark.parametrize('fault', THROUGH_A_BAG)
def test_inspect_prints_the_findings_of_a_bag(capsys, tmp_path, session, fault):
    samples = fault(session.imu, session.joints, session.temperature)
    write_session(str(tmp_path / 'bag'), *samples[:2], temperature=samples[2])
    code = main(['inspect', str(tmp_path / 'bag')])
    printed, found = ' '.join(capsys.readouterr().out.split()), findings(samples)
    assert trouble(found)
    for severity, check in {(f.severity, f.check) for f in found} & {
        (severity, check) for which, check, severity, _ in FAULTS if which is fault
    }:
        assert all(
            f'{severity} {check.replace("_", " ")} {" ".join(f.text.split())}' in printed
            for f in found
            if (f.severity, f.check) == (severity, check)
        )
    assert code == (1 if REFUSE in {f.severity for f in found} else 3)


# One of each check; a sensor with frozen readings does not refuse the other one.
@pytest.mark.parametrize(
    'fault',
    {
        check: fault
        for fault, check, severity, _ in FAULTS
        if severity == REFUSE and check != 'frozen'
    }.values(),
)
def test_calibrate_refuses_what_would_make_the_result_wrong(
    capsys, tmp_path, session, table, fault
):
    """One line, exit code 1, nothing written: with the table and by hand."""
    imu, joints, temperature = fault(session.imu, session.joints, session.temperature)
    write_session(str(tmp_path / 'bag'), imu, joints, temperature=temperature)
    references = [['--table', str(table)]]
    if fault is not two_clocks:  # by hand the joints do not matter
        references.append([])
    for more in references:
        capsys.readouterr()
        assert (
            main(['calibrate', str(tmp_path / 'bag'), *more, '--output', str(tmp_path / 'out')])
            == 1
        )
        printed = capsys.readouterr()
        assert printed.out == '' and len(printed.err.splitlines()) == 1
        assert ' must ' in printed.err
        assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize('by_hand', (False, True))
def test_a_dead_gyroscope_leaves_the_accelerometer_calibrated(tmp_path, coarse, table, by_hand):
    """Exit code 3; the gyroscope is absent from the file."""
    imu, joints, temperature = dead_gyroscope(coarse.imu, coarse.joints, coarse.temperature)
    write_session(str(tmp_path / 'bag'), imu, joints, temperature=temperature)
    more = [] if by_hand else ['--table', str(table)]
    arguments = ['calibrate', str(tmp_path / 'bag'), *more, '--no-report', '--output']
    few = 'accel_quadratic+gyro_bias_drift'
    assert main([*arguments, str(tmp_path / 'out'), '--candidates', few]) == 3
    found = calibration_from_text((tmp_path / 'out' / 'calibration.yaml').read_text())
    assert found.absent == ('gyroscope',)
    statuses = found.status_by_name
    assert statuses['accelerometer.bias.x'] == 'determined'
    assert not [name for name in statuses if name.startswith('gyroscope')]


@pytest.mark.long
@pytest.mark.parametrize(
    ('fault', 'check', 'unusable'),
    ((clipped_gyroscope, 'clipping', True), (wrong_gravity, 'gravity', False)),
)
def test_calibrate_goes_on_with_a_warning(capsys, tmp_path, coarse, table, fault, check, unusable):
    """
    Said on standard error, kept in the file and the report; exit code 3 when samples are unusable.
    """
    imu, joints, temperature = fault(coarse.imu, coarse.joints, coarse.temperature)
    write_session(str(tmp_path / 'bag'), imu, joints, temperature=temperature)
    more = ['--model-as-asked', *([] if unusable else ['--no-report'])]  # one report is enough
    code = main(
        [
            'calibrate',
            str(tmp_path / 'bag'),
            '--table',
            str(table),
            '--output',
            str(tmp_path / 'out'),
            *more,
        ]
    )
    (text,) = (
        line for line in capsys.readouterr().err.splitlines() if line.startswith('warning: ')
    )
    statistics = yaml.safe_load((tmp_path / 'out' / 'calibration.yaml').read_text())['statistics']
    (found,) = statistics['preflight']
    assert found['check'] == check and text == f'warning: {found["text"]}'
    assert (
        not unusable
        or found['text'].split(',')[0] in (tmp_path / 'out' / 'report.html').read_text()
    )
    assert (statistics['unusable'] > 0) == unusable
    assert code in ((3,) if unusable else (0, 3))


# Against the joints
# --------------------------------------------------------------------------------------------------


def turned(imu):
    """The sensor turned by 90 degrees about z: its x where the table has y."""
    return replace(
        imu,
        force_s=imu.force_s[:, [1, 0, 2]] * [1.0, -1.0, 1.0],
        rate_s=imu.rate_s[:, [1, 0, 2]] * [1.0, -1.0, 1.0],
    )


def test_a_sensor_turned_against_the_table_gets_the_mount_that_fits(
    capsys, tmp_path, coarse, table
):
    write_session(str(tmp_path / 'bag'), turned(coarse.imu), coarse.joints)
    assert (
        main(
            [
                'calibrate',
                str(tmp_path / 'bag'),
                '--table',
                str(table),
                '--output',
                str(tmp_path / 'out'),
            ]
        )
        == 1
    )
    (line,) = capsys.readouterr().err.splitlines()
    assert 'mount.rpy_deg' in line
    fits = yaml.safe_load(re.findall(r'\[[^]]*\]', line)[-1])
    corrected = tmp_path / 'corrected.yaml'
    corrected.write_text(yaml.safe_dump({**coarse.table, 'mount': {'rpy_deg': fits, 'xyz': None}}))
    assert main(
        [
            'calibrate',
            str(tmp_path / 'bag'),
            '--table',
            str(corrected),
            '--output',
            str(tmp_path / 'out'),
            '--no-report',
            '--model-as-asked',
        ]
    ) in (0, 3)


def test_a_joint_that_counts_backwards_is_named(capsys, tmp_path, coarse):
    axes = [
        dict(joint, axis=[-a for a in joint['axis']]) if joint['name'] == 'inner' else joint
        for joint in coarse.table['joints']
    ]
    wrong = tmp_path / 'table.yaml'
    wrong.write_text(yaml.safe_dump({**coarse.table, 'joints': axes}))
    write_bag(coarse, str(tmp_path / 'bag'))
    assert (
        main(
            [
                'calibrate',
                str(tmp_path / 'bag'),
                '--table',
                str(wrong),
                '--output',
                str(tmp_path / 'out'),
            ]
        )
        == 1
    )
    (line,) = capsys.readouterr().err.splitlines()
    assert 'inner' in line and not {'middle', 'outer'} & set(re.findall('[a-z]+', line))


def test_counts_against_the_joints(coarse):
    """Seven times too fast is neither deg/s nor rad/s; the joints know."""
    from imu_calibration.effects.sensor_model import SensorModel
    from imu_calibration.kinematics.table import Table
    from imu_calibration.preprocessing.joint_checks import against_joints
    from imu_calibration.references.turntable.collector import Collector, GatherStep

    model, description = (
        SensorModel(joint_names=coarse.joints.names),
        Table.from_mapping(coarse.table),
    )
    imu = coarse.imu
    for factor, expected in ((1.0, []), (7.0, ['rate_unit']), (180 / np.pi, ['rate_unit'])):
        collector = Collector(GatherStep(description, model))
        collector.push(SampleBlock(replace(imu, rate_s=factor * imu.rate_s), coarse.joints))
        assert [f.check for f in against_joints(collector.finish(), model, description)] == expected


def test_one_axis_cannot_tell_a_mirror_from_a_turn():
    about_y = np.diag([0.0, 1.0, 0.0])
    match = match_axes(-np.eye(3), about_y)
    assert match.wrong and match.turned and match.mirrored
    assert match.exchanges(about_y) == [(1, 1, -1.0)]
    assert not match_axes(np.eye(3), about_y).wrong


def test_every_exchange_of_axes_is_recognised():
    for matrix in signed_permutations():
        match = match_axes(0.017 * matrix + 1e-4)
        assert np.array_equal(match.matrix, matrix)
        assert match.mirrored == (np.linalg.det(matrix) < 0) and match.turned == (
            np.linalg.det(matrix) > 0
        )
        assert match.wrong == (not np.array_equal(matrix, np.eye(3)))


@pytest.mark.parametrize(('angle_deg', 'wrong'), ((30.0, False), (45.0, False), (90.0, True)))
def test_a_crooked_mount_is_no_exchange_of_axes(angle_deg, wrong):
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    assert match_axes(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])).wrong == wrong


# Good recordings
# --------------------------------------------------------------------------------------------------


GOOD_SESSIONS = {
    'white': {},
    'realistic': {'noise': 'realistic'},
    'consumer': {'grade': 'consumer', 'noise': 'realistic'},
    'without noise': {'noise': 'none'},
    'two axes': {'table': 'two_axis'},
    'centrifuge': {'table': 'centrifuge'},
    'no velocity': {'velocity': 'none'},
    'coarse encoder': {'encoder_resolution': 1e-3},
    'late clock': {'hidden': {'time_offset': 0.05}},
    'slow gyroscope': {'hidden': {'gyro_bandwidth': None}},
    'g-sensitive': {'hidden': {'gyro_g_sensitivity': None}},
}


@pytest.mark.parametrize('options', GOOD_SESSIONS.values(), ids=GOOD_SESSIONS)
def test_good_sessions_are_left_in_peace(options):
    good = make_session(
        5, **{'profile': 'quick' if 'table' not in options else 'random_short', **options}
    )
    found = findings((good.imu, good.joints, good.temperature), gravity=good.truth['gravity'])
    assert [f for f in found if f.severity != GOOD] == []
    assert {
        'force_unit',
        'rate_unit',
        'handedness',
        'gravity',
        'stamps',
        'sampling',
        'temperature',
    } <= {f.check for f in found}


@pytest.mark.parametrize('profile', ['avrutov_111', 'avrutov_rates_3', 'zhang_z60'])
def test_motions_of_the_papers_are_left_in_peace(profile):
    """
    One turn about (1, 1, 1) shows no axis of its own.

    Spins about the vertical are as steady as rests, and neither is a fault.
    """
    made = make_profile(profile)
    table = Table.from_mapping(made.table)
    model = SensorModel(joint_names=tuple(table.joint_names))
    found = findings(simulate_session(model, random_values(model), table, profile=made))
    assert [f for f in found if f.severity not in (GOOD, NOTE)] == []
    assert 'rate_unit' in {f.check for f in found} or profile == 'avrutov_rates_3'


@pytest.fixture(scope='module')
def good(tmp_path_factory, coarse):
    """A bag without faults."""
    bag = tmp_path_factory.mktemp('good') / 'bag'
    write_bag(coarse, str(bag))
    return bag


@pytest.fixture(scope='module')
def calibration(good, table):
    """The calibration file of the bag without faults, of which nothing is said."""
    output = good.parent / 'out'
    arguments = ['--table', str(table), '--output', str(output), '--no-report', '--model-as-asked']
    with redirect_stderr(StringIO()) as error:
        assert main(['calibrate', str(good), *arguments]) in (0, 3)
    assert error.getvalue() == ''
    return output / 'calibration.yaml'


def test_a_good_bag_gives_exit_code_zero_and_no_warning(capsys, good, calibration):
    assert main(['inspect', str(good)]) == 0
    assert 'warning' not in capsys.readouterr().out
    # The fixture compares the exit code and standard error of `calibrate`.
    assert yaml.safe_load(calibration.read_text())['statistics']['preflight'] == []


def test_how_the_stream_is_cut_does_not_matter(session):
    samples = clipped_gyroscope(session.imu, session.joints, session.temperature)
    whole = findings(samples)
    for cut in (7, 1000):
        imu = samples[0].select(slice(0, 4000)) if cut == 7 else samples[0]
        expected = whole if cut != 7 else findings((imu, *samples[1:]))
        assert findings((imu, *samples[1:]), cut=cut) == expected


def test_a_real_range_that_was_reached_once_is_no_clipping(session):
    """
    The largest reading of a smooth motion comes once.

    Many equal readings come from a rounded one, below it as above.
    """
    rounded = replace(
        session.imu,
        force_s=np.round(session.imu.force_s, 1),
        rate_s=np.round(session.imu.rate_s, 2),
    )
    assert not {'clipping', 'frozen'} & {f.check for f in findings((rounded, session.joints, None))}
    assert ('resolution', NOTE) in [
        (f.check, f.severity) for f in findings((rounded, session.joints, None))
    ]


@pytest.mark.parametrize(
    'fault', (gyroscope_frozen_for_a_time, gyroscope_frozen_at_its_largest, imu_frozen_for_a_time)
)
def test_what_is_frozen_does_not_clip(session, fault):
    assert [check for check, _ in trouble(findings(fault(session.imu, session.joints, None)))] == [
        'frozen'
    ]


def test_a_rate_of_nothing_is_no_end_of_the_range(session):
    """A gyroscope that is hardly turned and stops at 2 deg/s, whatever piles up there."""
    slow = replace(session.imu, rate_s=np.clip(session.imu.rate_s, -0.035, 0.035))
    assert 'clipping' not in {f.check for f in findings((slow, session.joints, None))}


# Topics
# --------------------------------------------------------------------------------------------------


def several_topics(folder, session, imu=1, joints=1, temperature=1):
    """
    Write a bag with so many topics of each type and return its path.

    None of the topics has its default name.
    """
    from rosbags.rosbag2 import Reader, Writer
    from rosbags.typesys import Stores, get_typestore

    few = (
        session.imu.select(slice(0, 300)),
        session.joints.select(slice(0, 300)),
        session.temperature.select(slice(0, 3)),
    )
    write_session(str(folder / 'plain'), *few[:2], temperature=few[2])
    kinds = {
        '/imu/data_raw': ('imu', imu),
        '/joint_states': ('joints', joints),
        '/imu/temperature': ('temperature', temperature),
    }
    typestore = get_typestore(Stores.ROS2_JAZZY)
    with Reader(folder / 'plain') as reader, Writer(folder / 'bag', version=9) as writer:
        out = {
            c.topic: [
                writer.add_connection(f'/{kinds[c.topic][0]}_{k}', c.msgtype, typestore=typestore)
                for k in range(kinds[c.topic][1])
            ]
            for c in reader.connections
        }
        for connection, stamp, data in reader.messages():
            for target in out[connection.topic]:
                writer.write(target, stamp, data)
    return folder / 'bag'


VERBS = {
    'calibrate': ['--output', 'OUT'],
    'diagnose': ['--table', 'TABLE', '--output', 'OUT'],
    'calibrate on a table': ['--table', 'TABLE', '--output', 'OUT'],
    'compensate': ['--calibration', 'CALIBRATION', '--output', 'OUT'],
}


@pytest.mark.parametrize('kind', ('imu', 'joints', 'temperature'))
@pytest.mark.parametrize('verb', VERBS)
def test_two_topics_of_a_type_are_refused_with_their_names(
    capsys, tmp_path, session, table, calibration, verb, kind
):
    bag = several_topics(tmp_path, session, **{kind: 2})
    if kind == 'joints' and verb in ('calibrate', 'compensate'):
        pytest.skip('does not read joints')
    places = {'OUT': str(tmp_path / 'out'), 'TABLE': str(table), 'CALIBRATION': str(calibration)}
    assert main([verb.split()[0], str(bag), *(places.get(word, word) for word in VERBS[verb])]) == 1
    printed = capsys.readouterr()
    assert printed.out == '' and len(printed.err.splitlines()) == 1
    assert f'/{kind}_0, /{kind}_1' in printed.err and '--' in printed.err
    assert not (tmp_path / 'out').exists()


def test_inspect_looks_at_every_imu(capsys, tmp_path, session):
    bag = several_topics(tmp_path, session, imu=2)
    assert main(['inspect', str(bag)]) == 0
    listing, *looks = capsys.readouterr().out.split('\n\n')
    assert [look.splitlines()[0].strip() for look in looks] == ['/imu_0', '/imu_1']
    assert all('force unit' in look for look in looks)
    assert {line.split()[0] for line in listing.splitlines() if line.rstrip().endswith('read')} == {
        '/imu_0',
        '/imu_1',
        '/joints_0',
        '/temperature_0',
    }
    assert main(['inspect', str(bag), '--imu-topic', '/imu_1']) == 0
    assert '\n/imu_0\n' not in capsys.readouterr().out


@pytest.mark.parametrize('kind', ('joints', 'temperature'))
def test_inspect_says_which_topics_it_leaves_alone(capsys, tmp_path, session, kind):
    assert main(['inspect', str(several_topics(tmp_path, session, **{kind: 2}))]) == 0
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith('not read'))
    assert f'/{kind}_0, /{kind}_1' in line and line.endswith(f'(--{kind.rstrip("s")}-topic)')


def test_inspect_says_what_the_recording_determines_by_hand(capsys, tmp_path):
    imu = hold_and_turn(3)[0]
    for samples, words in (
        (imu, 'without a table, it determines, from 14 poses and 13 turns'),
        (imu.select(slice(0, 400)), 'not usable for calibration without a table: '),
    ):
        write_session(str(tmp_path / str(len(samples))), samples)
        assert main(['inspect', str(tmp_path / str(len(samples)))]) == 0
        printed = capsys.readouterr().out
        assert words in printed and ('determined: accelerometer.bias.x' in printed) == (
            len(samples) > 400
        )


@pytest.mark.parametrize('bad', (0, 1))
def test_inspect_returns_the_worst_code_of_all_imus(capsys, tmp_path, session, table, bad):
    with BagWriter(tmp_path / 'bag') as bag:
        for k in range(2):
            imu = session.imu.select(slice(0, 4000))
            imu = in_g(imu, None, None)[0] if k == bad else imu
            topic = bag.add_topic(f'/imu_{k}', standard_definition(IMU_TYPE))
            bag.write(np.full(len(imu), topic), imu.stamp_ns, Packed.of_rows(encode_imu(imu)))
    assert main(['inspect', str(tmp_path / 'bag')]) == 3
    assert '--accelerometer-unit g' in capsys.readouterr().out
    assert main(['inspect', str(tmp_path / 'bag'), '--imu-topic', f'/imu_{1 - bad}']) == 0


def test_the_only_topic_of_a_type_is_taken_whatever_its_name(capsys, tmp_path, session):
    main(['inspect', str(several_topics(tmp_path, session))])
    out = capsys.readouterr().out
    assert [
        name
        for name in ('/imu_0', '/joints_0', '/temperature_0')
        if not any(name in line and 'read' in line for line in out.splitlines())
    ] == []


def test_a_bag_without_imu_lists_what_it_holds(capsys, tmp_path, session):
    assert main(['inspect', str(several_topics(tmp_path, session, imu=0))]) == 1
    line = capsys.readouterr().err
    assert (
        '/joints_0 (sensor_msgs/msg/JointState)' in line
        and '/temperature_0 (sensor_msgs/msg/Temperature)' in line
    )


# Real recordings
# --------------------------------------------------------------------------------------------------


REAL = {
    ('shaft_pitch_slow', '/imu/data_raw'): [('stamps', WARNING)],
    ('shaft_yaw_medium', '/imu_fixed/data_raw'): [('stamps', WARNING)],
    ('array_2', '/imu_1/data_raw'): [('clipping', WARNING)],
    ('array_5', '/imu_7/data_raw'): [('clipping', WARNING)],
    ('xsens_counts', None): [('force_unit', REFUSE), ('rate_unit', REFUSE)],
    ('mpu9150_0', None): [],
    ('mpu9150_3', None): [],
    ('ferraris', None): [],
}
"""What is known to be true of each; everything else would be a story."""


@pytest.mark.real_data
@pytest.mark.parametrize(('name', 'topic'), REAL, ids=lambda value: str(value))
def test_real_recordings_get_what_is_true_of_them(recordings, name, topic):
    preflight = Preflight(strict=False)
    with open_recording(recordings / name, imu_topic=topic, want_joints='optional') as recording:
        deque(BlockCleaner(watchers=[preflight]).all_of(recording.blocks()), maxlen=0)
    assert trouble(preflight.findings) == REAL[name, topic]
    for finding in preflight.findings:
        if finding.check == 'clipping':
            assert 'gyroscope' in finding.text and '34.87 rad/s (1998 deg/s)' in finding.text
        if name.startswith('shaft') and finding.check == 'jitter':
            assert '1 ms' in finding.text


@pytest.mark.real_data
def test_counts_are_in_order_once_scaled(capsys, recordings, tmp_path):
    """
    The factory's biases are up to 1.2 m/s^2 beside the nominal offset.

    Taken out before gravity is compared.
    """
    nominal = yaml.safe_load((recordings / 'xsens_counts' / 'reference.yaml').read_text())[
        'nominal'
    ]
    (tmp_path / 'nominal.yaml').write_text(yaml.safe_dump(nominal))
    assert (
        main(
            [
                'inspect',
                str(recordings / 'xsens_counts'),
                '--nominal',
                str(tmp_path / 'nominal.yaml'),
            ]
        )
        == 0
    )
    printed = capsys.readouterr().out
    assert 'warning' not in printed and 'refuse' not in printed
    assert re.search(r'\b1\.7\d*\b', printed)


@pytest.mark.real_data
def test_arm_refuses_other_units(capsys, recordings):
    assert (
        main(
            [
                'arm',
                str(recordings / 'xsens_counts'),
                '--imu-topic',
                '/imu/data_raw',
                '--imu-topic',
                '/imu/other',
            ]
        )
        == 1
    )
    assert capsys.readouterr().err.count('\n') == 1


def test_spikes_are_counted_once_among_the_samples(session):
    """
    The total was that of the samples plus the spikes: 16 of 15985 samples in a recording of 15969.
    """
    imu, joints, temperature = session.imu, session.joints, session.temperature
    force = imu.force_s.copy()
    force[1000::3000, 1] += 40.0
    told = [
        found.text
        for found in findings((replace(imu, force_s=force), joints, temperature))
        if found.check == 'stamps'
    ]
    assert any(f'{len(force[1000::3000])} of {len(imu)} ' in text for text in told)


def test_acceleration_without_gravity_is_no_question_of_units():
    """The remedy is another topic; a scale or offset cannot add gravity."""
    assert [force_error(length).code for length in (0.03, 0.5, 1.0, 2.0, 980.0, 5e4)] == [
        'without_gravity'
    ] * 2 + ['force_unit'] * 4
    assert force_error(0.03).key == 'imu_topic' and force_error(9.7) is None
    with refused(InputError, 'without_gravity', '0.12'):
        check_force(0.12)
