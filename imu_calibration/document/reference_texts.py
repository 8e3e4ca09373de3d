"""Parts of the statements on a calibration that depend on its reference: axes, next steps."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

MOUNT_AXES = 'mount'
"""The sensors have the axes of the frame that the table description mounts on the table."""
ACCELEROMETER_AXES = 'accelerometer_lower_triangular'
"""The sensors have the axes of the accelerometer: its matrix is lower triangular."""


@dataclass(frozen=True)
class ReferenceTexts:
    """Next steps of a user with one reference."""

    off_diagonal: str
    """For axes that no IMU has."""
    unsteady_bias: str
    """For a bias that moves from window to window."""
    too_few: Mapping[str, str]
    """Sensor -> for data without held-out errors."""
    needs_first: bool
    """Whether the need of a parameter that is not determined precedes `too_few`."""
    more_attitudes: str
    """For held-out attitudes that are those of the estimate."""


OF_TABLE = ReferenceTexts(
    off_diagonal='check the axes of the readings, and the mount in the table description',
    unsteady_bias='record after warm-up, on a rigid table, or estimate the bias in use',
    too_few={
        'accelerometer': 'record more windows of rest and motion',
        'gyroscope': 'record more windows of rest and motion',
    },
    needs_first=False,
    more_attitudes='hold it still in more attitudes, or mount it at another angle',
)
"""On a table or an arm."""
OF_GRAVITY = ReferenceTexts(
    off_diagonal='check in the driver that both sensors have the same axes',
    unsteady_bias='record after warm-up, or estimate the bias in use',
    too_few={
        'accelerometer': 'hold it still in more attitudes',
        'gyroscope': 'turn it between more attitudes held still',
    },
    needs_first=True,
    more_attitudes='hold it still in more attitudes',
)
"""By hand: only gravity at rest is known, and the accelerometer defines the axes."""


def texts_of(gauge: Mapping[str, Any]) -> ReferenceTexts:
    """Return the texts of the reference that gives sensors the axes of a document."""
    return OF_GRAVITY if gauge.get('axes') == ACCELEROMETER_AXES else OF_TABLE
