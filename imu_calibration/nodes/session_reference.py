"""What calibration_node compares the sensor with, a table or gravity alone: decided here, once."""

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
    """Where the IMU truly was, as a node needs to know it."""

    joint_names: JointNames | None
    """Joints to listen to; None: none."""
    text: str
    """What a session is calibrated on and how, for people."""
    begin: Callable[[CalibrationOptions, LiveSettings, LiveByHandSettings, bytes | None], LiveSession]
    """Returns a new session, which goes on with what an earlier one saved, if anything."""


def reference_of(table: Table | None, named: str) -> SessionReference:
    """Return the reference that a table or an arm with this name is; None: gravity alone."""
    if table is None:
        return SessionReference(None, "by hand, since neither 'table_file' nor 'urdf_file' was given: "
                                "hold the IMU still in 12 different attitudes and turn it in between",
                                lambda options, live, by_hand, saved: LiveByHand(options, live, by_hand, saved=saved))
    return SessionReference(table.joint_names, f'on {named} with the joints {", ".join(table.joint_names)}',
                            lambda options, live, by_hand, saved: LiveCalibration(table, options, live, saved=saved))
