"""What a recording did to the model that was asked for: effects it demands, and effects that it was not believed."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ModelChanges:
    """Names of effects, the strongest first."""

    added: tuple[str, ...] = ()
    """Taken into the model because the recording demands them."""
    denied: tuple[str, ...] = ()
    """Not taken in because parts of the recording disagree on them; the standard deviations allow for them."""

    def to_mapping(self) -> dict:
        """Return the part of a document's statistics."""
        return {name: value for name, value in (('added', list(self.added)), ('denied', list(self.denied))) if value}
