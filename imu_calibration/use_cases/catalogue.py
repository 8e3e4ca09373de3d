"""The catalogue of effects as a table."""

from os import PathLike
from typing import Any

from imu_calibration.estimation.standard_motions import MOTIONS
from imu_calibration.use_cases.choices import catalogue_of

SHOWN = 3
"""Columns of an equation that are shown."""


def effect_rows(added: str | PathLike | None = None) -> list[dict[str, Any]]:
    """
    Return one mapping per effect: name, sensor, unit, tolerance, compensation, sentence, equation, required data and motion.

    Raises
    ------
    InputError
        When the file of additional effects cannot be used.

    """
    return [_row(effect) for effect in catalogue_of(added).effects().values()]


def _row(effect):
    units = (effect.unit,) if isinstance(effect.unit, str) else tuple(dict.fromkeys(effect.unit))
    needs = [*effect.needs, *(motion.text for motion in MOTIONS if motion.name in effect.motion)]
    return {'effect': effect.name, 'sensor': effect.sensor, 'unit': ', '.join(units), 'tolerance': effect.tolerance,
            'compensation': effect.compensation, 'text': effect.explanation, 'equation': _equation(effect), 'needs': '; '.join(needs)}


def _equation(effect):
    """Return the output of the effect as a sum of coefficients times columns; empty where it changes the reference motion."""
    columns = [text for group in effect.groups for text in group.text]
    if not columns or effect.warp is not None:
        return ''
    shown = ' + '.join(f'k{n} * ({text})' if ' ' in text else f'k{n} * {text}' for n, text in enumerate(columns[:SHOWN], 1))
    return f'output_i += {shown}{f" + ... ({len(columns)} columns)" if len(columns) > SHOWN else ""}'
