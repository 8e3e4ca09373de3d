"""
State of a calibration node, its diagnostics, the next step for the user, markers of the coverage.
"""

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from imu_calibration.calibration.coverage import (
    ARROW,
    RADIUS,
    TEXT_COLOUR,
    Coverage,
    GroupState,
    arrows_of,
    label_of,
    seen_of,
    sphere_cells,
)
from imu_calibration.core.progress import LiveState
from imu_calibration.document.decision import HARMS
from imu_calibration.nodes.diagnostics import (
    ERROR,
    LOG_INFO,
    LOG_WARN,
    OK,
    REMINDER,
    WARN,
    make_status,
)
from imu_calibration.nodes.inputs import MatchedInput
from imu_calibration.preprocessing.stamping import COUNTED, REGULAR
from imu_calibration.preprocessing.stream_watch import StreamState
from imu_calibration.references.turntable import live_diagnosis as diagnosis


@dataclass(frozen=True)
class WorkerState:
    """State shown in diagnostics; replaced as one object, so that another thread may read it."""

    groups: list[GroupState] = field(default_factory=list)
    """State of the parameters of every effect."""
    streams: StreamState | None = None
    """Received, silent and faulty streams; None before the first block."""
    solution: int = 0
    """Number of the last solution; 0 before the first."""
    verdict: str = ''
    """The more cautious decision; '' before the first solution."""
    lines: tuple[str, ...] = ()
    """Reasons why the calibration is not complete, then all statements and next steps."""
    trouble: str = ''
    """Why the last attempt of a solution failed; '' otherwise."""
    faults: tuple[str, ...] = ()
    """Present faults, a line each."""
    gathered: int = 0
    """Number of windows, or of poses by hand."""
    values: dict[str, Any] = field(default_factory=dict)
    """Figures by name."""
    session: LiveState | None = None
    """Progress in addition to the parameter groups: the poses of a calibration by hand."""
    diagnosis: LiveState | None = None
    """Progress and findings of the diagnosis; None without a table."""
    judged: str = ''
    """The decisions in one phrase."""
    complete: bool = False
    """Whether nothing is missing (`outcome.shortcomings`)."""

    @property
    def is_gathering(self) -> bool:
        """Whether there is no solution yet, without a fault."""
        return not self.solution and not self.faults


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

    def __init__(
        self,
        inputs: Mapping[str, MatchedInput],
        save_command: str,
        noun: str,
        *,
        clock: Callable[[], float] = time.monotonic,
    ):
        self._inputs = inputs
        self._save_command = save_command
        self._noun = noun
        self._clock = clock
        self._received: set[str] = set()
        """Streams with messages at the last call of `lines`."""
        self._gathered = 0
        """Windows or poses at the last call."""
        # The last lines, and when they were returned, s of `clock`.
        self._logged_stamping = ''
        """Word of the stamps."""
        self._stamping_logged_at = float('-inf')
        self._logged_verdict = ''
        """Decisions, and whether every parameter is determined."""
        self._logged_advice = ''
        """Most useful next motion or action."""
        self._advised_at = float('-inf')
        self._logged_diagnosis = ''
        """Word and effect of the diagnosis."""

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
        """Yield lines on streams that begin, and on another kind of stamps of the IMU."""
        received = set()
        if state.streams is not None:
            received = {name for name in state.streams.coming if name in self._inputs}
        for name in sorted(received - self._received):
            yield (
                LOG_INFO,
                f'{MESSAGE_TYPES[name]} messages are received on {self._inputs[name].source()}',
            )
        self._received = received
        stamping = None if state.streams is None else state.streams.stamping
        if stamping is None or stamping.word == self._logged_stamping:
            return
        # Counted stamps are reported, and the return to regular ones.
        is_regular_again = stamping.word == REGULAR and self._logged_stamping
        if stamping.word == COUNTED or is_regular_again:
            if self._clock() - self._stamping_logged_at < REMINDER:
                return  # logged later if it lasts
            self._stamping_logged_at = self._clock()
            yield LOG_INFO, f'Imu: {stamping}'
        self._logged_stamping = stamping.word

    def _verdicts(self, state: WorkerState) -> Iterator[tuple[str, str]]:
        """Yield a line when the decisions on the sensors, or their completeness, have changed."""
        verdict = state.judged
        if state.complete:
            verdict += ', every parameter is determined'
        if verdict == self._logged_verdict:
            return
        self._logged_verdict = verdict
        if state.complete:
            yield LOG_INFO, f'{verdict}; save it with `{self._save_command}`'
        elif verdict:
            yield (
                LOG_WARN if state.verdict == HARMS else LOG_INFO,
                '; '.join([verdict, *state.lines[:2]]),
            )

    def _next(self, state: WorkerState) -> Iterator[tuple[str, str]]:
        """
        Yield a line when the most useful next motion has changed.

        Not more often than each `MIN_ADVICE_SECONDS`.
        """
        advice = advice_of(state)
        if not advice or advice == self._logged_advice or state.complete:
            return
        if self._clock() - self._advised_at >= MIN_ADVICE_SECONDS:
            self._logged_advice = advice
            self._advised_at = self._clock()
            yield LOG_INFO, f'next: {advice}'

    def _diagnosis(self, state: WorkerState) -> Iterator[tuple[str, str]]:
        """Yield a line when the outcome of the diagnosis has changed."""
        outcome = state.diagnosis
        if outcome is None or outcome.word in (diagnosis.WAITING, diagnosis.OFF):
            return
        key = f'{outcome.word}:{outcome.values.get("effect", "")}'
        if key != self._logged_diagnosis:
            self._logged_diagnosis = key
            yield (
                LOG_WARN if outcome.word == diagnosis.FAILED else LOG_INFO,
                f'diagnosis: {outcome.message}',
            )


