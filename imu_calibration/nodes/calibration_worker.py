"""
The worker thread of calibration_node.

It processes received messages, solves at intervals and saves; the main thread only receives.

The file has the files of a session, and all steps of this thread in their order.
"""

import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from imu_calibration.calibration.live import (
    LiveByHandSettings,
    LiveSession,
    LiveSettings,
    SolvePacer,
)
from imu_calibration.calibration.result import CalibrationResult, summary
from imu_calibration.core.errors import ImuCalibrationError, NotObservableError, shortened
from imu_calibration.document import files
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.document.outcome import missing, parameter_count, shortcomings
from imu_calibration.nodes.calibration_status import WorkerState
from imu_calibration.nodes.diagnosis_thread import DiagnosisThread, Listeners, return_freed_memory
from imu_calibration.preprocessing.stream_watch import StreamWatch
from imu_calibration.preprocessing.window import WindowSettings
from imu_calibration.references.turntable.live_diagnosis import question_about
from msg_adapters.live import LiveGatherer

DEFAULT_FILE = 'calibration.yaml'


class SessionFiles:
    """
    The two files of a session; each is written atomically, independently of the other.

    Parameters
    ----------
    save_file : str
        Path of the calibration; '': `DEFAULT_FILE` in the working directory, and files are saved on
        request only.

    """

    def __init__(self, save_file: str):
        self.given = bool(save_file)
        self.calibration = files.user_path(save_file or DEFAULT_FILE)
        self.saved_at = time.monotonic()
        self.n_saved = 0
        self._own: set[Path] = set()
        for path in (self.calibration, self.accumulator):
            files.remove_leftovers(path)

    @property
    def accumulator(self) -> Path:
        """Path of the accumulator."""
        return self.calibration.with_name(self.calibration.stem + '.accumulator.npz')

    def try_place(self) -> str:
        """Return the reason why saving is impossible here, '' when it is possible."""
        try:
            for path in (self.calibration, self.accumulator):
                files.try_place(path)
        except ImuCalibrationError as error:
            return f'saving failed: {error}'
        return ''

    def earlier(self) -> bytes | None:
        """
        Return the accumulator that an earlier session left, or None.

        Raises
        ------
        InputError
            When there is one that cannot be read.

        """
        return (
            files.read_bytes(self.accumulator, 'accumulator')
            if os.path.isfile(self.accumulator)
            else None
        )

    def put_aside(self) -> Path:
        """
        Rename the accumulator of an earlier session, so that it is not overwritten.

        Return the new name.

        Raises
        ------
        InputError
            When that cannot be done.

        """
        return files.put_aside(self.accumulator)

    def continue_earlier(self) -> None:
        """Let the files of the earlier session be those of this one."""
        self._own = {self.calibration, self.accumulator}

    def _write(self, path: Path, content: bytes, *, to_disk: bool = True) -> str:
        """
        Write a file of this session; a file of an earlier session is renamed, not replaced.

        Return a text about the renamed file, '' without one; raises as `files.write_whole`.
        """
        aside = None
        if path not in self._own and os.path.isfile(path):
            aside = files.put_aside(path)
        try:
            files.write_whole(path, content, to_disk)
        except BaseException:
            if aside is not None:
                os.rename(aside, path)
            raise
        self._own.add(path)
        return '' if aside is None else f' (that of an earlier session is now {aside.name})'

    def unsaved(self, live: LiveSession) -> int:
        """Return how many windows or poses of a session are in no file yet."""
        return max(live.n_windows - self.n_saved, 0)

    def note_saved(self, n_windows: int) -> None:
        """Record the number of saved windows or poses."""
        self.saved_at, self.n_saved = time.monotonic(), n_windows

    def save(self, live: LiveSession, text: str | None) -> tuple[bool, str]:
        """
        Save both files; return whether both are saved, and the outcome for each.

        Parameters
        ----------
        live : LiveSession
        text : str or None
            The calibration; None: only the accumulator is saved.

        """
        wanted: list[tuple[Path, Callable[[], bytes]]] = (
            [] if text is None else [(self.calibration, text.encode)]
        )
        done, failed = [], []
        for path, make in [*wanted, (self.accumulator, lambda: live.saved(pending=True))]:
            existed = os.path.exists(path)  # False where the path cannot even be
            try:
                done.append(f'{path}{self._write(path, make())}')
            except ImuCalibrationError as error:
                failed.append(
                    f'{error};'
                    f' {"the earlier file is unchanged" if existed else "no earlier file existed"}'
                )
        if not failed:
            self.note_saved(live.n_windows)
        lines = [f'not written: {line}' for line in failed]
        if done:
            lines.insert(0, f'written: {" and ".join(done)}')
        return not failed, '; '.join(lines)

    def autosave(self, live: LiveSession, period: float) -> bool:
        """
        Save the accumulator when that is due; return whether it was.

        Raises an InputError when it cannot be written.
        """
        if not period or time.monotonic() - self.saved_at < period or not self.unsaved(live):
            return False
        # Not again at once when it fails.
        self.saved_at, n_windows = (
            time.monotonic(),
            live.n_windows,
        )
        self._write(self.accumulator, live.saved(pending=False), to_disk=False)
        self.note_saved(n_windows)
        return True

    def keep(self, live: LiveSession, noun: str) -> str:
        """
        Save unsaved data at the end of a session where a path was given.

        Return the outcome, '' when all was saved.
        """
        unsaved = self.unsaved(live)
        if not unsaved:
            return ''
        ends = f'{unsaved} {noun} were in no file'
        if not self.given:
            return (
                f"{ends} and are lost: call ~/save, or give parameter 'save_file' and they are kept"
            )
        try:
            self._write(self.accumulator, live.saved(pending=True))
        except Exception as error:  # the process ends in any case
            return f'{ends} and are lost: {shortened(str(error), 300)}'
        return f'{ends}: they are kept in {self.accumulator}; resume:=true continues with them'


