"""
The PyPI package python-ins simulates an IMU on a two-axis table.

Our calibration must give its truth back.
"""

from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
from scipy.spatial.transform import Rotation

from imu_calibration.calibration.calibrate import calibrate_by_evidence
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.samples import ImuSamples, JointSamples
from imu_calibration.kinematics.joint import Joint
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable.table_reference import TableReference
from msg_adapters.bag import open_recording
from msg_adapters.write import write_session
from validation.figures import new_figure
from validation.second_opinions import installed
from validation.section import Section, text

LLA = (58.0, 55.0, 150.0)
"""Latitude and longitude in deg, height in m."""
TILT_DEG = (0.02, -0.015)
"""How the table stands crooked: roll and pitch about north and east."""
PERIOD, SEED = 0.01, 5
POSES = tuple(
    (outer, inner) for outer in (0, 45, 90, 135, 180, 225, 270, 315) for inner in (0, 90, 180)
)
"""Angles of the two axes, deg."""
REST_S, SPINS, SPIN_DEG = 8.0, (30.0, 90.0, 180.0), 720.0
TRUTH: dict[str, dict[str, Any]] = {
    'accelerometer': {
        'bias': (0.12, -0.2, 0.3),
        'matrix': ((1.004, 0.002, -0.003), (0.001, 0.997, 0.002), (-0.002, 0.004, 1.006)),
    },
    'gyroscope': {
        'bias': (0.004, -0.006, 0.003),
        'matrix': ((0.995, 0.003, 0.001), (-0.002, 1.003, 0.004), (0.002, -0.001, 1.008)),
    },
}
NOISE = {'accelerometer': 1.2e-3, 'gyroscope': 1.2e-4}
"""Root densities, m/s^2/sqrt(Hz) and rad/s/sqrt(Hz): 120 ug and 0.4 deg/sqrt(h)."""


def record():
    """
    Return (ImuSamples, JointSamples).

    Poses, then spins both ways about each axis, with python-ins' own motion, Earth and errors.
    """
    from pyins import inertial_sensor, sim, transform

    table = sim.Turntable(LLA, (*TILT_DEG, 0.0), angular_rate=60, angular_acceleration=60)
    table.rest(REST_S)
    for outer, inner in POSES:
        for axis, angle in (('outer', outer), ('inner', inner)):
            step = angle - getattr(table, f'{axis}_angle')
            if step:
                table.rotate(axis, step)
        table.rest(REST_S)
    for axis, turned in (('inner', 0), ('outer', 0), ('outer', 90)):
        if turned:
            table.rotate('inner', turned)
        for rate in SPINS:
            for sign in (1, -1):
                table.rotate(axis, sign * SPIN_DEG, angular_rate=rate, angular_acceleration=180)
                table.rest(3.0)
    # python-ins 1.0.1 gives the angles of one axis as (n,), which the Rotation of SciPy 1.17 takes
    # only as (n, 1)
    with mock.patch.object(
        sim, 'Rotation', SimpleNamespace(from_euler=_from_euler, from_matrix=Rotation.from_matrix)
    ):
        trajectory, imu, _ = table.generate_imu(PERIOD)
    accelerometer, gyroscope = (
        inertial_sensor.Parameters(
            TRUTH[sensor]['matrix'], TRUTH[sensor]['bias'], NOISE[sensor], rng=SEED + k
        )
        for k, sensor in enumerate(('accelerometer', 'gyroscope'))
    )
    measured = inertial_sensor.apply_imu_parameters(
        imu, 'rate', gyro_parameters=gyroscope, accel_parameters=accelerometer
    )
    mat_table = Rotation.from_euler('xyz', (*TILT_DEG, 0.0), True).as_matrix()
    mat = mat_table.T @ transform.mat_from_rph(trajectory[['roll', 'pitch', 'heading']].to_numpy())
    # outer about x, then inner about z: third column (0, -sin outer, cos outer), first row (cos
    # inner, -sin inner, 0)
    position = np.unwrap(
        np.column_stack(
            [np.arctan2(-mat[:, 1, 2], mat[:, 2, 2]), np.arctan2(-mat[:, 0, 1], mat[:, 0, 0])]
        ),
        axis=0,
    )
    stamp_ns = 10**18 + np.round(1e9 * measured.index.to_numpy()).astype(np.int64)
    values = measured.to_numpy()
    return (
        ImuSamples(stamp_ns, values[:, 3:], values[:, :3], 'imu_link'),
        JointSamples(stamp_ns, position, np.full_like(position, np.nan), ('outer', 'inner')),
    )


def _from_euler(axes, angles, degrees=False):
    angles = np.asarray(angles, float)
    return Rotation.from_euler(
        axes, angles[:, None] if len(axes) == 1 and angles.ndim == 1 else angles, degrees
    )


