"""State of a calibration node, its diagnostics, the next step for the user, markers of the coverage."""

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from imu_calibration.calibration.coverage import (
    ARROW,
    DONE_COLOUR,
    RADIUS,
    SEEN_DIAMETER,
    TEXT_COLOUR,
    VISITED,
    Coverage,
    GroupState,
    arrows_of,
    cells_of,
    line_of,
)
from imu_calibration.calibration.diagnosis import live_diagnosis as diagnosis
from imu_calibration.core.progress import LiveState
from imu_calibration.document.decision import HARMS
from imu_calibration.nodes.complaints import LOG_INFO, LOG_WARN
from imu_calibration.nodes.diagnostics import ERROR, OK, WARN, make_status
from imu_calibration.nodes.inputs import MatchedInput
from imu_calibration.preprocessing.stamping import COUNTED, REGULAR
from imu_calibration.preprocessing.stream_watch import StreamState


@dataclass(frozen=True)
class WorkerState:
    """State shown in diagnostics; replaced as one object, so that another thread may read it."""

    groups: list = field(default_factory=list)
    """GroupState of every effect."""
    streams: StreamState | None = None
    """How the streams are."""
    solution: int = 0
    """Number of the last solution; 0 before the first."""
    verdict: str = ''
    """The more cautious decision; '' before the first solution."""
    lines: tuple = ()
    """Reasons and next steps."""
    trouble: str = ''
    """Why there is no new solution."""
    faults: tuple = ()
    """Present faults, a line each."""
    gathered: int = 0
    """Windows, or poses by hand."""
    values: dict = field(default_factory=dict)
    """Figures by name."""
    session: LiveState | None = None
    """Progress in addition to the parameter groups: the poses of a calibration by hand."""
    diagnosis: LiveState | None = None
    """Detected model errors; None without a table."""
    judged: str = ''
    """The decisions in one phrase."""
    complete: bool = False
    """Whether each sensor helps and every requested parameter is determined."""


MIN_ADVICE_SECONDS = 5.0
"""Seconds between two pieces of advice; the most useful motion may change with every solution."""
MESSAGE_TYPES = {'imu': 'Imu', 'joints': 'JointState', 'temperature': 'Temperature'}


class CalibrationGuide:
    """
    Derives the lines to report from the state of the worker.

    Parameters
    ----------
    inputs : mapping
        Stream ('imu', 'joints', 'temperature') -> MatchedInput.
    save_command : str
        Command that saves the calibration, readable.
    noun : str
        Unit of the collected data: 'window' or 'pose'.
    clock : callable
        Seconds of a steady clock.

    """

    def __init__(self, inputs: Mapping[str, MatchedInput], save_command: str, noun: str, *, clock: Callable[[], float] = time.monotonic):
        self._inputs, self._save_command, self._noun, self._clock = inputs, save_command, noun, clock
        self._coming: set[str] = set()
        self._stamping = ''
        self._gathered, self._verdict, self._advice, self._advised, self._diagnosed = 0, '', '', float('-inf'), ''

    def lines(self, state: WorkerState) -> Iterator[tuple[str, str]]:
        """Yield (INFO or WARNING, line) for each change since the last call."""
        yield from self._streams(state)
        if state.gathered and not self._gathered:
            yield LOG_INFO, f'first {self._noun} gathered'
        self._gathered = state.gathered
        yield from self._verdicts(state)
        yield from self._next(state)
        yield from self._diagnosis(state)

    def _streams(self, state: WorkerState) -> Iterator[tuple[str, str]]:
        coming = set() if state.streams is None else {name for name in state.streams.coming if name in self._inputs}
        for name in sorted(coming - self._coming):
            yield LOG_INFO, f'{MESSAGE_TYPES[name]} messages are received on {self._inputs[name].source()}'
        self._coming = coming
        line = None if state.streams is None else state.streams.stamping
        if line is not None and line.word != self._stamping:
            if line.word == COUNTED or (line.word == REGULAR and self._stamping):
                yield LOG_INFO, f'Imu: {line}'
            self._stamping = line.word

    def _verdicts(self, state: WorkerState) -> Iterator[tuple[str, str]]:
        known = f'{state.judged}, every parameter is determined' if state.complete else state.judged
        if known == self._verdict:
            return
        self._verdict = known
        if state.complete:
            yield LOG_INFO, f'{known}; save it with `{self._save_command}`'
        elif known:
            yield LOG_WARN if state.verdict == HARMS else LOG_INFO, '; '.join([known, *state.lines[:2]])

    def _next(self, state: WorkerState) -> Iterator[tuple[str, str]]:
        advice = advice_of(state)
        if advice and advice != self._advice and not state.complete and self._clock() - self._advised >= MIN_ADVICE_SECONDS:
            self._advice, self._advised = advice, self._clock()
            yield LOG_INFO, f'next: {advice}'

    def _diagnosis(self, state: WorkerState) -> Iterator[tuple[str, str]]:
        found = state.diagnosis
        if found is None or found.word in (diagnosis.WAITING, diagnosis.OFF):
            return
        what = f'{found.word}:{found.values.get("effect", "")}'
        if what != self._diagnosed:
            self._diagnosed = what
            yield LOG_WARN if found.word == diagnosis.FAILED else LOG_INFO, f'diagnosis: {found.message}'


