"""Diagnostics of calibration_node: a status for the streams, the calibration, the poses or the diagnosis, and each parameter group."""

from imu_calibration.nodes.diagnostics import ERROR, OK, STALE, WARN, make_status

_STREAM_LEVELS = {'good': OK, 'trouble': WARN, 'silent': STALE}
_GROUP_LEVELS = {'determined': OK, 'weak': WARN, 'held': STALE, 'waiting': STALE}
_HAND_LEVELS = {'waiting': STALE, 'weak': WARN, 'determined': OK}
_DIAGNOSIS_LEVELS = {'nothing found': OK, 'off': OK, 'waiting': STALE, 'found': WARN, 'unexplained': WARN, 'failed': ERROR}
_VERDICT_LEVELS = {'': STALE, 'good': OK, 'weak': WARN, 'bad': ERROR}


def statuses_of(state):
    """Return the DiagnosticStatus messages of a WorkerState."""
    found = []
    if state.streams is not None:
        found.append(make_status(_STREAM_LEVELS[state.streams.word], 'streams', state.streams.message, state.streams.values))
    message = '; '.join([state.verdict or 'waiting for motion', *state.lines[:3]])
    level = _VERDICT_LEVELS.get(state.verdict, WARN)
    if state.trouble:
        message, level = f'{message}; {state.trouble}', max(level, WARN) if state.verdict else STALE
    found.append(make_status(level, 'calibration', message, {'version': state.solution, **state.values}))
    if state.hand is not None:
        found.append(make_status(_HAND_LEVELS[state.hand.word], 'poses', state.hand.message, state.hand.values))
    if state.diagnosis is not None:
        found.append(make_status(_DIAGNOSIS_LEVELS[state.diagnosis.word], 'diagnosis', state.diagnosis.message,
                                 {'outcome': state.diagnosis.word, **state.diagnosis.values}))
    return found + [_group_status(group) for group in state.groups]


def _group_status(group):
    level = _GROUP_LEVELS[group.status]
    text = {'determined': 'determined', 'weak': 'weak', 'held': 'held at its prior: the motion so far says next to nothing',
            'waiting': 'no solution yet'}[group.status]
    if group.needs:
        text += f'; still needed: {group.needs}'
    values = {'parameter': group.parameter, f'standard error [{group.unit}]': f'{group.sd:.3g}',
              f'tolerance [{group.unit}]': f'{group.tolerance:.3g}',
              'needs': group.needs, f'predicted after that motion [{group.unit}]': f'{group.predicted_sd:.3g}'}
    return make_status(level, f'{group.sensor} {group.effect}', text, values)
