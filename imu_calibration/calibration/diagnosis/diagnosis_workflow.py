"""The result of a diagnosis, and its lines of text."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from imu_calibration.calibration.diagnosis.diagnosis_result import (
    Candidate,
    Diagnosis,
    diagnosis_mapping,
)
from imu_calibration.calibration.diagnosis.findings import (
    DISAGREED,
    IMPOSSIBLE,
    LEAVES_MOST,
    REPLACED,
    UNCERTAIN,
)
from imu_calibration.core.units import error_text
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.verdict import motion_misfits, unsteady
from imu_calibration.effects.base import UNITS, Effect
from imu_calibration.effects.reference_effects import total_lags
from imu_calibration.selection.gain import Gain
from imu_calibration.selection.onset import Onset
from imu_calibration.selection.search import MIN_GAIN_NATS
from imu_calibration.selection.unexplained import Unexplained

MOST_SHOWN = 3
"""Parameters of a change that are printed."""
WHY_NOT = {
    LEAVES_MOST: (
        'most of the unexplained residual remains with it, so that both may have another cause'
    ),
    DISAGREED: (
        'the windows do not agree on it: the evidence comes from few windows, or some contradict'
        ' it; record more windows of the same motions'
    ),
    REPLACED: 'a formula, a place or the temperature explains the same part of the residual',
    UNCERTAIN: (
        'none of its coefficients is significant in the calibration with all uncertainties; record'
        ' motions that separate them'
    ),
    IMPOSSIBLE: 'its size is impossible for such a sensor, or within the steps of the encoders',
}
"""Verdict on a significant effect -> reason why it is no finding."""


@dataclass(frozen=True, eq=False)
class DiagnosisResult:
    """A diagnosis with the content of its files and its report."""

    diagnosis: Diagnosis
    """Findings, candidates and unexplained residuals."""
    calibration: Calibration
    """The extended calibration; that of the baseline without findings."""
    tolerances: np.ndarray
    """Tolerance of each parameter of the extended model."""
    needed: dict[str, tuple[str, float]]
    """As in `CalibrationResult`."""
    observations: str
    """Unit of the data: 'windows' or 'poses'."""
    proposed: Calibration | None = None
    """
    The calibration with the formulas proposed for the unexplained residual; None without a formula.
    """
    transferable: Calibration | None = None
    """
    As `proposed`, with only those formulas that compensation undoes and that lower the error on
    held-out windows; None without such one.
    """
    unhelpful: tuple[str, ...] = ()
    """Formulas that compensation undoes, but that do not lower that error."""

    @property
    def document(self) -> dict[str, Any]:
        """Content of diagnosis.json."""
        lags = {}
        for sensor, (value, sd) in self.lags.items():
            lags[sensor] = {'value': value, 'sd': sd, 'unit': 's'}
        return diagnosis_mapping(self.diagnosis) | {'lags': lags, 'notes': self.notes}

    @property
    def lines(self) -> list[str]:
        """The result as lines of text."""
        lines = diagnosis_lines(self.diagnosis)
        for note in (*self.notes, *self.session_terms):
            lines.append(f'note: {note}')
        lags = []
        for sensor, (value, sd) in self.lags.items():
            lags.append(f'the {sensor} by {1e3 * value:.4g} +- {1e3 * sd:.2g} ms')
        if lags:
            lines.append(f'total lag: {", ".join(lags)}')
        return lines

    @property
    def session_terms(self) -> list[str]:
        """Proposed formulas that are not in extended.yaml, a line each."""
        lines = []
        for effect in proposed_effects(self.diagnosis):
            if not is_transferable(effect):
                lines.append(
                    f'{effect.groups[0].text[0]} contains a quantity of this session (time, table):'
                    ' compensation of other recordings cannot undo it, it is left out of'
                    ' extended.yaml'
                )
        for formula in self.unhelpful:
            lines.append(
                f'{formula} does not lower the error on held-out windows in every regime: it is'
                ' left out of extended.yaml'
            )
        return lines

    @property
    def notes(self) -> list[str]:
        """
        Notes on residuals above the noise at rest, and on biases that move between windows.

        They are those of `motion_misfits` and `unsteady`, of sensors whose residual is not
        significant in the diagnosis. An onset explains all of them.
        """
        if self.diagnosis.onset is not None:
            return []
        quiet_sensors = set()
        for sensor, residual in self.diagnosis.unexplained.items():
            if not residual.significant:
                quiet_sensors.add(sensor)
        wandering = unsteady(self.calibration, self.tolerances)
        notes = []
        for reason in (*motion_misfits(self.calibration), *wandering):
            if not quiet_sensors.issuperset(reason.sensors):
                continue
            # Noise that is larger in motion has no effect that could explain it.
            needs_cause = reason in wandering or reason.key == 'diagnose'
            unexplained = '; no effect of the catalogue explains it' if needs_cause else ''
            notes.append(reason.what + unexplained)
        return notes

    @property
    def lags(self) -> dict[str, tuple[float, float]]:
        """
        Sensor -> (total lag of its output, standard deviation), s.

        The total does not depend on the shares of collinear lag effects.
        """
        calibration = self.calibration
        return total_lags(calibration.param_names, calibration.values, calibration.covariance)


def diagnosis_lines(diagnosis: Diagnosis) -> list[str]:
    """
    Return the lines on findings, on the unexplained residuals and on effects without a test.
    """
    lines = timing_lines(diagnosis)
    for number, finding in enumerate(diagnosis.findings, 1):
        lines.append(f'{number}. {finding.title}: {finding.explanation}')
        if finding.indistinguishable_from:
            lines.append(
                '   not separable in this recording from'
                f' {", ".join(finding.indistinguishable_from)}; to separate them:'
                f' {finding.separating_motion}'
            )
    refused = strongest_refused(diagnosis)
    if not diagnosis.findings and not proposed_effects(diagnosis):
        lines.append(nothing_named(diagnosis))
    elif refused is not None:
        lines.append(
            f'refused: {refused.effect} ({_gain_of(refused):.0f} nats on held-out windows):'
            f' {WHY_NOT[refused.verdict]}'
        )
    for sensor, residual in diagnosis.unexplained.items():
        indent = ''
        if residual.significant:
            indent = '   '
            variable = ''
            if residual.correlates_with:
                variable = f'; it correlates with {residual.correlates_with}'
            rms = in_words(residual.rms, sensor, residual.unit)
            lines.append(f'unexplained: {rms} rms in the {sensor}{variable}')
        details = beyond_lines(sensor, residual)
        details += _formula_lines(sensor, residual, diagnosis.formula_gains.get(sensor))
        lines += [indent + line for line in details]
    if diagnosis.not_testable:
        names = [entry['effect'] for entry in diagnosis.not_testable]
        lines.append(f'not testable here: {", ".join(names)}')
    return lines


def timing_lines(diagnosis: Diagnosis) -> list[str]:
    """
    Return the lines on the moment at which parameters change, and on errors of the stamps.
    """
    return [*_onset_lines(diagnosis.onset), *diagnosis.stamp_jitter.lines]


def _onset_lines(onset: Onset | None) -> list[str]:
    """Return the time of a change of parameters, with their values before and after, as lines."""
    if onset is None:
        return []
    # The largest changes of each sensor: their units differ.
    by_size = sorted(onset.before, key=lambda name: -abs(onset.after[name] - onset.before[name]))
    largest = []
    for sensor in sorted({name.partition('.')[0] for name in by_size}):
        of_sensor = [name for name in by_size if name.partition('.')[0] == sensor]
        largest += of_sensor[:MOST_SHOWN]
    # Their values, without the unit 1 of a ratio.
    changes = []
    for name in largest:
        before = in_words(onset.before[name], onset.what, onset.units[name]).removesuffix(' 1')
        after = in_words(onset.after[name], onset.what, onset.units[name]).removesuffix(' 1')
        changes.append(f'{name} {before} before, {after} after')
    values = '; '.join(changes)

    # The axes of each sensor that change.
    axes_of_sensors = []
    for sensor, axes in onset.sensor_axes.items():
        if axes:
            axes_of_sensors.append(f'{sensor} {" and ".join(axes)}')
    where = f' ({", ".join(axes_of_sensors)})' if axes_of_sensors else ''
    lines = [
        f'change at {onset.time:.1f} +- {onset.time_sd:.1g} s of {onset.what}{where}: {values}',
        (
            f'   it explains {100 * onset.share:.0f} % of the residual; other results: of the'
            ' longer part; record again without the change'
        ),
    ]
    if onset.temperature_c is not None:
        lines.append(
            f'   the temperature passed {onset.temperature_c:.1f} degC at this moment only: a step'
            ' above or below it is not separable in this recording'
        )
    return lines


def beyond_lines(sensor: str, residual: Unexplained) -> list[str]:
    """Return the axes, conditions and tones of an unexplained residual, as lines."""
    lines = []
    if residual.axes:
        lines.append(f'{sensor} axis {" and ".join(residual.axes)}')
    for regime in residual.regimes:
        share = f'{100 * regime.share:.0f} % of it'
        lines.append(f'where: {sensor} {regime.axis}, {regime.text} ({share})')
    for tone in residual.tones:
        lines.append(f'spectrum: {tone.text}')
    return lines


def _formula_lines(sensor: str, residual: Unexplained, gain: Gain | None) -> list[str]:
    """Return the formula that an unexplained residual follows and its gain, as lines."""
    if residual.proposal is None or gain is None:
        return []
    # The interval of the reduction is that of the rms with noise, as for effects of the catalogue.
    share = ' to '.join(f'{100 * end:.2g}' for end in gain.ci95)
    before = in_words(gain.heldout_rms_before, sensor)
    after = in_words(gain.heldout_rms_after, sensor)
    rms_beyond_noise = [in_words(rms, sensor) for rms in gain.beyond_noise]
    return [
        f'formula: {residual.proposal.sentence}',
        (
            f'gain of the formula: {gain.of} ({sensor}, held-out {gain.measure}, rms) {before}'
            f' before, {after} after, a reduction of {share} % (95 %); beyond the noise at rest'
            f' {rms_beyond_noise[0]} before, {rms_beyond_noise[1]} after'
        ),
    ]


def proposed_effects(diagnosis: Diagnosis) -> list[Effect]:
    """Return the formulas of a diagnosis as effects."""
    effects: list[Effect] = []
    for residual in diagnosis.unexplained.values():
        if residual.proposal is not None:
            effects += residual.proposal.effects
    return effects


def is_transferable(effect: Effect) -> bool:
    """
    Return whether compensation of another recording can undo an effect.

    Time, joints and attitude of another session are unknown to it. A model with such a formula
    would divide the error between the formula, which is not applied, and bias and matrix.
    """
    return effect.compensation == 'exact'


def nothing_named(diagnosis: Diagnosis) -> str:
    """
    Return the reason for a diagnosis without findings.

    No effect exceeds noise, or the best one is refused.
    """
    refused = strongest_refused(diagnosis)
    if refused is None:
        return 'nothing found: no effect of the catalogue explains more than noise'
    return (
        f'nothing named: {refused.effect} explains much ({_gain_of(refused):.0f} nats on held-out'
        f' windows), but {WHY_NOT[refused.verdict]}'
    )


def strongest_refused(diagnosis: Diagnosis) -> Candidate | None:
    """
    Return the refused effect with the largest gain in addition to the findings.

    None where no refused effect is significant.
    """
    refused = []
    for candidate in diagnosis.candidates:
        if candidate.verdict in WHY_NOT and _gain_of(candidate) > MIN_GAIN_NATS:
            refused.append(candidate)
    return max(refused, key=_gain_of, default=None)


def _gain_of(candidate: Candidate) -> float:
    """Return the held-out gain in addition to the findings, of a finding to the baseline, nats."""
    return candidate.gain_alone if candidate.gain_beside is None else candidate.gain_beside


def in_words(value: float, sensor: str, unit: str | None = None) -> str:
    """Return a specific force or rate, or a value in another unit, in people's units."""
    return error_text(value, unit or UNITS[sensor])
