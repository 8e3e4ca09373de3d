"""Poses and turns of a calibration by hand, with the errors that they have before and after."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from imu_calibration.calibration.from_solution import noise_entry
from imu_calibration.calibration.gathered_data import GatheredData
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.result import (
    GRAVITY_SD,
    CalibrationResult,
    ErrorBudget,
    Needs,
    WindowErrors,
)
from imu_calibration.document.statistics import RecordingStatistics
from imu_calibration.document.trust import Uncorrected
from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.solution import common_scale
from imu_calibration.preprocessing.joint_checks import check_force
from imu_calibration.preprocessing.recording_evidence import CheckFinding
from imu_calibration.preprocessing.sample_recording import SampleRecording
from imu_calibration.preprocessing.window import Window, WindowKind
from imu_calibration.references.gravity.advice import missing_motion
from imu_calibration.references.gravity.bias_movement import notes
from imu_calibration.references.gravity.equations import COMPONENTS
from imu_calibration.references.gravity.hand_calibration import (
    GAUGE,
    HandCalibration,
    HandData,
    gather_by_hand,
)
from imu_calibration.references.gravity.hand_parameters import (
    CROSS_TERMS,
    HandOptions,
    hand_options,
)
from imu_calibration.references.gravity.held_out_poses import (
    TURNS_LEAST,
    HeldOutPoses,
    folds_by_hand,
    uncorrected_by_hand,
    values_without,
)
from imu_calibration.selection.selected_effects import SelectedEffects

HandResult = CalibrationResult[HandCalibration]
"""A calibration by hand."""


@dataclass(frozen=True, eq=False)
class PoseObservations:
    """Means at rest and turns between them, of a recording without joints."""

    data: HandData
    """Poses and turns."""
    recording: SampleRecording
    """The samples, with counts and findings."""
    gravity: float
    """Gravity that was given, or the standard one, m/s^2."""

    unit: ClassVar[str] = 'poses'
    reference: ClassVar[str] = 'gravity, by hand'
    tested: ClassVar[tuple[str, ...]] = CROSS_TERMS

    @classmethod
    def of(
        cls,
        recording: SampleRecording,
        options: HandOptions,
        stills: Sequence[slice] | None = None,
    ) -> 'PoseObservations':
        """Return the poses and turns of a recording; `stills` as in `calibrate_by_hand`."""
        data = gather_by_hand(recording.imu, stills, temperature_c=recording.temperature_c)
        return cls(data, recording, options.gravity)

    @cached_property
    def gathered(self) -> GatheredData:
        """Counts and conditions of the recording."""
        imu = self.recording.imu
        temperature_c = self.recording.temperature_c
        temperature_range = None
        if temperature_c is not None:
            temperature_range = (float(temperature_c.min()), float(temperature_c.max()))
        return GatheredData(
            counts=self.recording.counts,
            frame_id=imu.frame_id,
            first_stamp_ns=int(imu.stamp_ns[0]),
            last_stamp_ns=int(imu.stamp_ns[-1]),
            largest_rate=float(np.sqrt(np.einsum('ij,ij->i', imu.rate_s, imu.rate_s).max())),
            largest_force=float(max(imu.force_s.max(), -imu.force_s.min())),
            temperature_c=temperature_range,
        )

    @property
    def period(self) -> float:
        """Sampling period, s."""
        return float(self.data.statistics['period'])

    @property
    def absent(self) -> tuple[str, ...]:
        """Sensors without readings."""
        return self.data.absent

    def searches(
        self, solution: HandCalibration, options: CalibrationOptions
    ) -> Iterator[SelectedEffects]:
        """Yield the search of effects in the recording, if it has enough poses."""
        # Here, because its import is slow.
        from imu_calibration.references.gravity.model_selection import (
            MIN_FOLD_POSES,
            investigate_by_hand,
        )

        # The search compares both sensors in poses and turns: with one sensor it has no data.
        data = self.data
        if options.as_asked or data.absent or len(data.poses) < MIN_FOLD_POSES:
            return
        yield investigate_by_hand(data, hand_options(options), solution)

    def gauge(self, solution: HandCalibration) -> dict[str, Any]:
        """Return the conventions of origin and axes."""
        return dict(GAUGE)

    def findings(self, solution: HandCalibration) -> tuple[CheckFinding, ...]:
        """
        Return the findings of the recording, and biases that moved.

        Raises
        ------
        InputError
            When the specific force at rest is clearly in another unit.

        """
        check_force(float(np.median(np.linalg.norm(solution.poses.force, axis=1))))
        moved = solution.statistics['bias_moved']
        return (*self.recording.findings, *notes(moved, self.gathered.duration))

    def with_reference_errors(self, solution: HandCalibration) -> HandCalibration:
        """Return the solution, which contains the uncertainty of gravity already."""
        return solution

    def held_out(self, solution: HandCalibration) -> HeldOutPoses:
        """Return the poses and turns to hold out in turn."""
        turns = solution.used_turns if self.data.turns else ()
        folds = folds_by_hand(solution.poses)
        return HeldOutPoses.of(solution, turns, folds, least_turns=TURNS_LEAST)

    def uncorrected(self, solution: HandCalibration) -> Uncorrected:
        """Return the errors that compensation leaves uncorrected."""
        return uncorrected_by_hand(solution)

    def statistics(self, solution: HandCalibration) -> RecordingStatistics:
        """Return the statistics of poses and turns, noise and scatter."""
        by_hand = solution.statistics
        delay = self.recording.delay
        sensors = {}
        for sensor, component in zip(SENSORS, COMPONENTS):
            dof = float(by_hand[f'{component}_dof'])
            sensors[sensor] = replace(noise_entry(solution.noise[sensor]), between_window_dof=dof)
        return RecordingStatistics(
            sensors=sensors,
            windows={'static': by_hand.get('poses', 0), 'turns': by_hand.get('turns', 0)},
            samples_used={'all': len(self.recording.imu)},
            by_hand=by_hand,
            dropped={reason: int(n) for reason, n in sorted(self.gathered.counts.items())},
            unusable_sensors=self.recording.unusable or None,
            gyroscope_delay=None if delay is None else delay.to_mapping(),
        )

    def needs(
        self, solution: HandCalibration, tolerances: np.ndarray, *, quality: dict[str, Any]
    ) -> Needs:
        """Return the needs of a solution, see `Observations.needs`."""
        undetermined = missing_motion(solution)
        # Parameter -> (text of its need, no predicted sd); the first item of a parameter counts.
        motions: dict[str, tuple[str, float]] = {}
        for item in reversed(undetermined):
            for name in item['parameters']:
                motions[name] = (item['needs'], float('nan'))
        return Needs(motions, undetermined)

    def singular_values(self, result: HandResult) -> np.ndarray:
        """Return an empty array: directions are estimated too."""
        return np.zeros(0)

    def window_errors(self, result: HandResult) -> WindowErrors:
        """
        Return the errors of the poses relative to gravity along its direction, and to zero rate.

        Errors after the calibration are those of poses held out in turn.
        """
        hand = result.applied
        poses = hand.poses
        force, rate = poses.force, poses.rate
        true = hand.gravity * hand.state.up
        zero = np.zeros_like(rate)

        # Corrected means, where possible with parameters estimated without the pose.
        corrected_force, corrected_rate = hand.compensate(
            force, rate, poses.time, temperature_c=poses.temperature_c
        )
        folds = folds_by_hand(poses)
        without = values_without(result.solution, hand.used_turns, folds)
        for fit in result.fits:
            without = fit.merged(without)
        for out, values in zip(folds, without, strict=True):
            fold_force, fold_rate = hand.hand_model.compensate(
                values, force, rate, **poses.conditions
            )
            corrected_force[out] = fold_force[out]
            corrected_rate[out] = fold_rate[out]

        n_samples = max(int(poses.stop[-1]), 1)
        time = (poses.start + poses.stop) / 2 * self.gathered.duration / max(n_samples - 1, 1)
        pose_scatter = float(hand.statistics.get('pose_scatter_sd', 0.0))
        drift_scatter = float(hand.statistics.get('drift_scatter_sd', 0.0))
        return WindowErrors(
            time=time,
            kind=np.full(len(force), WindowKind.STATIC),
            measured={'accelerometer': force, 'gyroscope': rate},
            true={'accelerometer': true, 'gyroscope': zero},
            before={'accelerometer': force - true, 'gyroscope': rate},
            after={'accelerometer': corrected_force - true, 'gyroscope': corrected_rate},
            floor={
                'accelerometer': np.hypot(poses.force_sem, pose_scatter),
                'gyroscope': np.hypot(poses.rate_sem, drift_scatter),
            },
        )

    def residuals_of(self, result: HandResult, window: Window) -> dict[str, np.ndarray]:
        """Empty: by hand no windows are stored."""
        return {}

    def error_budget(self, result: HandResult) -> ErrorBudget:
        """
        Return the sds of the parameters from noise, and from the uncertainty of gravity.
        """
        calibration = result.calibration
        is_known = result.options.gravity is not None
        relative = calibration.common_scale.get('sd', GRAVITY_SD / result.gravity)
        gravity = np.abs(common_scale(calibration.model, calibration.values)) * relative
        known = 'known' if is_known else 'not given: the standard one is known'
        return ErrorBudget(
            tuple(calibration.model.param_names),
            {'noise': calibration.own_sd, 'gravity': gravity},
            {
                'noise': 'noise, scatter of poses and turns, as this recording shows them',
                'gravity': f'gravity {known} to {relative * result.gravity:.2g} m/s²',
            },
        )
