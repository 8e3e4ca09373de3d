"""The thread of the diagnosis, receivers of results, and return of unused memory."""

import ctypes
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from imu_calibration.calibration.from_solution import ModelExtension
from imu_calibration.calibration.live import SolvePacer
from imu_calibration.core.progress import LiveState, listening
from imu_calibration.references.turntable.live_diagnosis import (
    FAILED,
    NOT_YET,
    OFF,
    Answer,
    DiagnosisQuestion,
)
from imu_calibration.references.turntable.selection.reduced_recording import REDUCING

THRESHOLD = 256 * 1024
"""
Bytes from which an array has separate pages, which are returned when it is freed; glibc raises its
threshold to 32 MB, so that arrays remain in a fragmented heap: 265 MB instead of 128 MB after a
diagnosis.
"""
_M_MMAP_THRESHOLD = -3


def _libc() -> Any:
    """Return the C library where it has these functions (glibc), or None."""
    library = ctypes.CDLL(None)
    return library if hasattr(library, 'mallopt') and hasattr(library, 'malloc_trim') else None


def give_arrays_own_pages() -> None:
    """Fix the size from which arrays have pages of their own."""
    libc = _libc()
    if libc is not None:
        libc.mallopt(_M_MMAP_THRESHOLD, THRESHOLD)


def return_freed_memory() -> None:
    """Return the free pages of the heap to the system."""
    libc = _libc()
    if libc is not None:
        libc.malloc_trim(0)


@dataclass(frozen=True)
class Listeners:
    """Receivers of the worker's results."""

    calibration: Callable[[str], None]
    """Called with the text of each new calibration document."""
    residuals: Callable[[Any], None]
    """Called with ImuSamples."""
    coverage: Callable[[Any], None] = lambda coverage: None
    """Called with each new Coverage."""


MAX_DIAGNOSIS_SHARE = 0.2
"""Largest share of the time for diagnoses."""
OFF_REASON = "parameter 'diagnosis_period' is 0"


class DiagnosisThread:
    """
    Runs one `DiagnosisQuestion` at a time.

    Parameters
    ----------
    period : float
        Interval between diagnoses without a request, s; 0: no diagnosis.

    """

    def __init__(self, period: float):
        self.period = period
        self._pacer = SolvePacer(MAX_DIAGNOSIS_SHARE)
        self._ending = False
        """Whether the node ends, and with it a running diagnosis."""
        self._thread: threading.Thread | None = None
        """Thread of the last diagnosis."""
        self._next_at = time.monotonic() + period
        """Time of the next diagnosis without a request, s of the steady clock."""
        self._is_requested = False
        """Whether a diagnosis is requested as soon as `MAX_DIAGNOSIS_SHARE` allows."""
        self._is_urgent = False
        """Whether it is requested at once."""
        self.state = NOT_YET if period else LiveState(OFF, OFF_REASON)
        """Outcome of the last diagnosis."""
        self.n_answers = 0
        """Number of completed diagnoses."""
        self._session = 0
        """Number of the session; the result for an earlier one is discarded."""
        self._diagnosed_samples: dict | None = None
        """Numbers of samples of the last question, which itself keeps all windows in memory."""
        self._extension: ModelExtension | None = None
        """Change of the model that the last diagnosis requires; None after `take_extension`."""

    def change(self, period: float) -> None:
        """Use another period; 0: no more diagnoses."""
        if bool(period) != bool(self.period):
            self.state = NOT_YET if period else LiveState(OFF, OFF_REASON)
        self.period = period
        self._next_at = time.monotonic() + period

    @property
    def is_running(self) -> bool:
        """Whether a diagnosis is running."""
        return self._thread is not None and self._thread.is_alive()

    def want(self, urgent: bool = False) -> None:
        """
        Request a diagnosis before the period is over, as soon as `MAX_DIAGNOSIS_SHARE` allows.

        At once when it is urgent.
        """
        self._is_requested = bool(self.period)
        self._is_urgent = urgent and bool(self.period)

    def forget(self) -> None:
        """Discard all results: the session is restarted."""
        self.state = NOT_YET if self.period else self.state
        self._is_requested = False
        self._is_urgent = False
        self._diagnosed_samples = self._extension = None
        self._session += 1

    def ask_when_due(
        self, make_question: Callable[[], DiagnosisQuestion | None], is_news: bool
    ) -> None:
        """
        Start the diagnosis `make_question()` (None: no diagnosis) when it is due.

        It is due when it is requested, or when the period is over and there is news.
        """
        now = time.monotonic()
        is_periodic = bool(self.period) and is_news and now >= self._next_at
        is_due = (self._is_requested or is_periodic) and self._pacer.due(now)
        if self.is_running or self._ending or not (is_due or self._is_urgent):
            return
        question = make_question()
        if question is None:
            return
        self._is_requested = self._is_urgent = False
        self._thread = threading.Thread(
            target=self._answer, args=(question, now, self._session), name='diagnosis', daemon=True
        )
        self._thread.start()

    def _answer(self, question: DiagnosisQuestion, start: float, session: int) -> None:
        """Diagnose, in its own thread; the result of another session is discarded."""
        try:
            with listening(lambda phase, done, total: self._check_needed(session, phase)):
                answer = question.answer()
        except _Ended:
            return
        except Exception as error:  # a diagnosis that fails must not end the calibration
            answer = Answer(
                LiveState(FAILED, f'the diagnosis failed: {type(error).__name__}: {error}')
            )
        if session == self._session:
            self.state = answer.state
            self._extension = answer.extension
            self._diagnosed_samples = question.samples
            self.n_answers += 1
        del answer
        return_freed_memory()
        end = time.monotonic()
        self._next_at = end + self.period
        self._pacer.note(start, end)

    def take_extension(self) -> ModelExtension | None:
        """Return the change of the model that the last diagnosis requires, once."""
        extension = self._extension
        self._extension = None
        return extension

    def settle(self, question: DiagnosisQuestion | None) -> None:
        """Run a diagnosis and wait for it, unless the last one was of the same samples."""
        self._join()
        if question is not None and self.period and question.samples != self._diagnosed_samples:
            self._is_urgent = True
            self.ask_when_due(lambda: question, True)
            self._join()

    def _join(self, timeout: float | None = None) -> None:
        """Wait for the end of the running diagnosis."""
        if self._thread is not None:
            self._thread.join(timeout)

    def _check_needed(self, session: int, phase: str) -> None:
        """
        End the diagnosis of an earlier session, or at the end of the node, by an exception.

        Otherwise return to the system the memory that its last step freed.
        """
        if self._ending or session != self._session:
            raise _Ended
        if phase == REDUCING:
            return_freed_memory()

    def end(self, timeout: float = 10.0) -> None:
        """Cancel the diagnosis, and wait for the thread."""
        self._ending = True
        self._join(timeout)


class _Ended(Exception):
    """The node is being shut down, or the session has been restarted."""
