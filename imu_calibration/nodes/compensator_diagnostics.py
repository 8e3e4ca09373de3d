"""Status of compensator_node, on /diagnostics and on the terminal."""

from math import sqrt
from time import monotonic
from typing import Any

import numpy as np

from imu_calibration.compensation.compensate import outside_conditions
from imu_calibration.compensation.health import FOLLOWED, HARMS, HOLDS, MOVED, UNIT, WAITING
from imu_calibration.core.units import HOTTEST_C
from imu_calibration.document.decision import decisions_text
from imu_calibration.document.outcome import parameter_count
from imu_calibration.nodes.adoption import Adopted
from imu_calibration.nodes.diagnostics import (
    ERROR,
    OK,
    REMINDER,
    WARN,
    DiagnosticsPublisher,
    make_status,
)
from imu_calibration.nodes.message_compensation import WITHHELD, LiveCompensation
from imu_calibration.preprocessing.stamping import COUNTED, REGULAR

SERIOUS = ('frame_id', 'not an Imu message', 'failed')
"""Prefixes of the reasons for which no message of a stream can be corrected."""
QUIET = 2.0
"""Seconds without a message after which diagnostics report it."""
ANOTHER_RATE = 0.1
"""Relative change of the period from which the stamps are worth another line."""
COLD = 10.0
"""Seconds without a temperature after which diagnostics report it; drivers send one per second."""
HEALTH_LEVELS: dict[str, Any] = {
    WAITING: OK,
    HOLDS: OK,
    FOLLOWED: OK,
    MOVED: WARN,
    HARMS: ERROR,
    UNIT: ERROR,
}
TEXT_OF_REASON = {
    WITHHELD: 'messages before the unit of the readings was known are not published',
    'no temperature yet': (
        'the calibration has thermal effects and no temperature was received: no messages are'
        ' published'
    ),
    'saturated': 'readings are saturated: they are marked by a covariance of the size of the range',
    'not finite': 'readings are not finite: these messages are not published',
    'covariance not finite': (
        "received covariances are invalid (not finite, or a variance below zero): the calibration's"
        ' noise is used'
    ),
    'zero stamp': (
        'the stamps of the driver are zero: times of arrival are used for the angular acceleration'
    ),
    'outside the invertible range': (
        'readings are outside the range in which the non-linear effects can be inverted: not'
        ' published'
    ),
}


