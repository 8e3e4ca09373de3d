"""What is hidden in which sessions: the tasks of hide and seek, each some rows of its record."""

import time
from itertools import combinations

import numpy as np

from imu_calibration.api.diagnose import diagnose as diagnose_block
from imu_calibration.effects.base import Role
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable.diagnosis_of_windows import build_diagnosis
from imu_calibration.references.turntable.selection.investigation import investigate
from imu_calibration.references.turntable.selection.window_gain import heldout_gain

from worlds import physics
from worlds.beyond_catalogue import NOTHING, hidden_row, row_of
from worlds.diagnosing import diagnose
from worlds.hiding import NOT_SIZED, all_effects, options_of, record, sizes_for
from worlds.physics_beyond import KINDS
from worlds.physics_draw import OUTSIDE, generator
from worlds.wanders import WANDERS

PARTS = (
    'effects',
    'none',
    'outside',
    'pairs',
    'sizes',
    'traps',
    'separating',
    'power',
    'beyond',
    'components',
)
GRADES = ('consumer', 'industrial', 'tactical', 'navigation')
REALISTIC = ('realistic', *WANDERS)
"""Kinds of realistic noise, dealt to effects and sessions in turn."""
DEG = np.pi / 180
TRAPS = {
    'joints_at_50_Hz': {'imu_rate': 400.0, 'joint_rate': 50.0},
    'encoder_0.01_deg': {'encoder_resolution': 0.01 * DEG},
    'two_seconds_lost': {'dropped': 'both'},
    'knock_on_table': {'knock': True},
    'wrong_covariance': {'wrong_covariance': True},
    'wander': {'noise': 'realistic'},
    'mounted_at_45_deg': {'mount_rpy_deg': (45.0, 0.0, 0.0)},
    'two_axis_table': {'table': 'two_axis'},
    'only_at_rest': {'profile': 'static_only'},
}
"""What must not produce a finding."""
SEPARATED = (
    'accel_quadratic',
    'accel_scale_asymmetry',
    'accel_cubic',
    'accel_size_effect',
    'lever_arm',
    'gyro_quadratic',
    'gyro_scale_asymmetry',
    'accel_bandwidth',
    'gyro_bandwidth',
    'time_offset',
    'accel_thermal_bias',
    'accel_bias_drift',
)
"""Effects with near relatives, sought again in sessions made to separate them."""
POWER = ('accel_quadratic', 'gyro_g_sensitivity', 'time_offset', 'gyro_thermal_bias', 'table_tilt')
POWER_SIZES = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0)
SIZES = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
"""Times the smallest detectable size, with sizes that are known of no instrument."""
BUNDLE = 13
"""Effects that one task hides: each task needs a session that hides nothing, for the sizes."""
PAIR_SESSIONS, BEYOND_ROUNDS = 40, 10
"""
Sessions to which all pairs are dealt, and times that each kind of cause beyond the catalogue is
hidden.
"""
COMPONENT_SESSIONS = 12
"""Sessions to which all single components are dealt."""
MOST_TOLERANCES = 1e6
"""
Size of a component, in tolerances, from which the session does not depend on it: a displacement
along its own axis, for example.
"""
FINE = ('tactical', 'navigation')
"""Grades at which the Earth's rate, whose size nobody chooses, is well above detectability."""


def seek(recording, hidden, **labels):
    """Diagnose a recording and return one row of the record."""
    start = time.process_time()
    return _row(
        diagnose(recording.windows, recording.table, recording.model),
        recording.truth,
        hidden,
        time.process_time() - start,
        labels,
    )


def _row(diagnosis, truth, hidden, seconds, labels):
    findings, rests = diagnosis.findings, diagnosis.unexplained.values()
    row = {
        **labels,
        'hidden': sorted(hidden or ()),
        'seconds': seconds,
        'found': [f.effect for f in findings],
        'implausible': [f.implausible for f in findings],
        'classes': [list(f.indistinguishable_from) for f in findings],
        'unexplained': any(rest.significant for rest in rests),
        'formulas': [column for rest in rests if rest.proposal for column in rest.proposal.columns],
        'errors_in_sd': {},
    }
    for finding in findings:
        if finding.effect in truth and finding.effect in (hidden or ()):
            true = by_convention(finding.effect, np.ravel(truth[finding.effect]))
            if finding.effect.endswith('_saturation'):
                value = next(iter(finding.parameters.values()))[0]
                row['level_error'] = float(abs(value / true[0] - 1))
                continue
            row['errors_in_sd'][finding.effect] = [
                float((value - t) / sd)
                for (value, sd, _), t in zip(finding.parameters.values(), true)
            ]
    return row


