"""Use cases of diagnosis as plain functions: on a table and by hand; what they find in lines for people."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from imu_calibration.beyond.unexplained import Unexplained, biases_off
from imu_calibration.by_hand.inquiry import too_few_poses
from imu_calibration.by_hand.workflow import evident_result, read_by_hand
from imu_calibration.calibration.by_evidence import baseline_options, calibrate_by_evidence
from imu_calibration.calibration.calibrate import conclude, solve_recordings
from imu_calibration.calibration.document import Calibration
from imu_calibration.calibration.model_changes import Demand
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.verdict_notes import unsteady
from imu_calibration.diagnosis.by_hand.diagnose import told_by_hand
from imu_calibration.diagnosis.diagnose import told
from imu_calibration.diagnosis.document import to_mapping
from imu_calibration.diagnosis.result import Diagnosis
from imu_calibration.diagnosis.sentences import DISAGREED, LEAVES_MOST
from imu_calibration.effects.base import SENSORS, UNIT, Effect, Role
from imu_calibration.effects.lags import total_lags
from imu_calibration.effects.named_models import BARE
from imu_calibration.preflight.checks import Preflight
from imu_calibration.reference.table import Table
from imu_calibration.selection.investigation import too_few_windows
from imu_calibration.units import for_people, significant

MUCH = 100.0
"""Gain of held-out log likelihood from which an effect that is refused is worth a word, nats."""
WHY_NOT = {LEAVES_MOST: 'leaves most of the rest, so that something else may be the cause of both',
           DISAGREED: 'the windows do not agree on it: a few carry it, or some speak against it; '
           'more windows of the same motions would settle it'}
"""Verdict on what explains much -> why it is not named."""


@dataclass(frozen=True, eq=False)
class DiagnosisResult:
    """A diagnosis with everything that is written and shown."""

    diagnosis: Diagnosis
    """What was found."""
    calibration: Calibration
    """The extended calibration; the baseline's when nothing was found."""
    tolerances: np.ndarray
    """Tolerance of each parameter of the extended model."""
    needed: dict[str, tuple[str, float]]
    """As in `CalibrationResult`."""
    observations: str
    """What the data consist of: 'windows' or 'poses'."""
    options: CalibrationOptions
    """What was asked for."""
    proposed: Calibration | None = None
    """The calibration with the formulas that are proposed for what stays unexplained, where there are any."""

    @property
    def document(self) -> dict[str, Any]:
        """Return the content of diagnosis.json."""
        lags = {sensor: {'value': value, 'sd': sd, 'unit': 's'} for sensor, (value, sd) in self.lags.items()}
        return to_mapping(self.diagnosis) | {'lags': lags, 'notes': self.notes}

    @property
    def lines(self) -> list[str]:
        """What was found, in lines for people."""
        words = [f'the {sensor} by {1e3 * value:.4g} +- {1e3 * sd:.2g} ms' for sensor, (value, sd) in self.lags.items()]
        lag = [f'lag in all, however it is told: {", ".join(words)}'] * bool(words)
        return [*diagnosis_lines(self.diagnosis), *(f'note: {note}' for note in self.notes), *lag]

    @property
    def notes(self) -> list[str]:
        """What is neither a finding nor a rest: a bias that steps, or wanders, on every axis passes for the noise of its sensor."""
        quiet = {sensor for sensor, rest in self.diagnosis.unexplained.items() if not rest.significant}
        return [f'{reason.what}; no effect of the catalogue says why: it steps or wanders'
                for reason in unsteady(self.calibration, self.tolerances) if quiet.issuperset(reason.sensors)]

    @property
    def lags(self) -> dict[str, tuple[float, float]]:
        """Sensor -> (what its output lags by in all, standard deviation), s: where halves share it out otherwise this repeats."""
        found = self.calibration
        return total_lags(found.param_names, found.values, found.covariance)


def diagnose_recording(source: Callable, table: Table, options: CalibrationOptions = CalibrationOptions(), *,
                       provenance: dict[str, Any] | None = None, progress: Callable | None = None) -> DiagnosisResult:
    """
    Calibrate a recording, say what the model gets wrong and why, and extend it.

    Parameters
    ----------
    source : callable
        Returns an iterator of SampleBlock, each time anew.
    table : Table
    options : CalibrationOptions
        The model to start from; where nothing is asked for, bias and matrix alone, so that everything else has to prove itself.
    provenance : dict, optional
    progress : callable, optional
        Called with the percent done since the last call.

    Returns
    -------
    DiagnosisResult

    """
    windows = []

    def read(step, numbered):
        return [step.read(source(), session, Preflight(table.gravity_value), windows=windows if not windows else None) for session,
                source in numbered]
    report = _percent(progress) if progress else None
    calibrated = calibrate_by_evidence([source], table, replace(options, as_asked=False), provenance=provenance, asking=report, mapper=read)
    if calibrated.found is None:
        raise too_few_windows(len(calibrated.result.gathered.spreads[0].windows))
    result, diagnosis = calibrated.result, told(windows, table, calibrated.found, calibrated=calibrated.result.solution)
    proposed = _with_proposals(source, table, options, result, diagnosis, provenance)
    if report:
        report(1.0)
    return DiagnosisResult(diagnosis, result.calibration, result.tolerances, result.needed, result.observations, baseline_options(options),
                           proposed)


