"""A calibration by hand: gravity is the reference."""

from collections.abc import Sequence
from dataclasses import dataclass

from imu_calibration.calibration.calibrate import calibrate_by_evidence
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.solved import Solved
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import BlockSource
from imu_calibration.preprocessing.checks import Preflight
from imu_calibration.preprocessing.sample_recording import SampleRecording, read_recording
from imu_calibration.references.gravity.hand_calibration import HandCalibration, solve_by_hand
from imu_calibration.references.gravity.hand_parameters import hand_options
from imu_calibration.references.gravity.pose_observations import HandResult, PoseObservations


@dataclass(frozen=True, eq=False)
class PoseRecording:
    """A recording by hand, of which each solution uses the same poses and turns."""

    observations: PoseObservations
    """Poses and turns."""

    def solved(self, options: CalibrationOptions) -> Solved[HandCalibration]:
        """Return the solution of the model that options request (`solve_by_hand`)."""
        solution = solve_by_hand(self.observations.data, hand_options(options))
        return Solved(solution, self.observations)


def gather_poses(
    sources: Sequence[BlockSource], options: CalibrationOptions, *, one_sensor: bool = True
) -> PoseRecording:
    """
    Return the poses and turns of one recording.

    `one_sensor`: whether one usable sensor suffices.

    Raises
    ------
    InputError
        When more than one recording is given, or a requested effect needs a table.

    """
    if len(sources) != 1:
        raise InputError(
            f'calibration by hand needs one recording, got {len(sources)}; calibrate them'
            ' separately and compare the results'
        )
    preflight = Preflight(options.gravity, one_sensor=one_sensor)
    recording = read_recording(sources[0], options.nominal, preflight)
    return PoseRecording(PoseObservations.of(recording, hand_options(options)))


def calibrate_poses(
    recording: SampleRecording,
    options: CalibrationOptions = CalibrationOptions(),
    provenance: dict | None = None,
    *,
    stills: Sequence[slice] | None = None,
) -> HandResult:
    """
    Return the HandResult of a recording; `stills` as in `calibrate_by_hand`.
    """
    observations = PoseObservations.of(recording, hand_options(options), stills)
    return calibrate_by_evidence(PoseRecording(observations), options, provenance=provenance)
