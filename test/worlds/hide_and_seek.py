"""
Hide and seek: effects are hidden in sessions made by physics, and `diagnose` has to find them.

Run as ``python test/worlds/hide_and_seek.py`` (or ``make hide-and-seek``): some hours on two free cores. Prints a confusion matrix and the
figures, draws them into docs/, and lists the sessions of which the record in the repository tells another thing. ``--seeds 3``, ``--minutes 20``,
``--fast`` and ``--parts effects,none`` run less, and draw into out/; what was run stands beside every figure.
"""

import argparse
import json
import os
import sys
import time
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from itertools import combinations
from pathlib import Path

for _name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS'):
    os.environ.setdefault(_name, '1')
sys.path[:0] = [str(Path(__file__).resolve().parents[1]), str(Path(__file__).resolve().parents[2])]

import numpy as np  # noqa: E402

from imu_calibration.diagnosis.diagnose import diagnose  # noqa: E402
from imu_calibration.selection.explained_share import sensors_of  # noqa: E402
from imu_calibration.selection.gain import heldout_gain  # noqa: E402
from imu_calibration.selection.investigation import investigate  # noqa: E402

from worlds import hide_and_seek_record as record_kept  # noqa: E402
from worlds.beyond_catalogue import rows_of_seed  # noqa: E402
from worlds.hide_and_seek_figures import write_figures  # noqa: E402
from worlds.hide_and_seek_report import report  # noqa: E402
from worlds.hiding import NOT_SIZED, all_effects, options_of, record, sizes_for  # noqa: E402
from worlds.physics_beyond import KINDS  # noqa: E402
from worlds.physics_draw import OUTSIDE  # noqa: E402

FIRST_SEED = 7000
"""Seeds from here on were never used while the search was developed."""
PARTS = ('effects', 'none', 'outside', 'pairs', 'sizes', 'traps', 'separating', 'power', 'beyond', 'grades')
GRADES = ('consumer', 'tactical', 'navigation')
"""Grades of the sensor beside the industrial one of all other parts."""
DEG = np.pi / 180
TRAPS = {
    'joints_at_50_Hz': {'imu_rate': 400.0, 'joint_rate': 50.0}, 'encoder_0.01_deg': {'encoder_resolution': 0.01 * DEG},
    'two_seconds_lost': {'dropped': 'both'}, 'knock_on_table': {'knock': True}, 'wrong_covariance': {'wrong_covariance': True},
    'wander': {'noise': 'realistic'},
    'mounted_at_45_deg': {'mount_rpy_deg': (45.0, 0.0, 0.0)}, 'two_axis_table': {'table': 'two_axis'},
    'only_at_rest': {'profile': 'static_only'},
}
"""What must not produce a finding."""
SEPARATED = ('accel_quadratic', 'accel_scale_asymmetry', 'accel_cubic', 'accel_size_effect', 'lever_arm', 'gyro_quadratic',
             'gyro_scale_asymmetry', 'accel_bandwidth', 'gyro_bandwidth', 'time_offset', 'accel_thermal_bias', 'accel_bias_drift')
"""Effects with near relatives, sought again in sessions made to separate them."""
POWER = ('accel_quadratic', 'gyro_g_sensitivity', 'time_offset', 'gyro_thermal_bias', 'table_tilt')
POWER_SIZES = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0)
SIZES = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
"""Times the smallest detectable size, with sizes that are known of no instrument."""


def seek(recording, hidden, **labels):
    """Diagnose a recording and return one row of the record."""
    start = time.process_time()
    diagnosis = diagnose(recording.windows, recording.table, recording.model)
    row = {**labels, 'hidden': sorted(hidden or ()), 'seconds': time.process_time() - start,
           'found': [f.effect for f in diagnosis.findings], 'implausible': [f.implausible for f in diagnosis.findings], 'classes': [list(f.indistinguishable_from) for f in diagnosis.findings],
           'unexplained': any(rest.significant for rest in diagnosis.unexplained.values()), 'errors_in_sd': {}}
    for finding in diagnosis.findings:
        if finding.effect in recording.truth and finding.effect in (hidden or ()):
            true = np.ravel(recording.truth[finding.effect])
            if finding.effect.endswith('_saturation'):
                value = next(iter(finding.parameters.values()))[0]
                row['level_error'] = float(abs(value / true[0] - 1))
                continue
            row['errors_in_sd'][finding.effect] = [float((value - t) / sd) for (value, sd, _), t in zip(finding.parameters.values(), true)]
    return row


