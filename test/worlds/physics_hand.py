"""
What electronics, drivers and hands do to a recording by hand; nothing here knows the estimator.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from imu_calibration.core.samples import ImuSamples

from worlds.hand_sessions import GRAVITY, SENSITIVITY, random_truth, turn_samples, unpack

SETTLES = 0.5
"""Time constant of a grip that gives way, s."""


def hold_and_turn(
    seed,
    *,
    n_poses=14,
    rate_hz=100.0,
    still=3.0,
    duration=1.6,
    force_sd=0.02,
    rate_sd=0.002,
    pose_sd=0.002,
    drift_sd=2e-4,
    creep=0.0,
    settling=0.0,
    tremor=0.0,
    attitudes=None,
    truth=None,
    largest=2.6,
):
    """
    Return (imu, ranges at rest, truth): poses held in a hand that creeps, and turns between them.

    Parameters
    ----------
    pose_sd, drift_sd : float
        Scatter of the accelerometer's (m/s^2) and of the gyroscope's (rad/s) bias from pose to
        pose.
    creep : float
        Rms rate per axis at which the attitude creeps while it is held, rad/s.
    settling : float
        Rms angle per axis by which a grip that flexes gives way after each turn, rad, with a time
        constant of half a second.
    tremor : float
        Rms specific force of the hand's tremor at some 8 Hz, m/s^2.
    attitudes : sequence of Rotation, optional
        Of the poses; random turns of 1.2 rad to `largest` when not given.

    """
    rng = np.random.default_rng(seed)
    truth = random_truth(rng) if truth is None else truth
    (bias_f, matrix_f, bias_w, matrix_w), response = unpack(truth), truth[SENSITIVITY].reshape(3, 3)
    period, count = 1 / rate_hz, int(round(still * rate_hz))
    attitude = Rotation.random(random_state=rng) if attitudes is None else attitudes[0]
    parts, ranges, total = [], [], 0
    for pose in range(n_poses):
        rate = rng.normal(0, creep, 3)
        gives, within = (
            rng.normal(0, settling, 3) if settling else np.zeros(3),
            period * np.arange(count),
        )
        held = attitude * Rotation.from_rotvec(
            np.outer(within, rate) + np.outer(-np.expm1(-within / SETTLES), gives)
        )
        rates = rate + np.outer(np.exp(-within / SETTLES) / SETTLES, gives)  # of small angles
        offsets = rng.normal(0, pose_sd, 3), rng.normal(0, drift_sd, 3)
        shake = tremor * np.sin(2 * np.pi * 8 * period * np.arange(count) + rng.uniform(0, 6))
        parts.append(
            (
                held.inv().apply([0, 0, GRAVITY])
                + np.outer(shake, rng.normal(0, 1, 3))
                + offsets[0],
                rates,
                offsets[1],
            )
        )
        ranges.append(slice(total, total + count))
        total, attitude = total + count, held[-1]
        if pose == n_poses - 1:
            break
        rotvec = rng.normal(size=3)
        rotvec *= rng.uniform(1.2, largest) / np.linalg.norm(rotvec)
        if attitudes is not None:
            rotvec = (attitude.inv() * attitudes[pose + 1]).as_rotvec()
        turning, body_rate = turn_samples(attitude, rotvec, rng.normal(0, 0.4, 3), period, duration)
        parts.append((turning.inv().apply([0, 0, GRAVITY]), body_rate, offsets[1]))
        total, attitude = total + len(body_rate), attitude * Rotation.from_rotvec(rotvec)
    true_f = np.concatenate([f for f, _, _ in parts])
    force = true_f @ matrix_f.T + bias_f
    rate = (
        np.concatenate([w @ matrix_w.T + bias_w + drift for _, w, drift in parts])
        + true_f @ response.T
    )
    stamp_ns = 10**18 + np.round(1e9 * period * np.arange(total)).astype(np.int64)
    return (
        ImuSamples(
            stamp_ns,
            force + rng.normal(0, force_sd, force.shape),
            rate + rng.normal(0, rate_sd, rate.shape),
            'imu_link',
        ),
        ranges,
        truth,
    )


def with_spikes(imu, share, seed, force=30.0, rate=5.0):
    """
    A glitch on the bus.

    A share of the samples carries an error of up to these sizes on one axis of each sensor.
    """
    rng = np.random.default_rng(seed)
    forces, rates = imu.force_s.copy(), imu.rate_s.copy()
    for values, size in ((forces, force), (rates, rate)):
        hit = np.flatnonzero(rng.random(len(values)) < share)
        values[hit, rng.integers(0, 3, len(hit))] += rng.uniform(-size, size, len(hit))
    return replace(imu, force_s=forces, rate_s=rates)


def with_corrupt_sample(imu, index, value=1e30):
    """One message whose bytes are not what the sensor said."""
    force, rate = imu.force_s.copy(), imu.rate_s.copy()
    force[index], rate[index] = value, value
    return replace(imu, force_s=force, rate_s=rate)


def clipped(imu, limit):
    """The gyroscope's range ends at `limit` rad/s."""
    return replace(imu, rate_s=np.clip(imu.rate_s, -limit, limit))


