"""
Figures of the planner over random tables, tolerances and grades.

``python benchmarks/bench_plan.py [--tables N] [--seeds N]``.

Each table has three axes in random directions, none closer than 60 degrees to parallel with its
neighbour, 200 to 400 deg/s (the fixed profile spins at 200), and a random mount. Tolerances are
drawn for each effect between one and three times the sd of the fixed profile `calibration` on that
table, for biases between twice and four times, so that the profile has no time to spare on some
effect; it is charged with the time after which its own motions, in its own order, meet the
tolerances. Achieved: errors of calibrations of simulated sessions over predicted sd, root mean
square over all parameters and seeds.
"""

import argparse
import os
import resource
import sys
import time
from pathlib import Path

# Small matrices: a second thread only waits for the first.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import numpy as np  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / 'test')]  # simulated worlds of the tests

from imu_calibration.api.calibrate import calibrate_recordings  # noqa: E402
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.samples import SampleBlock  # noqa: E402
from imu_calibration.effects.base import SENSORS  # noqa: E402
from imu_calibration.effects.sensor_model import (
    NAMED_MODELS,  # noqa: E402
    SensorModel,  # noqa: E402
)
from imu_calibration.estimation.solution import tolerances_of  # noqa: E402
from imu_calibration.kinematics.motion_limits import limits_of  # noqa: E402
from imu_calibration.planning.coordinates import Coordinates  # noqa: E402
from imu_calibration.planning.motion_library import MotionLibrary  # noqa: E402
from imu_calibration.planning.planner import Planner, make_planner  # noqa: E402
from imu_calibration.planning.planning_problem import (
    PlanningProblem,  # noqa: E402
    noise_of_grade,  # noqa: E402
)
from imu_calibration.planning.posterior import exact_information  # noqa: E402
from imu_calibration.references.turntable.requested_model import choose_model
from imu_calibration.simulation.motion_builder import Profile  # noqa: E402
from imu_calibration.simulation.profiles import make_profile  # noqa: E402
from imu_calibration.simulation.sensor_noise import GRADES  # noqa: E402
from imu_calibration.simulation.session import (
    SimulationOptions,
    random_values,
    simulate_session,
)  # noqa: E402
from tools.smallest import add_smallest  # noqa: E402

from worlds.random_tables import random_table  # noqa: E402
from worlds.stands import STANDS, quarter_tolerances, stand  # noqa: E402

RATE = 100.0
MARKS = np.linspace(0.1, 1.0, 19)
"""Shares of the fixed profile at which its result is evaluated."""


def fixed_profile(problem, table):
    """Return (times, standard deviations of all parameters at each) of the fixed profile."""
    profile = make_profile('calibration', 0, table)
    windows = problem.predictor.predict([profile.segments])[0]
    times, prior = (
        np.array([window.middle for window in windows]),
        problem.coordinates.prior_information,
    )
    found = []
    for mark in MARKS:
        known = int(np.searchsorted(times, mark * profile.duration))
        found.append(
            problem.coordinates.sd(
                np.linalg.inv(
                    prior + exact_information(windows[:known], times[:known], problem.noise)
                )
            )
        )
    return MARKS * profile.duration, np.array(found)


def drawn_tolerances(rng, model, sd):
    """Return {section: {effect: tolerance}} by the rule above."""
    drawn = {}
    for effect in model.effects:
        factor = rng.uniform(2.0, 4.0) if effect.name == 'bias' else rng.uniform(1.0, 3.0)
        drawn.setdefault(effect.sensor, {})[effect.name] = float(
            factor * sd[model.slices[effect.key]].max()
        )
    return drawn


def followed(plan, table, grade, seed):
    """Return (calibration, true values by name) of a simulated session that follows the plan."""
    profile = Profile(
        'plan', tuple(segment for one in plan.segments for segment in one), tuple(table.joint_names)
    )
    model = SensorModel(NAMED_MODELS['size_effect'], joint_names=table.joint_names)
    values = random_values(model, grade, seed)
    samples = simulate_session(
        model,
        values,
        table,
        profile=profile,
        options=SimulationOptions(noise=GRADES[grade].noise),
        seed=seed,
    )
    return calibrate_recordings(SampleBlock(*samples), table).calibration, dict(
        zip(model.param_names, values, strict=True)
    )


def achieved(plan, table, grade, seed):
    """
    Return (errors, reported standard deviations) of one simulated session.

    Both are divided by the predicted standard deviations. The session follows the plan.
    """
    found, truth = followed(plan, table, grade, seed)
    rows = [
        (found.values[k] - truth[name], found.sd[k], plan.sd[plan.model.param_names.index(name)])
        for k, name in enumerate(found.param_names)
        if name in truth and name in plan.model.param_names
    ]
    error, reported, predicted = np.array(rows).T
    return error / predicted, reported / predicted


