"""The names that a notebook needs, with errors that speak of their arguments; `imu_calibration` offers them."""

from collections.abc import Callable
from functools import wraps
from inspect import signature
from os import PathLike
from typing import ParamSpec, TypeVar

from imu_calibration import files
from imu_calibration.calibration.document import Calibration
from imu_calibration.errors import ImuCalibrationError
from imu_calibration.use_cases.calibrate import calibrate as _calibrate
from imu_calibration.use_cases.check import check as _check
from imu_calibration.use_cases.choices import Choices
from imu_calibration.use_cases.compensate import compensate as _compensate
from imu_calibration.use_cases.diagnose import diagnose as _diagnose
from imu_calibration.use_cases.simulate import simulate as _simulate

Arguments = ParamSpec('Arguments')
Result = TypeVar('Result')


def _for_notebooks(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return the function with errors that name its arguments."""
    names = set(signature(function).parameters)
    hints = {name: f'argument {name}' for name in (names | set(Choices.__annotations__) if 'choices' in names else names)}

    @wraps(function)
    def told(*arguments: Arguments.args, **named: Arguments.kwargs) -> Result:
        try:
            return function(*arguments, **named)
        except ImuCalibrationError as error:
            raise type(error)(error.told(hints)) from None
    return told


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


calibrate = _for_notebooks(_calibrate)
check = _for_notebooks(_check)
compensate = _for_notebooks(_compensate)
diagnose = _for_notebooks(_diagnose)
simulate = _for_notebooks(_simulate)