def by_convention(name, values):
    """Return parameters of an effect; each group whose sum is undetermined gets the mean zero."""
    effect, values = _effect(name), np.array(values, float)
    groups = effect.zero_sums
    if effect.role is Role.ARMS:
        # The mean of the three sensitive points is the common lever arm.
        groups = ((0, 3, 6), (1, 4, 7), (2, 5, 8))
    for group in groups:
        values[list(group)] -= values[list(group)].mean()
    return values


def _effect(name):
    """Return the effect of a name on the table of the sessions."""
    return next(effect for effect in CATALOGUE.effects().values() if effect.name == name)


def _each(cases, row, what):
    """Return the row of each case; one that fails is a row of its own and costs no other."""
    rows = []
    for case in cases:
        try:
            rows.append(row(case))
        except Exception as problem:  # noqa: B902 - one broken session must not lose an hour of others
            rows.append(failed(f'{what} {case}', problem))
    return rows


def failed(what, problem):
    """Return the row of what could not be run."""
    return {'part': 'failed', 'what': what, 'why': repr(problem)}


def oracle(recording, effect):
    """
    Return the held-out rms of what was found over that of a searcher who was told the effect.

    Or None where nothing compares.
    """
    found = investigate(recording.windows, recording.table, recording.model)
    asked = [q for q in found.problem.questions if q.name == effect]
    if not asked or found.limits:
        return None
    search = found.problem.search
    best = min(asked, key=lambda q: search.evidence.loss(search.indices([q])))
    sensors = best.effect.sensors
    pair = [
        heldout_gain(found.problem, [], choice, sensors=sensors) for choice in (found.named, [best])
    ]
    alike = (pair[0].measure, pair[0].sensor) == (pair[1].measure, pair[1].sensor)
    return pair[0].heldout_rms_after / pair[1].heldout_rms_after if alike else None


def effects_of_seed(seed, noise, effects, profile='random', table='three_axis', part='effects'):
    """
    Hide nothing, which gives the sizes, and then each effect.

    Each effect is at five times the smallest detectable size in the same session.
    """
    options = {'profile': profile, 'table': table}

    def row(effect):
        hidden = {effect: sizes_for(seed, noise, [effect], options).hidden(effect, seed, 5.0)}
        recording = record(seed, hidden, noise, **options | options_of(effect))
        found = seek(recording, hidden, part=part, seed=seed, noise=noise)
        return found | (
            {'oracle_ratio': oracle(recording, effect)}
            if part == 'effects' and seed % 10 == 0
            else {}
        )

    return [
        *(
            nothing_of(sizes_for(seed, noise, [], options), seed, noise)
            if part == 'effects'
            else []
        ),
        *_each(effects, row, f'{part} {seed} {noise}'),
    ]


def nothing_of(sizes, seed, noise):
    """Return the row of the session that gave the sizes."""
    empty, start = sizes.recording, time.process_time()
    diagnosis = build_diagnosis(sizes.found)
    return [
        _row(
            diagnosis,
            empty.truth,
            None,
            sizes.seconds + time.process_time() - start,
            {'part': 'none', 'seed': seed, 'noise': noise},
        )
    ]


def separating_of_seed(seed, noise, effects):
    """
    Hide each effect in a session made to separate relatives.

    Many angles, three speeds both ways, on an arm.
    """
    return effects_of_seed(
        seed, noise, effects, profile='separating', table='centrifuge', part='separating'
    )


def none_of_seed(seed, noise):
    """Hide nothing."""
    return [seek(record(seed, None, noise), None, part='none', seed=seed, noise=noise)]


