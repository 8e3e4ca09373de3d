"""The branch of a thermal hysteresis, from the thermometer's readings in order."""

import numpy as np

HALF_WIDTH = 1.0
"""
Half of the play between the branches, K: the temperature reverses by twice this from one branch to the other. A
package needs some kelvins to strain its element in the other direction; the noise and the steps of thermometers are much smaller.
"""


class ThermalBranch:
    """
    Play operator (Prandtl-Ishlinskii's element) on the temperature.

    With T the reading and p the middle that is dragged along, ``p <- min(max(p, T - w), T + w)``, and the branch is ``(T - p) / w``: 1
    during warming, -1 during cooling, between them until it has reversed by 2 w. It starts at 0, as the earlier temperature is unknown. It
    does not depend on the rate of the temperature, has one state variable, and is causal.
    """

    def __init__(self) -> None:
        self._middle: float | None = None
        self.now = 0.0
        """The branch at the last reading, in [-1, 1]."""

    def push(self, temperature_c: float) -> float:
        """Process the next reading and return the branch, in [-1, 1]."""
        middle = temperature_c if self._middle is None else self._middle
        self._middle = min(max(middle, temperature_c - HALF_WIDTH), temperature_c + HALF_WIDTH)
        self.now = (temperature_c - self._middle) / HALF_WIDTH
        return self.now

    def of(self, temperature_c: np.ndarray) -> np.ndarray:
        """Return the branch at each of the next readings, shape (n,)."""
        return np.array([self.push(each) for each in np.asarray(temperature_c, float).tolist()])
