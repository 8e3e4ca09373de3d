"""Effects defined by plain data: a column as text, and its description. They are written to documents and sent to other processes."""

import copyreg
import math
from collections.abc import Sequence
from typing import Any

from imu_calibration.core.errors import InputError
from imu_calibration.effects.base import AXES, SENSORS, VECTOR, Effect
from imu_calibration.effects.coefficients import Amplitudes
from imu_calibration.effects.column_group import ColumnGroup

JOINTS = {'joint angle', 'joint rate'}
"""Quantities that exist only with a table."""
MOTIONS = (('joint angle', ('static_dense', 'slow_turn')), ('joint rate', ('three_speeds',)),
           ('angular acceleration', ('oscillate_x', 'oscillate_y', 'oscillate_z')), ('thermal branch', ('warm_and_cool',)),
           ('vibration', ('shake',)),
           ('temperature', ('warm_up',)), ('time', ('warm_up',)),
           ('rate', ('two_axis', 'three_speeds')), ('force', ('static_dense', 'centrifuge')))
"""Standard motions that show a quantity; the first that a column uses applies."""
DRAWN_AGAINST = {'joint angle': 'angle', 'joint rate': 'angle', 'temperature': 'temperature', 'thermal branch': 'temperature',
                 'time': 'time', 'force': 'force', 'rate': 'rate'}
"""Quantity -> abscissa of the residual plot of a column that uses it; the first applies."""
MANY = 100.0
"""Tolerances in the default standard deviation of the prior."""


def term(name: str, *, sensor: str, column: Sequence[str] | str, unit: str, tolerance: float, text: str,
         tolerance_reason: str = '', prior_sd: float | None = None, largest: float | None = None,
         time_constant: float = 300.0) -> Effect:
    """
    Return an effect ``output_i += value_i column``, with one value for each axis.

    It is defined by this plain data only, which `from_definition` reads.

    Parameters
    ----------
    name : str
        Published name.
    sensor : str
        'accelerometer' or 'gyroscope'.
    column : str or sequence of three str
        Arithmetic of the true motion (`effects.expressions`): one column for all axes, or one for each. With `tau` in it the effect has a
        time constant as its last value.
    unit : str
        SI unit of the values.
    tolerance : float
        Standard deviation up to which a value counts as determined.
    text : str
        One sentence that explains it.
    tolerance_reason : str
        Source of the tolerance.
    prior_sd : float, optional
        Standard deviation of the prior about zero; a hundred tolerances.
    largest : float, optional
        Largest plausible size.
    time_constant : float
        Where the time constant starts, s.

    Raises
    ------
    InputError
        When a column is no arithmetic, or the sensor is unknown.

    """
    if sensor not in SENSORS:
        raise InputError(f"effect '{name}' must belong to {' or '.join(SENSORS)}, got '{sensor}'; correct it", code='sensor_unknown')
    numbers: dict[str, Any] = {'tolerance': tolerance, 'prior_sd': prior_sd, 'largest': largest, 'time_constant': time_constant}
    for key, value in numbers.items():
        if value is not None and (isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < math.inf):
            raise InputError(f"the {key} of effect '{name}' must be a number above zero, got {value!r:.60}; correct it",
                             code='tolerance_value')
    for key, value in {'unit': unit, 'text': text, 'tolerance_reason': tolerance_reason}.items():
        if not isinstance(value, str):
            raise InputError(f"the {key} of effect '{name}' must be a text, got {value!r:.60}; correct it", code='not_a_text')
    columns = (column,) if isinstance(column, str) else tuple(column)
    if len(columns) not in (1, 3):
        raise InputError(f"effect '{name}' must have one column, or one for each axis, got {len(columns)}; correct it", code='column_count')
    group = ColumnGroup(name, columns, name)
    try:
        settles, thermal, turns = (quantity in group.uses for quantity in ('time constant', 'temperature', 'thermal branch'))
    except InputError as error:
        raise error.named(f"effect '{name}'") from error
    definition = {'sensor': sensor, 'column': column if isinstance(column, str) else list(columns), 'unit': unit, 'text': text,
                  'tolerance_reason': tolerance_reason or None, **numbers}
    if not settles:
        del definition['time_constant']
    spread = MANY * tolerance if prior_sd is None else prior_sd
    needs = ('temperature',) * (thermal or turns) + ('cooling',) * turns
    needs += ('vibration',) * ('vibration' in group.uses)
    needs += ('rotation',) * bool(group.uses & {'rate', 'angular acceleration', 'joint rate'})
    shape: dict[str, Any] = {'components': VECTOR, 'shape': (3,), 'unit': unit, 'prior': 0.0, 'prior_sd': spread}
    if settles:
        shape = {'components': (*VECTOR, 'time_constant'), 'shape': (4,), 'unit': (*[unit] * len(AXES), 's'), 'time_constant': True,
                 'prior': (0.0, 0.0, 0.0, time_constant), 'prior_sd': (spread, spread, spread, 10 * time_constant / 3)}
    return Effect(
        name=name, sensor=sensor, **shape, tolerance=tolerance, tolerance_reason=tolerance_reason,
        explanation=_explanation(text, sensor, columns), needs=needs,
        motion=next((motions for quantity, motions in MOTIONS if quantity in group.uses), ('static_poses',)),
        compensation='none' if group.uses & {'time', 'attitude', *JOINTS} else 'exact', groups=(group,),
        coefficients=Amplitudes(name, name, len(columns) == 3, settles),
        smooth=not group.uses - {'time', 'temperature', 'thermal branch', 'reference temperature', 'time constant'},
        plausible=(('such', largest, 'its definition'),) if largest else (),
        definition={key: value for key, value in definition.items() if value is not None},
        against=tuple(drawn for quantity, drawn in DRAWN_AGAINST.items() if quantity in group.uses)[:1])


def _explanation(text, sensor, columns):
    """Return the text as a sentence; without text, a sentence with its columns."""
    text = text.strip() or f'The {sensor} output follows {", ".join(columns)}'
    return text if text.endswith(('.', '!', '?')) else f'{text}.'


def from_definition(name: str, definition: dict[str, Any]) -> Effect:
    """
    Return the effect that plain data define.

    Raises
    ------
    InputError
        When something is missing, or a key is unknown.

    """
    try:
        return term(name, **definition)
    except TypeError as error:
        raise InputError(f"effect '{name}' must have sensor, column, unit, tolerance and text, got {definition!r:.200} ({error}); "
                         "correct it", code='definition_keys') from error


def _reduced(effect):
    """Return how an effect is sent to other processes: by its definition if there is one, because `coefficients` hold functions."""
    return object.__reduce_ex__(effect, 2) if effect.definition is None else (from_definition, (effect.name, effect.definition))


copyreg.pickle(Effect, _reduced)
