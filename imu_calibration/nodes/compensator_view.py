"""Foxglove view of compensator_node: readings before and after, and the validity of the calibration."""

from dataclasses import dataclass
from functools import partial
from typing import Any

from imu_calibration.calibration.status import tolerances_of
from imu_calibration.compensation.health import CalibrationHealth
from imu_calibration.compensation.stop_watch import CorrectedStretch
from imu_calibration.nodes.adoption import Adopted
from imu_calibration.nodes.live_view import FoxgloveSettings, LiveView
from imu_calibration.nodes.message_compensation import LiveCompensation
from imu_calibration.settings import setting
from imu_calibration.use_cases.view_messages import HEALTH, PARAMETERS, READINGS, health, parameters, readings


@dataclass(frozen=True)
class CompensatorFoxglove(FoxgloveSettings):
    """Port when a calibration_node runs on the same host."""

    foxglove_port: int = setting(8767, '', 'port to listen on, not that of foxglove_bridge or calibration_node; 0: any free port',
                                 (0, 65535),
                                 'a program uses the port: the node warns and has no view',
                                 fixed='the server is bound to the port at its start')


class CompensatorView(LiveView):
    """Shows a compensation: readings before and after with their band, the check at stops, the parameters."""

    def __init__(self, node: Any, settings: FoxgloveSettings):
        self._adopted: Adopted | None = None
        super().__init__(node, (READINGS, HEALTH, PARAMETERS), settings)

    def change(self, settings: FoxgloveSettings) -> None:
        """Open or close the view; while closed it does not affect the message stream."""
        super().change(settings)
        self._listen()

    def take_calibration(self, adopted: Adopted) -> None:
        """Show the calibration in force."""
        self._adopted = adopted
        self.show(PARAMETERS, partial(parameters, adopted.used.calibration, tolerances_of(adopted.used.calibration.model)))
        self._listen()

    def _listen(self) -> None:
        compensation = None if self._adopted is None else self._adopted.compensation
        if compensation is not None and compensation.watch is not None:
            compensation.watch.listener = partial(self._take, compensation, compensation.watch.health) if self.is_on else None

    def _take(self, compensation: LiveCompensation, holds: CalibrationHealth, stretch: CorrectedStretch) -> None:
        self.add(READINGS, lambda: readings(stretch, compensation.sd))
        self.show(HEALTH, lambda: health(holds.state))
