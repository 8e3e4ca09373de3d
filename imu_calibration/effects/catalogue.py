"""The catalogue of effects: declared once for simulation, calibration, compensation, diagnosis and planning."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

from imu_calibration.core.errors import InputError, did_you_mean, shortened
from imu_calibration.effects.base import SECTIONS, Effect
from imu_calibration.effects.reference_effects import reference_effects
from imu_calibration.effects.sensor_effects import ACCELEROMETER, GYROSCOPE
from imu_calibration.effects.term import from_definition
from imu_calibration.kinematics.joint import JointNames

JOINTS = ('outer', 'middle', 'inner')
"""Default joint names."""
MOST_ADDED = 50
"""Effects that a document may add at most."""
UNDONE_WITH = {'force', 'rate', 'angular acceleration', 'temperature', 'thermal branch', 'vibration',
               'reference temperature'}
"""Quantities of a sample that compensation has."""


@lru_cache(maxsize=8)
def _own_effects(joint_names):
    every = ACCELEROMETER + GYROSCOPE + reference_effects(joint_names)
    return {effect.key: effect for effect in every if effect.size}


@dataclass(frozen=True, eq=False)
class Catalogue:
    """
    All effects: declared in this package or added by the user.

    It is immutable: adding an effect creates another catalogue, which is part of a SensorModel.
    """

    added: tuple = field(default=())
    """Effects in addition to the package's own."""

    def __reduce__(self):
        """Pickle the added effects only."""
        return Catalogue, (self.added,)

    def effects(self, joint_names: Sequence[str] = JOINTS) -> dict[tuple[str, str], Effect]:
        """Return every effect by (sensor, name) for a table with these joints."""
        return _own_effects(JointNames.of(joint_names)) | {effect.key: effect for effect in self.added}

    def find(self, sensor: str, name: str, joint_names: Sequence[str] = JOINTS, *, models: Iterable[str] = ()) -> Effect:
        """Return the effect `name` of `sensor`, or raise `InputError` with the closest name; `models` are suggested too."""
        effects = self.effects(joint_names)
        if (sensor, name) not in effects:
            known = sorted(known_name for known_sensor, known_name in effects if known_sensor == sensor)
            raise InputError(f"the {sensor} has no effect '{name}'{did_you_mean(name, [*models, *known])}; choose from {', '.join(known)}",
                             code='effect_unknown')
        return effects[sensor, name]

    def owner_of(self, name: str, joint_names: Sequence[str] = JOINTS) -> str:
        """Return the sensor that an effect name belongs to ('bias' and 'matrix' belong to both and are refused)."""
        names = [known for _, known in self.effects(joint_names)]
        if names.count(name) != 1:
            known = sorted(n for n in names if names.count(n) == 1)
            raise InputError(f"effect '{name}' is unknown or ambiguous{did_you_mean(name, known)}; choose from {', '.join(known)}",
                             code='effect_unknown')
        return next(sensor for sensor, known in self.effects(joint_names) if known == name)

    def with_effects(self, *effects: Effect) -> 'Catalogue':
        """
        Return a catalogue with further effects.

        Raises
        ------
        InputError
            When a name exists, the sensor is unknown, or an effect to be compensated has columns that compensation cannot compute.

        """
        grown = self
        for effect in effects:
            _check(effect, {name for _, name in grown.effects()})
            grown = replace(grown, added=(*grown.added, effect))
        return grown

    def definitions(self, names: Collection[str]) -> dict[str, Any]:
        """Return {effect name: plain data} of the added effects among `names`, for a document."""
        added = [effect for effect in self.added if effect.name in names]
        for effect in added:
            if effect.definition is None:
                raise InputError(f"effect '{effect.name}' must be made of text to be written into a document, it is made of code; "
                                 "make it with `effects.term.term`", code='made_of_code')
        return {effect.name: effect.definition for effect in added}

    @classmethod
    def from_definitions(cls, definitions: dict[str, Any]) -> 'Catalogue':
        """Return the catalogue with the effects of {name: plain data}."""
        return cls().with_definitions(definitions)

    def with_definitions(self, definitions: dict[str, Any]) -> 'Catalogue':
        """
        Return a catalogue with the effects of {name: plain data} too.

        Raises
        ------
        InputError
            As `with_effects` and `term`; also when there are too many.

        """
        if not isinstance(definitions, dict) or len(definitions) > MOST_ADDED:
            raise InputError(f'effects must be given as at most {MOST_ADDED} of NAME: {{sensor, column, unit, tolerance, text}}, got '
                             f'{len(definitions) if isinstance(definitions, dict) else shortened(str(definitions))}; correct it')
        return self.with_effects(*(from_definition(name, definition) for name, definition in definitions.items()))

    def with_document(self, document: dict[str, Any]) -> 'Catalogue':
        """
        Return a catalogue with the effects defined in a document under `effects`: a file of effects, or a calibration.

        Raises
        ------
        InputError
            When there is no such part, or when a file of effects has other parts.

        """
        strange = [] if 'format' in document else sorted(str(key) for key in document if key != 'effects')
        if strange or 'effects' not in document:
            raise InputError('a file of effects must hold effects: NAME: {sensor, column, unit, tolerance, text}, it holds '
                             f'{", ".join(strange)[:80] or ", ".join(map(str, document))[:80] or "nothing"}; correct it')
        return self.with_definitions(document['effects'] or {})


CATALOGUE = Catalogue()
"""The package's own effects."""


def _check(effect, taken):
    if not (isinstance(effect.name, str) and effect.name.isidentifier()) or effect.name in taken | {'effects'}:
        raise InputError(f"an effect must have a name of its own made of letters, digits and underscores, got '{effect.name}'; "
                         "choose another one", code='effect_name')
    if effect.sensor not in SECTIONS:
        raise InputError(f"effect '{effect.name}' must belong to {', '.join(SECTIONS)}, got '{effect.sensor}'; correct it")
    strange = {quantity for group in effect.groups for quantity in group.uses} - UNDONE_WITH
    if effect.compensation == 'exact' and strange:
        raise InputError(f"effect '{effect.name}' must not use {', '.join(sorted(strange))}, which are unknown during compensation; "
                         "declare it with compensation 'none'", code='time_unavailable')
