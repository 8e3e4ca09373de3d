"""Worlds in which the clock of the sensor runs at another rate."""

from worlds.physics_cause import Cause


class Clock(Cause):
    """Stamps by a clock of another rate."""

    def __init__(self, rate=0.0):
        super().__init__()
        self.rate = rate

    def stamped(self, time, rng):
        """Return the lag of each stamp."""
        return self.rate * time
