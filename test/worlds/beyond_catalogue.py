"""
Worlds whose cause no catalogue holds.

Is the rest flagged, on the right axis, at the right place, with a formula of the right family?
"""

import time
from dataclasses import replace

import numpy as np

from imu_calibration.calibration.from_solution import ModelExtension
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.references.turntable.selection.extended_solution import extended_solution
from imu_calibration.references.turntable.selection.linearised_problem import SearchedWindows
from imu_calibration.selection.unexplained import biases_off

from worlds.diagnosing import diagnose
from worlds.hiding import record
from worlds.physics_beyond import Beyond

NOTHING = 'nothing'
MEASURES = ('flagged', 'axis', 'family', 'lowered', 'place', 'no name')
"""What is drawn of each kind."""


def hidden_row(seed, kind, noise, *, known, size=1.0):
    """
    Return the row of the session of a seed with a cause of a kind.

    `known` are bias and matrix without it.
    """
    row, values = row_of(seed, kind, noise, Beyond(kind, seed, size))
    moved = [(values[name][0] - value) / values[name][1] for name, (value, _) in known.items()]
    return row | {'known_bias': float(np.sqrt(np.mean(np.square(moved))))}


def row_of(seed, kind, noise, cause=None, *, candidates=None, **options):
    """
    Return (row, bias and matrix of both sensors as estimated).

    `candidates` as for `api.diagnose.diagnose`, `options` as for `physics.make_session`.
    """
    recording = record(seed, None, noise, through_bag=False, cause=cause, **options)
    start = time.process_time()
    found = diagnose(recording.windows, recording.table, recording.model, candidates=candidates)
    row = {
        'part': 'beyond',
        'kind': kind,
        'seed': seed,
        'noise': noise,
        'seconds': time.process_time() - start,
        'found': [finding.effect for finding in found.findings],
        'formulas': [
            column
            for rest in found.unexplained.values()
            if rest.proposal
            for column in rest.proposal.columns
        ],
    }
    return row if cause is None else row | judged(found, cause), _known(found, recording)


def _known(found, recording):
    """
    Return {parameter: (value, sd)} beside what was found.

    With the formulas that were proposed in the model, as a user gets them.
    """
    effects = [
        effect
        for rest in found.unexplained.values()
        if rest.proposal
        for effect in rest.proposal.effects
    ]
    model = replace(found.model, catalogue=found.model.catalogue.with_effects(*effects))
    for effect in effects:
        model = model.with_effect(effect.sensor, effect.name)
    windows = [window for window in recording.windows if window.kind != 'unused']
    unlocked = np.zeros(len(windows), bool)
    problem = SearchedWindows(windows, recording.table, model, [], unlocked).linearised()
    solution = extended_solution(problem, chosen=[])
    unsure = ModelExtension(
        moves=tuple((moved, 1.0) for moved in biases_off(model, found.unexplained))
    )
    sd = np.sqrt(np.diag(unsure.applied(solution).covariance))
    places = {name: solution.model.param_names.index(name) for name in SensorModel().param_names}
    return {name: (float(solution.values[k]), float(sd[k])) for name, k in places.items()}


def judged(found, cause):
    """Return whether what is told of the rest is right about the cause, as a row."""
    kind, rest = cause.kind, found.unexplained[cause.kind.sensor]
    proposal, told = rest.proposal, set(rest.axes)
    # A change at one moment is the place in time after it, and in temperature where one is passed.
    onset = found.onset
    if onset is not None and kind.sensor in onset.what:
        told = set(onset.axes)
    else:
        onset = None
    row = {
        'flagged': bool(rest.significant) or onset is not None,
        'axis': told == cause.axes if len(cause.axes) == 1 else bool(told) and told <= cause.axes,
        'told_axes': sorted(told),
        'axes': sorted(cause.axes),
    }
    if kind.family is not None:
        row |= {
            'family': proposal is not None and proposal.family == kind.family,
            'reduction': 0.0 if proposal is None else float(proposal.reduction),
        }
    if kind.place:
        regimes = [
            regime for regime in rest.regimes if regime.variable.startswith(kind.place)
        ] or list(rest.regimes)
        places = [_f1(regime.time, regime.inside, cause, regime.offset) for regime in regimes[:1]]
        if onset is not None and (kind.place == 'time' or onset.temperature_c is not None):
            places = [_f1(cause.time, cause.time > onset.time, cause, True)]
        row |= {
            'f1': max(places, default=0.0),
            'where': [regime.text for regime in rest.regimes],
        }
    return row