def _with_proposals(source, table, options, result, diagnosis, provenance):
    """Return the calibration of the model that was found with the proposed formulas in it, or None where there are none."""
    effects = proposed_effects(diagnosis)
    if not effects:
        return None
    model = result.calibration.model
    catalogue = model.catalogue.with_effects(*effects)
    texts = {sensor: '+'.join([*(e.name for e in model.effects if e.sensor == sensor and e.role is not Role.LIMIT),
                               *(e.name for e in effects if e.sensor == sensor)]) for sensor in (*SENSORS, 'reference')}
    chosen = replace(options, accelerometer_model=texts['accelerometer'], gyroscope_model=texts['gyroscope'],
                     reference_model=texts['reference'] or 'none', catalogue=catalogue, as_asked=True)
    solution, gathered, gathered_model = solve_recordings([source], table, chosen)
    # A formula says how the output changes, not where what it stands for is nothing.
    unsure = Demand(moves=tuple((moved, 1.0) for moved in biases_off(model, diagnosis.unexplained)))
    return conclude(unsure.applied(solution), gathered, gathered_model, table=table, options=chosen, provenance=provenance).calibration


def diagnose_without_table(source: Callable, options: CalibrationOptions = CalibrationOptions(), provenance: dict[str, Any] | None = None,
                           *,
                           progress: Callable | None = None) -> DiagnosisResult:
    """
    Calibrate a recording by hand, say what the model gets wrong and why, and extend it (see `diagnosis.by_hand`).

    Parameters
    ----------
    source : callable
        Returns an iterator of SampleBlock.
    options : CalibrationOptions
        The model to start from; where nothing is asked for, bias and matrix alone.
    provenance, progress : optional
        As in `diagnose_recording`.

    Returns
    -------
    DiagnosisResult

    """
    preflight = Preflight(options.gravity)
    recording = read_by_hand(source(), options.nominal, [preflight])
    report = _percent(progress) if progress else None
    result, evident = evident_result(recording, replace(options, as_asked=False), provenance, findings=preflight.findings, progress=report)
    if evident.found is None:
        raise too_few_poses(len(evident.hand.poses.start))
    if report:
        report(1.0)
    return DiagnosisResult(told_by_hand(evident.found, evident.hand), result.calibration, result.tolerances, result.needed,
                           result.observations,
                           replace(options, accelerometer_model=options.accelerometer_model or BARE,
                                   gyroscope_model=options.gyroscope_model or BARE))


def _percent(advance):
    """Return a function of the share done that calls `advance` with what was added, in percent."""
    done = [0.0]

    def report(share):
        advance(100 * share - done[0])
        done[0] = 100 * share
    return report


def diagnosis_lines(diagnosis: Diagnosis) -> list[str]:
    """Return findings, what stays unexplained and what could not be tested, as lines."""
    lines = []
    for number, finding in enumerate(diagnosis.findings, 1):
        lines.append(f'{number}. {finding.title}: {finding.explanation}')
        if finding.indistinguishable_from:
            lines.append(f'   this recording cannot tell it from {", ".join(finding.indistinguishable_from)}; '
                         f'to separate them: {finding.separating_motion}')
    if not diagnosis.findings:
        lines.append(nothing_named(diagnosis))
    for sensor, rest in diagnosis.unexplained.items():
        if rest.significant:
            with_what = f'; it goes with {rest.correlates_with}' if rest.correlates_with else ''
            lines.append(f'unexplained: {in_words(rest.rms, sensor, rest.unit)} rms in the {sensor}{with_what}'
                         + (f'; {rest.where}' if rest.where else ''))
        lines += [f'   {line}' if rest.significant else line for line in beyond_lines(sensor, rest)]
    if diagnosis.not_testable:
        lines.append('not testable here: ' + ', '.join(entry['effect'] for entry in diagnosis.not_testable))
    return lines


def beyond_lines(sensor: str, rest: Unexplained) -> list[str]:
    """Return where a rest sits and what formula it follows, as lines."""
    lines = [f'axis {" and ".join(rest.axes)}'] * bool(rest.axes)
    lines += [f'where: {sensor} {regime.axis}, {regime.text} ({100 * regime.share:.0f} % of it)' for regime in rest.regimes]
    lines += [f'spectrum: {tone.text}' for tone in rest.tones]
    return lines + ([f'formula: {rest.proposal.sentence}'] if rest.proposal is not None else [])


def proposed_effects(diagnosis: Diagnosis) -> list[Effect]:
    """Return the formulas that a diagnosis proposes, as effects."""
    return [effect for rest in diagnosis.unexplained.values() if rest.proposal is not None for effect in rest.proposal.effects]


def nothing_named(diagnosis: Diagnosis) -> str:
    """Return why nothing was named: nothing explains more than noise, or what explains much is not sure to be the cause."""
    much = [row for row in diagnosis.candidates if row.verdict in WHY_NOT and row.gain_alone > MUCH]
    if not much:
        return 'nothing found: no effect of the catalogue explains more than noise does'
    return (f'nothing named: {much[0].effect} explains much ({much[0].gain_alone:.0f} nats on held-out windows), '
            f'but {WHY_NOT[much[0].verdict]}')


def in_words(value: float, sensor: str, unit: str | None = None) -> str:
    """Return a specific force or rate, or a value in another unit, in people's units."""
    factor, unit = for_people(unit or UNIT[sensor])
    return f'{significant(value * factor)} {unit}'
