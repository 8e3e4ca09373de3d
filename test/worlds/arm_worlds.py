"""
An IMU on an arm whose joints are not quite as its description says.

Attitudes and places by Pinocchio, everything else by differences in time.

Nothing here knows our chain, the catalogue of effects or the estimator, but for `in_our_axes`,
which says what the parameters are in the convention of the calibration: what nothing can tell from
the mount is taken as described.

Run as a program it prints the figures of 40 worlds.
"""

import argparse
import warnings
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from imu_calibration.core.samples import ImuSamples, JointSamples, SampleBlock
from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.kinematics.chain import (
    reference_motion,
    tilt,
    with_axis_angles,
    with_axis_places,
)
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.table import Table
from imu_calibration.kinematics.urdf import table_from_urdf
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.sensor_noise import GRADES, ImuNoise, read_encoders, realistic

from worlds.arms import SIX_AXES
from worlds.calibrated import calibrated_on_table
from worlds.physics_draw import draw_imu, generator, to_ns
from worlds.physics_sensor import Triad

START_NS = 1_700_000_000_000_000_000
STEP = 2e-3
"""
Step of the differences, s: rounding 1e-16 / STEP^2 and the fourth-order remainder both stay below
1e-5 of the noise.
"""


@dataclass(frozen=True, eq=False)
class ArmWorld:
    """What was recorded, the description that the searcher gets, and the truth."""

    block: SampleBlock
    table: Table
    accelerometer: Triad
    gyroscope: Triad
    model: object
    """Pinocchio's model of the arm as it is."""


def pinocchio():
    """Return the module."""
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        import pinocchio
    return pinocchio


def make_arm_world(
    seed,
    joint_error=3e-4,
    place_error=0.0,
    text=SIX_AXES,
    link='imu_link',
    rate=100.0,
    grade='industrial',
    seconds=np.inf,
):
    """
    Return an `ArmWorld`.

    Every joint's frame stands turned by `joint_error` (rad, about each axis) and shifted by
    `place_error` (m).

    A turn about the joint's axis is a wrong zero, one across it a wrong direction of the axis. Only
    the first `seconds` are recorded.
    """
    table = table_from_urdf(text, link, {'gravity': STANDARD_GRAVITY})
    rng, noise = generator(seed, 'arm'), realistic(grade, encoder_resolution=2e-6, stamp_jitter=0.0)
    model = _bent(text, rng, joint_error, place_error)
    profile = make_profile('within_limits_short', seed, table)
    time = np.arange(0.0, min(profile.duration, seconds), 1.0 / rate)
    accelerometer, gyroscope = draw_imu(GRADES[grade], {}, True, generator(seed, 'unit'))
    poses = [
        _poses(model, profile.at(time + k * STEP).position, table.joint_names, link)
        for k in (-2, -1, 0, 1, 2)
    ]
    forces = [_force(poses, arm) for arm in accelerometer.arms]
    still = np.full(len(time), 25.0)
    outputs = (
        accelerometer.respond(forces, time, still, forces[0]),
        gyroscope.respond([_rate(poses)] * 3, time, still, forces[0]),
    )
    noisy = ImuNoise(noise, sample_rate=rate, rng=generator(seed, 'noise')).add(*outputs)
    imu = ImuSamples(START_NS + to_ns(time), *noisy, link)
    # As joint states come: in another order, with joints that are nobody's business.
    joint_time = time[:-1] + 0.5 / rate
    motion = profile.at(joint_time)
    position = read_encoders(motion.position, noise, generator(seed, 'encoders'))
    joints = JointSamples(
        START_NS + to_ns(joint_time), position, motion.rate, tuple(table.joint_names)
    )
    return ArmWorld(SampleBlock(imu, joints), table, accelerometer, gyroscope, model)