def oracle(recording, effect):
    """Return the held-out rms of what was found over that of a searcher who was told the effect, or None where nothing compares."""
    found = investigate(recording.windows, recording.table, recording.model)
    told = [q for q in found.attempt.questions if q.name == effect]
    if not told or found.limits:
        return None
    search = found.attempt.search
    best = min(told, key=lambda q: search.evidence.loss(search.used([q])))
    sensors = sensors_of(best.effect)
    pair = [heldout_gain(found.attempt, [], choice, sensors=sensors) for choice in (found.named, [best])]
    alike = (pair[0].measure, pair[0].sensor) == (pair[1].measure, pair[1].sensor)
    return pair[0].heldout_rms_after / pair[1].heldout_rms_after if alike else None


def effects_of_seed(seed, noise, effects, factor=5.0, profile='random', table='three_axis', part='effects', **options):
    """Hide each effect in one session; the session that hides nothing gives the sizes."""
    labels, options = dict(options), {'profile': profile, 'table': table, **options}
    rows = []
    for effect in effects:
        hidden = {effect: sizes_for(seed, noise, [effect], options).hidden(effect, seed, factor)}
        recording = record(seed, hidden, noise, **options | options_of(effect))
        row = seek(recording, hidden, part=part, seed=seed, noise=noise, **labels)
        if part == 'effects' and seed % 4 == 0:
            row['oracle_ratio'] = oracle(recording, effect)
        rows.append(row)
    return rows


def separating_of_seed(seed, noise, effects):
    """Hide each effect in a session made to separate relatives: many angles, three speeds both ways, on an arm."""
    return effects_of_seed(seed, noise, effects, profile='separating', table='centrifuge', part='separating')


def none_of_seed(seed, noise, part='none', **options):
    """Hide nothing."""
    return [seek(record(seed, None, noise, **options), None, part=part, seed=seed, noise=noise, **options)]


def grade_of_seed(seed, noise, effects, grade):
    """Hide nothing, and each effect, in sensors of another grade."""
    return [*none_of_seed(seed, noise, part='grades', grade=grade), *effects_of_seed(seed, noise, effects, part='grades', grade=grade)]


def outside_of_seed(seed, noise, names):
    """Hide causes that no catalogue holds."""
    return [seek(record(seed, {name: None}, noise), {name: None}, part='outside', seed=seed, noise=noise) for name in names]


def pairs_of_seed(seed, noise, pairs):
    """Hide two effects at once, each pair in one session."""
    rows = []
    for pair in pairs:
        sizes = sizes_for(seed, noise, pair, {})
        hidden = {name: sizes.hidden(name, seed, 5.0) for name in pair}
        rows.append(seek(record(seed, hidden, noise, through_bag=False, **options_of(*pair)), hidden, part='pairs', seed=seed, noise=noise, beside=sizes.beside(hidden)))
    return rows


def all_pairs(effects):
    """Return all pairs of the effects whose size can be chosen."""
    return list(combinations([name for name in effects if name not in NOT_SIZED], 2))


def traps_of_seed(seed, names):
    """Set traps that must not produce a finding."""
    rows = []
    for name in names:
        options = {'noise': 'white', **TRAPS[name]}
        rows.append(seek(record(seed, None, **options), None, part='traps', trap=name, seed=seed, noise=options['noise']))
    return rows


def sizes_of_seed(seed, noise, effects, factors, part='sizes'):
    """Hide effects at several times the smallest detectable size; those of part 'power' are around it."""
    rows = []
    for effect in sorted(set(effects) - NOT_SIZED):
        sizes = sizes_for(seed, noise, [effect], {})
        for factor in factors:
            hidden = {effect: sizes.hidden(effect, seed, factor)}
            rows.append(seek(record(seed, hidden, noise, through_bag=False, **options_of(effect)), hidden, part=part, factor=factor, seed=seed, noise=noise))
    return rows


EFFECTS_PER_TASK = 13


