"""What a recording did to the model that was asked for: effects it demands, and effects that it was not believed."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class ModelChanges:
    """Names of effects, the strongest first."""

    added: tuple[str, ...] = ()
    """Taken into the model because the recording demands them."""
    denied: tuple[str, ...] = ()
    """Not taken in because parts of the recording disagree on them; the standard deviations allow for them."""
    implausible: dict[str, float] = field(default_factory=dict)
    """Not taken in because their sizes are known of no instrument -> share of what the model leaves that each explains; the standard deviations allow for them."""

    def to_mapping(self) -> dict:
        """Return the part of a document's statistics."""
        changes = (('added', list(self.added)), ('denied', list(self.denied)), ('implausible', self.implausible))
        return {name: value for name, value in changes if value}
