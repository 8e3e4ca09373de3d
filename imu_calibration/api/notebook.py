"""
The names that a notebook needs, with errors in terms of their arguments.

`imu_calibration` offers them.
"""

from collections.abc import Callable, Sequence
from functools import wraps
from inspect import signature
from os import PathLike
from typing import Any, ParamSpec, TypeVar

from numpy.typing import ArrayLike

from imu_calibration.api.calibrate import Calibrated
from imu_calibration.api.calibrate import calibrate_recordings as _calibrate
from imu_calibration.api.calibrate import check_recording as _check
from imu_calibration.api.choices import Choices
from imu_calibration.api.compensate import Compensated
from imu_calibration.api.compensate import compensate_recording as _compensate
from imu_calibration.api.diagnose import diagnose as _diagnose
from imu_calibration.api.inspect import RecordingSummary
from imu_calibration.api.inspect import inspect_imus as _inspect
from imu_calibration.api.noise import IdentifiedNoise
from imu_calibration.api.noise import identify_recording as _noise
from imu_calibration.api.recordings import Stand
from imu_calibration.api.simulate import simulate as _simulate
from imu_calibration.calibration.check_result import CheckResult
from imu_calibration.core.errors import ImuCalibrationError, InputError
from imu_calibration.core.samples import ImuSamples, SampleBlock
from imu_calibration.document import files
from imu_calibration.document.calibration import Calibration

Arguments = ParamSpec('Arguments')
Result = TypeVar('Result')
Recordings = str | PathLike | SampleBlock | Sequence[str | PathLike | SampleBlock]


API_FUNCTIONS: dict[str, Callable[..., Any]] = {'compensate': _compensate, 'noise': _noise}
"""Function with further options -> the function of `api` that has them."""