def _f1(time, inside, cause, offset):
    strength = np.abs(cause.signal).max(axis=1)
    true = np.interp(time, cause.time, strength) > 0.2 * strength.max()
    # An offset here is an offset of the other sign everywhere else: the bias is free.
    return max(
        float(2 * (true & told).sum() / max(true.sum() + told.sum(), 1))
        for told in [inside, ~inside][: 1 + offset]
    )


def figures(rows):
    """Return [(what, what is required, what was measured)]."""
    hidden, empty = (
        [row for row in rows if (row['kind'] == NOTHING) == nothing] for nothing in (False, True)
    )
    formula, place = ([row for row in hidden if key in row] for key in ('family', 'f1'))
    seconds = [row['seconds'] for row in rows]
    bias = [row['known_bias'] for row in hidden]

    def count(entries):
        entries = list(map(bool, entries))
        return f'{sum(entries)} of {len(entries)}'

    return [
        ('the rest is flagged', '95 %', count(row['flagged'] for row in hidden)),
        ('right axis', '95 %', count(row['axis'] for row in hidden)),
        ('right family of regressor', '80 %', count(row['family'] for row in formula)),
        (
            'F1 of the place, mean',
            '0.85',
            f'{np.mean([row["f1"] for row in place]) if place else np.nan:.2f} of {len(place)}',
        ),
        (
            'a formula that lowers the held-out rest by 60 %',
            '60 %',
            count(row['reduction'] >= 0.6 for row in formula),
        ),
        ('a false name', 'at most 2 %', count(row['found'] for row in hidden)),
        ('nothing hidden: a formula', 'at most 2 %', count(row['formulas'] for row in empty)),
        ('nothing hidden: a name', 'at most 2 %', count(row['found'] for row in empty)),
        (
            'what the cause moves biases and matrices by, rms',
            '0.5 sd',
            (
                f'{np.sqrt(np.mean(np.square(bias))) if bias else np.nan:.3f} sd; median world '
                f'{np.median(bias) if bias else np.nan:.2f} sd'
            ),
        ),
        (
            'processor time, median and 95 %',
            '5 s, 10 s',
            f'{np.median(seconds):.1f} s, {np.quantile(seconds, 0.95):.1f} s',
        ),
    ]


def missed(rows):
    """Yield a line for each world that was not told as it is."""
    for row in rows:
        wrong = [
            what
            for what, bad in (
                ('not flagged', not row.get('flagged', True)),
                ('axis', not row.get('axis', True)),
                ('family', not row.get('family', True)),
                (f'place {row.get("f1", 1):.2f}', row.get('f1', 1) < 0.85),
                (f'named {row["found"]}', row['found']),
            )
            if bad
        ]
        if wrong or (row['kind'] == NOTHING and row['formulas']):
            yield (
                f'  {row["kind"]} seed {row["seed"]}: {", ".join(wrong)} {row["formulas"]}'
                f' {row.get("where", "")}'
            )


def draw(rows, path):
    """Draw, for each kind, in what share of the worlds each thing was told rightly."""
    from matplotlib.figure import Figure

    kinds = sorted({row['kind'] for row in rows} - {NOTHING})
    shares = np.full((len(kinds), len(MEASURES)), np.nan)
    for place, kind in enumerate(kinds):
        some = [row for row in rows if row['kind'] == kind]
        told = {
            'flagged': [row['flagged'] for row in some],
            'axis': [row['axis'] for row in some],
            'family': [row['family'] for row in some if 'family' in row],
            'lowered': [row['reduction'] >= 0.6 for row in some if 'reduction' in row],
            'place': [row['f1'] for row in some if 'f1' in row],
            'no name': [not row['found'] for row in some],
        }
        shares[place] = [
            np.mean(told[measure]) if told[measure] else np.nan for measure in MEASURES
        ]
    figure = Figure(figsize=(7, 0.32 * len(kinds) + 1.5), layout='constrained')
    axes = figure.add_subplot()
    axes.imshow(shares, cmap='RdYlGn', vmin=0, vmax=1, aspect='auto')
    for (i, j), share in np.ndenumerate(shares):
        if np.isfinite(share):
            axes.text(j, i, f'{100 * share:.0f}', ha='center', va='center', fontsize=8)
    axes.set_xticks(range(len(MEASURES)), MEASURES)
    axes.set_yticks(range(len(kinds)), [kind.replace('_', ' ') for kind in kinds], fontsize=8)
    axes.set_title(
        f'Causes outside the catalogue, {len(rows)} worlds: told rightly, % (place: F1)',
        fontsize=10,
    )
    figure.savefig(path, dpi=110)
