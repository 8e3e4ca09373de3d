"""
Damaged documents.

Every field with wrong types, sizes and numbers is refused in one line, or does no harm to who uses
it.
"""

import copy
import math
import subprocess
import sys
from dataclasses import replace
from datetime import date

import numpy as np
import pytest
from fuzz.readers import noise_seeds
from refusal import refused

from imu_calibration.allan.document import counts, noise_from_mapping, noise_mapping, rows
from imu_calibration.compensation.compensate import outside_conditions
from imu_calibration.core import documents
from imu_calibration.core.errors import InputError
from imu_calibration.core.readings import RawReadings
from imu_calibration.core.samples import ImuSamples
from imu_calibration.document import trust
from imu_calibration.document.calibration_text import (
    calibration_mapping,
    calibration_to_text,
    checked_tolerances,
    from_mapping,
)
from imu_calibration.document.decision import decisions_text
from imu_calibration.document.proof_entry import EarlierErrors, ProofEntry, RegimeErrors
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.kinematics.table import Table
from imu_calibration.nodes.message_compensation import LiveCompensation
from msg_adapters.imu import FIELDS
from msg_adapters.write import encode_imu
from validation.imu_messages import parse_imu

from worlds.compensation_cases import random_calibration
from worlds.noise_worlds import identifying

WRONG = (
    None,
    True,
    'text',
    '',
    '1e-3',
    -1,
    0,
    7,
    1e308,
    -1e308,
    math.inf,
    math.nan,
    10**400,
    [],
    [1.0],
    [[1.0] * 3] * 3,
    [math.nan] * 3,
    [None] * 3,
    {},
    {'a': 1},
    date(2026, 1, 1),
    b'bytes',
    'x' * 4000,
)
"""What a field is replaced by."""
PROOF = ProofEntry(
    0.1,
    0.01,
    (0.05, 0.2),
    unit='m/s^2',
    windows=12,
    delay_s=1e-3,
    regimes={'rest': RegimeErrors(0.1, 0.01, (0.05, 0.2), seconds=30.0, unit='m/s^2')},
    earlier=EarlierErrors(0.02, (0.1, 0.3)),
)


def calibration():
    """A calibration with something in every part of its document."""
    made = random_calibration(
        3,
        ('accel_size_effect', 'accel_thermal_bias', 'accel_saturation'),
        ('gyro_g_sensitivity', 'gyro_thermal_scale'),
        gauge={'origin': 'mean_of_sensitive_points', 'axes': 'mount'},
        decision={'accelerometer': 'helps', 'gyroscope': 'helps'},
        decision_reasons={'accelerometer': 'a reason', 'gyroscope': 'another'},
        notes=('a note', 'next: a step'),
        proof={'accelerometer': PROOF, 'gyroscope': replace(PROOF, unit='rad/s')},
        provenance={'software': '1', 'bags': [{'name': 'a', 'sha256': 'b'}]},
        undetermined=({'parameters': {'accelerometer.bias.x': 0.5}, 'needs': 'a motion'},),
    )
    values = made.values.copy()
    values[made.model.slices['accelerometer', 'accel_saturation']] = 160.0
    statistics = {
        sensor: part | {'between_window_sd': 1e-3, 'wander_sd': 1e-4, 'chi2_per_dof': {'spin': 1.0}}
        for sensor, part in made.statistics.items()
    }
    statistics |= {
        'windows': {'static': 5},
        'samples_used': {'static': 500},
        'dropped': {},
        'preflight': [],
    }
    conditions = {
        'temperature_range_c': [20.0, 30.0],
        'largest_rate': 3.0,
        'largest_force': 12.0,
        'gravity': 9.81,
        'duration_s': 60.0,
        'date': '2026-11-21',
    }
    return type(made)(
        **{
            **{name: getattr(made, name) for name in made.__dataclass_fields__},
            'values': values,
            'statistics': statistics,
            'conditions': conditions,
        }
    )


GOOD = documents.from_text(calibration_to_text(calibration()))


def places(part, path=()):
    """Yield the path of every field; of a list the first and the last entry stand for all."""
    yield path
    items = (
        part.items()
        if isinstance(part, dict)
        else list(enumerate(part))
        if isinstance(part, list)
        else []
    )
    for key, value in items if isinstance(part, dict) else items[:1] + items[1:][-1:]:
        yield from places(value, (*path, key))


def changed(path, value):
    """Return the good document with one field replaced."""
    return _changed(GOOD, path, value)


def _changed(part, path, value):
    if not path:
        return value
    part = copy.copy(part)
    part[path[0]] = _changed(part[path[0]], path[1:], value)
    return part