def _bent(text, rng, joint_error, place_error):
    pin = pinocchio()
    model = pin.buildModelFromXML(text.split('?>', 1)[1])
    for k in range(1, model.njoints):
        turn = Rotation.from_rotvec(rng.normal(0.0, joint_error, 3)).as_matrix()
        model.jointPlacements[k] = model.jointPlacements[k] * pin.SE3(
            turn, rng.normal(0.0, 1.0, 3) * place_error
        )
    return model


def _poses(model, position, names, link):
    """Return attitude (link to root) and place of the link, shapes (n, 3, 3) and (n, 3)."""
    pin = pinocchio()
    data, frame, q = model.createData(), model.getFrameId(link), pin.neutral(model)
    turns, places = np.empty((len(position), 3, 3)), np.empty((len(position), 3))
    parts = [model.joints[model.getJointId(name)] for name in names]
    for row, at in enumerate(position):
        for part, angle in zip(parts, at, strict=True):
            q[part.idx_q : part.idx_q + part.nq] = (
                angle if part.nq == 1 else (np.cos(angle), np.sin(angle))
            )
        pin.framesForwardKinematics(model, data, q)
        turns[row], places[row] = data.oMf[frame].rotation, data.oMf[frame].translation
    return turns, places


def _force(poses, arm):
    """
    Return the specific force at a point of the link, in the link's frame.

    Second differences of where it is.
    """
    points = [place + turn @ arm for turn, place in poses]
    acceleration = (-points[0] + 16 * points[1] - 30 * points[2] + 16 * points[3] - points[4]) / (
        12 * STEP**2
    )
    return np.einsum('nji,nj->ni', poses[2][0], acceleration + [0.0, 0.0, STANDARD_GRAVITY])


def _rate(poses):
    """Return the rate in the link's frame: differences of the attitude."""
    here = Rotation.from_matrix(poses[2][0]).inv()
    steps = [(here * Rotation.from_matrix(turn)).as_rotvec() for turn, _ in poses]
    return (steps[0] - 8 * steps[1] + 8 * steps[3] - steps[4]) / (12 * STEP)


