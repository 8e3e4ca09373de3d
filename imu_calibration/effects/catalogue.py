"""The catalogue of effects, and effects of users: one column of text per parameter."""

import copyreg
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any

from imu_calibration.core.errors import InputError, did_you_mean, shortened
from imu_calibration.core.schema import (
    Document,
    mapping,
    maybe,
    number,
    one_or_each,
    require,
    text,
)
from imu_calibration.effects.base import (
    AXES,
    SECTIONS,
    SENSORS,
    VECTOR,
    Effect,
    amplitude_coefficients,
)
from imu_calibration.effects.expressions import ColumnGroup
from imu_calibration.effects.reference_effects import reference_effects
from imu_calibration.effects.sensor_effects import ACCELEROMETER, GYROSCOPE
from imu_calibration.kinematics.joint import JointNames

JOINT_INPUTS = {'joint angle', 'joint rate'}
"""Quantities that exist only with a table."""
NOT_COMPENSATED = {'time', 'attitude', 'temperature rate', *JOINT_INPUTS}
"""Quantities that are not known when readings are compensated."""
SMOOTH_QUANTITIES = {
    'time',
    'temperature',
    'temperature rate',
    'thermal branch',
    'reference temperature',
    'time constant',
}
"""Quantities that change smoothly in time, or are constant."""
QUANTITY_MOTIONS = (
    ('joint angle', ('static_dense', 'slow_turn')),
    ('joint rate', ('three_speeds',)),
    ('angular acceleration', ('oscillate_x', 'oscillate_y', 'oscillate_z')),
    ('thermal branch', ('warm_and_cool',)),
    ('vibration', ('shake',)),
    ('temperature', ('warm_up',)),
    ('temperature rate', ('warm_up',)),
    ('time', ('warm_up',)),
    ('rate', ('two_axis', 'three_speeds')),
    ('force', ('static_dense', 'centrifuge')),
)
"""Standard motions that show a quantity; the first that a column uses applies."""
NEEDED_DATA = {
    'temperature': {'temperature', 'temperature rate', 'thermal branch'},
    'cooling': {'thermal branch'},
    'vibration': {'vibration'},
    'rotation': {'rate', 'angular acceleration', 'joint rate'},
}
"""Data that an effect needs (`Effect.needs`) -> quantities in a column that require them."""
DRAWN_AGAINST = {
    'joint angle': 'angle',
    'joint rate': 'angle',
    'temperature': 'temperature',
    'temperature rate': 'temperature',
    'thermal branch': 'temperature',
    'time': 'time',
    'force': 'force',
    'rate': 'rate',
}
"""Quantity -> abscissa of the residual plot of a column that uses it; the first applies."""
PRIOR_TOLERANCES = 100.0
"""Tolerances in the default standard deviation of the prior."""


_ABOVE_ZERO = number(0.0, above=True, code='tolerance_value')
_TEXT = text(code='not_a_text')
_NEEDED = {
    'sensor': text(*SENSORS, code='sensor_unknown'),
    'column': one_or_each(text(code='column_count'), 1, len(AXES), code='column_count'),
    'unit': _TEXT,
    'tolerance': _ABOVE_ZERO,
    'text': _TEXT,
}
_FURTHER = {
    'tolerance_reason': _TEXT,
    'prior_sd': maybe(_ABOVE_ZERO),
    'largest': maybe(_ABOVE_ZERO),
    'time_constant': _ABOVE_ZERO,
}
DEFINITION = Document(
    'effect',
    mapping(_NEEDED, _FURTHER, closed=True),
    'correct it',
    dict.fromkeys(('missing', 'unknown', 'mapping'), 'definition_keys'),
    InputError,
)
EFFECTS = Document(
    'effects', mapping(), 'correct them', {'mapping': 'effects_count'}, error=InputError
)


