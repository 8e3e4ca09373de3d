"""
Check whether intervals of a calibration hold where unknown things happen.

Something happens then that no catalogue holds; run ``python -m worlds.misfit_coverage [--seeds N]``
in test/.

Prints for each world and group of parameters the root mean square of the errors in standard
deviations, with those that noise alone gives and as reported, how often the 95 % interval holds,
and how much wider than by noise alone the standard deviations are.
"""

import argparse
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.estimation.solution import HELD_PRIORS, Solution, of_fit
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window_finder import MotionGatherer
from imu_calibration.references.turntable.accumulator import Accumulator
from imu_calibration.references.turntable.estimation.solver import solve
from imu_calibration.references.turntable.repeated_linearisation import (
    MAX_TABLE_PASSES,
    linearise_again,
)
from imu_calibration.references.turntable.requested_model import choose_model
from imu_calibration.references.turntable.window_statistics import reduce_windows

from worlds.misfit_worlds import CAUSES, make_pair

OPTIONS = CalibrationOptions('bias+matrix', 'bias+matrix', 'time_offset')
"""The timing is asked, as a search would: a lag is not what these worlds are about."""
COARSE = {'imu_rate': 50.0, 'joint_rate': 50.0}
"""Rates of sessions in tests."""
GROUPS = tuple(
    f'{sensor}.{name}' for sensor in ('accelerometer', 'gyroscope') for name in ('bias', 'matrix')
)
FIRST_SEED = 9001


@dataclass(frozen=True, eq=False)
class Calibrated:
    """A session with its windows and what came out."""

    windows: list
    """Windows used."""
    solution: Solution
    """What came out."""
    truth: dict
    """As in `Session`."""


def calibrated(session, options=OPTIONS):
    """Return a session calibrated with a model that lacks its cause."""
    table = Table.from_mapping(session.table)
    gatherer = MotionGatherer(table)
    windows = gatherer.push(session.block) + gatherer.finish()
    model = choose_model(options, table)
    for _ in range(MAX_TABLE_PASSES):
        accumulator = Accumulator()
        for row in reduce_windows(windows, model, table):
            accumulator.add(row)
        solution = solve(accumulator, model)
        again = linearise_again(model, solution)
        if again is None:
            break
        model = again
    return Calibrated(windows, solution, session.truth)


@lru_cache(maxsize=None)
def clean(seed):
    """Return a session in which all is as the model has it, calibrated; made once."""
    return calibrated(make_pair(None, seed, **COARSE).first)


def base_sd(solution):
    """Return the standard deviations that noise alone gives, shape (n_params,)."""
    return np.sqrt(np.diag(of_fit(solution.terms) + solution.terms[HELD_PRIORS]))


def errors_in_sd(found):
    """
    Return ('noise alone' or 'reported', group) -> errors in standard deviations.

    The errors are of the group's parameters, with the held parameters left out.
    """
    errors, solution = {}, found.solution
    for group in GROUPS:
        sensor, name = group.split('.')
        part = solution.model.slices[sensor, name]
        free, error = (
            ~solution.held[part],
            solution.values[part] - np.ravel(getattr(found.truth[sensor], name)),
        )
        for what, sd in (('noise alone', base_sd(solution)), ('reported', solution.sd)):
            errors[what, group] = (error / sd[part])[free]
    return errors


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, default=8)
    parser.add_argument('--first', type=int, default=FIRST_SEED)
    arguments = parser.parse_args()
    print(
        '| world | parameters | rms error in sd, noise alone | as reported | 95 % interval holds |'
        f' wider, median (95 %) |\n|{" --- |" * 6}'
    )
    for cause in (None, *CAUSES):
        results = [
            calibrated(make_pair(cause, seed).first)
            for seed in range(arguments.first, arguments.first + arguments.seeds)
        ]
        errors = [errors_in_sd(found) for found in results]
        for group in GROUPS:
            alone, reported = (
                np.concatenate([error[what, group] for error in errors])
                for what in ('noise alone', 'reported')
            )
            part = results[0].solution.model.slices[tuple(group.split('.'))]
            wider = np.concatenate(
                [(found.solution.sd / base_sd(found.solution))[part] for found in results]
            )
            print(
                f'| {cause or "clean"} | {group} | {np.sqrt(np.mean(alone**2)):.1f} |'
                f' {np.sqrt(np.mean(reported**2)):.1f} |'
                f' {100 * np.mean(np.abs(reported) < 1.96):.0f} % | {np.median(wider):.1f}'
                f' ({np.quantile(wider, 0.95):.1f}) |',
                flush=True,
            )


if __name__ == '__main__':
    main()
