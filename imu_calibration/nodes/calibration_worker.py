"""The thread behind calibration_node: takes what arrived, solves when it is due, saves; the node's own thread only listens."""

import os
import threading
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

from imu_calibration.calibration.document import calibration_to_text
from imu_calibration.calibration.pacing import SolvePacer
from imu_calibration.calibration.result import summary
from imu_calibration.diagnosis.live import DiagnosisState, LiveDiagnosis
from imu_calibration.errors import ImuCalibrationError, NotObservableError
from imu_calibration.files import write_whole
from imu_calibration.nodes.diagnosis_thread import DiagnosisThread
from imu_calibration.preflight.stream_watch import StreamState, StreamWatch

PERIOD = 0.1
"""Seconds between two looks at what arrived."""
IDLE = 3.0
"""Seconds without messages after which the windows that are still open count as well."""


@dataclass(frozen=True)
class WorkerState:
    """What diagnostics tell; replaced as a whole, so that another thread may read it."""

    groups: list = field(default_factory=list)
    """GroupState of every effect."""
    streams: StreamState | None = None
    """How the streams are."""
    solution: int = 0
    """Number of the last solution; 0 before the first."""
    verdict: str = ''
    """'good', 'weak' or 'bad'."""
    lines: tuple = ()
    """Reasons and next steps."""
    trouble: str = ''
    """Why there is no new solution."""
    values: dict = field(default_factory=dict)
    """Figures by name."""
    hand: object = None
    """HandStatus of a calibration without a table."""
    diagnosis: DiagnosisState | None = None
    """What the model gets wrong; None without a table."""