PLACES = list(places(GOOD))
MESSAGES = [
    row.tobytes()
    for row in encode_imu(
        ImuSamples(
            10**18 + 5_000_000 * np.arange(30),
            np.column_stack([np.linspace(-20, 20, 30), np.ones(30), np.full(30, 9.8)]),
            np.column_stack([np.sin(np.arange(30)), np.linspace(-5, 5, 30), np.zeros(30)]),
            'imu_link',
        )
    )
]


KNOWN_TO_WORK = set()
"""What was used already: a kernel takes its time to make."""


def use(found):
    """
    Do with a calibration all that a robot does.

    Fails with any error and with any number that is not finite.
    """
    refused = list(trust.refused_sensors(found, live=True))
    against = (
        refused,
        trust.caveats(found),
        decisions_text(found.decisions),
        outside_conditions(found, 3**0.5, [25.0]),
    )
    assert '\n' not in ''.join(line for part in against for line in part)
    assert calibration_mapping(found)
    noise = [found.noise(sensor) for sensor in ('accelerometer', 'gyroscope')]
    numbers = (
        found.values.tobytes(),
        found.covariance.tobytes(),
        repr((found.model.param_names, found.model.temperature_ref_c, noise)),
    )
    if against[0] or numbers in KNOWN_TO_WORK:
        return
    KNOWN_TO_WORK.add(numbers)
    live = LiveCompensation(found, check_frame=False, correct_stamps=True)
    live.set_temperature(26.0)
    with np.errstate(all='raise', under='ignore'):
        for message in MESSAGES:
            out = live(message)
            if out is not None:
                numbers = parse_imu(out).doubles
                assert np.all(np.isfinite(numbers))
                for name in ('rate_cov', 'force_cov'):
                    assert np.all(np.diag(np.reshape(numbers[FIELDS[name]], (3, 3))) >= 0)


def test_the_document_that_is_damaged_is_whole():
    found = from_mapping(GOOD)
    use(found)
    assert calibration_mapping(found).keys() == GOOD.keys() and not trust.refused_sensors(
        found, live=True
    )


@pytest.mark.long
@pytest.mark.parametrize(
    'part', sorted({path[:1] for path in PLACES}), ids=lambda path: path[0] if path else 'whole'
)
def test_no_damaged_field_gets_through(part):
    refused = used = 0
    for path in PLACES:
        if path[:1] != part:
            continue
        for value in WRONG:
            try:
                found = from_mapping(changed(path, value))
            except InputError as error:
                assert '\n' not in str(error) and len(str(error)) < 500, (path, value)
                refused += 1
                continue
            try:
                use(found)
            except Exception as error:
                raise AssertionError(
                    f'{path} = {value!r}: {type(error).__name__}: {error}'
                ) from error
            used += 1
    print(f'{part}: {refused} refused, {used} without harm')
    assert refused or part == ('provenance',)


ATTACKS = """
import resource
resource.setrlimit(resource.RLIMIT_AS, (2 * 10**9, 2 * 10**9))
from imu_calibration.document.calibration_text import calibration_from_text
from imu_calibration.core.errors import InputError
laughs = "".join(f"a{k}: &a{k} [{', '.join(['*a' + str(k - 1)] * 10)}]\\n" for k in range(1, 12))
texts = {
    'brackets': '[' * 200_000, 'braces': '{a: ' * 100_000, 'dashes': '- ' * 100_000,
    'questions': '? ' * 100_000,
    'aliases': 'a0: &a0 [x, x]\\n' + laughs, 'recursion': 'a: &a [*a]',
    'many': 'a: [' + '1,' * 900_000 + ']', 'large': 'a: "' + 'x' * 3_000_000 + '"',
    'sixty': 'a: 1' + ':59' * 600_000, 'digits': 'a: ' + '9' * 100_000,
    'some digits': 'a: ' + '9' * 4_500, 'date': 'a: 2026-99-99', 'float': 'a: !!float x',
    'binary': 'a: !!binary xx', 'stamp': 'a: !!timestamp x', 'key': '? [a]\\n: b',
    'object': 'a: !!python/object/apply:os.getcwd []', 'nul': '\\0', 'empty': '',
    'half a character': 'a: \\ud800', 'merge': '<<: [1, 2]', 'list': '[]', 'number': '7',
    'bell': '\\a',
}
for name, text in texts.items():
    try:
        calibration_from_text(text)
        print(name, 'came through')
    except InputError as error:
        short = '\\n' not in str(error) and len(str(error)) < 500
        print('' if short else f'{name}: {error}', end='')
print('done')
"""


@pytest.mark.live
def test_texts_that_would_take_all_memory_or_end_the_process_are_refused_in_one_line():
    """
    Under a limit of 2 GB for the whole process.

    Most of them took minutes, gigabytes or the process.
    """
    done = subprocess.run(
        [sys.executable, '-c', ATTACKS], capture_output=True, text=True, timeout=120
    )
    assert (done.returncode, done.stdout) == (0, 'done\n'), done.stdout + done.stderr


