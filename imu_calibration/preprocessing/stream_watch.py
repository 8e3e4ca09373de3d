"""State of the streams of a live session from header stamps: rates, silence, dropped samples."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from imu_calibration.core.progress import LiveState
from imu_calibration.core.samples import SampleBlock
from imu_calibration.core.text_enum import StrEnum
from imu_calibration.preprocessing.stamping import IRREGULAR, StampLine
from imu_calibration.preprocessing.stream_cleaning import MESSAGES, STREAMS
from imu_calibration.preprocessing.window_cutter import dropped

SILENT_AFTER = 2.0
"""
Seconds without a message after which a stream counts as silent; also the lead of one stream's
stamps over the other's.
"""
RECENT_SECONDS = 10.0
"""Seconds for which a loss is called recent."""
COLD_AFTER = 10.0
"""The same for temperatures, of which one per second is usual."""


class StreamHealth(StrEnum):
    """How the streams of a session are."""

    GOOD = 'good'
    TROUBLE = 'trouble'
    """Messages are lost or late, or stamps differ between streams."""
    SILENT = 'silent'
    """No messages arrive."""


GOOD, TROUBLE, SILENT = StreamHealth


@dataclass(frozen=True)
class StreamState(LiveState):
    """The state of all streams together; `word` is a StreamHealth."""

    silent: tuple = ()
    """Needed streams without messages: 'imu', 'joints', 'temperature'."""
    coming: tuple = ()
    """Streams with messages."""
    unusable: dict = field(default_factory=dict)
    """Why the messages of a silent stream are unusable: stream -> dropped samples."""
    stamping: StampLine | None = None
    """How the stamps of the IMU are; None while that is not known."""


class StreamWatch:
    """
    Records every block and reports the state of the streams.

    Parameters
    ----------
    joints, temperature : bool
        Whether joint states and temperatures are needed.

    """

    def __init__(self, joints: bool = True, temperature: bool = False):
        # Needed stream -> seconds without a message after which it is silent.
        self._needed = {'imu': SILENT_AFTER}
        if joints:
            self._needed['joints'] = SILENT_AFTER
        if temperature:
            self._needed['temperature'] = COLD_AFTER
        # Stream -> samples, newest stamp in ns, time of the newest message in s, period in s.
        self._count = dict.fromkeys(STREAMS, 0)
        self._newest = {}
        self._arrived = {}
        self._period = {}
        # Reason -> dropped samples: of the session, and of the newest loss; and the time of it, s.
        self._lost = Counter()
        self._recent = Counter()
        self._lost_at: float | None = None
        # Since when the stamps of the streams differ, s; None while they agree.
        self._apart_since: float | None = None
        # Messages that were used with a modification: the last time, s, and reason -> count.
        self._unstamped_at: float | None = None
        self._notes: Counter[str] = Counter()

    @property
    def last_arrival(self) -> float | None:
        """
        Arrival time of the last message, s of the clock given to `note`; None before the first.
        """
        return max(self._arrived.values(), default=None)

    def note(self, block: SampleBlock, now: float) -> None:
        """Process a SampleBlock that arrived at `now`, s of a steady clock."""
        if block.notes:
            self._notes.update(block.notes)
            self._unstamped_at = now
        for name in self._count:
            samples = getattr(block, name)
            if samples is None or not len(samples):
                continue
            first = int(samples.stamp_ns[0])
            last = int(samples.stamp_ns[-1])
            if len(samples) > 1 and last > first:
                self._period[name] = (last - first) * 1e-9 / (len(samples) - 1)
            self._count[name] += len(samples)
            self._newest[name] = last
            self._arrived[name] = now

    def note_counts(self, counts: dict[str, int], now: float) -> None:
        """Record the counts of samples by their use."""
        lost = Counter(dropped(counts))
        new = lost - self._lost
        if new:
            self._recent = new
            self._lost_at = now
        self._lost = lost

    def _apart_for(self, lead: float, now: float) -> float:
        """
        Return the time for which the stamps of the streams have differed, s.

        `lead`: stamp of the IMU minus stamp of the joints, s. In a fast replay they differ briefly.
        """
        if abs(lead) <= SILENT_AFTER:
            self._apart_since = None
            return 0.0
        if self._apart_since is None:
            self._apart_since = now
        return now - self._apart_since

    def state(self, now: float, stamping: StampLine | None = None) -> StreamState:
        """Return the StreamState at `now`; `stamping` as its field."""
        values: dict[str, Any] = {}
        for name, count in self._count.items():
            values[f'{name} messages'] = count
        for name, period in self._period.items():
            values[f'{name} rate [Hz]'] = f'{1 / period:.1f}'
        for reason, count in self._lost.items():
            values[f'dropped: {reason}'] = count
        values.update(self._notes)
        if stamping:
            values['imu stamps'] = str(stamping)
        silent = tuple(
            name
            for name, patience in self._needed.items()
            if now - self._arrived.get(name, float('-inf')) > patience
        )
        coming = tuple(
            name
            for name in self._arrived
            if now - self._arrived[name] <= self._needed.get(name, SILENT_AFTER)
        )
        unusable = {}
        for name in silent:
            reasons = self._recent_losses(now, MESSAGES[name])
            if reasons:
                unusable[name] = reasons
        word, text = self._health(silent, now, stamping)
        return StreamState(word, text, values, silent, coming, unusable, stamping)

    def _recent_losses(self, now: float, beginning: str = '') -> str:
        """Return the recently dropped samples, of reasons with a beginning, in words; or ''."""
        if self._lost_at is None or now - self._lost_at >= RECENT_SECONDS:
            return ''
        return ', '.join(
            f'{count} {reason}'
            for reason, count in self._recent.items()
            if reason.startswith(beginning)
        )

    def _health(
        self, silent: Sequence[str], now: float, stamping: StampLine | None
    ) -> tuple[StreamHealth, str]:
        """Return the `StreamHealth` and the line that describes it; `silent`: silent streams."""
        if silent:
            missing = ' and no '.join(MESSAGES[name] for name in silent)
            text = f'no {missing} messages received'
            if len(silent) == len(self._needed):
                return SILENT, text
            return TROUBLE, f'{text}, no data can be used until then'
        lead = 0.0
        if 'joints' in self._needed:
            lead = (self._newest['imu'] - self._newest['joints']) * 1e-9
        if self._apart_for(lead, now) > SILENT_AFTER:
            return (
                TROUBLE,
                (
                    f'the Imu stamps are {abs(lead):.1f} s {"ahead of" if lead > 0 else "behind"}'
                    ' the joint stamps; bring the clocks together'
                ),
            )
        if stamping is not None and stamping.word == IRREGULAR:
            return (
                TROUBLE,
                (
                    f'{stamping}: sampling times are unknown; the driver should stamp by the'
                    " sensor's clock"
                ),
            )
        if self._unstamped_at is not None and now - self._unstamped_at < RECENT_SECONDS:
            notes = ', '.join(f'{count} {reason}' for reason, count in self._notes.items())
            return TROUBLE, f'{notes}: the driver sets none, the time of arrival is used'
        losses = self._recent_losses(now)
        if losses:
            return TROUBLE, f'dropped lately: {losses}'
        return GOOD, f'{" and ".join(MESSAGES[name] for name in self._needed)} messages come'
