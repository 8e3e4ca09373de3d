"""The decision per sensor, from its error on held-out data: does the calibration help?"""

from collections.abc import Iterable, Mapping
from enum import StrEnum
from typing import Any

from imu_calibration.core.units import error_text
from imu_calibration.effects.base import SENSORS

HARM = 1.05
"""Factor on the error of a regime from which it is named, where the interval lies above 1 too."""
LATE = 1e-3
"""Delays from this size on are named as a cause, s."""
AT_REST = 0.7
"""An error at rest of at least this share of the total is attributed to the bias."""
DELAY_SHARE = 0.1
"""A delay is named as a cause where it explains this share of the residual."""
OTHER_ATTITUDES = '; unproven for other attitudes, because all held-out windows have the same attitude'
NO_PROOF = 'its error on held-out data was not measured'


class SensorDecision(StrEnum):
    """Whether the calibration of a sensor helps; stored as text in a document."""

    HELPS = 'helps'
    """The 95 % interval of error after / error before lies below 1."""
    UNPROVEN = 'unproven'
    """The interval includes 1, there is none, or the held-out windows of the accelerometer have one attitude."""
    HARMS = 'harms'
    """The interval lies above 1."""


HELPS, UNPROVEN, HARMS = SensorDecision
BY_DEFINITION: dict[str, Any] = {'decision': dict.fromkeys(SENSORS, str(HELPS)),
                                 'decision_reasons': dict.fromkeys(SENSORS, 'the true parameters of a simulation')}
"""Fields of the Calibration with which a session was simulated."""
_CAUTION = (HELPS, UNPROVEN, HARMS)


def decide(entry: Mapping | None) -> SensorDecision:
    """Return the decision on a sensor from its entry of a proof (`proof.prove`), or from None."""
    if not entry or not entry['windows'] or entry.get('one_attitude'):
        return UNPROVEN
    low, high = entry['ci95']
    return HELPS if high < 1.0 else HARMS if low > 1.0 else UNPROVEN


def most_cautious(decisions: Iterable[SensorDecision]) -> SensorDecision:
    """Return the worst of several decisions; HELPS without any."""
    return max(decisions, key=_CAUTION.index, default=HELPS)


def decisions_text(decisions: Mapping[str, SensorDecision]) -> str:
    """Return the decisions on the sensors in one phrase; '' without any."""
    words = set(decisions.values())
    return str(*words) if len(words) == 1 else ', '.join(f'{sensor} {word}' for sensor, word in decisions.items())


def reason_of(entry: Mapping | None) -> str:
    """Return the reason for `decide`: errors before and after, the interval of their ratio, and where it does not help the likely cause."""
    if not entry or not entry['windows']:
        return NO_PROOF
    earlier = entry.get('earlier')
    more = f', {error_text(earlier["after"], entry["unit"])} with the earlier calibration' if earlier else ''
    cause = OTHER_ATTITUDES if entry.get('one_attitude') else '' if decide(entry) is HELPS else _cause(entry)
    return (f'{_errors(entry, entry["unit"])} on held-out data ({entry["windows"]} windows, after / before {ratio_text(entry)})'
            f'{more}{cause}')


def worse_regimes(entry: Mapping) -> list[str]:
    """Return a line for each regime in which the error grows."""
    return [f'{_errors(part, part.get("unit", entry["unit"]))} on held-out data of the regime {name} (after / before {ratio_text(part)})'
            for name, part in harmed(entry).items()]


def harmed(entry: Mapping) -> dict[str, Any]:
    """Return {regime: entry} of the regimes of a proof in which the error grows."""
    return {name: part for name, part in (entry.get('regimes') or {}).items() if part['after'] > HARM * part['before']
            and part['ci95'][0] > 1.0}


def helps_everywhere(entry: Mapping | None) -> bool:
    """Return whether an entry of a proof shows a smaller error in total and in each regime."""
    if decide(entry) is not HELPS or entry is None:
        return False
    return not any(part['after'] >= part['before'] or part['ci95'][1] >= 1.0 for part in (entry.get('regimes') or {}).values())


def _errors(entry, unit):
    return f'error {error_text(entry["before"], unit)} to {error_text(entry["after"], unit)}'


def ratio_text(entry: Mapping) -> str:
    """Return the interval of error after / error before as it is printed everywhere."""
    low, high = entry['ci95']
    return f'{low:.2g} to {high:.2g}'


def _cause(entry):
    """Return the most likely cause as the end of a sentence."""
    late, share = entry.get('delay_s', 0.0), entry.get('delay_explains', 0.0)
    if abs(late) > LATE and share > DELAY_SHARE:
        side = 'late' if late > 0 else 'early'
        return f'; likely cause: the readings are {abs(late) * 1e3:.0f} ms {side}, which the model does not include'
    regimes = entry.get('regimes') or {}
    rest = regimes.get('rest', {'after': 0.0})
    if 'rest' in harmed(entry) or rest['after'] > AT_REST * entry['after'] > 0.0 and rest.get('unit', entry['unit']) == entry['unit']:
        return '; likely cause: the bias has changed'
    if regimes and set(harmed(entry)) == {'angular acceleration'}:
        return '; likely cause: the error correlates with angular acceleration: a lever arm, a varying lag, a loose mount'
    if entry['after'] < HARM * entry['before']:
        return '; likely cause: the error is close to the smallest that this recording can show, or the parameters change during it'
    return '; likely cause: parameters that this motion hardly determines are biased by an effect that the model does not include'