def one_table(number, seeds):
    """Return one row of figures."""
    rng = np.random.default_rng([number, 14])
    table, grade = random_table(rng, speeds_deg=(200, 400)), list(GRADES)[number % len(GRADES)]
    noise, model = (
        noise_of_grade(GRADES[grade].noise, RATE),
        choose_model(CalibrationOptions(), table),
    )
    problem = PlanningProblem(
        MotionLibrary(table, limits_of(table)), Coordinates(model, tolerances_of(model)), noise
    )
    times, sd = fixed_profile(problem, table)
    tolerances = drawn_tolerances(rng, model, sd[-1])
    began = time.process_time()
    planner: Planner = make_planner(table, noise=noise, tolerances=tolerances)
    plan = planner.plan()
    taken = time.process_time() - began
    enough = np.all(sd[:, plan.wanted] <= plan.tolerances[plan.wanted], axis=1)
    fixed = float(times[np.argmax(enough)]) if enough.any() else np.inf
    errors, reported = (
        zip(
            *(achieved(plan, table, grade, 1000 * number + seed) for seed in range(seeds)),
            strict=True,
        )
        if seeds
        else ([], [])
    )
    return {
        'grade': grade,
        'met': not plan.missing,
        'plan': plan.seconds,
        'bound': plan.lower_bound_seconds,
        'fixed': fixed,
        'rms': float(np.sqrt(np.mean(np.square(errors)))) if seeds else np.nan,
        'reported': float(np.median(reported)) if seeds else np.nan,
        'planning': taken,
        'motions': len(plan.motions),
    }


def planned_session(plan, table, seed):
    """
    Return the undetermined parameters and the sensors that do not help.

    The result is for a simulated session that follows the plan.
    """
    found, _ = followed(plan, table, 'industrial', seed)
    wanted = {name for name, flag in zip(plan.model.param_names, plan.wanted, strict=True) if flag}
    weak = [
        name
        for name, status in zip(found.param_names, found.status, strict=True)
        if name in wanted and status != 'determined'
    ]
    return weak + [sensor for sensor in SENSORS if found.decision.get(sensor) != 'helps']


def stands(sessions, first, names):
    """
    Print the targets of the six stands.

    Time over the bound at a quarter of the default tolerances, memory, and planned sessions.
    """
    noise, passed = noise_of_grade(GRADES['industrial'].noise, RATE), 0
    print(
        'stand                 plan s  bound s  ratio  planning s  most MB  default plan s  bound s'
    )
    plans = {}
    for name in names:
        table = stand(name)
        tolerances, began = quarter_tolerances(table), time.process_time()
        plan = make_planner(table, noise=noise, tolerances=tolerances).plan()
        taken, memory = (
            time.process_time() - began,
            resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        )
        plans[name] = make_planner(table, noise=noise).plan()
        print(
            f'{name:<21} {plan.seconds:6.1f}  {plan.lower_bound_seconds:7.1f} '
            f' {plan.seconds / plan.lower_bound_seconds:5.2f}  {taken:10.1f}  {memory:7.0f} '
            f' {plans[name].seconds:14.1f}  {plans[name].lower_bound_seconds:7.1f}',
            flush=True,
        )
    for number in range(sessions):
        name = list(plans)[number % len(plans)]
        weak = planned_session(plans[name], stand(name), first + number)
        passed += not weak
        if weak:
            print(f'session {first + number} on {name}: {", ".join(weak)}', flush=True)
    print(
        f'{passed} of {sessions} planned sessions with every parameter determined and both sensors'
        ' of help (target 35 of 40); ratio at most 1.25; seven joints at most 500 MB and 10 s'
    )


def main():
    """Print a row for each table, and a summary; or the targets of the six stands."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[1])
    parser.add_argument('--tables', type=int, default=20)
    parser.add_argument('--seeds', type=int, default=5)
    parser.add_argument('--first', type=int, default=0)
    parser.add_argument(
        '--sessions',
        type=int,
        default=0,
        help='print the targets of the six stands with so many sessions instead',
    )
    parser.add_argument('--stands', nargs='*', choices=STANDS, default=STANDS)
    add_smallest(parser, tables=1, first=5, seeds=1)
    options = parser.parse_args()
    if options.sessions:
        return stands(options.sessions, options.first, options.stands)
    rows = []
    print(
        'table grade       met  plan s  bound s  ratio  fixed s  share  achieved/predicted '
        ' reported/predicted  planning s'
    )
    for number in range(options.first, options.first + options.tables):
        row = one_table(number, options.seeds)
        rows.append(row)
        print(
            f'{number:5d} {row["grade"]:<11} {"yes" if row["met"] else "NO ":<4}{row["plan"]:7.1f} '
            f' {row["bound"]:7.1f}  {row["plan"] / row["bound"]:5.2f}  {row["fixed"]:7.1f} '
            f' {row["plan"] / row["fixed"]:5.2f}  {row["rms"]:18.2f}  {row["reported"]:18.2f} '
            f' {row["planning"]:10.1f}',
            flush=True,
        )
    ratio, share = (
        np.array([row['plan'] / row[name] for row in rows]) for name in ('bound', 'fixed')
    )
    rms = np.array([row['rms'] for row in rows])
    print(
        f'tolerances met on {sum(row["met"] for row in rows)} of {len(rows)}; plan over bound:'
        f' median {np.median(ratio):.2f}, largest {ratio.max():.2f}; plan over fixed profile:'
        f' median {np.median(share):.2f}, largest {share.max():.2f}; achieved over predicted:'
        f' median {np.nanmedian(rms):.2f}, {np.nanmin(rms):.2f} to {np.nanmax(rms):.2f}; processor'
        f' time: largest {max(row["planning"] for row in rows):.1f} s'
    )


if __name__ == '__main__':
    main()