def outside_of_seed(seed, noise, names):
    """Hide causes that no catalogue holds."""
    return _each(
        names,
        lambda name: seek(
            record(seed, {name: None}, noise), {name: None}, part='outside', seed=seed, noise=noise
        ),
        f'outside {seed}',
    )


def pairs_of_seed(seed, noise, pairs):
    """Hide two effects at once, each pair in one session."""

    def row(pair):
        sizes = sizes_for(seed, noise, pair, {})
        hidden = {name: sizes.hidden(name, seed, 5.0) for name in pair}
        return seek(
            record(seed, hidden, noise, through_bag=False, **options_of(*pair)),
            hidden,
            part='pairs',
            seed=seed,
            noise=noise,
            beside=sizes.beside(hidden),
        )

    return _each(pairs, row, f'pairs {seed}')


def components_of(effects):
    """Return (effect, component) of all effects with several amplitudes of a free size."""
    cases = []
    for name in effects:
        count = _effect(name).n_amplitudes
        if name not in NOT_SIZED and count > 1:
            cases += [(name, component) for component in range(count)]
    return cases


def components_of_seed(seed, noise, cases):
    """
    Hide one component of an effect at a time, and diagnose as the command does.

    An effect with collinear components may be found only where all are drawn at once, or be
    withdrawn by the calibration that follows the search.
    """

    def row(case):
        effect, component = case
        sizes = sizes_for(seed, noise, [effect], {})
        hidden = {effect: sizes.hidden(effect, seed, 5.0, component)}
        labels = {'component': component, 'seed': seed, 'noise': noise}
        if np.max(np.abs(hidden[effect])) > MOST_TOLERANCES * _effect(effect).tolerance:
            return {'part': 'not determined', 'hidden': [effect], **labels}
        start, kind = time.process_time(), noise.partition('@')
        session = physics.make_session(
            seed,
            hidden,
            kind[0],
            **({'grade': kind[2]} if kind[2] else {}) | options_of(effect),
        )
        found = diagnose_block(session.block, Table.from_mapping(session.table)).result.diagnosis
        return _row(
            found,
            session.truth['values'],
            hidden,
            time.process_time() - start,
            {'part': 'components', **labels},
        )

    return _each(cases, row, f'components {seed} {noise}')


def all_pairs(effects):
    """Return all pairs of the effects whose size can be chosen."""
    return list(combinations([name for name in effects if name not in NOT_SIZED], 2))


def traps_of_seed(seed, names):
    """Set traps that must not produce a finding."""

    def row(name):
        options = {'noise': 'white', **TRAPS[name]}
        return seek(
            record(seed, None, **options),
            None,
            part='traps',
            trap=name,
            seed=seed,
            noise=options['noise'],
        )

    return _each(names, row, f'traps {seed}')


def sizes_of_seed(seed, noise, effects, factors, part='sizes'):
    """
    Hide effects at several times the smallest detectable size; those of part 'power' are around it.
    """

    def row(case):
        effect, factor = case
        hidden = {effect: sizes_for(seed, noise, [effect], {}).hidden(effect, seed, factor)}
        return seek(
            record(seed, hidden, noise, through_bag=False, **options_of(effect)),
            hidden,
            part=part,
            factor=factor,
            seed=seed,
            noise=noise,
        )

    return _each(
        [(effect, factor) for effect in sorted(set(effects) - NOT_SIZED) for factor in factors],
        row,
        f'{part} {seed}',
    )


