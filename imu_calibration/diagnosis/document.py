"""The diagnosis as plain data: diagnosis.json."""

from typing import Any

import numpy as np

from imu_calibration.diagnosis.result import Diagnosis, formula_gain
from imu_calibration.effects.base import SENSORS, UNIT

FORMAT = 'imu_calibration/diagnosis/1'


def to_mapping(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the content of diagnosis.json: plain dicts, lists, strings and numbers, None for NaN and infinity."""
    return _plain({
        'format': FORMAT,
        'baseline': {sensor: _baseline(diagnosis.baseline, sensor) for sensor in SENSORS},
        'findings': [_finding(finding) for finding in diagnosis.findings],
        'gain': _gain(diagnosis.gain) if diagnosis.findings else None,
        'dead_reckoning': diagnosis.traces.dead_reckoning,
        'simulation_distance': {sensor: each.to_mapping() for sensor, each in diagnosis.traces.distances.items()},
        'unexplained': {sensor: _rest(sensor, diagnosis.unexplained[sensor], diagnosis.locked) for sensor in SENSORS},
        'not_testable': list(diagnosis.not_testable),
        'candidates': [_candidate(candidate) for candidate in diagnosis.candidates],
        'windows': {'used': diagnosis.windows, 'held_out_for_the_gain': diagnosis.locked}})


def _candidate(candidate):
    beside = {'heldout_log_likelihood_gain': candidate.gain_beside, 'p_value': candidate.p_value_beside}
    return {'effect': candidate.effect, 'sensor': candidate.sensor, 'verdict': candidate.verdict,
            'heldout_log_likelihood_gain': candidate.gain_alone, 'p_value': candidate.p_value_alone, 'beside_findings': beside}


def _baseline(solution, sensor):
    model = solution.model
    return {'effects': list(getattr(model, sensor)), 'reference_effects': list(model.reference),
            'residual_rms': solution.residual_rms[sensor][0], 'window_mean_rms': solution.residual_rms[sensor][1],
            'noise_rms': np.sqrt(np.mean(solution.noise[sensor].white_variance))}


def _finding(finding):
    return {'effect': finding.effect, 'sensor': finding.sensor, 'explanation': finding.explanation,
            'parameters': {name: {'value': value, 'sd': sd, 'unit': unit} for name, (value, sd, unit) in finding.parameters.items()},
            'p_value': finding.p_value, 'heldout_log_likelihood_gain': finding.heldout_gain, 'share_of_unexplained': finding.share,
            'gain': _gain(finding.gain), 'indistinguishable_from': list(finding.indistinguishable_from),
            'sizes_of_mates': {mate: {name: {'value': value, 'unit': unit} for name, (value, unit) in sizes.items()}
                               for mate, sizes in finding.sizes_of_mates.items()},
            'separating_motion': finding.separating_motion, 'implausible': finding.implausible}


def _gain(gain):
    return {'sensor': gain.sensor, 'measure': gain.measure, 'heldout_rms_before': gain.heldout_rms_before,
            'heldout_rms_after': gain.heldout_rms_after, 'reduction': gain.reduction, 'ci95': list(gain.ci95), 'windows': gain.windows}


def _rest(sensor, rest, locked):
    unit = rest.unit or UNIT[sensor]
    return {'significant': rest.significant, 'rms': rest.rms, 'unit': unit, 'sigma': rest.sigma, 'correlates_with': rest.correlates_with,
            'share': rest.share, 'where': rest.where, 'axes': list(rest.axes), 'regimes': [regime.to_mapping() for regime in rest.regimes],
            'tones': [tone.to_mapping() for tone in rest.tones],
            'proposals': [] if rest.proposal is None else [rest.proposal.to_mapping() | {'gain': _gain(formula_gain(rest, locked))}]}


def _plain(value):
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value
