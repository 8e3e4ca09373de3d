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


OFF_WHY = "parameter 'diagnosis_period' is 0"


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
        self._thread: threading.Thread | None = None
        self._next = time.monotonic() + period
        self._wanted = False
        self._urgent = False
        self.state = NOT_YET if period else LiveState(OFF, OFF_WHY)
        self.n_answers, self._session = 0, 0
        self._answered: dict | None = (
            # Numbers of samples of the last question; the question itself keeps all windows in
            # memory
            None
        )
        self._extension: ModelExtension | None = None

    def change(self, period: float) -> None:
        """Use another period; 0: no more diagnoses."""
        if bool(period) != bool(self.period):
            self.state = NOT_YET if period else LiveState(OFF, OFF_WHY)
        self.period, self._next = period, time.monotonic() + period

    @property
    def is_running(self) -> bool:
        """Whether a diagnosis is running."""
        return self._thread is not None and self._thread.is_alive()

    def want(self, urgent: bool = False) -> None:
        """
        Request a diagnosis before the period is over, as soon as `MAX_DIAGNOSIS_SHARE` allows.

        At once when it is urgent.
        """
        self._wanted, self._urgent = bool(self.period), urgent and bool(self.period)

    def forget(self) -> None:
        """Discard all results: the session is restarted."""
        self.state = NOT_YET if self.period else self.state
        self._wanted = False
        self._urgent = False
        self._answered = self._extension = None
        self._session += 1

    def ask_when_due(
        self, make_question: Callable[[], DiagnosisQuestion | None], is_news: bool
    ) -> None:
        """
        Start the diagnosis `make_question()` (None: no diagnosis) when it is due.

        It is due when it is requested, or when the period is over and there is news.
        """
        now = time.monotonic()
        due = self._urgent or (
            (self._wanted or (bool(self.period) and is_news and now >= self._next))
            and self._pacer.due(now)
        )
        if not due or self.is_running or self._ending:
            return
        question = make_question()
        if question is None:
            return
        self._wanted = self._urgent = False
        self._thread = threading.Thread(
            target=self._answer, args=(question, now, self._session), name='diagnosis', daemon=True
        )
        self._thread.start()

    def _answer(self, question, start, session):
        try:
            with listening(lambda phase, done, total: self._go_on(session, phase)):
                answer = question.answer()
        except _Ended:
            return
        except Exception as error:  # a diagnosis that fails must not end the calibration
            answer = Answer(
                LiveState(FAILED, f'the diagnosis failed: {type(error).__name__}: {error}')
            )
        if session == self._session:
            self.state, self._extension = answer.state, answer.extension
            self._answered, self.n_answers = question.samples, self.n_answers + 1
        del answer
        return_freed_memory()
        end = time.monotonic()
        self._next = end + self.period
        self._pacer.note(start, end)

    def take_extension(self) -> ModelExtension | None:
        """Return the change of the model that the last diagnosis requires, once."""
        extension, self._extension = self._extension, None
        return extension

    def settle(self, question: DiagnosisQuestion | None) -> None:
        """
        Run a diagnosis and wait for it.

        One of the same windows that was completed already is not repeated.
        """
        self._join()
        if question is not None and self.period and question.samples != self._answered:
            self._urgent = True
            self.ask_when_due(lambda: question, True)
            self._join()

    def _join(self, timeout=None):
        if self._thread is not None:
            self._thread.join(timeout)

    def _go_on(self, session, phase):
        """
        End a diagnosis that nobody waits for; otherwise return the memory that its last step freed.
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