def our_table():
    """Return the table as we describe it: base x north, y east, z down, as python-ins has it."""
    return Table(
        (Joint('outer', (1, 0, 0)), Joint('inner', (0, 0, 1))),
        up=(0, 0, -1),
        latitude=LLA[0],
        height=LLA[2],
        azimuth_deg=0.0,
    )


def calibrate_through_a_bag(imu, joints):
    """Write the session into a bag and return the Calibration of what is read back."""
    table = our_table()
    with TemporaryDirectory() as folder:
        path = Path(folder, 'session')
        write_session(path, imu, joints)
        with open_recording(path) as recording:
            blocks = list(recording.blocks(table.joint_names))
    options = CalibrationOptions(as_asked=True)
    recordings = TableReference(table).gather([blocks], options)
    return calibrate_by_evidence(recordings, options).calibration


def compare(calibration):
    """
    Return [(parameter, value, truth, sd, status)] of everything that python-ins knows the truth of.

    Its lever arms are zero.
    """
    truth = {
        f'{sensor}.{effect}.{name}': value
        for sensor, effects in TRUTH.items()
        for effect, values in effects.items()
        for name, value in zip(_names(effect), np.ravel(values))
    }
    rows = []
    for name, value, sd, status in zip(
        calibration.param_names, calibration.values, calibration.sd, calibration.status
    ):
        arm = '.accel_size_effect.' in name or '.lever_arm.' in name
        if name in truth or arm:
            rows.append((name, value, truth.get(name, 0.0), sd, status))
    return rows


def _names(effect):
    return list('xyz') if effect == 'bias' else [a + b for a in 'xyz' for b in 'xyz']


def run(folder, plots):
    """Return the section."""
    section = Section('A second opinion on tables: python-ins simulates, we calibrate')
    if not installed('pyins'):
        section.say('Skipped: python-ins is not installed; `make validate` installs it.')
        return section
    imu, joints = record()
    calibration = calibrate_through_a_bag(imu, joints)
    rows = [row for row in compare(calibration) if row[-1] != 'held']
    ratio = np.array([(value - true) / sd for _, value, true, sd, _ in rows])
    statuses = []  # of biases and matrices
    for name, *_, status in rows:
        if 'size_effect' not in name and 'lever_arm' not in name:
            statuses.append(status)
    section.claim(
        'truth of python-ins within three of our standard deviations',
        f'all {len(rows)} parameters that are not held',
        f'largest {np.abs(ratio).max():.1f} sd, rms {np.sqrt(np.mean(ratio**2)):.2f} sd',
        np.abs(ratio).max() < 3,
        headline=True,
    )
    section.claim(
        'biases and matrices are all determined',
        '24 of 24',
        f'{statuses.count("determined")} of 24',
        statuses.count('determined') == 24,
    )

    # The tilt has two components.
    is_tilt = ['table_tilt' in name for name in calibration.param_names]
    size = np.degrees(np.hypot(*calibration.values[is_tilt]))
    sd = np.degrees(max(calibration.sd[is_tilt]))
    true = np.hypot(*TILT_DEG)
    section.claim(
        'tilt of the table, size',
        f'{true:.4f} deg',
        f'{size:.4f} ± {sd:.4f} deg',
        abs(size - true) < 3 * sd,
    )
    section.table(
        ('parameter', 'found', 'sd', 'truth', 'error in sd', 'status'),
        [
            (n, f'{v:+.6f}', f'{s:.6f}', f'{t:+.6f}', f'{(v - t) / s:+.1f}', status)
            for n, v, t, s, status in rows
        ],
    )
    section.say(
        text(
            'simulated_table',
            minutes=len(imu) * PERIOD / 60,
            rate=1 / PERIOD,
            poses=len(POSES),
            rest=REST_S,
            spin=SPIN_DEG,
            spins=', '.join(f'{rate:.0f}' for rate in SPINS),
            latitude=LLA[0],
        )
    )
    _draw(section, plots, rows, ratio)
    return section


def _draw(section, plots, rows, ratio):
    figure, axes = new_figure(1, 1, (9, 3.6))
    axes.axhspan(-1, 1, color='tab:blue', alpha=0.15)
    axes.plot(ratio, 'o', color='tab:blue')
    names = [name.replace('accelerometer', 'acc').replace('gyroscope', 'gyr') for name, *_ in rows]
    axes.set_xticks(range(len(rows)), names, rotation=90, fontsize=7)
    axes.set(ylabel='error, in sd', ylim=(-4, 4))
    section.plot(
        plots,
        'simulated_table.png',
        figure,
        "Our estimate minus python-ins' truth, in our standard deviations; the band is one.",
    )