def tasks_of(options):
    """Return (function, arguments) of everything that is to run; parts take turns, so that a run cut short has some of each."""
    names = tuple(options.effects.split(',')) if options.effects else all_effects()
    bundles = [names[k:k + EFFECTS_PER_TASK] for k in range(0, len(names), EFFECTS_PER_TASK)]
    n_seeds, first = options.seeds, options.first_seed
    seeds = range(first, first + n_seeds)
    some = {
        'effects': [(effects_of_seed, (seed, noise, bundle)) for seed in seeds for noise in options.noise for bundle in bundles],
        'none': [(none_of_seed, (seed, noise)) for seed in range(first + 100, first + 100 + 3 * n_seeds) for noise in options.noise],
        'outside': [(outside_of_seed, (seed, 'realistic', tuple(OUTSIDE))) for seed in seeds[:max(n_seeds // 2, 1)]],
        'pairs': [(pairs_of_seed, (first + 200 + k, 'realistic', pairs)) for k, pairs in enumerate(_dealt(all_pairs(names), max(n_seeds // 2, 1)))],
        'sizes': [(sizes_of_seed, (seed, 'realistic', bundle, SIZES)) for seed in range(first + 400, first + 400 + max(n_seeds // 5, 1)) for bundle in bundles],
        'traps': [(traps_of_seed, (seed, tuple(TRAPS))) for seed in seeds[:max(n_seeds // 5, 1)]],
        'separating': [(separating_of_seed, (seed, 'white', SEPARATED)) for seed in seeds[:max(n_seeds // 5, 1)]],
        'beyond': [(rows_of_seed, (seed, 'realistic', tuple(KINDS))) for seed in range(first + 2000, first + 2000 + max(n_seeds // 2, 1))],
        'grades': [(grade_of_seed, (seed, 'realistic', bundle, grade)) for seed in seeds[:max(n_seeds // 10, 1)] for grade in GRADES for bundle in bundles],
        'power': [(sizes_of_seed, (seed, 'white', POWER, POWER_SIZES, 'power')) for seed in range(first + 300, first + 300 + max(n_seeds // 3, 1))],
    }
    placed = [(k / len(some[part]), task) for part in PARTS if part in options.parts for k, task in enumerate(some[part])]
    return [task for _, task in sorted(placed, key=lambda pair: pair[0])]


def _dealt(things, hands):
    """Return things dealt out to hands in turn."""
    return [tuple(things[k::hands]) for k in range(min(hands, len(things)))]


def run(task):
    """Run one task; a failure is a row of its own."""
    function, arguments = task
    try:
        return function(*arguments)
    except Exception as problem:  # noqa: B902 - one broken session must not lose an hour of others
        return [{'part': 'failed', 'what': f'{function.__name__}{arguments[:2]}', 'why': repr(problem)}]


def main(arguments=None):
    """Run the tasks on two processes, keep a record, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, default=20, help='sessions per effect and noise')
    parser.add_argument('--first-seed', type=int, default=FIRST_SEED)
    parser.add_argument('--effects', help='names joined by commas; default all')
    parser.add_argument('--parts', default=','.join(PARTS), type=lambda text: text.split(','))
    parser.add_argument('--noise', default='white,realistic', type=lambda text: text.split(','),
                        help="white, realistic and names of worlds.wanders, joined by commas; '@navigation' behind for another grade than industrial")
    parser.add_argument('--processes', type=int, default=2)
    parser.add_argument('--minutes', type=float, help='start nothing new after this time')
    parser.add_argument('--fast', action='store_true', help='one seed, white noise')
    parser.add_argument('--record', type=Path, default=Path('out/hide_and_seek.jsonl'), help='one line per session')
    parser.add_argument('--docs', type=Path, help='where pictures and figures go; default docs/ for a run in full, else beside the record')
    parser.add_argument('--from-record', action='store_true', help='only print and draw what the record holds')
    parser.add_argument('--keep', action='store_true', help='take the rows into the record of the repository')
    options = parser.parse_args(arguments)
    part_of_it = options.fast or options.effects or options.minutes or set(options.parts) != set(PARTS)
    docs = options.docs or (options.record.parent if part_of_it else Path(__file__).resolve().parents[2] / 'docs')
    if options.fast:
        options.seeds, options.noise = 1, ['white']
    rows = []
    if options.from_record:
        rows = record_kept.read(options.record)
    else:
        rows = _work(tasks_of(options), options)
    report(rows, docs)
    write_figures(rows, docs)
    kept = record_kept.read()
    changed = record_kept.differences(rows, kept)
    print(f'\nbeside the record in the repository ({len(kept)} sessions), of {len(rows)} sessions another thing is told of {len(changed)}', *changed, sep='\n  ')
    if options.keep:
        record_kept.keep(rows)
    return 0


def _work(tasks, options):
    options.record.parent.mkdir(parents=True, exist_ok=True)
    rows, start, done = [], time.time(), 0
    with options.record.open('w') as record_file, ProcessPoolExecutor(options.processes) as pool:
        waiting, running = list(tasks), set()
        while waiting or running:
            in_time = options.minutes is None or time.time() - start < 60 * options.minutes
            while waiting and in_time and len(running) < options.processes:
                running.add(pool.submit(run, waiting.pop(0)))
            if not running:
                break
            ready, running = wait(running, return_when=FIRST_COMPLETED)
            for future in ready:
                new, done = future.result(), done + 1
                rows += new
                record_file.writelines(json.dumps(row) + '\n' for row in new)
            record_file.flush()
            minutes = (time.time() - start) / 60
            print(f'\r{done}/{len(tasks)} tasks, {len(rows)} sessions, {minutes:.1f} min', end='', file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return rows


if __name__ == '__main__':
    sys.exit(main())