def term(
    name: str,
    *,
    sensor: str,
    column: Sequence[str] | str,
    unit: str,
    tolerance: float,
    text: str,
    tolerance_reason: str = '',
    prior_sd: float | None = None,
    largest: float | None = None,
    time_constant: float = 300.0,
) -> Effect:
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
        Arithmetic of the true motion (`effects.expressions`): one column for all axes, or one for
        each. With `tau` in it the effect has a time constant as its last value.
    unit : str
        SI unit of the values.
    tolerance : float
        Standard deviation up to which a value counts as determined.
    text : str
        One sentence that explains it.
    tolerance_reason : str
        Source of the tolerance.
    prior_sd : float, optional
        Standard deviation of the prior about zero; default: a hundred tolerances.
    largest : float, optional
        Largest plausible size.
    time_constant : float
        Prior of the time constant, s.

    Raises
    ------
    InputError
        When a column is no arithmetic, or the sensor is unknown.

    """
    numbers: dict[str, Any] = {
        'tolerance': tolerance,
        'prior_sd': prior_sd,
        'largest': largest,
        'time_constant': time_constant,
    }
    texts = {'unit': unit, 'text': text, 'tolerance_reason': tolerance_reason}
    require({'sensor': sensor, 'column': column, **numbers, **texts}, _definition_of(name))
    columns = (column,) if isinstance(column, str) else tuple(column)
    group = ColumnGroup(name, columns, name)
    try:
        uses = group.uses  # reads the columns
    except InputError as error:
        raise error.named(f"effect '{name}'") from error
    has_time_constant = 'time constant' in uses

    # The arguments as plain data, from which documents make the effect again.
    definition = {
        'sensor': sensor,
        'column': column if isinstance(column, str) else list(columns),
        'unit': unit,
        'text': text,
        'tolerance_reason': tolerance_reason or None,
        **numbers,
    }
    if not has_time_constant:
        del definition['time_constant']

    # Data and motions that show the effect.
    needs = tuple(data for data, quantities in NEEDED_DATA.items() if uses & quantities)
    motions = [motions for quantity, motions in QUANTITY_MOTIONS if quantity in uses]
    abscissas = [abscissa for quantity, abscissa in DRAWN_AGAINST.items() if quantity in uses]

    # The values and their prior. A time constant has that of `bias_drift`, 1000 s for 300 s.
    amplitude_sd = PRIOR_TOLERANCES * tolerance if prior_sd is None else prior_sd
    fields: dict[str, Any] = {
        'components': VECTOR,
        'shape': (3,),
        'unit': unit,
        'prior': 0.0,
        'prior_sd': amplitude_sd,
    }
    if has_time_constant:
        fields = {
            'components': (*VECTOR, 'time_constant'),
            'shape': (4,),
            'unit': (*[unit] * len(AXES), 's'),
            'time_constant': True,
            'prior': (0.0, 0.0, 0.0, time_constant),
            'prior_sd': (amplitude_sd, amplitude_sd, amplitude_sd, 10 * time_constant / 3),
        }
    text = text.strip() or f'The {sensor} output follows {", ".join(columns)}'
    return Effect(
        name=name,
        sensor=sensor,
        **fields,
        tolerance=tolerance,
        tolerance_reason=tolerance_reason,
        explanation=text if text.endswith(('.', '!', '?')) else f'{text}.',
        needs=needs,
        motion=motions[0] if motions else ('static_poses',),
        compensation='none' if uses & NOT_COMPENSATED else 'exact',
        groups=(group,),
        coefficients=partial(amplitude_coefficients, own_axis=len(columns) == 3),
        smooth=uses <= SMOOTH_QUANTITIES,
        plausible=('such', largest, 'its definition') if largest else (),
        definition={key: value for key, value in definition.items() if value is not None},
        against=tuple(abscissas[:1]),
    )


def from_definition(name: str, definition: dict[str, Any]) -> Effect:
    """
    Return the effect that plain data define.

    Raises
    ------
    InputError
        When something is missing, or a key is unknown.

    """
    require(definition, _definition_of(name))
    return term(name, **definition)


def _definition_of(name: str) -> Document:
    """Return the declaration with the name of the effect, for errors."""
    return replace(DEFINITION, name=f"effect '{shortened(str(name))}'")


def _reduced(effect: Effect) -> Any:
    """
    Return the pickled form of an effect, as of `object.__reduce__`.

    An effect with a definition is made again from it, because `coefficients` hold functions.
    """
    if effect.definition is None:
        return object.__reduce_ex__(effect, 2)
    return from_definition, (effect.name, effect.definition)


copyreg.pickle(Effect, _reduced)


JOINTS = ('outer', 'middle', 'inner')
"""Default joint names."""
MOST_ADDED = 50
"""Effects that a document may add at most."""
QUANTITIES_OF_SAMPLE = {
    'force',
    'rate',
    'angular acceleration',
    'temperature',
    'thermal branch',
    'vibration',
    'reference temperature',
}
"""Quantities that compensation has of each sample."""


@lru_cache(maxsize=8)
def _package_effects(joint_names: JointNames) -> dict[tuple[str, str], Effect]:
    """Return the effects of this package by (sensor, name), without those that need more joints."""
    effects = ACCELEROMETER + GYROSCOPE + reference_effects(joint_names)
    return {effect.key: effect for effect in effects if effect.size}


@dataclass(frozen=True, eq=False)
class Catalogue:
    """
    All effects: declared in this package or added by the user.

    It is immutable: adding an effect creates another catalogue, which is part of a SensorModel.
    """

    added: tuple = field(default=())
    """Effects in addition to the package's own."""
    candidates: frozenset[str] | None = None
    """Names of the package's effects that a search tests; None: all."""

    def __reduce__(self):
        """Pickle the added effects and the names of the candidates only."""
        return Catalogue, (self.added, self.candidates)

    def is_candidate(self, effect: Effect) -> bool:
        """Return whether a search tests an effect; added effects are always tested."""
        if self.candidates is None or effect.name in self.candidates:
            return True
        return any(effect is added for added in self.added)

    def with_candidates(self, text: str | None) -> 'Catalogue':
        """
        Return a catalogue whose search tests only some of the package's effects.

        `text`: names joined by +, or 'none'; None: all effects.

        Raises
        ------
        InputError
            When an effect does not exist.

        """
        if text is None:
            return replace(self, candidates=None)
        names = frozenset() if text == 'none' else frozenset(text.split('+'))
        for name in sorted(names):
            self.owner_of(name)
        return replace(self, candidates=names)

    def effects(self, joint_names: Sequence[str] = JOINTS) -> dict[tuple[str, str], Effect]:
        """Return every effect by (sensor, name) for a table with these joints."""
        added = {effect.key: effect for effect in self.added}
        return _package_effects(JointNames.of(joint_names)) | added

    def find(
        self,
        sensor: str,
        name: str,
        joint_names: Sequence[str] = JOINTS,
        *,
        models: Iterable[str] = (),
    ) -> Effect:
        """
        Return the effect `name` of `sensor`, or raise `InputError` with the closest name.

        `models` are suggested too.
        """
        effects = self.effects(joint_names)
        if (sensor, name) not in effects:
            choices = sorted(choice for owner, choice in effects if owner == sensor)
            raise InputError(
                f"the {sensor} has no effect '{name}'{did_you_mean(name, [*models, *choices])};"
                f' choose from {", ".join(choices)}',
                code='effect_unknown',
            )
        return effects[sensor, name]

    def owner_of(self, name: str, joint_names: Sequence[str] = JOINTS) -> str:
        """
        Return the sensor that an effect name belongs to.

        The names 'bias' and 'matrix' belong to both sensors and are refused.
        """
        keys = list(self.effects(joint_names))
        names = [effect_name for _, effect_name in keys]
        if names.count(name) != 1:
            choices = sorted(choice for choice in names if names.count(choice) == 1)
            raise InputError(
                f"effect '{name}' is unknown or ambiguous{did_you_mean(name, choices)}; choose from"
                f' {", ".join(choices)}',
                code='effect_unknown',
            )
        sensor, _ = keys[names.index(name)]
        return sensor

    def with_effects(self, *effects: Effect) -> 'Catalogue':
        """
        Return a catalogue with further effects.

        Raises
        ------
        InputError
            When a name exists, the sensor is unknown, or an effect to be compensated has columns
            that compensation cannot compute.

        """
        catalogue = self
        for effect in effects:
            _check(effect, {name for _, name in catalogue.effects()})
            catalogue = replace(catalogue, added=(*catalogue.added, effect))
        return catalogue

    def definitions(self, names: Collection[str]) -> dict[str, Any]:
        """Return {effect name: plain data} of the added effects among `names`, for a document."""
        added = [effect for effect in self.added if effect.name in names]
        for effect in added:
            if effect.definition is None:
                raise InputError(
                    f"effect '{effect.name}' must be made of text to be written into a document, it"
                    ' is made of code; make it with `effects.catalogue.term`',
                    code='made_of_code',
                )
        return {effect.name: effect.definition for effect in added}

    def with_definitions(self, definitions: dict[str, Any]) -> 'Catalogue':
        """
        Return a catalogue with the effects of {name: plain data} too.

        Raises
        ------
        InputError
            As `with_effects` and `term`; also when there are too many.

        """
        require(definitions, EFFECTS)
        if len(definitions) > MOST_ADDED:
            raise InputError(
                f'effects must be at most {MOST_ADDED}, got {len(definitions)}; remove some',
                code='effects_count',
            )
        return self.with_effects(
            *(from_definition(name, definition) for name, definition in definitions.items())
        )

    def with_document(self, document: dict[str, Any]) -> 'Catalogue':
        """
        Return a catalogue with the effects that a document defines under `effects`.

        The document is a file of effects, or a calibration, which has a 'format'.

        Raises
        ------
        InputError
            When there is no such part, or when a file of effects has other parts.

        """
        unknown = []
        if 'format' not in document:
            unknown = sorted(str(key) for key in document if key != 'effects')
        if unknown or 'effects' not in document:
            raise InputError(
                'a file of effects must hold effects: NAME: {sensor, column, unit, tolerance,'
                ' text}, it holds'
                f' {", ".join(unknown)[:80] or ", ".join(map(str, document))[:80] or "nothing"};'
                ' correct it',
                code='effects_file',
            )
        return self.with_definitions(document['effects'] or {})


CATALOGUE = Catalogue()
"""The package's own effects."""


def _check(effect: Effect, taken_names: set[str]) -> None:
    """Refuse an effect with an unusable name, without a sensor, or that cannot be compensated."""
    is_identifier = isinstance(effect.name, str) and effect.name.isidentifier()
    # 'effects' is a key of a section of a document.
    if not is_identifier or effect.name in taken_names | {'effects'}:
        raise InputError(
            'an effect must have a name of its own made of letters, digits and underscores, got'
            f" '{effect.name}'; choose another one",
            code='effect_name',
        )
    if effect.sensor not in SECTIONS:
        raise InputError(
            f"effect '{effect.name}' must belong to {', '.join(SECTIONS)}, got '{effect.sensor}';"
            ' correct it'
        )
    quantities: set[str] = set()
    for group in effect.groups:
        quantities |= group.uses
    unknown = quantities - QUANTITIES_OF_SAMPLE
    if effect.compensation == 'exact' and unknown:
        raise InputError(
            f"effect '{effect.name}' must not use {', '.join(sorted(unknown))}, which are unknown"
            " during compensation; declare it with compensation 'none'",
            code='time_unavailable',
        )
