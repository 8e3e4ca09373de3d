"""From a recording or a calibration file to its view in Foxglove."""

from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, Unpack

from imu_calibration.calibration.coverage import Coverage, bars_of, table_coverage
from imu_calibration.calibration.effect_states import group_states
from imu_calibration.calibration.hand_result import HandResult
from imu_calibration.calibration.next_pose import hand_coverage
from imu_calibration.calibration.pose_scan import NOTHING
from imu_calibration.calibration.result import CalibrationResult, exit_code
from imu_calibration.calibration.table_result import TableResult
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import SampleBlock
from imu_calibration.document import files
from imu_calibration.document.calibration import Calibration
from imu_calibration.estimation.status import tolerances_of
from imu_calibration.references.gravity.hand_options import HandOptions
from imu_calibration.use_cases.calibrate import calibrate
from imu_calibration.use_cases.choices import Choices
from imu_calibration.use_cases.foxglove_file import PARAMETERS, RESIDUAL, SPECTRUM, foxglove_bytes, parameters, residual, spectrum
from imu_calibration.use_cases.stand import Stand


@dataclass(frozen=True, eq=False)
class View:
    """View of a calibration."""

    calibration: Calibration
    """The calibration."""
    contents: dict[str, dict[str, Any]]
    """Topic -> content, as in `foxglove_file.SCHEMAS`."""
    coverage: Coverage | None
    """The sphere; None where only a file is known."""
    seconds: float = 0.0
    """Until the middle of the last window."""

    @property
    def exit_code(self) -> int:
        """That of the calibration."""
        return exit_code(self.calibration)

    @property
    def lacks(self) -> tuple[str, ...]:
        """Content that cannot be shown, with the reason."""
        if self.coverage is None:
            return ('a calibration file contains no residuals: only the parameters are shown; give the recording for residuals',)
        if SPECTRUM not in self.contents:
            return ('no window with motion was long enough for a spectrum, and by hand there is none: it is left out',)
        return ()

    def save(self, path: str | PathLike) -> None:
        """
        Write the view as MCAP, atomically.

        Raises
        ------
        InputError
            When foxglove-sdk is not installed or the place cannot be written.

        """
        files.write_whole(path, foxglove_bytes(self.contents, self.coverage, self.calibration.frame_id or 'imu_link',
                                                seconds=self.seconds))


def view(source: str | PathLike | SampleBlock, table: Stand | None = None, **choices: Unpack[Choices]) -> View:
    """
    Return the view of a recording, which is calibrated, or of a calibration file: only its parameters.

    Parameters
    ----------
    source : path-like or SampleBlock
        A bag or samples in memory, or a calibration.yaml, or the folder that holds it.
    table : path-like, Table or Arm, optional
        The reference of the recording, as for `calibrate`.
    choices
        See `Choices`.

    Raises
    ------
    ImuCalibrationError
        When the recording or the file cannot be used.

    """
    path = None if isinstance(source, SampleBlock) else _document_of(Path(source))
    if path is None:
        result = calibrate(source, table, **choices).result
        contents = {PARAMETERS: parameters(result.calibration, result.tolerances), RESIDUAL: residual(result),
                    SPECTRUM: spectrum(result, result.gathered.kept)}
        if not contents[SPECTRUM]['lines']:
            del contents[SPECTRUM]
        return View(result.calibration, contents, _coverage(result), contents[RESIDUAL]['windows'][-1]['time'])
    if table is not None:
        raise InputError('a table or arm needs a recording, a calibration file was given; '
                         'omit one')
    calibration = files.read_calibration(path)
    return View(calibration, {PARAMETERS: parameters(calibration, tolerances_of(calibration.model))}, None)


def _document_of(path):
    """Return the calibration file that a path means, None where it means a recording."""
    path = path / 'calibration.yaml' if (path / 'calibration.yaml').is_file() else path
    return path if path.suffix in ('.yaml', '.yml') else None


def _coverage(result: CalibrationResult) -> Coverage:
    if isinstance(result, HandResult):
        found = hand_coverage(replace(NOTHING, poses=result.hand.poses), result, HandOptions(tolerances=result.options.tolerances))
    else:
        assert isinstance(result, TableResult), 'a calibration is made by hand or on a table'
        found = table_coverage(result)
    return replace(found, bars=bars_of(group_states(result)))