def advice_of(state: WorkerState) -> str:
    """Return the most useful next motion or action, '' when unknown."""
    if state.session is not None:
        return state.session.values.get('next', '')
    steps = [line.removeprefix('next: ') for line in state.lines if line.startswith('next: ')]
    for group in state.groups:
        if group.counts and group.needs:
            steps.append(group.needs)
    return next(iter(steps), '')


STATUS_LEVELS = {
    **dict.fromkeys(('good', 'determined', 'waiting', 'nothing found', 'off', '', 'helps'), OK),
    **dict.fromkeys(('trouble', 'weak', 'held', 'found', 'unexplained', 'unproven'), WARN),
    **dict.fromkeys(('silent', 'failed', 'harms'), ERROR),
}
"""Word of a stream, a parameter group, a session, a diagnosis or a decision -> its level."""


def statuses_of(state: WorkerState, stream_faults: list[str] = []) -> list:
    """
    Return the DiagnosticStatus messages of a WorkerState.

    `stream_faults` are lines about its topics.
    """
    statuses = []
    if state.streams is not None:
        level = max(STATUS_LEVELS[state.streams.word], WARN if stream_faults else OK)
        statuses.append(
            make_status(
                level,
                'streams',
                '; '.join([state.streams.message, *stream_faults]),
                values=state.streams.values,
            )
        )

    # The decisions, then their reasons, at most three, and faults.
    parts = [state.judged or state.verdict or 'waiting for motion', *state.lines[:3]]
    if state.trouble:
        parts.append(state.trouble)
    parts += state.faults
    is_incomplete = state.verdict and (state.trouble or not state.complete)
    level = max(STATUS_LEVELS[state.verdict], WARN if is_incomplete else OK)
    if state.faults:
        level = ERROR
    statuses.append(
        make_status(
            level,
            'calibration',
            '; '.join(dict.fromkeys(parts)),
            values={'version': state.solution, **state.values},
        )
    )
    if state.session is not None:
        statuses.append(_live_status('poses', state.session, state.session.values))
    if state.diagnosis is not None:
        values = {'outcome': state.diagnosis.word, **state.diagnosis.values}
        statuses.append(_live_status('diagnosis', state.diagnosis, values))
    return statuses + [_group_status(group) for group in state.groups]


def _live_status(name: str, state: LiveState, values: dict[str, Any]) -> DiagnosticStatus:
    """Return the status of a session or a diagnosis."""
    return make_status(STATUS_LEVELS[state.word], name, state.message, values=values)


def _group_status(group: GroupState) -> DiagnosticStatus:
    """Return the status of the parameters of one effect."""
    text = {
        'determined': 'determined',
        'weak': 'weak',
        'held': 'held at its prior: the motion so far contains almost no information',
        'waiting': 'no solution yet',
    }[group.status]
    if group.needs and group.counts:
        text += f'; still needed: {group.needs}'
    elif group.needs:
        text += '; not needed for the sensors'
    figures = {
        f'standard error [{group.unit}]': group.sd,
        f'tolerance [{group.unit}]': group.tolerance,
        f'predicted after that motion [{group.unit}]': group.predicted_sd,
    }
    values = {'parameter': group.parameter, 'needs': group.needs}
    for name, figure in figures.items():
        if not math.isnan(figure):
            values[name] = f'{figure:.3g}'
    # Parameters of the reference do not count: they are shown, and need no action.
    level = STATUS_LEVELS[group.status] if group.counts else OK
    return make_status(level, f'{group.sensor} {group.effect}', text, values=values)