class CompensatorDiagnostics:
    """Collects the state of the node; a fault is logged at its beginning and at its end."""

    def __init__(self, node: Any):
        self._node = node
        self._largest_counts: dict[str, int] = {}
        """Reason why messages are not corrected -> largest count so far."""
        self._n_received = 0
        """Messages at the last `collect`."""
        self._last_arrival = monotonic()
        """Time of the last `collect` with new messages, s, on the clock of all times here."""
        self._logged_source = ''
        """Source of the messages in the last log line about it."""
        self._logged_stamps: tuple[Any, int] | None = None
        """Kind of the stamps, and rounded logarithm of their period, in the last log line."""
        self._stamps_logged_at = -np.inf
        """Time of that line."""
        self._temperature: float | None = None
        """Last usable temperature, degrees Celsius."""
        self._temperature_at = monotonic()
        """Time of its reception."""
        self._temperature_fault = ''
        """Requirement that a received temperature did not fulfil; '' after its report."""
        self._publisher = DiagnosticsPublisher(node, self.collect)

    def publish_now(self) -> None:
        """Publish the present state at once."""
        self._publisher.publish_now()

    def note_temperature(self, temperature_c: float) -> bool:
        """
        Record a temperature.

        Return whether it is usable: finite, and by its magnitude in degrees Celsius.
        """
        if temperature_c > HOTTEST_C:
            self._temperature_fault = f'in degrees Celsius, {temperature_c:.1f} is kelvin'
            return False
        if not np.isfinite(temperature_c):
            self._temperature_fault = 'finite'
            return False
        self._temperature = temperature_c
        self._temperature_at = monotonic()
        return True

    def collect(self) -> list:
        """Return the list of DiagnosticStatus."""
        node = self._node
        node.look_for_correction()
        node.return_from_harm()
        compensation = node.compensation

        # Present faults, also for the log; a doubt about stamps is repeated less often.
        unready = self._unready()
        serious, notes = self._lines(compensation, unready)
        self._note_arrivals(compensation)
        self._tell_stamps(compensation)
        if monotonic() - self._last_arrival > QUIET:
            notes.append(node.imu.silence())
        for source in node.inputs:
            notes += source.faults()
        node.complaints.now('compensation', notes, serious)
        doubts = []
        if compensation is not None and compensation.slope.doubt:
            doubts.append(compensation.slope.doubt)
        node.complaints.now('stamps', doubts, patience=REMINDER)
        notes += doubts
        adopted: Adopted | None = node.adopted
        notes += [] if adopted is None else adopted.caveats

        # The worst of them is the level; without any the state is reported.
        level = WARN if notes else OK
        if serious:
            level = ERROR
        good = ''
        if adopted is not None:
            good = (
                f'corrected with calibration {adopted.version}'
                f' ({decisions_text(adopted.calibration.decisions)})'
            )
        elif unready:
            good = f'{unready}; {self._uncorrected()}'
        frame_id = '' if adopted is None else adopted.calibration.frame_id
        return [
            *self._health(compensation, frame_id),
            make_status(
                level,
                'compensation',
                '; '.join(serious + notes) or good,
                values=self._values(),
                hardware_id=frame_id,
            ),
        ]

    def _health(self, compensation: LiveCompensation | None, frame_id: str) -> list:
        """Return the status of the calibration's validity at the last stop; log its loss."""
        if compensation is None or compensation.watch is None:
            return []
        state = compensation.watch.health.state
        # A calibration that needs temperatures reports this in `_outside_lines`.
        conditions = []
        if not compensation.needs_temperature and self._temperature is not None:
            conditions = outside_conditions(
                compensation.calibration, temperature_c=[self._temperature]
            )
        health_level = HEALTH_LEVELS[state.word]
        doubts = [state.message] if health_level == WARN else []
        faults = [state.message] if health_level == ERROR else []
        self._node.complaints.now('health', doubts, faults, replaces=True)
        self._node.complaints.now('conditions', conditions)
        return [
            make_status(
                max(health_level, WARN if conditions else OK),
                'health',
                '; '.join([state.message, *conditions]),
                values={'outcome': state.word, **state.values},
                hardware_id=frame_id,
            )
        ]

    def _note_arrivals(self, compensation: LiveCompensation | None) -> None:
        """Record the time of new messages, and log their source when it has changed."""
        node = self._node
        n_received = node.uncorrected
        if compensation is not None:
            n_received += compensation.received
        if n_received != self._n_received:
            self._n_received = n_received
            self._last_arrival = monotonic()
            source = node.imu.source()
            if source != self._logged_source and node.imu.publishers:
                self._logged_source = source
                node.get_logger().info(f'Imu messages are received on {source}')

    def _tell_stamps(self, compensation: LiveCompensation | None) -> None:
        """
        Log a change of the kind or of the regular rate of the stamps, at most once a minute.

        The first kind is logged only if the stamps are counted.
        """
        line = None if compensation is None else compensation.slope.line
        if line is None:
            return
        rate = 0
        if line.word == REGULAR:  # the other lines state no rate
            rate = round(np.log(line.period_ns) / ANOTHER_RATE)
        stamps = (line.word, rate)
        if stamps == self._logged_stamps:
            return
        if line.word == COUNTED or self._logged_stamps is not None:
            if monotonic() - self._stamps_logged_at < REMINDER:
                return  # logged later if it lasts
            self._stamps_logged_at = monotonic()
            self._node.get_logger().info(str(line))
        self._logged_stamps = stamps

    def _uncorrected(self) -> str:
        """Return the treatment of messages without a calibration, readable."""
        if self._node.settings.passthrough:
            return 'messages pass unchanged'
        return 'nothing is published'

    def _unready(self) -> str:
        """Return a text on a calibration in progress; '' with a calibration or a fault."""
        node = self._node
        if node.unready or node.problem or node.awaited or node.adopted is not None:
            return node.unready
        if node.settings.takes_topic and node.documents.publishers:
            return f'{", ".join(node.documents.names())} has not sent a calibration yet'
        return ''

    def _lines(
        self, compensation: LiveCompensation | None, unready: str
    ) -> tuple[list[str], list[str]]:
        """Return (faults that prevent correction, notes), one line each."""
        node = self._node
        serious = [node.corrected_already] if node.corrected_already else []
        if node.problem:
            in_use = f'; calibration {node.adopted.version} remains in use' if node.adopted else ''
            serious.append(node.problem + in_use)

        if compensation is None:
            if unready:
                return serious, []
            waiting = f'waiting for a calibration, {self._uncorrected()}'
            if node.awaited:
                waiting = f'waiting for {node.awaited}; {self._uncorrected()}'
            # After a refusal waiting is a consequence of the fault.
            if node.problem:
                return serious + [waiting], []
            return serious, [waiting]

        if compensation.gate is not None and compensation.gate.error is not None:
            serious.append(f'nothing is published: {compensation.gate.error}')
        notes = []
        for reason in self._new_reasons(compensation):
            line = self._line(reason, compensation)
            if reason.startswith(SERIOUS):
                serious.append(line)
            else:
                notes.append(line)
        notes += self._outside_lines(compensation)
        notes += self._temperature_lines(compensation)
        return serious, notes

    def _new_reasons(self, compensation: LiveCompensation) -> list[str]:
        """
        Return the reasons whose counts exceed their earlier maximum.

        The counts of a new compensation start at zero.
        """
        reasons = []
        for reason, count in dict(compensation.counts).items():
            if count > self._largest_counts.get(reason, 0):
                self._largest_counts[reason] = count
                reasons.append(reason)
        return reasons

    def _line(self, reason: str, compensation: LiveCompensation) -> str:
        """Return the line about a reason in `counts`."""
        if reason.startswith('frame_id'):
            return (
                f"messages carry {reason}, the calibration is for '{compensation.frame_id}': they"
                ' are not corrected'
            )
        return TEXT_OF_REASON.get(reason, f'{reason}: these messages are not published')

    def _outside_lines(self, compensation: LiveCompensation) -> list[str]:
        """Return lines on rates since the last call and temperatures outside the calibration's."""
        fastest = sqrt(compensation.fastest_squared)
        compensation.fastest_squared = 0.0
        temperatures_c = None
        if compensation.needs_temperature and compensation.warming is not None:
            reference_c = compensation.calibration.model.temperature_ref_c
            temperatures_c = [compensation.warming + reference_c]
        return outside_conditions(compensation.calibration, fastest, temperatures_c)

    def _temperature_lines(self, compensation: LiveCompensation) -> list[str]:
        """Return the faults of the received temperatures where the calibration needs them."""
        node = self._node
        if not compensation.needs_temperature or node.temperature is None:
            return []
        lines = []
        if self._temperature_fault:
            lines.append(
                f'temperatures on {node.temperature.topic_name} must be'
                f' {self._temperature_fault}: they are ignored; correct the driver'
            )
            self._temperature_fault = ''
        if monotonic() - self._temperature_at > COLD:
            last = (
                'none received yet'
                if self._temperature is None
                else f'the last one, {self._temperature:.1f} C, remains in use'
            )
            lines.append(f'{node.temperature.silence()}; {last}')
        return lines

    def _values(self) -> dict[str, Any]:
        """Return the figures of the status 'compensation' by name."""
        node = self._node
        adopted = node.adopted
        values = {
            'calibration': adopted.version if adopted else 'none',
            'source': adopted.source if adopted else '',
            'adopt': node.settings.adopt,
            'refused': node.refusal,
            'loop': 'wait set' if node.by_wait_set else 'public executor',
            'input': node.imu.source(),
            'passed or held back without calibration': node.uncorrected,
        }
        if adopted is None:
            return values
        calibration = adopted.calibration
        compensation = adopted.compensation
        values |= {
            'decision': decisions_text(calibration.decisions),
            'not corrected': ', '.join(adopted.used.refused) or 'none',
            'date': calibration.conditions.get('date', ''),
            **parameter_count(calibration).figures,
            'messages': compensation.received,
            'corrected': compensation.corrected,
            **compensation.counts,
        }
        line = compensation.slope.line
        derivative = compensation.slope.derivative
        if line is not None:
            values |= {'stamps': str(line), 'period [s]': f'{1e-9 * line.period_ns:.6g}'}
        if derivative is not None:
            noise = derivative.noise_sd(float(calibration.noise('gyroscope')[0].max()))
            values |= {
                'derivative window [samples]': derivative.taps,
                'derivative delay [s]': f'{derivative.delay:.4g}',
                'derivative noise [rad/s^2]': f'{noise:.3g}',
            }
        return values
