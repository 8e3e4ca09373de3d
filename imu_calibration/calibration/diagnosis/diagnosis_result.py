"""Result of a diagnosis: findings, candidates, solutions, residuals."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from imu_calibration.core.documents import json_types
from imu_calibration.effects.base import UNITS
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import Solution
from imu_calibration.selection.gain import Gain
from imu_calibration.selection.stamp_jitter import NO_JITTER, StampJitter
from imu_calibration.selection.unexplained import Unexplained


class ParameterEstimate(NamedTuple):
    """Estimate of one parameter, SI."""

    value: float
    sd: float
    unit: str


@dataclass(frozen=True, eq=False)
class Finding:
    """One effect that is missing in the model."""

    effect: str
    """Published name."""
    sensor: str
    """'accelerometer', 'gyroscope' or 'reference'."""
    explanation: str
    """One sentence for a test engineer, with the size."""
    parameters: dict[str, ParameterEstimate]
    """Parameter name -> its estimate from all windows."""
    p_value: float
    """
    Probability of such a decrease of the misfit from noise, times the number of effects under test.
    """
    heldout_gain: float
    """Gain of log likelihood on held-out windows, nats."""
    share: float
    """Share of the unexplained residual that it removes from held-out windows."""
    gain: Gain
    """
    `gain.Gain` on windows held out from the choice, of this finding in addition to the earlier
    ones.
    """
    indistinguishable_from: tuple
    """Effects that are collinear with it in this recording, at most two."""
    separating_motion: str
    """Motion that separates them; empty without such an effect."""
    against: tuple = ()
    """Variables of its residual plot, as in ``Effect.against``."""
    sizes_of_mates: dict = field(default_factory=dict)
    """
    Each of `indistinguishable_from` -> parameter name -> (value, unit), SI: its estimate in the
    place of the finding.
    """
    implausible: bool = False
    """Whether its size exceeds the known range of such sensors; it is then in no model."""

    @property
    def title(self) -> str:
        """Its name, with the mark where its size is implausible."""
        return self.effect + ' (implausible)' * self.implausible


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect under test."""

    effect: str
    """Published name."""
    sensor: str
    """'accelerometer', 'gyroscope' or 'reference'."""
    gain_alone: float
    """Held-out gain of log likelihood in addition to the baseline, nats."""
    p_value_alone: float
    """Its p-value in addition to the baseline, times the number of effects under test."""
    gain_beside: float | None
    """Held-out gain in addition to the findings, nats; None for a finding."""
    p_value_beside: float | None
    """Its p-value in addition to the findings, times the number of effects under test."""
    verdict: str
    """
    ``found``, ``as good as NAME``, ``not needed beside the findings``, ``no evidence``, or the
    reason of a refusal.
    """


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Result of a diagnosis for reports, documents and nodes."""

    findings: tuple[Finding, ...]
    """Findings in order of strength."""
    unexplained: dict[str, Unexplained]
    """Sensor -> residual that the findings do not explain."""
    candidates: tuple[Candidate, ...]
    """Every effect under test, in order of strength."""
    not_testable: tuple
    """{'effect', 'why', 'needs'} of the effects without a test."""
    baseline: Solution
    """Solution of the baseline model."""
    solution: Any
    """Solution of the extended model on all windows; the baseline's without findings."""
    gain: Gain | None
    """
    `gain.Gain` of all findings together on windows held out from the choice; None by hand without
    findings.
    """
    windows: int
    """Windows used."""
    locked: int
    """Windows held out from the choice of effects."""
    traces: Any = None
    """`traces.Traces`: residuals before and after, for plots; None during a live session."""
    onset: Any = None
    """
    Parameters that change at one moment (`selection.onset.Onset`), or None; the findings are those
    of the longer part.
    """
    stamp_jitter: StampJitter = NO_JITTER
    """Errors of the stamps from the scatter in motion; by hand none are estimated."""
    formula_gains: dict[str, Gain] = field(default_factory=dict)
    """Sensor with a proposed formula -> the held-out gain of corrected readings by it."""

    @property
    def model(self) -> SensorModel:
        """The extended SensorModel, linearised at the solution."""
        return self.solution.model.at(self.solution.values)


def parameters_of(solution: Solution, sensor: str, effect: str) -> dict[str, ParameterEstimate]:
    """Return parameter name -> its estimate, of one effect."""
    declared = next(e for e in solution.model.effects if (e.sensor, e.name) == (sensor, effect))
    indices = solution.model.slices[sensor, effect]
    values = solution.values[indices]
    sds = np.sqrt(np.maximum(np.diag(solution.covariance)[indices], 0.0))
    parameters = {}
    for k, name in enumerate(declared.param_names()):
        parameters[name] = ParameterEstimate(float(values[k]), float(sds[k]), declared.unit_of(k))
    return parameters


DIAGNOSIS_FORMAT = 'imu_calibration/diagnosis/1'


