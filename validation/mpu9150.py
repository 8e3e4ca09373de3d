"""
MPU-9150 by hand against published biases, and turn angles against two peers.

The angles are of turns that were not used.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from imu_calibration.preprocessing.rest_detection import find_still
from imu_calibration.references.gravity.hand_calibration import (
    calibrate_by_hand,
    gather_by_hand,
    solve_by_hand,
)
from imu_calibration.references.gravity.hand_parameters import HandOptions
from validation.hand_peers import imu_calib, imu_tk, turned
from validation.peers import WITHIN
from validation.recordings import gravity_of, load, reference
from validation.second_opinions import Forward, fit_norm
from validation.section import Section, listed, text

NAME = 'mpu9150_0'
TURNS = ('mpu9150_0', 'mpu9150_3')
"""Recordings whose left-out turns are compared."""
LEFT_OUT = None
"""Turns of a recording that are left out, one at a time; None for all."""


def figures(folder):
    """Return (HandCalibration, bias difference from the published ones in m/s^2)."""
    imu = load(folder, NAME)
    found = calibrate_by_hand(imu, HandOptions(gravity_sd=0.02), find_still(imu))
    return (
        found,
        found.accelerometer[0] - reference(folder, NAME)['published']['accelerometer_bias'],
    )


def ours_without(data, imu, ranges, gravity, without):
    """
    Return (accelerometer, gyroscope) of a calibration by hand from `HandData`.

    It omits the turns that overlap the slice `without`.
    """
    turns = [
        turn
        for turn in data.turns
        if data.poses.start[turn.last] <= without.start
        or data.poses.stop[turn.first] >= without.stop
    ]
    found = solve_by_hand(replace(data, turns=turns), HandOptions(gravity))
    return Forward(*found.accelerometer), Forward(*found.gyroscope[:2])


def left_out_turns(imu, gravity):
    """
    Return {method: rms angle in degrees} of all turns.

    Each turn has the gyroscope from the other turns.

    The angle is that between gravity after a turn and gravity before it, rotated by the corrected
    rates from the middle of one rest to the middle of the next. The directions of gravity are the
    same for all methods: those of the norm fit to all poses.
    """
    ranges = find_still(imu)
    methods: dict[str, Callable[..., Any]] = {
        'ours': partial(ours_without, gather_by_hand(imu, ranges)),
        'imu_tk': imu_tk,
        'imu-calib': imu_calib,
    }
    squares = {name: [] for name in methods}
    force = np.array([imu.force_s[rest].mean(axis=0) for rest in ranges])
    up, step = fit_norm(force, gravity).directions(force), 1e-9 * np.diff(imu.stamp_ns)
    middle = [(rest.start + rest.stop) // 2 for rest in ranges]
    turns = list(zip(middle, middle[1:], up, up[1:]))
    for begin, end, before, after in turns[:LEFT_OUT]:
        for name, method in methods.items():
            gyroscope = method(imu, ranges, gravity, slice(begin, end))[1]
            rotated = (
                turned(gyroscope.compensated(imu.rate_s[begin : end + 1]), step[begin:end]).T
                @ before
            )
            squares[name].append(
                np.arctan2(np.linalg.norm(np.cross(rotated, after)), rotated @ after) ** 2
            )
    return {name: float(np.degrees(np.sqrt(np.mean(found)))) for name, found in squares.items()}


def run(folder, plots):
    """Return the section."""
    section = Section('Published biases: MPU-9150 (mpu9150_0)')
    found, difference = figures(folder)
    section.claim(
        'mpu9150_0: accelerometer biases against the published ones',
        'within 10 mm/s²',
        f'{listed(1e3 * difference, 1)} mm/s²',
        np.max(np.abs(difference)) < 0.010,
    )
    for name in TURNS:
        angles = left_out_turns(load(folder, name), gravity_of(folder, name))
        best = min(value for method, value in angles.items() if method != 'ours')
        section.claim(
            f'{name}: angles of turns that were left out, first or within {WITHIN - 1:.0%} of the'
            ' better peer',
            f'at most {WITHIN * best:.3f}°',
            ', '.join(f'{method} {value:.3f}°' for method, value in angles.items()),
            angles['ours'] <= WITHIN * best,
        )
    statistics = found.statistics
    section.say(
        text(
            'mpu9150',
            sds=', '.join(f'{1e3 * sd:.1f}' for sd in found.sd[:3]),
            poses=statistics['poses'],
            turns=statistics['turns'],
            residual=1e3 * statistics['norm_residual_rms'],
        )
    )
    return section
