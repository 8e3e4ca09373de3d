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
from imu_calibration.nodes.message_compensation import WITHHELD
from imu_calibration.preprocessing.stamping import COUNTED, REGULAR

SERIOUS = ('frame_id', 'not an Imu message', 'failed')
"""Prefixes of the reasons for which no message of a stream can be corrected."""
QUIET = 2.0
"""Seconds without a message after which diagnostics report it."""
ANOTHER_RATE = 0.1
"""Relative change of the period from which the stamps are worth another line."""
COLD = 10.0
"""Seconds without a temperature after which diagnostics report it; drivers send one per second."""
HEALTH_LEVELS = {WAITING: OK, HOLDS: OK, FOLLOWED: OK, MOVED: WARN, HARMS: ERROR, UNIT: ERROR}
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
        self._node, self._counts = node, {}
        self._received = 0
        self._last_change = monotonic()
        self._last_source = ''
        self._last_stamps: tuple[Any, int] | None = None
        self._temperature: float | None = None
        self._temperature_at = monotonic()
        self._unusable_temperatures = ''
        self._stamps_at = -np.inf
        self._publisher = DiagnosticsPublisher(node, self.collect)

    def publish_now(self) -> None:
        """Publish the present state at once."""
        self._publisher.publish_now()

    def note_temperature(self, temperature_c: float) -> bool:
        """
        Record a temperature.

        Return whether it is usable: finite, and by its magnitude in degrees Celsius.
        """
        if not np.isfinite(temperature_c) or temperature_c > HOTTEST_C:
            self._unusable_temperatures = (
                f'in degrees Celsius, {temperature_c:.1f} is kelvin'
                if temperature_c > HOTTEST_C
                else 'finite'
            )
            return False
        self._temperature, self._temperature_at = temperature_c, monotonic()
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
        notes += self._stream(compensation) + [
            line for each in node.inputs for line in each.faults()
        ]
        node.complaints.now('compensation', notes, serious)
        doubts = (
            [compensation.slope.doubt]
            if compensation is not None and compensation.slope.doubt
            else []
        )
        node.complaints.now('stamps', doubts, patience=REMINDER)
        notes += doubts
        adopted: Adopted | None = node.adopted
        notes += [] if adopted is None else adopted.caveats

        # The worst of them is the level.
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

    def _health(self, compensation, frame_id):
        """Return a status with the validity of the calibration; log the loss of validity."""
        if compensation is None:
            return []
        state = compensation.watch.health.state
        warm = (
            []
            if compensation.needs_temperature or self._temperature is None
            else outside_conditions(compensation.calibration, temperature_c=[self._temperature])
        )
        level = max(HEALTH_LEVELS[state.word], WARN if warm else OK)
        grave = HEALTH_LEVELS[state.word] == ERROR
        doubts = [state.message] if HEALTH_LEVELS[state.word] == WARN else []
        faults = [state.message] if grave else []
        self._node.complaints.now('health', doubts, faults, replaces=True)
        self._node.complaints.now('conditions', warm)
        return [
            make_status(
                level,
                'health',
                '; '.join([state.message, *warm]),
                values={'outcome': state.word, **state.values},
                hardware_id=frame_id,
            )
        ]

    def _stream(self, compensation):
        """Return the faults of the message stream, and log its source when it begins."""
        node = self._node
        received = self._node.uncorrected + (0 if compensation is None else compensation.received)
        if received != self._received:
            self._received, self._last_change = received, monotonic()
            source = node.imu.source()
            if source != self._last_source and node.imu.publishers:
                self._last_source = source
                node.get_logger().info(f'Imu messages are received on {source}')
        self._tell_stamps(compensation)
        return [node.imu.silence()] if monotonic() - self._last_change > QUIET else []

    def _tell_stamps(self, compensation):
        """Log a change of the kind or of the regular rate of the stamps, at most once a minute."""
        line = None if compensation is None else compensation.slope.line
        if line is None:
            return
        rate = 0
        if line.word == REGULAR:  # the other lines state no rate
            rate = round(np.log(line.period_ns) / ANOTHER_RATE)
        shown = (line.word, rate)
        if shown == self._last_stamps:
            return
        if line.word == COUNTED or self._last_stamps is not None:
            if monotonic() - self._stamps_at < REMINDER:
                return  # logged later if it lasts
            self._stamps_at = monotonic()
            self._node.get_logger().info(str(line))
        self._last_stamps = shown

    def _uncorrected(self):
        """Return what happens to messages without a calibration."""
        if self._node.settings.passthrough:
            return 'messages pass unchanged'
        return 'nothing is published'

    def _unready(self):
        """Return which calibration is in progress while there is none and no fault; else ''."""
        node = self._node
        if node.unready or node.problem or node.awaited or node.adopted is not None:
            return node.unready
        if node.settings.takes_topic and node.documents.publishers:
            return f'{", ".join(node.documents.names())} has not sent a calibration yet'
        return ''

    def _lines(self, compensation, unready):
        """Return (faults that prevent correction, notes), one line each."""
        node = self._node
        serious = [node.corrected_already] if node.corrected_already else []
        if node.problem:
            serious.append(
                node.problem
                + (f'; calibration {node.adopted.version} remains in use' if node.adopted else '')
            )
        if compensation is None:
            if unready:
                return serious, []
            what = self._uncorrected()
            waiting = (
                f'waiting for {node.awaited}; {what}'
                if node.awaited
                else f'waiting for a calibration, {what}'
            )
            return (serious + [waiting], []) if node.problem else (serious, [waiting])
        if compensation.gate is not None and compensation.gate.error is not None:
            serious.append(f'nothing is published: {compensation.gate.error}')
        notes = []
        for reason, count in self._new_counts(compensation).items():
            (serious if reason.startswith(SERIOUS) else notes).append(
                self._line(reason, compensation)
            )
        return serious, notes + self._outside(compensation) + self._warmth(compensation)

    def _new_counts(self, compensation):
        """
        Return the reasons whose counts exceed their earlier maximum.

        The counts of a new compensation start at zero.
        """
        counts = dict(compensation.counts)
        new = {
            reason: count for reason, count in counts.items() if count > self._counts.get(reason, 0)
        }
        self._counts |= new
        return new

    def _line(self, reason, compensation):
        if reason.startswith('frame_id'):
            return (
                f"messages carry {reason}, the calibration is for '{compensation.frame_id}': they"
                ' are not corrected'
            )
        return TEXT_OF_REASON.get(reason, f'{reason}: these messages are not published')

    def _outside(self, compensation):
        fastest, compensation.fastest_squared = sqrt(compensation.fastest_squared), 0.0
        temperature = (
            None
            if not compensation.needs_temperature or compensation.warming is None
            else [compensation.warming + compensation.calibration.model.temperature_ref_c]
        )
        return outside_conditions(compensation.calibration, fastest, temperature)

    def _warmth(self, compensation):
        """Return the faults of the temperature, when the calibration needs one."""
        node = self._node
        if not compensation.needs_temperature or node.temperature is None:
            return []
        lines = []
        if self._unusable_temperatures:
            lines.append(
                f'temperatures on {node.temperature.topic_name} must be'
                f' {self._unusable_temperatures}: they are ignored; correct the driver'
            )
            self._unusable_temperatures = ''
        if monotonic() - self._temperature_at > COLD:
            last = (
                'none received yet'
                if self._temperature is None
                else f'the last one, {self._temperature:.1f} C, remains in use'
            )
            lines.append(f'{node.temperature.silence()}; {last}')
        return lines

    def _values(self):
        node, adopted = self._node, self._node.adopted
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
        calibration, compensation = adopted.calibration, adopted.compensation
        values |= {
            'decision': decisions_text(calibration.decisions),
            'not corrected': ', '.join(adopted.used.refused) or 'none',
            'date': calibration.conditions.get('date', ''),
            **parameter_count(calibration).figures,
            'messages': compensation.received,
            'corrected': compensation.corrected,
            **compensation.counts,
        }
        line, derivative = compensation.slope.line, compensation.slope.derivative
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
