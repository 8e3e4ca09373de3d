"""Terminal lines of calibration_node during a session: one at every change, with the next useful action."""

import time
from collections.abc import Callable, Iterator, Mapping

from imu_calibration.calibration.diagnosis import live_diagnosis as diagnosis
from imu_calibration.document.decision import HARMS
from imu_calibration.nodes.calibration_state import WorkerState
from imu_calibration.nodes.complaints import INFO, WARNING
from imu_calibration.nodes.inputs import MatchedInput
from imu_calibration.preprocessing.stamping import COUNTED, REGULAR

PATIENCE = 5.0
"""Seconds between two pieces of advice; the most useful motion may change with every solution."""
KINDS = {'imu': 'Imu', 'joints': 'JointState', 'temperature': 'Temperature'}


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
            yield INFO, f'first {self._noun} gathered'
        self._gathered = state.gathered
        yield from self._verdicts(state)
        yield from self._next(state)
        yield from self._diagnosis(state)

    def _streams(self, state: WorkerState) -> Iterator[tuple[str, str]]:
        coming = set() if state.streams is None else {name for name in state.streams.coming if name in self._inputs}
        for name in sorted(coming - self._coming):
            yield INFO, f'{KINDS[name]} messages are received on {self._inputs[name].source()}'
        self._coming = coming
        line = None if state.streams is None else state.streams.stamping
        if line is not None and line.word != self._stamping:
            if line.word == COUNTED or (line.word == REGULAR and self._stamping):
                yield INFO, f'Imu: {line}'
            self._stamping = line.word

    def _verdicts(self, state: WorkerState) -> Iterator[tuple[str, str]]:
        known = f'{state.judged}, every parameter is determined' if state.complete else state.judged
        if known == self._verdict:
            return
        self._verdict = known
        if state.complete:
            yield INFO, f'{known}; save it with `{self._save_command}`'
        elif known:
            yield WARNING if state.verdict == HARMS else INFO, '; '.join([known, *state.lines[:2]])

    def _next(self, state: WorkerState) -> Iterator[tuple[str, str]]:
        advice = advice_of(state)
        if advice and advice != self._advice and not state.complete and self._clock() - self._advised >= PATIENCE:
            self._advice, self._advised = advice, self._clock()
            yield INFO, f'next: {advice}'

    def _diagnosis(self, state: WorkerState) -> Iterator[tuple[str, str]]:
        found = state.diagnosis
        if found is None or found.word in (diagnosis.WAITING, diagnosis.OFF):
            return
        what = f'{found.word}:{found.values.get("effect", "")}'
        if what != self._diagnosed:
            self._diagnosed = what
            yield WARNING if found.word == diagnosis.FAILED else INFO, f'diagnosis: {found.message}'


def advice_of(state: WorkerState) -> str:
    """Return the most useful next motion or action, '' when unknown."""
    if state.session is not None:
        return state.session.values.get('next', '')
    steps = [line.removeprefix('next: ') for line in state.lines if line.startswith('next: ')]
    return next(iter([*steps, *(group.needs for group in state.groups if group.needs)]), '')
