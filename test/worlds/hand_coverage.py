"""
Check whether standard deviations by hand hold where no model holds.

The hand and the sensor then do things that no model holds; run ``python -m worlds.hand_coverage``
in test/.
"""

from argparse import ArgumentParser

import numpy as np

from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.solution import HELD_PRIORS, of_fit
from imu_calibration.references.gravity.hand_calibration import gather_by_hand

from worlds.hand_sessions import GRAVITY, PARAM_NAMES
from worlds.physics_hand import hold_and_turn, warmed_up
from worlds.searched_by_hand import searched

WORLDS = {
    'clean': {},
    'warm-up': {},
    'creep': {'creep': 0.0026},
    'poses that do not repeat': {'pose_sd': 0.02, 'drift_sd': 2e-3},
    'flexing grip': {'settling': 0.009},
}
"""
What `hold_and_turn` is told: 0.15 deg/s of creep, 2 mg and 0.11 deg/s from pose to pose, half a
degree of giving way.
"""
GROUPS = {
    'accelerometer.bias': slice(0, 3),
    'accelerometer.matrix': slice(3, 9),
    'gyroscope.bias': slice(9, 12),
    'gyroscope.matrix': slice(12, 21),
}


def session(world, seed, n_poses=24):
    """
    Return (data, truth, change of the biases) of one session of a world.

    The change is from the start to the mean over the recording, found as a user's would be.
    """
    imu, _, truth = hold_and_turn(seed, n_poses=n_poses, rate_hz=50.0, **WORLDS[world])
    moved = {sensor: np.zeros(3) for sensor in SENSORS}
    if world == 'warm-up':
        before, (imu, _) = imu, warmed_up(imu, seed, force=0.05, rate=0.01, time_constant=60.0)
        moved = dict(
            zip(
                SENSORS,
                (
                    (imu.force_s - before.force_s).mean(axis=0),
                    (imu.rate_s - before.rate_s).mean(axis=0),
                ),
                strict=True,
            )
        )
    return gather_by_hand(imu), truth, moved


def errors(world, seed, asked=CalibrationOptions(gravity=GRAVITY), **options):
    """
    Return group -> (errors, reported sds, factor of the sds).

    The factor is the ratio to the sds that only noise and scatter give.
    """
    data, truth, moved = session(world, seed, **options)
    hand, truth = searched(data, asked).solution, truth.copy()
    for sensor, part in zip(SENSORS, (slice(0, 3), slice(9, 12)), strict=True):
        # A bias beside a drift is that of the start, else a mean.
        if not any(
            effect.sensor == sensor and effect.time_constant for effect in hand.hand_model.extras
        ):
            truth[part] += moved[sensor]
    places = [hand.param_names.index(name) for name in PARAM_NAMES[:21]]
    fit = of_fit(hand.terms) + hand.terms[HELD_PRIORS]
    grown = hand.sd[places] / np.sqrt(np.maximum(np.diag(fit)[places], 1e-30))
    off, sd = hand.values[places] - truth[:21], hand.sd[places]
    return {group: (off[part], sd[part], grown[part]) for group, part in GROUPS.items()}


def main():
    parser = ArgumentParser()
    parser.add_argument('--first', type=int, default=1)
    parser.add_argument('--seeds', type=int, default=8)
    parser.add_argument('--worlds', nargs='*', default=list(WORLDS))
    options = parser.parse_args()
    for world in options.worlds:
        runs = [errors(world, seed) for seed in range(options.first, options.first + options.seeds)]
        for group in GROUPS:
            off, sd, grown = (np.concatenate([run[group][k] for run in runs]) for k in range(3))
            alone = off / (sd / grown)
            print(
                f'{world:26s} {group:22s} noise alone {np.sqrt(np.mean(alone**2)):5.2f}'
                f' {100 * np.mean(np.abs(alone) < 1.96):4.0f} %   reported'
                f' {np.sqrt(np.mean((off / sd) ** 2)):5.2f}'
                f' {100 * np.mean(np.abs(off / sd) < 1.96):4.0f} %   wider by'
                f' {np.median(grown):.2f} (95 %: {np.quantile(grown, 0.95):.2f})',
                flush=True,
            )


if __name__ == '__main__':
    main()
