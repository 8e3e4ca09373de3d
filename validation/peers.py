"""
Beside plain peers on the same simulated data, where the truth is known.

By hand in six kinds of session, on a table with nothing to find but bias and matrix.
"""

import sys
from itertools import islice
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from imu_calibration.api.calibrate import calibrate_recordings
from imu_calibration.core.errors import ImuCalibrationError
from imu_calibration.core.samples import SampleBlock
from imu_calibration.effects.forward_equations import predict
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.joint import JointNames
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window_finder import MotionGatherer
from validation.hand_peers import imu_calib, imu_tk, norm_fit, six_faces, turned
from validation.second_opinions import Forward, fit_norm
from validation.section import Section, text

SEEDS = (8101, 8102, 8103, 8104)
"""Of each kind by hand."""
ON_A_TABLE = (8201, 8202, 8203)
TABLE_SECONDS = 300.0
MOST_KINDS = 6
"""Kinds of session by hand, and of trials."""
BEHIND = 1.25
"""Level or a little behind the best peer."""
GRAVITY = 9.81
TRIAL_SEEDS = (8301, 8302, 8303, 8304)
WITHIN = 1.05
"""First, or so close to the first."""


def kinds():
    """Return name -> function of a seed that returns (ImuSamples, ranges held still, truth)."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))
    from worlds.physics_hand import clipped, hold_and_turn, with_spikes, with_stamp_jitter

    def made(change=lambda imu, seed: imu, **options):
        def make(seed):
            imu, ranges, truth = hold_and_turn(seed, **options)
            return change(imu, seed), ranges, truth

        return make

    return {
        'clean': made(),
        'half of the turns clipped': made(
            lambda imu, seed: clipped(imu, 0.8 * np.median(np.abs(imu.rate_s).max(axis=0))),
            n_poses=18,
        ),
        'eight poses': made(n_poses=8),
        'poses creep by 0.15 deg/s': made(creep=np.radians(0.15)),
        'stamps late by 3 ms rms': made(lambda imu, seed: with_stamp_jitter(imu, 3e-3, seed)),
        '1 % spikes': made(lambda imu, seed: with_spikes(imu, 0.01, seed)),
    }


def plain(imu, ranges, average):
    """
    Return (accelerometer, gyroscope) as somebody writes it in an afternoon.

    The person knows when the sensor was held still.

    The norm fit for the accelerometer; the gyroscope's bias is the average over the poses, its
    matrix turns gravity from pose to pose.
    """
    force = np.array([average(imu.force_s[held], axis=0) for held in ranges])
    accelerometer = fit_norm(force, GRAVITY)
    up = accelerometer.directions(force)
    bias = np.mean([average(imu.rate_s[held], axis=0) for held in ranges], axis=0)
    step = 1e-9 * (imu.stamp_ns[-1] - imu.stamp_ns[0]) / (len(imu) - 1)
    turns = [
        imu.rate_s[first.stop : second.start] - bias for first, second in zip(ranges, ranges[1:])
    ]

    def misses(values):
        inverse = np.linalg.inv(values.reshape(3, 3))
        return np.concatenate(
            [
                turned(turn @ inverse.T, step).T @ before - after
                for turn, before, after in zip(turns, up, up[1:])
            ]
        )

    return accelerometer, Forward(
        bias, least_squares(misses, np.eye(3).ravel(), x_scale='jac').x.reshape(3, 3)
    )


def plain_on_a_table(block, table):
    """
    Return (accelerometer, gyroscope).

    Bias and matrix by least squares over all samples beside what the joints say.
    """
    gatherer, model = (
        MotionGatherer(table),
        SensorModel(
            accelerometer=('bias', 'matrix'),
            gyroscope=('bias', 'matrix'),
            joint_names=JointNames.of(table.joint_names),
        ),
    )
    windows = gatherer.push(block) + gatherer.finish()
    found = []
    for place, measured in enumerate(('force_s', 'rate_s')):
        readings = [getattr(window, measured) for window in windows]
        reference = [
            np.broadcast_to(
                predict(model, model.start(), table, motion=window.motion)[place], reading.shape
            )
            for window, reading in zip(windows, readings)
        ]
        design = np.insert(np.concatenate(reference), 0, 1.0, axis=1)
        solution = np.linalg.lstsq(design, np.concatenate(readings), rcond=None)[0]
        found.append(Forward(solution[0], solution[1:].T))
    return found


def errors(found, truth):
    """
    Return rms errors of the compensated accelerometer and gyroscope.

    The units are m/s^2 at 1 g, and rad/s at 1 rad/s rms per axis, over the same directions for all.
    """
    rng, rms = np.random.default_rng(1), []
    force = rng.normal(size=(500, 3))
    for sensor, true, motion in zip(
        found,
        truth,
        (GRAVITY * force / np.linalg.norm(force, axis=1, keepdims=True), rng.normal(size=(500, 3))),
    ):
        reading = motion @ true.matrix.T + true.bias
        rms.append(np.sqrt(np.mean((sensor.compensated(reading) - motion) ** 2)))
    return rms


def ours(calibration):
    """Return (accelerometer, gyroscope) of a Calibration."""
    values = dict(zip(calibration.param_names, calibration.values))
    return [
        Forward(
            np.array([values[f'{sensor}.bias.{axis}'] for axis in 'xyz']),
            np.array(
                [[values[f'{sensor}.matrix.{row}{column}'] for column in 'xyz'] for row in 'xyz']
            ),
        )
        for sensor in ('accelerometer', 'gyroscope')
    ]


def _truth(values):
    """Return the true errors of accelerometer and gyroscope of a session."""
    from worlds.hand_sessions import unpack

    bias_f, matrix_f, bias_w, matrix_w = unpack(values)
    return Forward(bias_f, matrix_f), Forward(bias_w, matrix_w)


def by_hand(make):
    """
    Return rms errors over the seeds of ours, the plain fit on means and on medians, shape (3, 2).

    Inf where we refuse.
    """
    rows = []
    for seed in SEEDS:
        imu, ranges, values = make(seed)
        truth = _truth(values)
        try:
            mine = errors(
                ours(calibrate_recordings(SampleBlock(imu), gravity=GRAVITY).calibration), truth
            )
        except ImuCalibrationError:
            mine = [np.inf, np.inf]
        rows.append(
            [
                mine,
                *(errors(plain(imu, ranges, average), truth) for average in (np.mean, np.median)),
            ]
        )
    return np.sqrt(np.mean(np.square(rows), axis=0))


def trial(make):
    """
    Return {method: median errors over the sessions of a trial}.

    None for a sensor that a method does not calibrate.
    """
    found = {}
    for seed in TRIAL_SEEDS:
        imu, ranges, values = make(seed)
        truth = _truth(values)
        methods = {
            'ours': ours(calibrate_recordings(SampleBlock(imu), gravity=GRAVITY).calibration),
            **{
                peer.__name__: peer(imu, ranges, GRAVITY)
                for peer in (imu_tk, imu_calib, norm_fit, six_faces)
            },
        }
        for name, sensors in methods.items():
            found.setdefault(name, []).append(
                [np.inf] * 2
                if sensors is None
                else errors(
                    (sensors[0], sensors[1] or Forward(np.full(3, np.inf), np.eye(3))), truth
                )
            )
    return {name: np.median(rows, axis=0) for name, rows in found.items()}


def trials(section):
    """Add a claim for each trial of `worlds.hand_trials`, and the table of all methods."""
    from worlds.hand_trials import TRIALS

    rows = []
    for kind, make in islice(TRIALS.items(), MOST_KINDS):
        found = trial(make)
        mine, peers = (
            found['ours'],
            np.nanmin([errors for name, errors in found.items() if name != 'ours'], axis=0),
        )
        section.claim(
            f'{kind}: median error of {len(TRIAL_SEEDS)} sessions, accelerometer and gyroscope,'
            ' against the best peer',
            f'at most {WITHIN} of it',
            '; '.join(
                f'{1e3 * a:.2f} against {1e3 * b:.2f} {unit}'
                for a, b, unit in zip(mine, peers, ('mm/s²', 'mrad/s'))
            ),
            np.all(mine <= WITHIN * peers),
        )
        rows.append(
            (
                kind,
                *(
                    ' / '.join(
                        f'{1e3 * value:.3g}' if np.isfinite(value) else '–' for value in errors
                    )
                    for errors in found.values()
                ),
            )
        )
    section.say(text('hand_trials', sessions=len(TRIAL_SEEDS)))
    section.table(('trial (mm/s² / mrad/s)', *(name.replace('_', ' ') for name in found)), rows)


def on_a_table():
    """
    Return rms errors of ours and of plain least squares over all samples, shape (2, 2).

    Where both know all there is.
    """
    from worlds.physics import make_session

    rows = []
    for seed in ON_A_TABLE:
        session = make_session(seed, noise='white', duration=TABLE_SECONDS, temperature=None)
        table = Table.from_mapping(session.table)
        truth = [
            Forward(session.truth[sensor].bias, session.truth[sensor].matrix)
            for sensor in ('accelerometer', 'gyroscope')
        ]
        rows.append(
            [
                errors(found, truth)
                for found in (
                    ours(calibrate_recordings(session.block, table).calibration),
                    plain_on_a_table(session.block, table),
                )
            ]
        )
    return np.sqrt(np.mean(np.square(rows), axis=0))


def run(folder, plots):
    """Return the section."""
    section = Section('Beside plain peers where the truth is known')
    rows = []
    ratios = {}  # kind -> our error over that of the better peer, by sensor
    for kind, make in islice(kinds().items(), MOST_KINDS):
        found = by_hand(make)  # ours and the two peers, by sensor
        ratios[kind] = found[0] / found[1:].min(axis=0)
        rows.append((kind, *(f'{1e3 * value:.2f}' for value in found.T.ravel())))
    all_ratios = np.concatenate(list(ratios.values()))
    closer = np.count_nonzero(all_ratios <= 1.0)
    section.claim(
        f'{len(SEEDS) * len(rows)} sessions by hand, {len(rows)} kinds, two sensors: closer to the'
        ' truth than either peer',
        'in most',
        f'{closer} of {len(all_ratios)}',
        closer > len(all_ratios) / 2,
        headline=True,
    )
    section.claim(
        'the same: our error over that of the better peer, accelerometer and gyroscope',
        f'at most {BEHIND} in every kind',
        '; '.join(f'{kind} {force:.2f}, {rate:.2f}' for kind, (force, rate) in ratios.items()),
        max(all_ratios) <= BEHIND,
        headline=True,
    )
    trials(section)
    mine, plainly = on_a_table()
    section.claim(
        'a table, bias and matrix are all there is: our error over that of plain least squares over'
        ' all samples',
        f'at most {BEHIND}',
        f'{mine[0] / plainly[0]:.2f} ({1e3 * mine[0]:.3f} and {1e3 * plainly[0]:.3f} mm/s²), '
        f'gyroscope {mine[1] / plainly[1]:.2f}',
        max(mine / plainly) <= BEHIND,
        headline=True,
    )
    section.say(
        text('peers', seeds=len(SEEDS), minutes=TABLE_SECONDS / 60, sessions=len(ON_A_TABLE))
    )
    section.table(
        (
            'kind of session',
            *(
                f'{sensor}, {who}'
                for sensor in ('mm/s²', 'mrad/s')
                for who in ('ours', 'on means', 'on medians')
            ),
        ),
        rows,
    )
    return section
