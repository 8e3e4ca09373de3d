"""
One table of the scale factors that a sensor in SI units can have, for all checks and decisions.

Data sheets promise a few per cent. A factor far from one is usually a wrong unit, a wrong
full-scale range, or a wrong sampling rate in a driver that multiplies increments.
"""

from imu_calibration.core.text_enum import StrEnum

USUAL_SCALE = (0.6, 1.7)
"""Scale factors without remark."""
POSSIBLE_SCALE = (0.4, 2.5)
"""Scale factors that are applied where the data support them; none outside is applied."""


class ScaleRange(StrEnum):
    """Where a scale factor, reading over true value, lies in the table."""

    USUAL = 'usual'
    """Within `USUAL_SCALE`."""
    DOUBTFUL = 'doubtful'
    """Within `POSSIBLE_SCALE`: the unit is in question."""
    IMPOSSIBLE = 'impossible'
    """Outside, zero, negative or not finite."""


USUAL, DOUBTFUL, IMPOSSIBLE = ScaleRange


def scale_range(factor: float) -> ScaleRange:
    """Return where a scale factor lies in the table."""
    if USUAL_SCALE[0] <= factor <= USUAL_SCALE[1]:
        return USUAL
    if POSSIBLE_SCALE[0] <= factor <= POSSIBLE_SCALE[1]:
        return DOUBTFUL
    return IMPOSSIBLE
