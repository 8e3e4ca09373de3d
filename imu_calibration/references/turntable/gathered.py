"""The result of the map step of a calibration, and the merge of the results of several recordings."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from imu_calibration.core.errors import ImuCalibrationError, InputError
from imu_calibration.estimation.accumulator import Accumulator
from imu_calibration.estimation.window_statistics import WindowStatistics
from imu_calibration.preprocessing.window import Window
from imu_calibration.references.turntable.held_out import HeldOut

MOST_SAMPLES = 100_000
"""Most samples kept; beyond it every second window of each kind is removed."""


class SpreadWindows:
    """
    Every so many-th window of each kind, so that memory and the time of a search are bounded.

    The selection depends only on the recording.
    """

    def __init__(self) -> None:
        self.n_samples, self._stride, self._counts, self._kept = 0, 1, {}, []

    def add(self, window: Window) -> None:
        """Add a window in order of time, as a copy in separate memory (`owned_window`)."""
        number = self._counts[window.kind] = self._counts.get(window.kind, -1) + 1
        if number % self._stride:
            return
        self._kept.append((number, window))
        self.n_samples += len(window.time)
        while self.n_samples > MOST_SAMPLES and len(self._kept) > 1:
            self._stride *= 2
            self._kept = [(number, window) for number, window in self._kept if number % self._stride == 0]
            self.n_samples = sum(len(window.time) for _, window in self._kept)

    def copy(self) -> 'SpreadWindows':
        """Return an independent copy; the windows are shared."""
        twin = SpreadWindows()
        twin.n_samples, twin._stride, twin._counts, twin._kept = self.n_samples, self._stride, dict(self._counts), list(self._kept)
        return twin

    @property
    def windows(self) -> list[Window]:
        """The windows kept, in order of time."""
        return [window for _, window in self._kept]


KEPT_SAMPLES = 200_000
"""Samples of moving windows kept for plots and for the autocorrelation of residuals."""
MOST_ASKED = 4
"""Most recordings with windows kept for the search of effects."""
KEPT_POSES = 2000
"""Most static windows with kept joint positions."""


@dataclass(eq=False)
class Gathered:
    """Reduced data of a recording."""

    accumulator: Accumulator = field(default_factory=Accumulator)
    """The least-squares system."""
    held_out: HeldOut = field(default_factory=HeldOut)
    """The same windows in folds for cross-validation."""
    kept: list = field(default_factory=list)
    """Windows with all samples, up to KEPT_SAMPLES."""
    spreads: list[SpreadWindows] = field(default_factory=lambda: [SpreadWindows()])
    """Windows for the search of effects, of each of the recordings with most samples, the largest first; empty without a search."""
    poses: list = field(default_factory=list)
    """(time, session, joint positions) of each static window."""
    counts: dict = field(default_factory=dict)
    """Samples used and dropped, gaps, by reason."""
    frame_id: str = ''
    """Frame of the first IMU message."""
    first_stamp_ns: int | None = None
    """First IMU stamp."""
    last_stamp_ns: int | None = None
    """Last IMU stamp."""
    largest_rate: float = 0.0
    """Largest rate of the reference, rad/s."""
    largest_force: float = 0.0
    """Largest measured component of specific force, m/s^2."""
    temperature_c: tuple | None = None
    """Lowest and highest temperature."""
    findings: tuple = ()
    """Findings of the checks of the recording before the estimate (`CheckFinding`)."""

    judged_from: float = 0.0
    """Windows from this time on are judged by a proof, s."""

    def take(self, window: WindowStatistics) -> None:
        """Add a reduced window."""
        self.accumulator.add(window)
        self.held_out.add(window, window.time >= self.judged_from)

    def anew(self, windows: Iterable[WindowStatistics], judged_from: float = 0.0) -> 'Gathered':
        """Return the same with the windows reduced again."""
        fresh = replace(self, accumulator=Accumulator(), held_out=HeldOut(), judged_from=judged_from)
        for window in windows:
            fresh.take(window)
        return fresh

    @property
    def moving(self) -> list:
        """Moving windows with all their kept samples; live, the windows of the search of effects."""
        return self.kept or [window for spread in self.spreads for window in spread.windows if window.kind != 'static']

    @property
    def duration(self) -> float:
        """Seconds from the first to the last IMU stamp, recordings added."""
        return 0.0 if self.first_stamp_ns is None or self.last_stamp_ns is None else (self.last_stamp_ns - self.first_stamp_ns) * 1e-9


def merge(parts: Iterable[Gathered]) -> Gathered:
    """Merge the reduced data of several recordings: the merge step of calibration."""
    parts = list(parts)
    total = parts[0]
    for part in parts[1:]:
        total.accumulator.merge(part.accumulator)
        total.held_out.merge(part.held_out)
        total.kept, total.poses = _within_reach(total.kept + part.kept), total.poses + part.poses
        total.spreads = sorted(total.spreads + part.spreads, key=lambda spread: -spread.n_samples)[:MOST_ASKED]
        total.counts = {key: _added(total.counts.get(key, 0), part.counts.get(key, 0)) for key in {**total.counts, **part.counts}}
        total.largest_rate = max(total.largest_rate, part.largest_rate)
        total.largest_force = max(total.largest_force, part.largest_force)
        total.frame_id = total.frame_id or part.frame_id
        total.findings += part.findings
        ranges = [r for r in (total.temperature_c, part.temperature_c) if r]
        total.temperature_c = (min(r[0] for r in ranges), max(r[1] for r in ranges)) if ranges else None
        if part.first_stamp_ns is not None and part.last_stamp_ns is not None:
            total.first_stamp_ns = part.first_stamp_ns if total.first_stamp_ns is None else total.first_stamp_ns
            total.last_stamp_ns = (total.last_stamp_ns or total.first_stamp_ns) + part.last_stamp_ns - part.first_stamp_ns
    return total


def _within_reach(windows):
    """Return the windows up to KEPT_SAMPLES samples."""
    ends = np.cumsum([len(window.time) for window in windows])
    return windows[:int(np.searchsorted(ends, KEPT_SAMPLES, side='right'))]


def _added(a, b):
    return a + b if isinstance(a, (int, float)) and isinstance(b, (int, float)) else a or b


def naming(names: Sequence[str], session: int) -> Callable:
    """Return a function that calls another one and, with several recordings, puts the recording's name before its error."""
    def call(function, *arguments, **options):
        try:
            return function(*arguments, **options)
        except ImuCalibrationError as error:
            if len(names) < 2:
                raise
            raise error.named(names[session]) from error
    return call


def join(parts: Sequence[Gathered], names: Sequence[str], check: Callable[[Gathered], object]) -> Gathered:
    """
    Return the merged Gathered of several recordings.

    Parameters
    ----------
    parts : list of Gathered
        One per recording, in order.
    names : sequence of str
        Names of the recordings.
    check : callable
        Called with each part; raises when it cannot be used.

    Raises
    ------
    InputError
        When a recording has no window, another frame than the first, or does not pass the check, with its name.

    """
    for session, part in enumerate(parts):
        naming(names, session)(check, part)
        if len(parts) > 1:
            part.findings = tuple(finding.named(names[session]) for finding in part.findings)
            _require_like_the_first(parts[0], part, names[0], names[session])
    return merge(parts)


def _require_like_the_first(first, part, first_name, name):
    if not part.accumulator.rows:
        raise InputError(f'{name}: every recording must contain a static window, spin or dynamic segment, this one has none; omit it')
    if part.frame_id != first.frame_id:
        raise InputError(f"{name}: all recordings must be of one IMU, "
                         f"the frame is '{part.frame_id}' here and '{first.frame_id}' in {first_name}; "
                         'calibrate different IMUs one by one')