def with_wrong_full_scale(imu, factor):
    """The driver converts counts by the sensitivity of another full-scale setting."""
    return replace(imu, rate_s=factor * imu.rate_s)


def with_stamp_jitter(imu, sd, seed):
    """
    The sensor samples evenly, the computer stamps on arrival: late by varying times, in order.
    """
    late = np.abs(np.random.default_rng(seed).normal(0, sd, len(imu)))
    return replace(
        imu,
        stamp_ns=np.maximum.accumulate(imu.stamp_ns + np.round(1e9 * late).astype(np.int64))
        + np.arange(len(imu)),
    )


def warmed_up(imu, seed, *, force=0.0, rate=0.0, kelvin=8.0, time_constant=120.0):
    """
    Return (imu, temperature in degrees Celsius).

    The board warms up exponentially and takes the biases along.

    `force` and `rate` are the sizes of the changes of the biases over the whole warm-up, m/s^2 and
    rad/s, in a random direction.
    """
    rng = np.random.default_rng(seed)
    time = 1e-9 * (imu.stamp_ns - imu.stamp_ns[0])
    share = 1 - np.exp(-time / time_constant)
    directions = [v / np.linalg.norm(v) for v in rng.normal(size=(2, 3))]
    return (
        replace(
            imu,
            force_s=imu.force_s + force * np.outer(share, directions[0]),
            rate_s=imu.rate_s + rate * np.outer(share, directions[1]),
        ),
        25.0 + kelvin * share + rng.normal(0, 0.05, len(time)),
    )


def drifting(imu, force=0.0, rate=0.0):
    """
    The biases of the x axes move steadily by these amounts over the recording, m/s^2 and rad/s.
    """
    share = (imu.stamp_ns - imu.stamp_ns[0]) / (imu.stamp_ns[-1] - imu.stamp_ns[0])
    return replace(
        imu,
        force_s=imu.force_s + np.outer(share, [force, 0, 0]),
        rate_s=imu.rate_s + np.outer(share, [rate, 0, 0]),
    )


def with_slow_turn(seed, rate=0.03, seconds=4.0, **session):
    """
    Return (imu, truth, samples of the turn).

    A session, then a slow, steady turn about the vertical, which gravity does not show, and a rest.
    """
    imu, ranges, truth = hold_and_turn(seed, **session)
    rng, last = np.random.default_rng(seed + 1), ranges[-1]
    period = int(np.median(np.diff(imu.stamp_ns)))
    bias_f, matrix_f, _, matrix_w = unpack(truth)
    mean, bias = imu.force_s[last].mean(axis=0), imu.rate_s[last].mean(axis=0)
    up = np.linalg.solve(matrix_f, mean - bias_f)
    turning = matrix_w @ (rate * up / np.linalg.norm(up))
    count = int(seconds * 1e9 / period)
    noise = imu.force_s[last].std(axis=0), imu.rate_s[last].std(axis=0)
    speed = np.repeat([1.0, 0.0], count)[:, None] * turning
    more = ImuSamples(
        imu.stamp_ns[-1] + period * np.arange(1, 2 * count + 1),
        mean + noise[0] * rng.normal(size=(2 * count, 3)),
        bias + speed + noise[1] * rng.normal(size=(2 * count, 3)),
        imu.frame_id,
    )
    return ImuSamples.concatenate([imu, more]), truth, slice(len(imu), len(imu) + count)
