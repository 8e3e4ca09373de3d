"""
Parameters that change at one moment.

Biases after a shock, exchanged axes, a displaced mount, a belt that slipped, a clock that was set.
"""

from dataclasses import dataclass, field
from itertools import chain


@dataclass(frozen=True, eq=False)
class Onset:
    """A group of parameters with one value before and another value after a moment."""

    time: float
    """Moment of the change, s since the first sample."""
    time_sd: float
    """Its standard deviation, s."""
    what: str
    """Name of the effect of the reference, or the sensors of which biases or matrices change."""
    before: dict[str, float]
    """Parameter -> value before the moment."""
    after: dict[str, float]
    """Parameter -> value after it."""
    sd: dict[str, float]
    """Parameter -> standard deviation of the difference."""
    units: dict[str, str]
    """Parameter -> unit."""
    share: float
    """Share of the excess over noise that the second state removes."""
    sensor_axes: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """
    Sensor -> its axes of which the bias or the row of the matrix changes, the largest change first;
    empty for an effect of the reference.
    """
    temperature_c: float | None = None
    """
    Temperature of which all windows before the moment are on one side and all later ones on the
    other, so that a step where it is passed is not separable; None without one.
    """

    @property
    def axes(self) -> tuple[str, ...]:
        """Axes of any sensor that change."""
        return tuple(dict.fromkeys(chain.from_iterable(self.sensor_axes.values())))

    def to_mapping(self) -> dict:
        """Return the onset as plain data."""
        return {
            'time': self.time,
            'time_sd': self.time_sd,
            'what': self.what,
            'share': self.share,
            'axes': list(self.axes),
            'sensor_axes': {sensor: list(axes) for sensor, axes in self.sensor_axes.items()},
            'temperature_c': self.temperature_c,
            'parameters': {
                name: {
                    'before': value,
                    'after': self.after[name],
                    'sd': self.sd[name],
                    'unit': self.units[name],
                }
                for name, value in self.before.items()
            },
        }
