"""The result of a calibration by hand."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from imu_calibration.calibration.hand_proof import held_out_values
from imu_calibration.calibration.result import CalibrationResult, ErrorBudget, ReferenceErrors, WindowErrors
from imu_calibration.effects.base import Role
from imu_calibration.preprocessing.window import Window, WindowKind
from imu_calibration.references.gravity.hand_calibration import HandCalibration
from imu_calibration.references.gravity.hand_options import hand_options


@dataclass(frozen=True, eq=False, kw_only=True)
class HandResult(CalibrationResult):
    """A calibration by hand with the data for its report."""

    hand: HandCalibration
    """Parameters, poses, noise and residuals."""

    observations: ClassVar[str] = 'poses'

    @property
    def reference(self) -> str:
        """Gravity."""
        return 'gravity, by hand'

    @property
    def gravity(self) -> float:
        """The reference, m/s^2."""
        return self.hand.gravity

    @property
    def period(self) -> float:
        """Sampling period, s."""
        return float(self.hand.statistics['period'])

    @property
    def singular_values(self) -> np.ndarray:
        """Empty: the directions of the poses are estimated too."""
        return np.zeros(0)

    def first_rest(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean specific force and rate of the first pose, each shape (3,)."""
        return self.hand.poses.force[0], self.hand.poses.rate[0]

    def window_errors(self) -> WindowErrors:
        """Return the errors of the poses, after: held out; relative to gravity along its estimated direction, and to zero rate."""
        hand, poses = self.hand, self.hand.poses
        force, rate = poses.force, poses.rate
        true, zero = hand.gravity * hand.state.up, np.zeros_like(rate)
        corrected_force, corrected_rate = hand.compensate(force, rate, poses.time, temperature_c=poses.temperature_c)
        for out, values in held_out_values(hand, hand.used_turns, hand_options(self.options).settings):
            corrected = hand.model.compensate(values, force, rate, time=poses.time, temperature_c=poses.temperature_c)
            corrected_force[out], corrected_rate[out] = (part[out] for part in corrected)
        samples = max(int(poses.stop[-1]), 1)
        time = (poses.start + poses.stop) / 2 * self.gathered.duration / max(samples - 1, 1)
        scatter = [float(hand.statistics.get(f'{name}_scatter_sd', 0.0)) for name in ('pose', 'drift')]
        return WindowErrors(time, np.full(len(force), WindowKind.STATIC), {'accelerometer': force, 'gyroscope': rate},
                            {'accelerometer': true, 'gyroscope': zero}, {'accelerometer': force - true, 'gyroscope': rate},
                            {'accelerometer': corrected_force - true, 'gyroscope': corrected_rate},
                            {'accelerometer': np.hypot(poses.force_sem, scatter[0]), 'gyroscope': np.hypot(poses.rate_sem, scatter[1])})

    def residuals_of(self, window: Window) -> dict[str, np.ndarray]:
        """Empty: by hand no windows are stored."""
        return {}

    def error_budget(self, errors: ReferenceErrors = ReferenceErrors()) -> ErrorBudget:
        """Return noise and gravity, the only reference. The sds contain the uncertainty of a gravity that was not given."""
        model, values, known = self.calibration.model, self.calibration.values, self.options.gravity is not None
        relative = self.calibration.common_scale.get('sd', errors.gravity / self.gravity)
        part, gravity, gravity_sd = model.part('accelerometer', Role.LINEAR), np.zeros(len(values)), relative * self.gravity
        gravity[part] = np.abs(values[part]) * relative
        return ErrorBudget(tuple(model.param_names), {'noise': self.calibration.own_sd, 'gravity': gravity},
                           {'noise': 'noise, scatter of poses and turns, as this recording shows them',
                            'gravity': f'gravity {"known" if known else "not given: the standard one is known"} to {gravity_sd:.2g} m/s²'})