def diagnosis_mapping(diagnosis: Diagnosis) -> dict[str, Any]:
    """
    Return the content of diagnosis.json.

    It has plain dicts, lists, strings and numbers, None for NaN and infinity.
    """
    baseline = {}
    unexplained = {}
    for sensor, residual in diagnosis.unexplained.items():
        baseline[sensor] = _baseline(diagnosis.baseline, sensor)
        unexplained[sensor] = residual_mapping(
            sensor, residual, diagnosis.formula_gains.get(sensor)
        )
    distances = {}
    for sensor, distance in diagnosis.traces.distances.items():
        distances[sensor] = distance.to_mapping()
    return json_types(
        {
            'format': DIAGNOSIS_FORMAT,
            'baseline': baseline,
            'onset': None if diagnosis.onset is None else diagnosis.onset.to_mapping(),
            'stamp_jitter_s': diagnosis.stamp_jitter.to_mapping().get('sd_s'),
            'findings': [_finding(finding) for finding in diagnosis.findings],
            'gain': None if diagnosis.gain is None else _gain(diagnosis.gain),
            'dead_reckoning': diagnosis.traces.dead_reckoning,
            'simulation_distance': distances,
            'unexplained': unexplained,
            'not_testable': diagnosis.not_testable,
            'candidates': [_candidate(candidate) for candidate in diagnosis.candidates],
            'windows': {'used': diagnosis.windows, 'held_out_for_the_gain': diagnosis.locked},
        }
    )


def _candidate(candidate: Candidate) -> dict[str, Any]:
    """Return an effect under test as plain data."""
    in_addition_to_findings = {
        'heldout_log_likelihood_gain': candidate.gain_beside,
        'p_value': candidate.p_value_beside,
    }
    return {
        'effect': candidate.effect,
        'sensor': candidate.sensor,
        'verdict': candidate.verdict,
        'heldout_log_likelihood_gain': candidate.gain_alone,
        'p_value': candidate.p_value_alone,
        'beside_findings': in_addition_to_findings,
    }


def _baseline(solution: Solution, sensor: str) -> dict[str, Any]:
    """Return effects, residuals and noise of one sensor in the baseline as plain data."""
    model = solution.model
    return {
        'effects': getattr(model, sensor),
        'reference_effects': model.reference,
        'residual_rms': solution.residual_rms[sensor][0],
        'window_mean_rms': solution.residual_rms[sensor][1],
        'noise_rms': np.sqrt(np.mean(solution.noise[sensor].white_variance)),
    }


def _finding(finding: Finding) -> dict[str, Any]:
    """Return a finding as plain data."""
    parameters = {name: entry._asdict() for name, entry in finding.parameters.items()}
    sizes_of_mates: dict[str, dict[str, Any]] = {}
    for mate, sizes in finding.sizes_of_mates.items():
        sizes_of_mates[mate] = {}
        for name, (value, unit) in sizes.items():
            sizes_of_mates[mate][name] = {'value': value, 'unit': unit}
    return {
        'effect': finding.effect,
        'sensor': finding.sensor,
        'explanation': finding.explanation,
        'parameters': parameters,
        'p_value': finding.p_value,
        'heldout_log_likelihood_gain': finding.heldout_gain,
        'share_of_unexplained': finding.share,
        'gain': _gain(finding.gain),
        'indistinguishable_from': finding.indistinguishable_from,
        'sizes_of_mates': sizes_of_mates,
        'separating_motion': finding.separating_motion,
        'implausible': finding.implausible,
    }


def _gain(gain: Gain) -> dict[str, Any]:
    """Return a gain as plain data."""
    names = (
        'sensor',
        'of',
        'measure',
        'heldout_rms_before',
        'heldout_rms_after',
        'reduction',
        'ci95',
        'windows',
    )
    return {name: getattr(gain, name) for name in names}


def residual_mapping(
    sensor: str, residual: Unexplained, formula_gain: Gain | None
) -> dict[str, Any]:
    """
    Return the unexplained residual of a sensor as plain data.

    `sigma` is None where structure makes it significant and not its size. `formula_gain`: gain of
    the formula that the residual follows.
    """
    proposals = []
    if residual.proposal is not None and formula_gain is not None:
        proposals.append(residual.proposal.to_mapping() | {'gain': _formula_gain(formula_gain)})
    return {
        'significant': residual.significant,
        'rms': residual.rms,
        'unit': residual.unit or UNITS[sensor],
        'sigma': None if residual.by_structure else residual.sigma,
        'by_structure': residual.by_structure,
        'correlates_with': residual.correlates_with,
        'share': residual.share,
        'where': '; '.join(regime.text for regime in residual.regimes) or None,
        'axes': residual.axes,
        'regimes': [regime.to_mapping() for regime in residual.regimes],
        'tones': [tone.to_mapping() for tone in residual.tones],
        'proposals': proposals,
    }


def _formula_gain(gain: Gain) -> dict[str, Any]:
    """Return the gain of a formula as plain data, with the rms beyond the noise at rest."""
    before, after = gain.beyond_noise
    return _gain(gain) | {'beyond_noise_before': before, 'beyond_noise_after': after}
