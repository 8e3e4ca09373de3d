"""Motions of the two source papers, each with the table (and fixture) it is made for."""

from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from imu_calibration.simulation.motion_primitives import FACES, pose_deg, spin_vertical, swing, two_axes

ORDERS = ('XYX', 'XYZ', 'XZX', 'XZY', 'YXY', 'YXZ', 'YZX', 'YZY', 'ZXY', 'ZXZ', 'ZYX', 'ZYZ')
"""The twelve orders of three gimbals, from the base outwards."""
AXIS = {'X': [1.0, 0.0, 0.0], 'Y': [0.0, 1.0, 0.0], 'Z': [0.0, 0.0, 1.0]}
EQUAL_ANGLES_DEG = np.arange(0.0, 401.0, 10.0)
"""Avrutov 2017, samples 1 and 2: the 41 equal angles (40 according to the paper)."""


def _table(axes, up=(0.0, 0.0, 1.0), latitude=50.45, height=170.0, rpy_deg=(0.0, 0.0, 0.0)):
    names = ('outer', 'middle', 'inner') if len(axes) == 3 else ('turn',)
    joints = [{'name': name, 'axis': list(axis)} for name, axis in zip(names, axes, strict=True)]
    mount = {'rpy_deg': list(rpy_deg), 'xyz': None}
    return {'joints': joints, 'up': list(up), 'latitude': latitude, 'height': height, 'azimuth_deg': 0.0, 'mount': mount}


GIMBALS = _table([AXIS[axis] for axis in 'ZYX'])


def avrutov_rates_deg(sample: int) -> np.ndarray:
    """Return the rates about x, y, z of Avrutov's gyroscope series (sample 3 or 4), deg/s, shape (11, 3)."""
    if sample == 3:
        rate = np.arange(0.0, 101.0, 10.0)
        return np.stack([rate, rate ** (1 / 2), rate ** (1 / 3)], axis=1)
    rate = np.arange(0.0, 11.0)
    return np.stack([rate, np.exp(-rate), rate**2], axis=1)


def _equal_angles(builder, _rng):
    """All gimbals at the same angle, 41 positions (averaging of 30...60 s is shortened; `duration` stretches it)."""
    builder.rest(5.0)
    for angle in EQUAL_ANGLES_DEG:
        builder.move(np.full(builder.n_joints, angle), shortest=False)
        builder.rest(5.0)


def _body_rates(builder, _rng, sample):
    """Each row as one turn of the vertical joint: the inner two hold the wanted direction of the rate upright."""
    for rates in avrutov_rates_deg(sample):
        speed = np.linalg.norm(rates)
        builder.move(pose_deg(rates if speed else [0, 0, 1], np.nan))
        builder.rest(2.0)
        builder.spin([[speed, 0.0, 0.0]], 10.0)


def _gimbal_rates(builder, _rng, sample):
    """Each row commanded to the three gimbals (x inner, z outer): the body rates are not the gimbal rates."""
    for x, y, z in avrutov_rates_deg(sample):
        builder.move([0.0, 0.0, 0.0])
        builder.rest(2.0)
        builder.spin([[z, y, x]], 30.0)


def _six_faces(builder):
    for face in FACES:
        builder.move(pose_deg(face))
        builder.rest(10.0)


def _zhang_spins(builder, _rng):
    _six_faces(builder)
    for axis in np.eye(3):
        builder.move(pose_deg(axis, np.nan))
        for speed in (100.0, 150.0, 200.0):
            builder.spin([[speed, 0.0, 0.0]], 10.0)


def _zhang_oscillations(builder, _rng):
    _six_faces(builder)
    for axis in range(3):
        for amplitude, frequency in ((10.0, 1.0), (5.0, 2.0), (90.0, 0.5)):
            swing(builder, axis, amplitude, frequency=frequency, duration=12.0)


def _zhang_mixed(builder, _rng):
    _six_faces(builder)
    for axis in np.eye(3):
        spin_vertical(builder, axis, [200.0], dwell=6.0)
    for axis in range(3):
        swing(builder, axis, 10.0, frequency=1.0, duration=12.0)
    for at_deg, rates in (([0, 0, 0], [200, 0, 200]), ([0, 0, 0], [200, 200, 0]), ([0, 0, 90], [200, 200, 0])):
        two_axes(builder, at_deg, rates, dwell=6.0)


SKEW_60_RPY_DEG = Rotation.from_rotvec(np.pi / 3 * np.ones(3) / np.sqrt(3)).as_euler('xyz', degrees=True).tolist()
"""A fixture that turns the sensor by 60 deg about (1, 1, 1): every spin axis then meets all three sensor axes."""

REGISTRY: dict[str, tuple[str, Callable, dict, int]] = {
    **{f'avrutov_{order}{suffix}': (f'41 positions of equal angles 0..400 deg, gimbals {order} from the base; add _up_x or _up_y to turn '
                                    'gravity', _equal_angles, _table([AXIS[axis] for axis in order], up), 3)
       for order in ORDERS for suffix, up in (('', AXIS['Z']), ('_up_x', AXIS['X']), ('_up_y', AXIS['Y']))},
    'avrutov_111': ("the literal reading of 'around three axes simultaneously': one turn about (1, 1, 1)", _equal_angles,
                    _table([[1.0, 1.0, 1.0]]), 1),
    **{f'avrutov_rates_{sample}': (f'gyroscope series of sample {sample} as body rates: one turn about a fixed axis for each row',
                                   partial(_body_rates, sample=sample), GIMBALS, 3) for sample in (3, 4)},
    **{f'avrutov_gimbals_{sample}': (f'gyroscope series of sample {sample} commanded to the gimbals, which are not body rates',
                                     partial(_gimbal_rates, sample=sample), GIMBALS, 3) for sample in (3, 4)},
    'zhang_z0': ('six faces, spins about the sensor axes at 100, 150, 200 deg/s', _zhang_spins, GIMBALS, 3),
    'zhang_z60': ('the same with a fixture skewed by 60 deg about (1, 1, 1)', _zhang_spins,
                  _table([AXIS[a] for a in 'ZYX'], rpy_deg=SKEW_60_RPY_DEG), 3),
    'zhang_o': ('six faces, swings about the sensor axes: 10 deg 1 Hz, 5 deg 2 Hz, 90 deg 0.5 Hz', _zhang_oscillations, GIMBALS, 3),
    'zhang_m': ('six faces, three spins, three swings, three simultaneous turns', _zhang_mixed, GIMBALS, 3),
}
