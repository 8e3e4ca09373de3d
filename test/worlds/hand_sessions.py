"""
Recordings by hand, simulated.

Held still in poses, turned between them by smooth motions whose rates are exact.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from imu_calibration.core.samples import ImuSamples

GRAVITY = 9.81
LOWER, SQUARE = ('xx', 'yx', 'yy', 'zx', 'zy', 'zz'), tuple(a + b for a in 'xyz' for b in 'xyz')
PARAM_NAMES = (
    *(f'accelerometer.bias.{k}' for k in 'xyz'),
    *(f'accelerometer.matrix.{k}' for k in LOWER),
    *(f'gyroscope.bias.{k}' for k in 'xyz'),
    *(f'gyroscope.matrix.{k}' for k in SQUARE),
    *(f'gyroscope.gyro_g_sensitivity.{k}' for k in SQUARE),
)
"""
Truths are laid out like this: the accelerometer's matrix without the elements above its diagonal,
which are zero.
"""
NOMINAL, SENSITIVITY = (
    np.array(
        [float(name.endswith(('matrix.xx', 'matrix.yy', 'matrix.zz'))) for name in PARAM_NAMES]
    ),
    slice(21, 30),
)
FACES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)


def unpack(truth):
    """Return bias and matrix of the accelerometer and of the gyroscope."""
    lower = np.zeros((3, 3))
    lower[np.tril_indices(3)] = truth[3:9]
    return truth[0:3], lower, truth[9:12], truth[12:21].reshape(3, 3)


def random_truth(rng, sensitivity=0.0):
    truth = NOMINAL.copy()
    truth[0:3] += rng.normal(0, 0.2, 3)
    truth[3:9] += rng.normal(0, 0.01, 6)
    truth[9:12] += rng.normal(0, 0.02, 3)
    truth[12:21] += rng.normal(0, 0.01, 9)
    truth[SENSITIVITY] += rng.normal(0, sensitivity, 9) if sensitivity else 0.0
    return truth


def turn_samples(start, rotvec, wobble, period, duration):
    """
    Attitudes and exact body rates of a turn that starts and ends at rest.

    The axis wobbles on the way.
    """
    s = np.arange(period, duration - 0.5 * period, period) / duration
    share, speed = s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2 / duration
    bump, bump_speed = 4 * share * (1 - share), 4 * speed * (1 - 2 * share)
    inner = Rotation.from_rotvec(np.outer(bump, wobble))
    attitude = start * Rotation.from_rotvec(np.outer(share, rotvec)) * inner
    return attitude, inner.inv().apply(np.outer(speed, rotvec)) + np.outer(bump_speed, wobble)


def simulate(
    seed,
    n_poses=12,
    period=0.02,
    still=2.0,
    duration=1.6,
    force_sd=0.02,
    rate_sd=0.002,
    pose_sd=0.0,
    drift_sd=0.0,
    sensitivity=0.0,
    attitudes=None,
    truth=None,
    wobble=0.4,
    spoil=None,
):
    """
    A recording held still in poses with turns between; returns (imu, ranges, true parameters).

    `spoil(force, rate, time, pose)` returns what a hidden cause adds to both outputs, for the true
    motion and the number of the pose that each sample is in or leaves.
    """
    rng = np.random.default_rng(seed)
    truth = random_truth(rng, sensitivity) if truth is None else truth
    (bias_f, matrix_f, bias_w, matrix_w), response = unpack(truth), truth[SENSITIVITY].reshape(3, 3)
    attitude = Rotation.random(random_state=rng) if attitudes is None else attitudes[0]
    count, force, rate, ranges, total = int(still / period), [], [], [], 0
    true_f, true_w, poses = [], [], []
    for pose in range(n_poses):
        up = attitude.inv().apply([0, 0, GRAVITY])
        drift = rng.normal(0, drift_sd, 3)
        force.append(np.tile(matrix_f @ up + bias_f + rng.normal(0, pose_sd, 3), (count, 1)))
        rate.append(np.tile(bias_w + drift + response @ up, (count, 1)))
        ranges.append(slice(total, total + count))
        true_f.append(np.tile(up, (count, 1)))
        true_w.append(np.zeros((count, 3)))
        poses.append(np.full(count, pose))
        if pose == n_poses - 1:
            break
        rotvec = rng.normal(size=3)
        rotvec *= rng.uniform(1.2, 2.6) / np.linalg.norm(rotvec)
        if attitudes is not None:
            rotvec = (attitude.inv() * attitudes[pose + 1]).as_rotvec()
        on_the_way, body_rate = turn_samples(
            attitude, rotvec, rng.normal(0, wobble, 3), period, duration
        )
        true_force = on_the_way.inv().apply([0, 0, GRAVITY])
        force.append(true_force @ matrix_f.T + bias_f)
        rate.append(body_rate @ matrix_w.T + bias_w + drift + true_force @ response.T)
        true_f.append(true_force)
        true_w.append(body_rate)
        poses.append(np.full(len(body_rate), pose))
        total += count + len(body_rate)
        attitude = attitude * Rotation.from_rotvec(rotvec)
    force, rate = np.concatenate(force), np.concatenate(rate)
    stamp_ns = 10**9 + np.round(np.arange(len(force)) * period * 1e9).astype(np.int64)
    if spoil is not None:
        more = spoil(
            np.concatenate(true_f),
            np.concatenate(true_w),
            period * np.arange(len(force)),
            np.concatenate(poses),
        )
        force, rate = force + more[0], rate + more[1]
    noisy = (
        force + rng.normal(0, force_sd, force.shape),
        rate + rng.normal(0, rate_sd, rate.shape),
    )
    return ImuSamples(stamp_ns, *noisy, 'imu_link'), ranges, truth
