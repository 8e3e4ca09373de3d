"""
The names that a notebook needs, with errors in terms of their arguments.

`imu_calibration` offers them.
"""

from collections.abc import Callable, Sequence
from functools import wraps
from inspect import signature
from os import PathLike
from typing import Any, ParamSpec, TypeVar, cast

from numpy.typing import ArrayLike

from imu_calibration.core.errors import ImuCalibrationError, InputError
from imu_calibration.core.samples import SampleBlock
from imu_calibration.document import files
from imu_calibration.document.calibration import Calibration
from imu_calibration.use_cases.calibrate import Calibrated
from imu_calibration.use_cases.calibrate import calibrate as _calibrate
from imu_calibration.use_cases.calibrate import check as _check
from imu_calibration.use_cases.choices import Choices
from imu_calibration.use_cases.compensate import compensate as _compensate
from imu_calibration.use_cases.diagnose import diagnose as _diagnose
from imu_calibration.use_cases.recordings import Stand
from imu_calibration.use_cases.simulate import simulate as _simulate

Arguments = ParamSpec('Arguments')
Result = TypeVar('Result')
Recordings = str | PathLike | SampleBlock | Sequence[str | PathLike | SampleBlock]


def _for_notebooks(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return the function with errors that name its arguments."""
    names = set(signature(function).parameters)
    hints = {
        name: f'argument {name}'
        for name in (names | set(Choices.__annotations__) if 'choices' in names else names)
    }

    @wraps(function)
    def with_hints(*arguments: Arguments.args, **named: Arguments.kwargs) -> Result:
        try:
            return function(*arguments, **named)
        except ImuCalibrationError as error:
            raise type(error)(error.with_hint(hints), code=error.code) from None

    return with_hints


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
        As for `use_cases.calibrate.calibrate`.

    """
    given = [values is not None for values in (recordings, time, force, rate)]
    if given not in ([True, False, False, False], [False, True, True, True]):
        names = [
            name
            for name, there in zip(('recordings', 'time', 'force', 'rate'), given, strict=True)
            if there
        ]
        raise InputError(
            'calibrate must have either recordings, or the arrays time, force and rate, got'
            f' {", ".join(names) or "none"}; give one or the other'
        )
    if recordings is None:
        recordings = SampleBlock.from_arrays(
            cast(ArrayLike, time),
            cast(ArrayLike, force),
            cast(ArrayLike, rate),
            joints=joints,
            temperature_c=temperature_c,
        )
    return _calibrate(recordings, table, **choices)


check = _for_notebooks(_check)
compensate = _for_notebooks(_compensate)
diagnose = _for_notebooks(_diagnose)
simulate = _for_notebooks(_simulate)
