"""What a proof says, in sentences: whether a calibration helps on data that took no part, and what most likely spoils it."""

from collections.abc import Mapping
from typing import Any

from imu_calibration.effects.base import SENSORS

HARM = 1.05
"""A regime is harmed when its error grows by this factor, and the interval says that it does grow."""
LATE = 1e-3
"""Delays from this size on are named as a cause, s."""
AT_REST = 0.7
"""An error at rest of this share of the whole comes from the bias."""
DELAY_SHARE = 0.1
"""They must explain this share of what is left."""


def disproved(proof: Mapping) -> list[str]:
    """Return a line for each sensor whose error on held-out data is not shown to shrink with the calibration, or grows in some motion."""
    lines = []
    for sensor, found in proof.items():
        if sensor not in SENSORS:
            continue
        if not (found['windows'] and found['after'] < found['before'] and found['ci95'][1] < 1.0):
            lines.append(f'on {found["windows"]} windows that took no part the {sensor} error is {found["after"]:.3g} {found["unit"]} '
                         f'with it and {found["before"]:.3g} without ({_ratio(found)}): that it helps is not shown{_cause(found)}')
        elif worse := harmed(found):
            name, part = max(worse.items(), key=lambda item: item[1]['after'] / max(item[1]['before'], 1e-300))
            lines.append(f'on data that took no part ({name}) the {sensor} error is {part["after"]:.3g} {part.get("unit", found["unit"])} '
                         f'with it and {part["before"]:.3g} without ({_ratio(part)}): it makes this motion worse{_cause(found)}')
    return lines


def harmed(found: Mapping) -> dict[str, Any]:
    """Return {regime: entry} of the regimes in which an entry of a proof says that the error grows."""
    return {name: part for name, part in (found.get('regimes') or {}).items() if part['after'] > HARM * part['before']
            and part['ci95'][0] > 1.0}


def helps_everywhere(found: Mapping | None) -> bool:
    """Return whether an entry of a proof is sure that the error shrinks, on the whole and in every motion with windows enough to tell."""
    if not found or not found['windows'] or not found['ci95'][1] < 1.0:
        return False
    return not any(part['after'] >= part['before'] or part['ci95'][1] >= 1.0 for part in (found.get('regimes') or {}).values())


def proven(proof: Mapping) -> list[str]:
    """Return what a proof shows, a line for each sensor."""
    return [f'{sensor} error on data that took no part ({found["windows"]} windows): {found["before"]:.3g} {found["unit"]} without, '
            f'{found["after"]:.3g} with it ({_ratio(found)}){_earlier(found)}' for sensor, found in proof.items()]


def _earlier(found):
    known = found.get('earlier')
    return f', {known["after"]:.3g} with the earlier calibration' if known else ''


def _ratio(found):
    low, high = found['ci95']
    return f'after / before {low:.2f} to {high:.2f}'


def _cause(found):
    """Return the most likely cause as the end of a sentence."""
    late, share = found.get('delay_s', 0.0), found.get('delay_explains', 0.0)
    if abs(late) > LATE and share > DELAY_SHARE:
        return (f'; the likely cause is that the readings come {abs(late) * 1e3:.0f} ms too {"late" if late > 0 else "early"}, '
                'which the model leaves out')
    regimes = found.get('regimes') or {}
    rest = regimes.get('rest', {'after': 0.0})
    if 'rest' in harmed(found) or rest['after'] > AT_REST * found['after'] > 0.0 and rest.get('unit', found['unit']) == found['unit']:
        return '; most likely the bias has moved'
    if regimes and set(harmed(found)) == {'angular acceleration'}:
        return '; the likely cause goes with angular acceleration: a lever arm, a lag that changes, a mount that gives way'
    if found['after'] < HARM * found['before']:
        return '; most likely the sensor is about as good as this recording can show, or its errors change while it is recorded'
    return '; most likely something that the model leaves out has gone into values that this motion hardly shows'