TABLE = {
    'joints': [
        {'name': 'outer', 'axis': [0, 0, 1]},
        {
            'name': 'inner',
            'axis': [1, 0, 0],
            'xyz': [0.0, 0.0, 0.1],
            'rpy_deg': [0, 0, 0],
            'range_deg': [-90, 90],
            'speed_deg_s': 60.0,
        },
        {'name': 'slide', 'axis': [1, 0, 0], 'type': 'prismatic', 'range_m': [0, 1]},
        {
            'name': 'follower',
            'axis': [0, 1, 0],
            'mimic': {'joint': 'outer', 'multiplier': 2.0, 'offset': 0.1},
        },
    ],
    'up': [0, 0, 1],
    'gravity': 9.81,
    'gravity_sd': 0.001,
    'latitude': 48.0,
    'height': 300.0,
    'azimuth_deg': 10.0,
    'joint_noise_rad': 1e-5,
    'mount': {'rpy_deg': [0, 0, 0], 'xyz': [0, 0, 0]},
}
READINGS = {
    'accelerometer': {'unit': 'counts', 'scale': 415.0, 'offset': [32768.0] * 3},
    'gyroscope': {'unit': 'counts:4770/(rad/s)', 'offset': 32000.0},
    'axes': 'frd',
}
FLAT_READINGS = {'accelerometer_scale': 400.0, 'gyroscope_offset': [1.0, 2.0, 3.0]}
EFFECTS = {
    'mine': {
        'sensor': 'accelerometer',
        'column': 'f_x * abs(f_x)',
        'unit': 's^2/m',
        'tolerance': 0.001,
        'text': 'mine',
        'tolerance_reason': 'a guess',
        'prior_sd': 1.0,
        'largest': 2.0,
    },
    'settling': {
        'sensor': 'gyroscope',
        'column': ['exp(-t / tau)'] * 3,
        'unit': 'rad/s',
        'tolerance': 1e-4,
        'text': 'settles',
        'time_constant': 60.0,
    },
}
TOLERANCES = {
    'accelerometer': {'bias': 0.01, 'matrix': 1e-3},
    'gyroscope': {'bias': 1e-4},
    'reference': {'table_tilt': 1e-4},
}


def _outermost_entry(path):
    """Return the entry of the outermost list of a path, or None without a list."""
    return next((key for key in path if isinstance(key, int)), None)


def read_readings(mapping):
    """Convert readings as a description says."""
    readings = RawReadings.from_mapping(mapping)
    with np.errstate(all='raise', under='ignore'):
        assert np.all(np.isfinite(readings.convert_message([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])))


def use_noise(document):
    """Do with the figures of a noise document all that exports and nodes do."""
    figures = noise_from_mapping(document)
    counts(figures)
    rows(figures)
    with np.errstate(over='ignore', invalid='ignore'):
        noise_mapping(figures)


@pytest.mark.long
@pytest.mark.parametrize(
    ('good', 'read'),
    (
        (TABLE, Table.from_mapping),
        (TOLERANCES, checked_tolerances),
        (READINGS, read_readings),
        (FLAT_READINGS, read_readings),
        (EFFECTS, CATALOGUE.with_definitions),
        (None, use_noise),
    ),
    ids=('table', 'tolerances', 'readings', 'flat readings', 'effects', 'noise'),
)
def test_damaged_documents_are_refused_in_one_line_or_can_be_used(good, read):
    is_noise = good is None
    if is_noise:  # the document of an identification
        with identifying(0):
            good = documents.from_text(noise_seeds(None)[0].decode())
        # Of a curve the first and the last entry stand for all.
        for name, curve in good['allan_deviation'].items():
            good['allan_deviation'][name] = (
                curve[:: len(curve) - 1] if name == 'tau' else [d[:: len(d) - 1] for d in curve]
            )
    refused = 0
    for path in list(places(good))[1:]:
        # Both sensors and all axes of a document of noise have one declaration: below the fields of
        # the gyroscope and in lists of the axis x nothing else is checked.
        if is_noise and (path[0] == 'gyroscope' and len(path) > 2 or _outermost_entry(path) == 0):
            continue
        for value in WRONG:
            try:
                found = read(_changed(good, path, value))
            except InputError as error:
                assert '\n' not in str(error), (path, value)
                refused += 1
                continue
            if isinstance(found, Table):
                assert (
                    1.0 < found.gravity_value < 30.0
                    and np.all(np.isfinite(found.mat_nb))
                    and np.all(np.isfinite(found.mat_sl))
                )
    assert refused > 20


def test_a_misspelt_tolerance_is_told():
    with refused(InputError, 'tolerance_name', 'accel_size_effect'):
        checked_tolerances({'accelerometer': {'size_effect': 1e-3}})