def advice_of(state: WorkerState) -> str:
    """Return the most useful next motion or action, '' when unknown."""
    if state.session is not None:
        return state.session.values.get('next', '')
    steps = [line.removeprefix('next: ') for line in state.lines if line.startswith('next: ')]
    return next(iter([*steps, *(group.needs for group in state.groups if group.needs)]), '')


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


def markers_of(coverage: Coverage, stamp: Time) -> MarkerArray:
    """
    Return the picture, in the frame of the sensor; each message replaces the one before.

    Cells: orange and large where another rest is informative, green and small elsewhere. An arrow from the present up direction to the
    next one, a ring of the turn between them; blue points: earlier up directions; the arms of the three sensitive points; one line of text.
    """
    frame = coverage.frame_id or 'imu_link'
    arrows = [_arrow(*each, number=k) for k, each in enumerate(arrows_of(coverage))]
    made = [_marker('all', 0, Marker.SPHERE), *_cells(coverage), *_seen(coverage), *arrows, *_turn(coverage), _text(coverage)]
    made[0].action = Marker.DELETEALL
    for marker in made:
        marker.header.frame_id, marker.header.stamp = frame, stamp
    return MarkerArray(markers=made)


def driven_markers(up: np.ndarray, text: str, *, frame_id: str, stamp: Time) -> MarkerArray:
    """Return the planner's markers: an arrow to the up direction after the driven motion, and a description of that motion."""
    made = [_arrow('driven', np.zeros(3), 1.25 * RADIUS * up, ARROW), _marker('driven', 1, Marker.TEXT_VIEW_FACING, scale=(0.0, 0.0, 0.08))]
    made[1].text = text
    _at(made[1], (0.0, 0.0, -1.5 * RADIUS))
    for marker in made:
        marker.header.frame_id, marker.header.stamp = frame_id or 'imu_link', stamp
    return MarkerArray(markers=made)


def _marker(name, number, kind, *, color=TEXT_COLOUR, alpha=1.0, scale=(1.0, 1.0, 1.0)):
    marker = Marker(ns=name, id=number, action=Marker.ADD, color=ColorRGBA(r=color[0], g=color[1], b=color[2], a=alpha))
    marker.type = kind
    marker.scale.x, marker.scale.y, marker.scale.z = map(float, scale)
    marker.pose.orientation.w = 1.0
    return marker


def _at(marker, place):
    marker.pose.position = _point(place)
    return marker


def _point(place):
    return Point(x=float(place[0]), y=float(place[1]), z=float(place[2]))


def _cells(coverage):
    for k, (place, color, size) in enumerate(cells_of(coverage)):
        yield _at(_marker('cells', k, Marker.SPHERE, color=color, alpha=0.9, scale=(size,) * 3), place)


def _seen(coverage):
    if len(coverage.seen):
        marker = _marker('seen', 0, Marker.SPHERE_LIST, color=VISITED, scale=(SEEN_DIAMETER,) * 3)
        marker.points = [_point(1.1 * RADIUS * up) for up in coverage.seen]
        yield marker


def _turn(coverage):
    step = coverage.next
    if step.axis is not None and coverage.up is not None and step.up is not None:
        ring = _marker('turn', 0, Marker.LINE_STRIP, color=ARROW, alpha=0.7, scale=(0.012, 0.0, 0.0))
        angles = np.linspace(0, step.angle, 24)
        across = np.cross(step.axis, coverage.up)
        ring.points = [_point(0.7 * RADIUS * (np.cos(a) * coverage.up - np.sin(a) * across)) for a in angles]
        yield ring


def _arrow(name, start, end, color, number=0):
    marker = _marker(name, number, Marker.ARROW, color=color, scale=(0.025, 0.05, 0.07))
    marker.points = [_point(start), _point(end)]
    return marker


def _text(coverage):
    marker = _marker('text', 0, Marker.TEXT_VIEW_FACING, color=DONE_COLOUR if coverage.done else TEXT_COLOUR, scale=(0.0, 0.0, 0.09))
    marker.text = line_of(coverage)
    return _at(marker, (0.0, 0.0, 1.6 * RADIUS))