def _for_notebooks(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return the function with errors that name its arguments."""
    names = set(signature(function).parameters)
    # Further named arguments are those of the function of `api`, or choices.
    if 'options' in names:
        names |= set(signature(API_FUNCTIONS[function.__name__]).parameters)
    if 'choices' in names:
        names |= set(Choices.__annotations__)
    hints = {name: f'argument {name}' for name in names}

    @wraps(function)
    def with_hints(*arguments: Arguments.args, **named: Arguments.kwargs) -> Result:
        """Call the function; an error names the arguments."""
        try:
            return function(*arguments, **named)
        except ImuCalibrationError as error:
            raise type(error)(error.with_hint(hints), code=error.code) from None

    return with_hints


def _recording(
    verb: str,
    recording: Any,
    time: Any,
    force: Any,
    rate: Any,
    joints: dict[str, ArrayLike] | None,
    temperature_c: ArrayLike | None,
) -> Any:
    """
    Return the recording, or the arrays as one; exactly one of both must be given.

    Arrays as for `SampleBlock.from_arrays`; `verb`: name of the function, for the error.
    """
    arguments = {'recordings': recording, 'time': time, 'force': force, 'rate': rate}
    given = [name for name, values in arguments.items() if values is not None]
    if given == ['recordings']:
        return recording
    if given != ['time', 'force', 'rate']:
        raise InputError(
            f'{verb} must have either recordings, or the arrays time, force and rate, got'
            f' {", ".join(given) or "none"}; give one or the other',
            code='recording_or_arrays',
        )
    return SampleBlock.from_arrays(time, force, rate, joints=joints, temperature_c=temperature_c)


def _needed(verb: str, calibration: Any) -> Any:
    """Return the calibration, which must be given."""
    if calibration is None:
        raise InputError(
            f'{verb} must have a calibration, none was given; give it, or the path of its file',
            key='calibration',
            code='calibration_missing',
        )
    return calibration


@_for_notebooks
def load(path: str | PathLike) -> Calibration:
    """
    Return the calibration in a file: it prints itself and compensates arrays.

    Raises
    ------
    InputError
        When there is no such file, or no calibration in it.

    """
    return files.read_calibration(path)


@_for_notebooks
def calibrate(
    recordings: Recordings | None = None,
    table: Stand | None = None,
    *,
    time: ArrayLike | None = None,
    force: ArrayLike | None = None,
    rate: ArrayLike | None = None,
    joints: dict[str, ArrayLike] | None = None,
    temperature_c: ArrayLike | None = None,
    **choices: Any,
) -> Calibrated:
    """
    Calibrate from recordings, or from arrays: ``calibrate(time=t, force=f, rate=w)``.

    Parameters
    ----------
    recordings : path-like, SampleBlock, or a sequence of them
        Bags, text logs, or samples in memory; absent where arrays are given.
    table : path-like, Table or Arm, optional
        The reference; without one gravity at rest.
    time, force, rate, joints, temperature_c
        See `SampleBlock.from_arrays`.
    choices
        As for `api.calibrate.calibrate_recordings`.

    """
    block = _recording('calibrate', recordings, time, force, rate, joints, temperature_c)
    return _calibrate(block, table, **choices)


@_for_notebooks
def check(
    recording: str | PathLike | SampleBlock | None = None,
    calibration: Calibration | str | PathLike | None = None,
    table: Stand | None = None,
    *,
    time: ArrayLike | None = None,
    force: ArrayLike | None = None,
    rate: ArrayLike | None = None,
    joints: dict[str, ArrayLike] | None = None,
    temperature_c: ArrayLike | None = None,
    **choices: Any,
) -> CheckResult:
    """
    Test a calibration on a recording, or on arrays.

    ``check(calibration=c, time=t, force=f, rate=w)``; arguments as for `calibrate` and
    `api.calibrate.check_recording`.
    """
    block = _recording('check', recording, time, force, rate, joints, temperature_c)
    return _check(block, _needed('check', calibration), table, **choices)


@_for_notebooks
def compensate(
    recording: str | PathLike | ImuSamples | SampleBlock | None = None,
    calibration: Calibration | str | PathLike | None = None,
    *,
    time: ArrayLike | None = None,
    force: ArrayLike | None = None,
    rate: ArrayLike | None = None,
    temperature_c: ArrayLike | None = None,
    **options: Any,
) -> Compensated:
    """
    Correct the calibrated errors in a recording, or in arrays.

    ``compensate(calibration=c, time=t, force=f, rate=w)``; arguments as for `calibrate` and
    `api.compensate.compensate_recording`.
    """
    block = _recording('compensate', recording, time, force, rate, None, temperature_c)
    return _compensate(block, _needed('compensate', calibration), **options)


@_for_notebooks
def inspect(
    recording: str | PathLike | SampleBlock | None = None,
    table: Stand | None = None,
    *,
    time: ArrayLike | None = None,
    force: ArrayLike | None = None,
    rate: ArrayLike | None = None,
    joints: dict[str, ArrayLike] | None = None,
    temperature_c: ArrayLike | None = None,
    **choices: Any,
) -> list[RecordingSummary]:
    """
    Return the RecordingSummary of each Imu topic of a recording, or of arrays.

    Arguments as for `calibrate`.
    """
    block = _recording('inspect', recording, time, force, rate, joints, temperature_c)
    return _inspect(block, table, choices)


@_for_notebooks
def noise(
    recording: str | PathLike | SampleBlock | None = None,
    *,
    time: ArrayLike | None = None,
    force: ArrayLike | None = None,
    rate: ArrayLike | None = None,
    temperature_c: ArrayLike | None = None,
    **options: Any,
) -> IdentifiedNoise:
    """
    Identify the noise of an IMU from a recording at rest, or from arrays.

    Arguments as for `calibrate` and `api.noise.identify_recording`.
    """
    block = _recording('noise', recording, time, force, rate, None, temperature_c)
    return _noise(block, **options)


diagnose = _for_notebooks(_diagnose)
simulate = _for_notebooks(_simulate)
