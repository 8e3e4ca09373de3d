"""Errors of readings on held-out data before and after a calibration, by regime of motion."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, TypeVar

from imu_calibration.core.documents import stated

Entry = TypeVar('Entry', bound='RegimeErrors')


@dataclass(frozen=True)
class RegimeErrors:
    """Errors of readings before and after, in all motions or in one regime."""

    before: float
    """Rms error per component with nominal parameters, in `unit`."""
    after: float
    """Rms error per component with the calibration, in `unit`."""
    ci95: tuple[float, float]
    """95 % interval of after / before, from resamples of complete blocks."""
    seconds: float | None = None
    """Length of the data, s; None where poses or turns are counted."""
    unit: str = ''
    """Unit of the errors."""
    windows: int | None = None
    """Number of windows, poses or turns; None where only the length is known."""

    def to_mapping(self) -> dict[str, Any]:
        """Return the entry of a document: the fields that are not at their default."""
        return stated(self)

    @classmethod
    def from_mapping(cls: type[Entry], entry: Mapping[str, Any]) -> Entry:
        """Return the errors that an entry of a document describes; further keys are ignored."""
        arguments = {}
        for part in fields(cls):
            if part.name in entry:
                arguments[part.name] = entry[part.name]
        arguments['ci95'] = tuple(arguments['ci95'])
        return cls(**arguments)


@dataclass(frozen=True)
class EarlierErrors:
    """Error of an earlier calibration on the same data."""

    after: float
    """Rms error per component, in the unit of the entry."""
    ci95: tuple[float, float]
    """95 % interval of after / before."""


@dataclass(frozen=True)
class ProofEntry(RegimeErrors):
    """Errors of one sensor on held-out data."""

    delay_s: float | None = None
    """Delay of the readings that the model does not include, s; None where it is unknown."""
    delay_explains: float | None = None
    """Share of the squared error with the calibration that this delay explains."""
    regimes: Mapping[str, RegimeErrors] = field(default_factory=dict)
    """Regime of motion -> its errors; a regime with too few windows is left out."""
    one_attitude: bool = False
    """Whether all held-out windows of the accelerometer have the same attitude."""
    few_directions: bool = False
    """Whether all held-out rests lie near the axes of the sensor."""
    earlier: EarlierErrors | None = None
    """Error of an earlier calibration, where it was given."""

    def to_mapping(self) -> dict[str, Any]:
        """Return the entry of a document."""
        entry = super().to_mapping()
        # Regimes and the earlier calibration come last.
        regimes = entry.pop('regimes')
        earlier = entry.pop('earlier', None)
        if regimes:
            entry['regimes'] = {}
        for name, errors in regimes.items():
            # A regime in the unit of the entry does not repeat it.
            if errors.get('unit') == self.unit:
                del errors['unit']
            entry['regimes'][str(name)] = errors
        if earlier is not None:
            entry['earlier'] = earlier
        return entry

    @classmethod
    def from_mapping(cls, entry: Mapping[str, Any]) -> 'ProofEntry':
        """Return the errors that an entry of a document describes; further keys are ignored."""
        regimes = {}
        for name, part in (entry.get('regimes') or {}).items():
            regimes[name] = RegimeErrors.from_mapping({'unit': entry['unit'], **part})
        earlier = entry.get('earlier')
        if earlier is not None:
            earlier = EarlierErrors(earlier['after'], tuple(earlier['ci95']))
        return super().from_mapping({**entry, 'regimes': regimes, 'earlier': earlier})


Proof = Mapping[str, ProofEntry]
"""Sensor -> its errors on held-out data; a sensor without held-out data is left out."""