def tasks_of(options):
    """
    Return (function, arguments) of everything that is to run.

    Parts take turns, so that a run cut short has some of each.

    Each round of the part `effects` hides every effect once in white noise and once in a kind of
    realistic noise that is dealt to it, at each grade; each task has a session of its own.
    """
    names = tuple(options.effects.split(',')) if options.effects else all_effects()
    rounds, first = range(options.seeds), options.first_seed
    rng = generator(first, 'order of hide and seek')

    def shuffled(things):
        return [things[k] for k in rng.permutation(len(things))]

    singles = [
        single
        for k in rounds
        for grade in options.grades
        for single in _singles(
            [name for name in names if name not in NOT_SIZED or grade in FINE],
            k,
            grade,
            options.noise,
        )
    ]
    pairs = shuffled(all_pairs(names))[: options.pairs]
    some = {
        'effects': [
            (effects_of_seed, (first + k, *single)) for k, single in enumerate(shuffled(singles))
        ],
        'none': [
            (none_of_seed, (first + 1000 + k, noise))
            for k, noise in enumerate(
                shuffled(
                    [
                        f'{noise}@{grade}'
                        for _ in rounds
                        for grade in options.grades
                        for noise in options.noise or ('white', *REALISTIC)
                    ]
                )
            )
        ],
        'pairs': [
            (pairs_of_seed, (first + 2000 + k, 'realistic', hand))
            for k, hand in enumerate(_dealt(pairs, PAIR_SESSIONS))
        ],
        'sizes': [
            (sizes_of_seed, (first + 3000 + k, 'realistic', hand, SIZES))
            for k, hand in enumerate(hand for _ in rounds for hand in _dealt(shuffled(names), 8))
        ],
        'beyond': [
            (beyond_of_seed, (first + 4000 + k, 'realistic', hand))
            for k, hand in enumerate(
                hand
                for _ in range(BEYOND_ROUNDS * options.seeds)
                for hand in _dealt(shuffled(tuple(KINDS)), 3)
            )
        ],
        'outside': [
            (outside_of_seed, (first + 5000 + k, 'realistic', tuple(OUTSIDE))) for k in rounds
        ],
        'traps': [(traps_of_seed, (first + 5000 + k, tuple(TRAPS))) for k in rounds],
        'separating': [
            (separating_of_seed, (first + 5000 + k, 'white', SEPARATED)) for k in rounds
        ],
        'components': [
            (components_of_seed, (first + 7000 + k, noise, hand))
            for k, noise, hand in _component_hands(names, rounds, shuffled)
        ],
        'power': [
            (sizes_of_seed, (first + 6000 + k, 'white', POWER, POWER_SIZES, 'power'))
            for k in range(3 * options.seeds)
        ],
    }
    placed = [
        ((k + 0.5) / len(some[part]), task)
        for part in PARTS
        if part in options.parts
        for k, task in enumerate(some[part])
    ]
    return [task for _, task in sorted(placed, key=lambda pair: pair[0])]


def _component_hands(names, rounds, shuffled):
    """
    Return (number, noise, cases) of the single components: all in white noise, then realistic.

    Each task has a session of its own, because each needs one that hides nothing.
    """
    tasks = []
    for _ in rounds:
        for noise in ('white', 'realistic'):
            for hand in _dealt(shuffled(components_of(names)), COMPONENT_SESSIONS):
                tasks.append((len(tasks), noise, hand))
    return tasks


def beyond_of_seed(seed, noise, kinds):
    """Hide nothing, then a cause of each kind."""
    empty, known = row_of(seed, NOTHING, noise)
    return [
        empty,
        *_each(kinds, lambda kind: hidden_row(seed, kind, noise, known=known), f'beyond {seed}'),
    ]


def _singles(names, number, grade, asked):
    """
    Return (noise, effects) of a round at a grade.

    All in white noise and dealt to the kinds of realistic noise, or all in each that is asked for.
    """
    every = [
        (f'{noise}@{grade}', hand)
        for noise in asked or ('white',)
        for hand in _dealt(names, -(-len(names) // BUNDLE))
    ]
    turn = number + 3 * GRADES.index(grade)
    dealt = [
        tuple(names[(k + turn) % len(REALISTIC) :: len(REALISTIC)]) for k in range(len(REALISTIC))
    ]
    return every + (
        []
        if asked
        else [(f'{noise}@{grade}', hand) for noise, hand in zip(REALISTIC, dealt) if hand]
    )


def _dealt(things, hands):
    """Return things dealt out to hands in turn."""
    return [tuple(things[k::hands]) for k in range(min(hands, len(things)))]


def run(task):
    """Run one task; a failure is a row of its own."""
    function, arguments = task
    try:
        return function(*arguments)
    except Exception as problem:  # noqa: B902 - one broken session must not lose an hour of others
        return [failed(f'{function.__name__}{arguments[:2]}', problem)]