def in_our_axes(world, n=60, seed=1):
    """
    Return (turn, shift, rest).

    The IMU's true axes and origin in the calibration's convention, and what no convention can
    explain, rad.

    Fits the errors that the calibration knows of (tilt, azimuth, angles, zeros) to Pinocchio's
    attitudes; the turn between link and mount that this leaves is the convention. Places follow in
    the same way.
    """
    table, names = world.table, world.table.joint_names
    rng = np.random.default_rng(seed)
    position = rng.uniform(-2.0, 2.0, (n, len(names)))
    turns, places = _poses(world.model, position, names, world.block.imu.frame_id)
    n_angles, n_zeros, n_places = len(names.angles), len(names.zeros), len(names.places)

    def bent(x):
        shifted = position.copy()
        shifted[:, [names.index(name) for name in names.zeros]] += x[
            3 + n_angles : 3 + n_angles + n_zeros
        ]
        return tilt(with_axis_angles(table, x[3 : 3 + n_angles]), x[:2]), shifted

    def attitude_rest(x):
        bent_table, shifted = bent(x)
        ours = reference_motion(bent_table, _still(shifted)).mat_sn
        world_turn, mount = (
            Rotation.from_euler('z', x[2]).as_matrix(),
            Rotation.from_rotvec(x[-3:]).as_matrix(),
        )
        return (mount @ ours @ world_turn - turns.transpose(0, 2, 1)).ravel()

    fit = least_squares(
        attitude_rest,
        np.zeros(3 + n_angles + n_zeros + 3),
        x_scale=1e-3,
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
    )
    mount = Rotation.from_rotvec(fit.x[-3:]).as_matrix()

    def place_rest(x):
        bent_table, shifted = bent(fit.x)
        ours = _places_of(with_axis_places(bent_table, x[:n_places]), shifted)
        turned = Rotation.from_euler('z', -fit.x[2]).apply(ours)
        return (turned - places + x[-6:-3] + turns @ mount @ x[-3:]).ravel()

    # Far from its start nothing: everything is linear but for the azimuth.
    move = least_squares(
        place_rest, np.zeros(n_places + 6), x_scale=1e-3, xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    return mount, move.x[-3:], (np.abs(fit.fun).max(), np.abs(move.fun).max())


def _still(position):
    zero = np.zeros_like(position)
    return JointMotion(np.arange(len(position)) * 0.01, position, zero, zero, zero)


def _places_of(table, position):
    """
    Return where the reference point is, shape (n, 3).

    Products of frames, since the recursion knows no places.
    """
    turn, places = Rotation.from_matrix(table.mat_nb), np.zeros((len(position), 3))
    at = dict(zip(table.joint_names, position.T, strict=True))
    for joint in table.joints:
        places = places + turn.apply(joint.xyz)
        turn = (
            turn
            * Rotation.from_euler('xyz', joint.rpy_deg, degrees=True)
            * Rotation.from_rotvec(at[joint.source][:, None] * np.array(joint.axis))
        )
    return places + turn.apply(table.mount_xyz)


@lru_cache(maxsize=1)
def truth(world):
    """
    Return {parameter: true value} of bias, matrix and arms, in the convention of the calibration.
    """
    mount, shift, _ = in_our_axes(world)
    values = {}
    for sensor, triad in (('accelerometer', world.accelerometer), ('gyroscope', world.gyroscope)):
        values |= {f'{sensor}.bias.{a}': v for a, v in zip('xyz', triad.bias, strict=True)}
        matrix = triad.matrix @ mount
        values |= {
            f'{sensor}.matrix.{a}{b}': matrix[i, j]
            for i, a in enumerate('xyz')
            for j, b in enumerate('xyz')
        }
    arms = world.accelerometer.arms @ mount + shift
    values |= {
        f'accelerometer.accel_size_effect.{a}{b}': arms[i, j]
        for i, a in enumerate('xyz')
        for j, b in enumerate('xyz')
    }
    return values


@lru_cache(maxsize=1)
def calibrated(world):
    """Return the calibration of a world, which several tests judge."""

    return calibrated_on_table([[world.block]], world.table).calibration


def deviations(world, calibration=None):
    """
    Return {parameter: error in standard deviations}, and the calibration.

    The errors are of a calibration of the world, by default of `calibrated`.
    """
    if calibration is None:
        calibration = calibrated(world)
    found = dict(
        zip(
            calibration.param_names,
            zip(calibration.values, calibration.sd, strict=True),
            strict=True,
        )
    )
    return {
        name: (found[name][0] - value) / found[name][1] for name, value in truth(world).items()
    }, calibration


def main():
    """Print how far the parameters of 40 arms are from the truth."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n', 1)[0])
    parser.add_argument('--worlds', type=int, default=40)
    parser.add_argument('--first', type=int, default=100, help='first seed')
    parser.add_argument('--place-error', type=float, default=0.0, help='m')
    options = parser.parse_args()
    every = []
    for seed in range(options.first, options.first + options.worlds):
        errors, _ = deviations(make_arm_world(seed, place_error=options.place_error))
        every.append(list(errors.values()))
        worst = max(errors, key=lambda name: abs(errors[name]))
        print(
            f'world {seed}: mean square {np.mean(np.square(every[-1])):.2f}, worst'
            f' {errors[worst]:+.2f} sd, {worst}',
            flush=True,
        )
    every = np.abs(np.array(every))
    print(
        f'{len(every)} worlds of {every.shape[1]} parameters: within 3 sd'
        f' {100 * np.mean(every < 3):.1f} %, each parameter in at least'
        f' {100 * np.mean(every < 3, axis=0).min():.1f} % of the worlds, all at once in'
        f' {100 * np.mean(np.all(every < 3, axis=1)):.1f} %; within 1.96 sd'
        f' {100 * np.mean(every < 1.96):.1f} %; mean square {np.mean(every**2):.2f}'
    )


if __name__ == '__main__':
    main()
