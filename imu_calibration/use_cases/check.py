"""Test whether a calibration reduces the errors of a recording."""

from dataclasses import replace
from os import PathLike
from typing import Unpack

from imu_calibration.calibration.hand_workflow import check_by_hand, gravity_of
from imu_calibration.calibration.table_calibration import CheckResult, check_on_table
from imu_calibration.core.samples import SampleBlock
from imu_calibration.document import files
from imu_calibration.document.calibration import Calibration
from imu_calibration.use_cases.choices import Choices, calibration_options, check_names, topics_of
from imu_calibration.use_cases.provenance import made_from
from imu_calibration.use_cases.recordings import name_of, open_bag, provenance_of, source_of
from imu_calibration.use_cases.stand import Stand, table_of


def check(recording: str | PathLike | SampleBlock, calibration: Calibration | str | PathLike, table: Stand | None = None,
          **choices: Unpack[Choices]) -> CheckResult:
    """
    Test whether a calibration helps on a recording: the error before and after, by sensor and kind of motion.

    Parameters
    ----------
    recording : path-like or SampleBlock
        A bag, or samples in memory, of the IMU that was calibrated.
    calibration : Calibration or path-like
    table : path-like, Table or Arm, optional
        The reference of this recording; it need not be the one of the calibration. Without it gravity is: the IMU held still in some
        attitudes, and the turns between them.
    choices
        See `Choices`; the topics, the window settings and the local gravity apply.

    Raises
    ------
    ImuCalibrationError
        When the recording cannot be used, or is of an IMU that is not on the table.

    """
    check_names(choices)
    calibration = files.given_calibration(calibration)
    options, topics = calibration_options(choices), topics_of(choices)
    if table is None:
        result = check_by_hand(source_of(recording, topics, want_joints=False), calibration, options)
        return replace(result, notes=(*_gravity(options, calibration), *_notes(recording, calibration)))
    if not isinstance(recording, SampleBlock):
        open_bag(recording, topics, want_joints=True).close()
    table = table_of(table, [recording], topics, gravity=options.gravity)
    source = source_of(recording, topics, table.joint_names)
    result = check_on_table([source], table, calibration, options=options, names=[name_of(recording)])
    return replace(result, notes=_notes(recording, calibration))


def _gravity(options, calibration):
    """Return a note on the gravity used, when none was given."""
    if options.gravity:
        return ()
    taken = gravity_of(calibration, options)
    return (f'gravity is that of the calibration, {taken:.6g} m/s^2; give the local value if it differs',)


def _notes(recording, calibration):
    """Return a note when the calibration was made from this very recording."""
    same = made_from(calibration.provenance) & made_from(provenance_of([recording], {}))
    return ('it was calibrated from this recording: the result can differ on new recordings',) if same else ()
