"""What compensator_node says about itself."""

import re
from math import sqrt
from time import monotonic

import numpy as np

from imu_calibration.calibration.status import DETERMINED
from imu_calibration.compensation.compensate import outside_conditions
from imu_calibration.nodes.diagnostics import ERROR, OK, WARN, DiagnosticsPublisher, make_status

SERIOUS = ('frame_id', 'not an Imu message')
"""Beginnings of the reasons for which a stream as a whole cannot be corrected."""
QUIET = 2.0
"""Seconds without a message after which diagnostics say so."""
KNOWN = {'no temperature yet': 'the calibration has thermal effects and no temperature came yet: nothing is published',
         'saturated': 'readings are saturated: they are marked by a covariance of the size of the range',
         'not finite': 'readings are not finite: these messages are not published',
         'beyond what can be undone': 'readings are too large for the non-linear effects to be undone: these messages are not published'}


class CompensatorDiagnostics:
    """Collects the state of the node; a line that differs from earlier ones in more than its numbers is logged."""

    def __init__(self, node):
        self._node, self._logged, self._counts = node, set(), {}
        self._received, self._last_change = 0, monotonic()
        self._publisher = DiagnosticsPublisher(node, self.collect)

    def publish_now(self):
        """Publish the present state at once."""
        self._publisher.publish_now()

    def collect(self):
        """Return the list of DiagnosticStatus."""
        node = self._node
        node.look_for_correction()
        compensation = node.compensation
        serious, notes = self._lines(compensation)
        if self._quiet(compensation):
            notes.append(f'no messages come on {node.input_topic}')
        for line in serious + notes:
            kind = re.sub(r'[\d.]+', '#', line)
            if kind not in self._logged:
                self._logged.add(kind)
                node.get_logger().warning(line)
        level = ERROR if serious else WARN if notes else OK
        message = '; '.join(serious + notes) or f'corrected with calibration {node.version}'
        frame = compensation.calibration.frame_id if compensation is not None else ''
        return [make_status(level, 'compensation', message, self._values(compensation), frame)]

    def _quiet(self, compensation):
        received = self._node.uncorrected + (0 if compensation is None else compensation.received)
        if received != self._received:
            self._received, self._last_change = received, monotonic()
        return monotonic() - self._last_change > QUIET

    def _lines(self, compensation):
        """Return (what prevents correction, what should be known), one line each."""
        node = self._node
        serious = [node.corrected_already] if node.corrected_already else []
        if compensation is None:
            what = 'messages pass unchanged' if node.settings.passthrough else 'nothing is published'
            waiting = f'waiting for a calibration, {what}'
            return (serious + [f'{node.problem}; {waiting}'], []) if node.problem else (serious, [waiting])
        notes = [f'{node.problem}; calibration {node.version} stays'] if node.problem else []
        for reason, count in self._new_counts(compensation).items():
            (serious if reason.startswith(SERIOUS) else notes).append(self._line(reason, count, compensation))
        return serious, notes + self._outside(compensation)

    def _new_counts(self, compensation):
        """Return the reasons of which there is more than at the last call."""
        counts = dict(compensation.counts)
        new = {reason: count for reason, count in counts.items() if count > self._counts.get(reason, 0)}
        self._counts = counts
        return new

    def _line(self, reason, count, compensation):
        if reason.startswith('frame_id'):
            return f"messages carry {reason}, the calibration is for '{compensation.frame_id}': they are not corrected"
        return KNOWN.get(reason, f'{reason}: these messages are not published')

    def _outside(self, compensation):
        fastest, compensation.fastest_squared = sqrt(compensation.fastest_squared), 0.0
        temperature = None if not compensation.needs_temperature or compensation.dt is None else \
            np.array([compensation.dt + compensation.calibration.model.temperature_ref_c])
        return outside_conditions(compensation.calibration, np.array([[fastest, 0.0, 0.0]]), temperature)

    def _values(self, compensation):
        node = self._node
        values = {'calibration': node.version or 'none', 'source': node.source,
                  'loop': 'wait set' if node.by_wait_set else 'public executor',
                  'passed or held back without calibration': node.uncorrected}
        if compensation is None:
            return values
        calibration = compensation.calibration
        values |= {'date': calibration.conditions.get('date', ''), 'parameters': len(calibration.status),
                   'not determined': sum(status != DETERMINED for status in calibration.status),
                   'messages': compensation.received, 'corrected': compensation.corrected, **compensation.counts}
        if compensation.period is not None:
            values['period [s]'] = f'{compensation.period:.6g}'
        derivative = compensation.derivative
        if derivative is not None:
            noise = derivative.noise_sd(float(calibration.noise('gyroscope')[0].max()))
            values |= {'derivative window [samples]': derivative.taps, 'derivative delay [s]': f'{derivative.delay:.4g}',
                       'derivative noise [rad/s^2]': f'{noise:.3g}'}
        return values