MESSAGE_CHECK_SECONDS = 0.1
"""Interval at which received messages are processed, s."""
IDLE = 3.0
"""Seconds without messages after which open windows are included in a solution."""


class CalibrationWorker(threading.Thread):
    """
    Runs a session.

    A step that fails is reported and skipped, and the session continues: no error of a message, a
    solution or a disk ends it.

    Parameters
    ----------
    gatherer : LiveGatherer
        Where messages are added by another thread.
    live : LiveSession
    make_live : callable
        Returns a new LiveSession, for a reset.
    place : SessionFiles
    autosave_period : float
        Interval at which the accumulator is saved, s; 0: on request only.
    listeners : Listeners
    hints : dict, optional
        As for `errors.with_hint`.
    provenance : dict, optional
        Options and files, for the document.

    """

    def __init__(
        self,
        gatherer: LiveGatherer,
        live: LiveSession,
        make_live: Callable[[], LiveSession],
        *,
        place: SessionFiles,
        autosave_period: float,
        listeners: Listeners,
        hints: dict[str, str] | None = None,
        provenance: dict | None = None,
    ):
        super().__init__(name='calibration', daemon=True)
        self.gatherer = gatherer
        self.live = live
        self.make_live = make_live
        self.place = place
        self.autosave_period = autosave_period
        self.listeners = listeners
        self.hints = hints or {}
        self._provenance = provenance or {}
        self._pacer = SolvePacer(live.settings.solve_share)
        self._watch = StreamWatch(live.needs_joints, live.needs_temperature)
        self._diagnosis = DiagnosisThread(self._diagnosis_period)
        self._diagnosed = 0
        self._asked: SimpleQueue[tuple[Callable[[], tuple[bool, str]], Future]] = SimpleQueue()
        self._wake = threading.Event()
        self._ending = False
        self._n_solutions, self._new_windows, self._closed = 0, self.live.n_windows > 0, True
        self.place.note_saved(self.live.n_windows)
        self._covered: tuple[int, int, int] | None = None
        self._looked = time.monotonic()
        self._trouble = ''
        self._faults: dict[str, str] = {}
        self._faults['place'] = self.place.try_place()
        self.state = WorkerState(groups=self.live.groups())

    @property
    def gathered(self) -> str:
        """Name of the observations (plural)."""
        return self.live.observations

    @property
    def _diagnosis_period(self) -> float:
        return self.live.diagnosis_period

    def ask(self, what: str | Callable[[], tuple[bool, str]]) -> Future:
        """
        Queue 'solve', 'diagnose', 'save', 'reset' or a function.

        Return the future of its (success, message).
        """
        answer: Future = Future()
        self._asked.put((getattr(self, f'_{what}') if isinstance(what, str) else what, answer))
        self._wake.set()
        return answer

    def end(self, timeout: float = 20.0) -> str:
        """
        Wait for the end of the present step, save unsaved windows, and return a line about them.

        '' for no unsaved windows.
        """
        self._ending = True
        self._wake.set()
        self._diagnosis.end()
        if self.is_alive():
            self.join(timeout)
        return (
            f'a solution was still being made: {self.gathered} since the last save are lost'
            if self.is_alive()
            else self.place.keep(self.live, self.gathered)
        )

    def run(self) -> None:
        """Run the steps until `end`."""
        # 11 MB and 0.2 s, which the first fit of a bias process would need later.
        import_module('scipy.optimize')
        import_module('scipy.ndimage')
        try:
            while not self._ending:
                self._wake.wait(MESSAGE_CHECK_SECONDS)
                self._wake.clear()
                for step in (
                    self._take,
                    self._answer,
                    self._solve_when_due,
                    self._adopt_what_was_found,
                    self._autosave,
                    self._diagnose_when_due,
                    self._tell,
                    self._cover,
                ):
                    self._survive(step)
            self._survive(self._take)
        finally:
            while not self._asked.empty():
                self._asked.get()[1].set_result((False, 'the node is ending'))

    def _survive(self, step: Callable[[], None]) -> None:
        """Run one step; its error is reported until it succeeds again."""
        name = step.__name__.strip('_')
        try:
            step()
        except ImuCalibrationError as error:
            self._faults[name] = error.with_hint(self.hints)
        except Exception as error:
            self._faults[name] = (
                f'{name.replace("_", " ")} failed and is left out:'
                f' {shortened(f"{type(error).__name__}: {error}", 200)}'
            )
        else:
            self._faults[name] = ''

    def _take(self) -> None:
        # Silence is measured from the last call: messages that arrived during a solution are
        # processed in the next one.
        self._looked = time.monotonic()
        block = self.gatherer.flush()
        self._watch.note(block, self._looked)
        windows: Any = self.live.push(block)  # of the kind that the session itself reads
        if block.imu is not None or block.joints is not None:
            self._closed = False
        if windows:
            self._new_windows = True
            residuals = self.live.residuals(windows)
            if residuals is not None and len(residuals):
                self.listeners.residuals(residuals)

    def _answer(self) -> None:
        while not self._asked.empty():
            action, answer = self._asked.get()
            try:
                result = action()
            except ImuCalibrationError as error:
                result = False, error.with_hint(self.hints)
            except Exception as error:  # every request gets a result
                result = False, shortened(f'{type(error).__name__}: {error}', 300)
            self._survive(self._tell)  # the requester reads the diagnostics next
            answer.set_result(result)

    def _solve_when_due(self) -> None:
        idle = not self._closed and self._looked - (self._watch.last_arrival or 0.0) > IDLE
        if idle:
            self._closed, self._new_windows = True, True
        if not self._new_windows or not self._pacer.due(time.monotonic()):
            return
        self._new_windows = False
        try:
            self._publish_solution(pending=self._closed)
            if idle:
                self._diagnosis.want()
        except ImuCalibrationError as error:
            self._trouble = error.with_hint(self.hints)
            self._faults['solution'] = (
                '' if isinstance(error, NotObservableError) else self._trouble
            )

    def _diagnose_when_due(self) -> None:
        n_windows = self.live.n_windows
        self._diagnosis.ask_when_due(lambda: question_about(self.live), n_windows > self._diagnosed)
        if self._diagnosis.is_running:
            self._diagnosed = max(n_windows, self._diagnosed)

    def _adopt_what_was_found(self) -> None:
        if self._adopt():
            self._publish_solution(pending=self._closed)

    def _adopt(self) -> bool:
        """Apply the last result of the diagnosis to the model; return whether the model changes."""
        extension = self._diagnosis.take_extension()
        return extension is not None and self.live.adopt(extension)

    def _settled_solution(self) -> tuple[CalibrationResult, str]:
        """
        Publish the solution of all messages with the model that the diagnosis requires.

        The result of `calibrate` for these messages.
        """
        published = self._publish_solution(pending=True)
        if not self._diagnosis_period:
            return published
        self._diagnosis.settle(question_about(self.live))
        return self._publish_solution(pending=True) if self._adopt() else published

    def _publish_solution(self, pending: bool) -> tuple[CalibrationResult, str]:
        start = time.monotonic()
        result = self.live.solve(
            pending, self._provenance | {'mode': 'live', 'solution': self._n_solutions + 1}
        )
        self._n_solutions += 1
        self._trouble = ''
        self._new_windows = False
        self._closed = pending
        self._faults['solution'] = ''
        text = calibration_to_text(result.calibration)
        self.listeners.calibration(text)
        return_freed_memory()
        self._pacer.note(start, time.monotonic())
        return result, text

    def _solve(self) -> tuple[bool, str]:
        result, _ = self._publish_solution(pending=True)
        self._diagnosis.want()
        return True, '; '.join(
            [
                f'{result.verdict.text} ({self.live.n_windows} {self.gathered})',
                *summary(result, self.hints),
            ]
        )

    def _diagnose(self) -> tuple[bool, str]:
        if not self._diagnosis_period:
            return (
                False,
                (
                    "a diagnosis is not available by hand, and not if parameter 'diagnosis_period'"
                    ' is 0'
                ),
            )
        self._publish_solution(pending=True)
        self._diagnosis.want(urgent=True)
        return (
            True,
            (
                f'diagnosis of {self.live.n_windows} windows started; its result is published on'
                ' /diagnostics and in the calibration'
            ),
        )

    def _save(self) -> tuple[bool, str]:
        text, what = None, ''
        try:
            result, text = self._settled_solution()
            what = (
                f'{result.verdict.text}:'
                f' {missing(result.calibration) or "every parameter is determined"}'
            )
        except ImuCalibrationError as error:
            what = f'no calibration yet: {error.with_hint(self.hints)}'
        if text is None and not self.live.n_windows:
            return False, f'{what}; no file was written'
        whole, written = self.place.save(self.live, text)
        self._faults['place'] = '' if whole else written
        return whole and text is not None, f'{what}; {written}'

    def _reset(self) -> tuple[bool, str]:
        lost = self.place.unsaved(self.live)
        self.live = self.make_live()
        self._new_windows = False
        self._closed = True
        self._diagnosed = 0
        self.place.note_saved(0)
        self._trouble = ''
        self._diagnosis.forget()
        return (
            True,
            (f'restarted, {lost} unsaved {self.gathered} were deleted; ' if lost else 'restarted; ')
            + 'the last calibration remains published until the next one',
        )

    def change(
        self, settings: LiveSettings | WindowSettings | LiveByHandSettings
    ) -> tuple[bool, str]:
        """Use other settings from now on; another gravity by hand changes the solution at once."""
        if self.live.change(settings):
            self._new_windows = self.live.n_windows > 0
        if isinstance(settings, LiveSettings):
            self._pacer = SolvePacer(settings.solve_share)
            self._diagnosis.change(self._diagnosis_period)
        return True, ''

    def _autosave(self) -> None:
        if self.place.autosave(self.live, self.autosave_period):
            self._faults['place'] = ''

    def _tell(self) -> None:
        counts = self.live.counts
        self._watch.note_counts(counts, self._looked)
        result = self.live.result
        lines: list[str] = []
        verdict = ''
        judged = ''
        complete = False
        if result is not None:
            verdict = str(result.verdict.word)
            judged = result.verdict.text
            complete = result.verdict.complete
            # First the causes of an incomplete state: a status has room for three lines.
            reasons = shortcomings(result.calibration)
            lines = list(dict.fromkeys([*reasons, *summary(result, self.hints)]))
        values = {
            self.gathered: self.live.n_windows,
            'solutions': self._n_solutions,
            'saves to': str(self.place.calibration),
            f'{self.gathered} in no file yet': self.place.unsaved(self.live),
            'process': os.getpid(),
            **counts,
        }
        if result is not None:
            values |= parameter_count(result.calibration).figures
        if self.live.needs_linearising:
            lines = [
                *lines,
                (
                    'an effect is outside the range of its linearisation and the stored windows are'
                    ' no longer available: calibrate the recording offline'
                ),
            ]
        stale = (
            self.state.solution != self._n_solutions or self.state.groups == [] or result is None
        )
        groups = self.live.groups() if stale else self.state.groups
        found = self._diagnosis.state
        diagnosis = self.live.diagnosed(
            replace(
                found,
                values={
                    **found.values,
                    'diagnoses': self._diagnosis.n_answers,
                    'being made': self._diagnosis.is_running,
                },
            )
        )
        self.state = WorkerState(
            groups,
            self._watch.state(self._looked, self.live.stamping),
            self._n_solutions,
            verdict,
            tuple(lines),
            self._trouble,
            tuple(line for line in self._faults.values() if line),
            self.live.n_windows,
            values,
            self.live.status(self.hints),
            diagnosis,
            judged,
            complete,
        )

    def _cover(self) -> None:
        """Update the picture of the coverage after a change."""
        seen = (
            id(self.live),
            self.live.n_covered,
            self._n_solutions,
        )
        if seen != self._covered:
            self._covered = seen
            self.listeners.coverage(self.live.coverage())
