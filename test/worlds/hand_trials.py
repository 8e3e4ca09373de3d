"""
Sessions by hand with one disturbance each, by its physics.

43 rests, turns and full turns at 100 Hz; nothing here knows the estimator.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from imu_calibration.core.samples import ImuSamples

from worlds.hand_sessions import FACES, GRAVITY, random_truth, turn_samples, unpack

RATE_HZ, RESTS, FIRST, STILL = 100.0, 43, 10.0, (2.5, 4.0)
"""
The first rest, from which peers take noise and bias, and the shortest and longest of the others, s.
"""
FULL_TURN_EVERY = 4
FADE = 0.1
"""A disturbance of a rest grows and fades within this time, s."""
VIBRATION = ((17.0, 0.3), (31.0, 0.2))
"""Hz, amplitude in m/s^2; the gyroscope shows 0.02 rad/s at each."""
TREMOR, TREMOR_RATE, SWAY = 0.002 * GRAVITY, np.radians(0.3), np.radians(0.02)
"""
Rms specific force (m/s^2) and rate (rad/s) at 7 to 11 Hz, and rms angle of the slow sway (rad).
"""
KELVIN, WARM_UP = 10.0, 80.0


def clean(seed, rests=RESTS):
    """
    Return (ImuSamples, ranges of the rests, parameters at the end).

    The parameters at the end are the ones of the entire session.
    """
    return _session(seed, rests)


def vibration(seed, rests=RESTS):
    """A machine that shakes the support in every rest."""
    return _session(seed, rests, _vibrate)


def tremor(seed, rests=RESTS):
    """A hand that trembles and sways while it holds."""
    return _session(seed, rests, _tremble)


def jitter(seed, rests=RESTS, sd=3e-3):
    """Stamps that are early or late by a normal error, in order."""
    imu, ranges, truth = _session(seed, rests)
    late = np.random.default_rng([seed, 3]).normal(0.0, sd, len(imu))
    return (
        replace(
            imu,
            stamp_ns=np.sort(imu.stamp_ns + np.round(1e9 * late).astype(np.int64))
            + np.arange(len(imu)),
        ),
        ranges,
        truth,
    )


def ramp(seed, rests=RESTS):
    """
    A board that warms up by 10 K after power-on; no temperature is recorded.

    The parameters are those of the warm sensor, at the end.
    """
    imu, ranges, truth = _session(seed, rests)
    rng, time = np.random.default_rng([seed, 4]), 1e-9 * (imu.stamp_ns - imu.stamp_ns[0])
    warm = -KELVIN * np.expm1(-time / WARM_UP)
    force = rng.choice([-1, 1], 3) * rng.uniform(0.2e-3, 0.5e-3, 3) * GRAVITY
    rate = rng.choice([-1, 1], 3) * np.radians(rng.uniform(0.01, 0.03, 3))
    truth = truth.copy()
    truth[0:3] += warm[-1] * force
    truth[9:12] += warm[-1] * rate
    return (
        replace(
            imu,
            force_s=imu.force_s + np.outer(warm, force),
            rate_s=imu.rate_s + np.outer(warm, rate),
        ),
        ranges,
        truth,
    )


TRIALS = {
    'clean': clean,
    'vibration while holding': vibration,
    'hand tremor of 2 mg': tremor,
    'stamps that jitter by 3 ms': jitter,
    'ramp of 10 K, judged on the warm sensor': ramp,
}


def _session(seed, rests, disturb=None, force_sd=0.02, rate_sd=0.002):
    rng = np.random.default_rng([seed, 1])
    truth, attitude, period = random_truth(rng), Rotation.random(random_state=rng), 1 / RATE_HZ
    bias_f, matrix_f, bias_w, matrix_w = unpack(truth)
    forces, rates, ranges, total = [], [], [], 0
    for rest in range(rests):
        count = round(RATE_HZ * (FIRST if rest == 0 else rng.uniform(*STILL)))
        force, rate = (
            np.tile(attitude.inv().apply([0, 0, GRAVITY]), (count, 1)),
            np.zeros((count, 3)),
        )
        if disturb is not None:
            force, rate = disturb(rng, period * np.arange(count), force)
        forces.append(force)
        rates.append(rate)
        ranges.append(slice(total, total + count))
        total += count
        if rest == rests - 1:
            break
        axis = rng.normal(size=3)
        full = rest % FULL_TURN_EVERY == FULL_TURN_EVERY - 1
        rotvec = axis / np.linalg.norm(axis) * (2 * np.pi if full else rng.uniform(1.0, 2.6))
        if rest < len(FACES):  # by hand, a degree off
            face = Rotation.from_rotvec(rng.normal(0, np.radians(0.6), 3)).apply(FACES[rest])
            rotvec = _to_face(attitude, face, rng)
            full = False
        turning, rate = turn_samples(
            attitude,
            rotvec,
            np.zeros(3) if full else rng.normal(0, 0.3, 3),
            period,
            rng.uniform(3.0, 4.0) if full else rng.uniform(1.2, 2.5),
        )
        forces.append(turning.inv().apply([0, 0, GRAVITY]))
        rates.append(rate)
        total, attitude = total + len(rate), attitude * Rotation.from_rotvec(rotvec)
    force, rate = (
        np.concatenate(forces) @ matrix_f.T + bias_f,
        np.concatenate(rates) @ matrix_w.T + bias_w,
    )
    noisy = force + rng.normal(0, force_sd, force.shape), rate + rng.normal(0, rate_sd, rate.shape)
    return (
        ImuSamples(
            10**18 + np.round(1e9 * period * np.arange(total)).astype(np.int64), *noisy, 'imu_link'
        ),
        ranges,
        truth,
    )


def _to_face(attitude, face, rng):
    """
    Return a rotation vector in the sensor's axes after which `face` points up.

    With a turn about it.
    """
    up = attitude.inv().apply([0, 0, 1.0])
    axis = np.cross(face, up)
    turn = Rotation.from_rotvec(
        axis / np.linalg.norm(axis) * np.arctan2(np.linalg.norm(axis), face @ up)
    )
    return (turn * Rotation.from_rotvec(rng.uniform(0.3, 1.0) * np.asarray(face))).as_rotvec()


def _vibrate(rng, time, force):
    swell, rate = _swell(time), np.zeros_like(force)
    for frequency, size in VIBRATION:
        wave = swell * np.sin(2 * np.pi * frequency * time + rng.uniform(0, 2 * np.pi))
        along, about = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
        force, rate = force + size * np.outer(wave, along), rate + 0.02 * np.outer(wave, about)
    return force, rate


def _tremble(rng, time, force):
    swell, period = _swell(time), time[1] - time[0]
    shake, twist, angle = (np.zeros_like(force) for _ in range(3))
    for axis in range(3):
        for part, size, lowest, highest in (
            (shake, TREMOR, 7, 11),
            (twist, TREMOR_RATE, 7, 11),
            (angle, SWAY, 0.15, 0.5),
        ):
            waves = sum(
                np.sin(2 * np.pi * rng.uniform(lowest, highest) * time + rng.uniform(0, 2 * np.pi))
                for _ in range(4)
            )
            part[:, axis] = size * swell * waves / np.sqrt(2)
    angle += np.cumsum(twist, axis=0) * period  # small angles: the attitude follows the rate
    return force + shake + np.cross(force, angle), np.gradient(angle, period, axis=0)


def _swell(time):
    """Return how strong the disturbance of a rest is, shape (n,): smooth at both ends."""
    return np.clip(np.minimum(time, time[-1] - time) / FADE, 0, 1) ** 2
