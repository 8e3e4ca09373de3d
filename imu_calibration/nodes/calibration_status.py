"""Diagnostics of calibration_node: a status for the streams, the calibration, the poses or the diagnosis, and each parameter group."""

import math

from imu_calibration.calibration.coverage import GroupState
from imu_calibration.nodes.calibration_state import WorkerState
from imu_calibration.nodes.diagnostics import ERROR, OK, WARN, make_status

_STREAM_LEVELS = {'good': OK, 'trouble': WARN, 'silent': ERROR}
_GROUP_LEVELS = {'determined': OK, 'weak': WARN, 'held': WARN, 'waiting': OK}
_HAND_LEVELS = {'waiting': OK, 'weak': WARN, 'determined': OK}
_DIAGNOSIS_LEVELS = {'nothing found': OK, 'off': OK, 'waiting': OK, 'found': WARN, 'unexplained': WARN, 'failed': ERROR}
_DECISION_LEVELS = {'': OK, 'helps': OK, 'unproven': WARN, 'harms': ERROR}


def statuses_of(state: WorkerState, stream_faults: list[str] = []) -> list:
    """Return the DiagnosticStatus messages of a WorkerState; `stream_faults` are lines about its topics."""
    found = []
    if state.streams is not None:
        level = max(_STREAM_LEVELS[state.streams.word], WARN if stream_faults else OK)
        found.append(make_status(level, 'streams', '; '.join([state.streams.message, *stream_faults]), values=state.streams.values))
    parts = [state.judged or state.verdict or 'waiting for motion', *state.lines[:3], *[state.trouble] * bool(state.trouble), *state.faults]
    incomplete = WARN if state.verdict and (state.trouble or not state.complete) else OK
    level = ERROR if state.faults else max(_DECISION_LEVELS[state.verdict], incomplete)
    found.append(make_status(level, 'calibration', '; '.join(dict.fromkeys(parts)), values={'version': state.solution, **state.values}))
    if state.session is not None:
        found.append(make_status(_HAND_LEVELS[state.session.word], 'poses', state.session.message, values=state.session.values))
    if state.diagnosis is not None:
        found.append(make_status(_DIAGNOSIS_LEVELS[state.diagnosis.word], 'diagnosis', state.diagnosis.message,
                                 values={'outcome': state.diagnosis.word, **state.diagnosis.values}))
    return found + [_group_status(group) for group in state.groups]


def _group_status(group: GroupState):
    text = {'determined': 'determined', 'weak': 'weak', 'held': 'held at its prior: the motion so far contains almost no information',
            'waiting': 'no solution yet'}[group.status]
    if group.needs:
        text += f'; still needed: {group.needs}'
    figures = {f'standard error [{group.unit}]': group.sd, f'tolerance [{group.unit}]': group.tolerance,
               f'predicted after that motion [{group.unit}]': group.predicted_sd}
    values = {'parameter': group.parameter, 'needs': group.needs,
              **{name: f'{figure:.3g}' for name, figure in figures.items() if not math.isnan(figure)}}
    return make_status(_GROUP_LEVELS[group.status], f'{group.sensor} {group.effect}', text, values=values)