def markers_of(coverage: Coverage, stamp: Time) -> MarkerArray:
    """
    Return the picture, in the frame of the sensor; each message replaces the one before.

    Cells: orange and large where another rest is informative, green and small elsewhere. An arrow
    from the present up direction to the next one, a ring of the turn between them; blue points:
    earlier up directions; the arms of the three sensitive points; one line of text.
    """
    markers = [Marker(ns='all', action=Marker.DELETEALL)]

    # Cells of the sphere, the earlier up directions, and arrows.
    for k, (place, color, size) in enumerate(sphere_cells(coverage)):
        scale = (size,) * 3
        markers.append(
            _marker('cells', k, Marker.SPHERE, color=(*color, 0.9), scale=scale, place=place)
        )
    seen, color, diameter = seen_of(coverage)
    if len(seen):
        scale = (diameter,) * 3
        markers.append(
            _marker('seen', 0, Marker.SPHERE_LIST, color=color, scale=scale, points=seen)
        )
    for k, arrow in enumerate(arrows_of(coverage)):
        markers.append(_arrow(*arrow, number=k))

    # The turn to the next rest: in the sensor frame up turns by the negative angle about the axis.
    step = coverage.next
    if step.axis is not None and coverage.up is not None and step.up is not None:
        across = np.cross(step.axis, coverage.up)
        angles = np.linspace(0, step.angle, 24)[:, None]
        markers.append(
            _marker(
                'turn',
                0,
                Marker.LINE_STRIP,
                color=(*ARROW, 0.7),
                scale=(0.012, 0.0, 0.0),
                points=0.7 * RADIUS * (np.cos(angles) * coverage.up - np.sin(angles) * across),
            )
        )
    place, color, line = label_of(coverage)
    markers.append(
        _marker(
            'text',
            0,
            Marker.TEXT_VIEW_FACING,
            color=color,
            scale=(0.0, 0.0, 0.09),
            place=place,
            text=line,
        )
    )
    return _stamped(markers, coverage.frame_id, stamp)


def driven_markers(up: np.ndarray, text: str, *, frame_id: str, stamp: Time) -> MarkerArray:
    """
    Return the planner's markers.

    An arrow to the up direction after the driven motion, and a description of that motion.
    """
    return _stamped(
        [
            _arrow('driven', np.zeros(3), 1.25 * RADIUS * up, ARROW),
            _marker(
                'driven',
                1,
                Marker.TEXT_VIEW_FACING,
                color=TEXT_COLOUR,
                scale=(0.0, 0.0, 0.08),
                place=(0.0, 0.0, -1.5 * RADIUS),
                text=text,
            ),
        ],
        frame_id,
        stamp,
    )


def _stamped(markers: list[Marker], frame_id: str, stamp: Time) -> MarkerArray:
    """Return markers with the same header."""
    for marker in markers:
        marker.header.frame_id = frame_id or 'imu_link'
        marker.header.stamp = stamp
    return MarkerArray(markers=markers)


def _arrow(name: str, start: Any, end: Any, color: Any, number: int = 0) -> Marker:
    """Return the marker of an arrow between two points, each 3 floats."""
    return _marker(
        name, number, Marker.ARROW, color=color, scale=(0.025, 0.05, 0.07), points=(start, end)
    )


def _marker(
    name: str,
    number: int,
    kind: int,
    *,
    color: Any,
    scale: Any,
    place: Any = (0.0, 0.0, 0.0),
    points: Any = (),
    text: str = '',
) -> Marker:
    """
    Return a marker of a shape `kind`; namespace and number identify it.

    Colours are 3 floats and optionally the opacity, places and scales 3 floats.
    """
    red, green, blue, opacity = map(float, (*color, 1.0)[:4])
    x, y, z = map(float, scale)
    return Marker(
        ns=name,
        id=number,
        type=kind,
        action=Marker.ADD,
        color=ColorRGBA(r=red, g=green, b=blue, a=opacity),
        scale=Vector3(x=x, y=y, z=z),
        pose=Pose(position=_point(place), orientation=Quaternion(w=1.0)),
        points=[_point(point) for point in points],
        text=text,
    )


def _point(place: Any) -> Point:
    """Return 3 floats as a message."""
    x, y, z = map(float, place)
    return Point(x=x, y=y, z=z)
