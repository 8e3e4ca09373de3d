"""Reference of calibration_node, a table or only gravity: selected here, once."""

from collections.abc import Callable
from dataclasses import dataclass

from imu_calibration.by_hand.live import LiveByHand
from imu_calibration.calibration.live import LiveCalibration
from imu_calibration.calibration.live_settings import LiveByHandSettings, LiveSettings
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.session import LiveSession
from imu_calibration.reference.joint import JointNames
from imu_calibration.reference.table import Table


@dataclass(frozen=True)
class SessionReference:
    """Reference of the IMU's motion, as a node uses it."""

    joint_names: JointNames | None
    """Joints to listen to; None: none."""
    text: str
    """Readable description of the reference and the procedure."""
    begin: Callable[[CalibrationOptions, LiveSettings, LiveByHandSettings, bytes | None], LiveSession]
    """Returns a new session, resumed from an earlier one's accumulator if given."""


def reference_of(table: Table | None, named: str) -> SessionReference:
    """Return the reference for a table or an arm with this name; None: only gravity."""
    if table is None:
        return SessionReference(None, "by hand, since neither 'table_file' nor 'urdf_file' was given: "
                                "hold the IMU still in 12 different attitudes and turn it in between",
                                lambda options, live, by_hand, saved: LiveByHand(options, live, by_hand, saved=saved))
    return SessionReference(table.joint_names, f'on {named} with the joints {", ".join(table.joint_names)}',
                            lambda options, live, by_hand, saved: LiveCalibration(table, options, live, saved=saved))