class CalibrationWorker(threading.Thread):
    """
    Runs a LiveCalibration, or a LiveByHand without a table.

    Parameters
    ----------
    gatherer : LiveGatherer
        Where messages are added by another thread.
    make_live : callable
        Returns a new LiveCalibration or LiveByHand; called at the start (with ``resume=True``) and for every reset.
    save_file : str
        Path of the calibration document; the accumulator goes beside it.
    autosave_period : float
        Seconds between two savings of the accumulator; 0: only when asked.
    on_calibration : callable
        Called with the text of each new calibration document.
    on_residuals : callable
        Called with ImuSamples.
    on_trouble : callable
        Called with one line when something cannot be used.
    by_hand : bool
        Whether there is no table, and so no joint states.
    hints : dict, optional
        As for `errors.with_hint`.

    """

    def __init__(self, gatherer, make_live, save_file, autosave_period, on_calibration, on_residuals, on_trouble, by_hand=False,
                 hints=None):
        super().__init__(name='calibration', daemon=True)
        self.gatherer, self.make_live = gatherer, make_live
        self.save_file, self.autosave_period = Path(save_file).expanduser(), autosave_period
        self.on_calibration, self.on_residuals, self.on_trouble = on_calibration, on_residuals, on_trouble
        self.hints = hints or {}
        self.live = make_live(resume=True)
        self.failure = None
        self.state = WorkerState(groups=self.live.groups())
        self._pacer, self._watch = SolvePacer(self.live.settings.solve_share), StreamWatch(joints=not by_hand)
        self._by_hand, self._diagnosis = by_hand, DiagnosisThread(0.0 if by_hand else self.live.settings.diagnosis_period)
        self._diagnosed, self._windows = 0, self._new_diagnosis()
        self._asked, self._lock, self._wake, self._ending = [], threading.Lock(), threading.Event(), False
        self._n_solutions, self._new_windows, self._closed, self._saved = 0, self.live.n_windows > 0, True, (time.monotonic(), 0)
        self._trouble = ''

    @property
    def accumulator_file(self):
        """Where the accumulator is saved."""
        return accumulator_file(self.save_file)

    def ask(self, what):
        """Ask for 'solve', 'save' or 'reset'; return a Request whose `done` is set when (success, message) is there."""
        request = Request(what)
        with self._lock:
            self._asked.append(request)
        self._wake.set()
        return request

    def end(self, timeout=20.0):
        """Let the thread finish what it does, and wait for it."""
        self._ending = True
        self._wake.set()
        self._diagnosis.end()
        if self.is_alive():
            self.join(timeout)

    def run(self):
        """Work until `end`."""
        try:
            while not self._ending:
                self._wake.wait(PERIOD)
                self._wake.clear()
                self._take()
                self._answer()
                self._solve_when_due()
                self._autosave()
                self._diagnose_when_due()
                self._tell()
        except BaseException as error:
            self.failure = error
            raise
        finally:
            for request in self._asked:
                request.answer(False, 'the node is ending')

    def _take(self):
        now = time.monotonic()
        try:
            block = self.gatherer.flush()
            self._watch.note(block, now)
            windows = self.live.push(block)
        except ImuCalibrationError as error:
            self._complain(error.told(self.hints))
            return
        if block.imu is not None or block.joints is not None:
            self._closed = False
        if windows:
            self._new_windows = True
            self._windows.add([] if self._by_hand else windows)
            residuals = self.live.residuals(windows)
            if residuals is not None and len(residuals):
                self.on_residuals(residuals)

    def _answer(self):
        with self._lock:
            asked, self._asked = self._asked, []
        for request in asked:
            try:
                success, message = True, getattr(self, '_' + request.what)()
            except ImuCalibrationError as error:
                success, message = False, error.told(self.hints)
            self._tell()   # who asked looks at the diagnostics next
            request.answer(success, message)

    def _solve_when_due(self):
        idle = not self._closed and time.monotonic() - (self._watch.last_arrival or 0.0) > IDLE
        if idle:
            self._closed, self._new_windows = True, True
        if not self._new_windows or not self._pacer.due(time.monotonic()):
            return
        self._new_windows = False
        try:
            self._publish_solution(pending=self._closed)
            if idle:
                self._diagnosis.want()
        except NotObservableError as error:
            self._trouble = error.told(self.hints)
        except ImuCalibrationError as error:
            self._trouble = error.told(self.hints)
            self._complain(error.told(self.hints))

    def _diagnose_when_due(self):
        n_windows = self.live.n_windows
        self._diagnosis.ask_when_due(lambda: self._windows.question(self.live), n_windows > self._diagnosed)
        if self._diagnosis.is_running:
            self._diagnosed = max(n_windows, self._diagnosed)

    def _publish_solution(self, pending):
        start = time.monotonic()
        result = self.live.solve(pending, {'mode': 'live', 'solution': self._n_solutions + 1})
        self._n_solutions += 1
        self._trouble, self._new_windows, self._closed = '', False, pending
        text = calibration_to_text(result.calibration)
        self.on_calibration(text)
        self._pacer.note(start, time.monotonic())
        return text

    def _solve(self):
        self._publish_solution(pending=True)
        self._diagnosis.want()
        verdict, lines = summary(self.live.result, self.hints)
        return f'{verdict} ({self.live.n_windows} {"poses" if self._by_hand else "windows"})' + ''.join(f'; {line}' for line in lines)

    def _save(self):
        text = self._publish_solution(pending=True)
        write_whole(self.save_file, text.encode())
        self._save_accumulator(pending=True)
        return f'written: {self.save_file} and {self.accumulator_file.name}'

    def _new_diagnosis(self):
        settings = self.live.settings
        return LiveDiagnosis(0 if self._by_hand or not settings.diagnosis_period else settings.diagnosis_samples)

    def _save_accumulator(self, pending):
        write_whole(self.accumulator_file, self.live.saved(pending), to_disk=pending)
        self._saved = (time.monotonic(), self.live.n_windows)

    def _reset(self):
        self.live = self.make_live(resume=False)
        self._new_windows, self._closed, self._diagnosed, self._windows = False, True, 0, self._new_diagnosis()
        self._diagnosis.forget()
        return 'started anew; the last calibration stays published until there is another one'

    def _autosave(self):
        when, n_windows = self._saved
        if self.autosave_period and time.monotonic() - when >= self.autosave_period and self.live.n_windows > n_windows:
            try:
                self._save_accumulator(pending=False)
            except ImuCalibrationError as error:
                self._saved = (time.monotonic(), n_windows)
                self._complain(error.told(self.hints))

    def _complain(self, line):
        self._trouble = line
        self.on_trouble(line)

    def _tell(self):
        now, counts = time.monotonic(), self.live.counts
        self._watch.note_counts(counts, now)
        result = self.live.result
        verdict, lines = ('', ()) if result is None else summary(result, self.hints)
        gathered = 'poses' if self._by_hand else 'windows'
        values = {gathered: self.live.n_windows, 'solutions': self._n_solutions, 'process': os.getpid(), **counts}
        if self.live.needs_linearising():
            lines = [*lines, 'an effect has moved too far from where it was linearised and the stored windows are gone: '
                     'calibrate the recording offline']
        if self.state.solution != self._n_solutions or self.state.groups == [] or result is None:
            groups = self.live.groups()
        else:
            groups = self.state.groups
        hand, diagnosis = (self.live.status(self.hints), None) if self._by_hand else (None, self._diagnosis_state())
        self.state = WorkerState(groups, self._watch.state(now), self._n_solutions, verdict, tuple(lines), self._trouble, values,
                                 hand, diagnosis)

    def _diagnosis_state(self):
        state = self._diagnosis.state
        return replace(state, values={**state.values, 'diagnoses': self._diagnosis.n_answers, 'being made': self._diagnosis.is_running})


class Request:
    """Something asked of the worker."""

    def __init__(self, what):
        self.what, self.done = what, threading.Event()
        self.success, self.message = False, ''

    def answer(self, success, message):
        """Give the answer."""
        self.success, self.message = success, message
        self.done.set()


def accumulator_file(save_file):
    """Return the path of the accumulator that belongs to a calibration file."""
    path = Path(save_file).expanduser()
    return path.with_name(path.stem + '.accumulator.npz')
