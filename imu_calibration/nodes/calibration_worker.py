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
        """Whether the user has named the file."""
        self.calibration = files.user_path(save_file or DEFAULT_FILE)
        """Path of the calibration."""
        self.saved_at = time.monotonic()
        """Time of the last save, s of the steady clock."""
        self.n_saved = 0
        """Windows or poses in the saved accumulator."""
        self._written: set[Path] = set()
        """Files of this session, which are replaced; others at their paths are renamed."""
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
        if not os.path.isfile(self.accumulator):
            return None
        return files.read_bytes(self.accumulator, 'accumulator')

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
        """Replace the files of the earlier session at the next save, without renaming them."""
        self._written = {self.calibration, self.accumulator}

    def _write(self, path: Path, content: bytes, *, to_disk: bool = True) -> str:
        """
        Write a file of this session; a file of an earlier session is renamed, not replaced.

        Return a text about the renamed file, '' without one; raises as `files.write_whole`, with
        the file of the earlier session under its first name again.
        """
        renamed_to = None
        if path not in self._written and os.path.isfile(path):
            renamed_to = files.put_aside(path)
        try:
            files.write_whole(path, content, to_disk)
        except BaseException:
            if renamed_to is not None:
                os.rename(renamed_to, path)
            raise
        self._written.add(path)
        return (
            '' if renamed_to is None else f' (that of an earlier session is now {renamed_to.name})'
        )

    def unsaved(self, live: LiveSession) -> int:
        """Return the number of windows or poses of a session that are in no file yet."""
        return max(live.n_windows - self.n_saved, 0)

    def note_saved(self, n_windows: int) -> None:
        """Record the number of saved windows or poses."""
        self.saved_at = time.monotonic()
        self.n_saved = n_windows

    def save(self, live: LiveSession, text: str | None) -> tuple[bool, str]:
        """
        Save both files; return whether both are saved, and the outcome for each.

        Parameters
        ----------
        live : LiveSession
        text : str or None
            The calibration; None: only the accumulator is saved.

        """
        contents: list[tuple[Path, Callable[[], bytes]]] = []
        if text is not None:
            contents.append((self.calibration, text.encode))
        contents.append((self.accumulator, lambda: live.saved(pending=True)))

        written = []
        failures = []
        for path, make_content in contents:
            existed = os.path.exists(path)  # False where the path cannot even be
            try:
                written.append(f'{path}{self._write(path, make_content())}')
            except ImuCalibrationError as error:
                earlier = 'the earlier file is unchanged' if existed else 'no earlier file existed'
                failures.append(f'{error}; {earlier}')
        if not failures:
            self.note_saved(live.n_windows)
        lines = [f'not written: {line}' for line in failures]
        if written:
            lines.insert(0, f'written: {" and ".join(written)}')
        return not failures, '; '.join(lines)

    def autosave(self, live: LiveSession, period: float) -> bool:
        """
        Save the accumulator if there is unsaved data `period` s after the last save; 0: never.

        Return whether it was saved; raises an InputError when it cannot be written.
        """
        if not period or time.monotonic() - self.saved_at < period or not self.unsaved(live):
            return False
        # Before the attempt: one that fails is repeated after the period, not at once.
        self.saved_at = time.monotonic()
        n_windows = live.n_windows
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
        unsaved_text = f'{unsaved} {noun} were in no file'
        if not self.given:
            return (
                f"{unsaved_text} and are lost: call ~/save, or give parameter 'save_file' and they"
                ' are kept'
            )
        try:
            self._write(self.accumulator, live.saved(pending=True))
        except Exception as error:  # the process ends in any case
            return f'{unsaved_text} and are lost: {shortened(str(error), 300)}'
        return (
            f'{unsaved_text}: they are kept in {self.accumulator}; resume:=true continues with them'
        )


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
    session_files : SessionFiles
        Where calibration and accumulator are saved.
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
        session_files: SessionFiles,
        autosave_period: float,
        listeners: Listeners,
        hints: dict[str, str] | None = None,
        provenance: dict | None = None,
    ):
        super().__init__(name='calibration', daemon=True)
        self.gatherer = gatherer
        self.live = live
        self.make_live = make_live
        self.session_files = session_files
        self.autosave_period = autosave_period
        self.listeners = listeners
        self.hints = hints or {}
        self._provenance = provenance or {}
        self._pacer = SolvePacer(live.settings.solve_share)
        self._watch = StreamWatch(live.needs_joints, live.needs_temperature)
        self._diagnosis = DiagnosisThread(self._diagnosis_period)
        self._n_diagnosed = 0
        """Windows at the last diagnosis."""
        self._requests: SimpleQueue[tuple[Callable[[], tuple[bool, str]], Future]] = SimpleQueue()
        """Requested functions, and futures of their (success, message)."""
        self._wake = threading.Event()
        """Set to begin the next round of steps at once."""
        self._ending = False
        """Whether the thread ends after the present round."""
        self._read_at = time.monotonic()
        """Time of the last reading of messages, s of the steady clock."""
        self._n_solutions = 0
        """Number of the last solution."""
        self._new_windows = self.live.n_windows > 0
        """Whether data came after the last solution."""
        self._includes_pending = True
        """Whether no message was added after the last solution with open windows."""
        self._has_ended = False
        """Whether the messages ended and no solution was made since."""
        self._covered: tuple[int, int, int] | None = None
        """State of the last picture of the coverage (see `_update_coverage`)."""
        self._trouble = ''
        """Why the last attempt of a solution failed; '' otherwise."""
        self.session_files.note_saved(self.live.n_windows)
        self._faults: dict[str, str] = {'place': self.session_files.try_place()}
        """Step, 'solution' or 'place' (of the files) -> its present fault, '' without one."""
        self.state = WorkerState(groups=self.live.groups())
        """State for the diagnostics, which another thread reads."""

    @property
    def gathered(self) -> str:
        """Name of the observations (plural)."""
        return self.live.observations

    @property
    def _diagnosis_period(self) -> float:
        """Time between diagnoses, s."""
        return self.live.diagnosis_period

    def ask(self, what: str | Callable[[], tuple[bool, str]]) -> Future:
        """
        Queue 'solve', 'diagnose', 'save', 'reset' or a function.

        Return the future of its (success, message).
        """
        response: Future = Future()
        action = getattr(self, f'_{what}') if isinstance(what, str) else what
        self._requests.put((action, response))
        self._wake.set()
        return response

    def end(self, timeout: float = 20.0) -> str:
        """
        Wait for the end of the present step, save unsaved windows or poses.

        Return a line about them, '' for none.
        """
        self._ending = True
        self._wake.set()
        self._diagnosis.end()
        if self.is_alive():
            self.join(timeout)
        if self.is_alive():
            return f'a solution was still being made: {self.gathered} since the last save are lost'
        return self.session_files.keep(self.live, self.gathered)

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
                    self._process_messages,
                    self._execute_requests,
                    self._solve_when_due,
                    self._apply_diagnosis,
                    self._autosave,
                    self._diagnose_when_due,
                    self._update_state,
                    self._update_coverage,
                ):
                    self._run_step(step)
            self._run_step(self._process_messages)
        finally:
            while not self._requests.empty():
                self._requests.get()[1].set_result((False, 'the node is ending'))

    def _run_step(self, step: Callable[[], None]) -> None:
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

    def _process_messages(self) -> None:
        """Add the received messages to the session, and publish the residuals of new windows."""
        # Silence is measured from the last call: messages that arrived during a solution are
        # processed in the next one.
        self._read_at = time.monotonic()
        block = self.gatherer.flush()
        self._watch.note(block, self._read_at)
        windows: Any = self.live.push(block)  # of the kind that the session itself reads
        if block.imu is not None or block.joints is not None:
            self._includes_pending = False
        if windows:
            self._new_windows = True
            residuals = self.live.residuals(windows)
            if residuals is not None and len(residuals):
                self.listeners.residuals(residuals)

    def _execute_requests(self) -> None:
        """Execute the queued requests."""
        while not self._requests.empty():
            action, response = self._requests.get()
            try:
                result = action()
            except ImuCalibrationError as error:
                result = False, error.with_hint(self.hints)
            except Exception as error:  # every request gets a result
                result = False, shortened(f'{type(error).__name__}: {error}', 300)
            self._run_step(self._update_state)  # the requester reads the diagnostics next
            response.set_result(result)

    def _solve_when_due(self) -> None:
        """
        Publish a solution of new data, and of open windows once no message arrives.

        The first solution after the end of the messages is followed by a diagnosis.
        """
        silence = self._read_at - (self._watch.last_arrival or 0.0)
        if not self._includes_pending and silence > IDLE:
            self._includes_pending = True
            self._new_windows = True
            self._has_ended = True
        if not self._new_windows or not self._pacer.due(time.monotonic()):
            return
        self._new_windows = False
        try:
            self._publish_solution(pending=self._includes_pending)
            if self._has_ended:
                self._has_ended = False
                self._diagnosis.want()
        except ImuCalibrationError as error:
            self._trouble = error.with_hint(self.hints)
            self._faults['solution'] = (
                '' if isinstance(error, NotObservableError) else self._trouble
            )

    def _diagnose_when_due(self) -> None:
        """Start a diagnosis when it is requested, or due with new windows."""
        n_windows = self.live.n_windows
        self._diagnosis.ask_when_due(
            lambda: question_about(self.live), n_windows > self._n_diagnosed
        )
        if self._diagnosis.is_running:
            self._n_diagnosed = max(n_windows, self._n_diagnosed)

    def _apply_diagnosis(self) -> None:
        """Publish a solution of the model that the last diagnosis requires, if it is new."""
        if self._extend_model():
            self._publish_solution(pending=self._includes_pending)

    def _extend_model(self) -> bool:
        """Apply the last result of the diagnosis to the model; return whether the model changes."""
        extension = self._diagnosis.take_extension()
        return extension is not None and self.live.adopt(extension)

    def _settled_solution(self) -> tuple[CalibrationResult, str]:
        """
        Publish the solution of all messages with the model that the diagnosis requires.

        Return (result, text of its document), equal to those of `calibrate` for these messages.
        """
        published = self._publish_solution(pending=True)
        if not self._diagnosis_period:
            return published
        self._diagnosis.settle(question_about(self.live))
        return self._publish_solution(pending=True) if self._extend_model() else published

    def _publish_solution(self, pending: bool) -> tuple[CalibrationResult, str]:
        """Solve, with open windows if `pending`; return (result, text of its document)."""
        start = time.monotonic()
        result = self.live.solve(
            pending, self._provenance | {'mode': 'live', 'solution': self._n_solutions + 1}
        )
        self._n_solutions += 1
        self._trouble = ''
        self._new_windows = False
        self._includes_pending = pending
        self._faults['solution'] = ''
        text = calibration_to_text(result.calibration)
        self.listeners.calibration(text)
        return_freed_memory()
        self._pacer.note(start, time.monotonic())
        return result, text

    def _solve(self) -> tuple[bool, str]:
        """Publish a solution on request; return (success, message)."""
        result, _ = self._publish_solution(pending=True)
        self._diagnosis.want()
        verdict = f'{result.verdict.text} ({self.live.n_windows} {self.gathered})'
        return True, '; '.join([verdict, *summary(result, self.hints)])

    def _diagnose(self) -> tuple[bool, str]:
        """Publish a solution and request its diagnosis; return (success, message)."""
        if not self._diagnosis_period:
            return False, (
                "a diagnosis is not available by hand, and not if parameter 'diagnosis_period' is 0"
            )
        self._publish_solution(pending=True)
        self._diagnosis.want(urgent=True)
        return True, (
            f'diagnosis of {self.live.n_windows} windows started; its result is published on'
            ' /diagnostics and in the calibration'
        )

    def _save(self) -> tuple[bool, str]:
        """Save the calibration and the accumulator; return (success of both, message)."""
        text = None
        try:
            result, text = self._settled_solution()
            shortage = missing(result.calibration) or 'every parameter is determined'
            outcome = f'{result.verdict.text}: {shortage}'
        except ImuCalibrationError as error:
            outcome = f'no calibration yet: {error.with_hint(self.hints)}'
        if text is None and not self.live.n_windows:
            return False, f'{outcome}; no file was written'
        is_saved, written = self.session_files.save(self.live, text)
        self._faults['place'] = '' if is_saved else written
        return is_saved and text is not None, f'{outcome}; {written}'

    def _reset(self) -> tuple[bool, str]:
        """Begin a new session; return (success, message)."""
        n_lost = self.session_files.unsaved(self.live)
        self.live = self.make_live()
        self._new_windows = False
        self._includes_pending = True
        self._has_ended = False
        self._n_diagnosed = 0
        self.session_files.note_saved(0)
        self._trouble = ''
        self._diagnosis.forget()
        message = 'restarted; '
        if n_lost:
            message = f'restarted, {n_lost} unsaved {self.gathered} were deleted; '
        return True, message + 'the last calibration remains published until the next one'

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
        """Save the accumulator when that is due."""
        if self.session_files.autosave(self.live, self.autosave_period):
            self._faults['place'] = ''

    def _update_state(self) -> None:
        """Replace `state` by the present one."""
        counts = self.live.counts
        self._watch.note_counts(counts, self._read_at)
        result = self.live.result
        # With a solution the groups change only with the next one; computing them is slow.
        groups = self.state.groups
        if self.state.solution != self._n_solutions or not groups or result is None:
            groups = self.live.groups()
        diagnosis = self._diagnosis.state
        progress = {
            'diagnoses': self._diagnosis.n_answers,
            'being made': self._diagnosis.is_running,
        }
        diagnosis = replace(diagnosis, values={**diagnosis.values, **progress})
        state = WorkerState(
            groups=groups,
            streams=self._watch.state(self._read_at, self.live.stamping),
            solution=self._n_solutions,
            trouble=self._trouble,
            faults=tuple(line for line in self._faults.values() if line),
            gathered=self.live.n_windows,
            session=self.live.status(self.hints),
            diagnosis=self.live.diagnosed(diagnosis),
        )

        # Figures of the session; decision, texts and figures of the last solution.
        lines: list[str] = []
        values = {
            self.gathered: self.live.n_windows,
            'solutions': self._n_solutions,
            'saves to': str(self.session_files.calibration),
            f'{self.gathered} in no file yet': self.session_files.unsaved(self.live),
            'process': os.getpid(),
            **counts,
        }
        if result is not None:
            # First the causes of an incomplete state: a status has room for three lines.
            reasons = shortcomings(result.calibration)
            lines = list(dict.fromkeys([*reasons, *summary(result, self.hints)]))
            values |= parameter_count(result.calibration).figures
            state = replace(
                state,
                verdict=str(result.verdict.word),
                judged=result.verdict.text,
                complete=result.verdict.complete,
            )
        if self.live.needs_linearising:
            lines.append(
                'an effect is outside the range of its linearisation and the stored windows are'
                ' no longer available: calibrate the recording offline'
            )
        self.state = replace(state, lines=tuple(lines), values=values)

    def _update_coverage(self) -> None:
        """Update the picture of the coverage after a change."""
        # Session, rests and solution, on which the picture depends.
        present = (id(self.live), self.live.n_covered, self._n_solutions)
        if present != self._covered:
            self._covered = present
            self.listeners.coverage(self.live.coverage())
