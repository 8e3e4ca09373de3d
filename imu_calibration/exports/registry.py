"""The targets that there are: every module of `targets` that declares TARGETS."""

from functools import cache
from importlib import import_module
from pkgutil import iter_modules

from imu_calibration.errors import InputError, did_you_mean
from imu_calibration.exports import targets
from imu_calibration.exports.target import Target


@cache
def all_targets() -> dict[str, Target]:
    """Return every target by name, in alphabetical order."""
    modules = [import_module(f'{targets.__name__}.{found.name}') for found in iter_modules(targets.__path__)]
    return {target.name: target for target in sorted((t for module in modules for t in module.TARGETS), key=lambda t: t.name)}


def find_target(name: str) -> Target:
    """
    Return the target of a name.

    Raises
    ------
    InputError
        When there is none.

    """
    return _find(name, [target for target in all_targets().values() if target.write is not None], 'written')


def find_reader(name: str) -> Target:
    """
    Return the target of a name; its files must be readable.

    Raises
    ------
    InputError
        When there is none.

    """
    return _find(name, [target for target in all_targets().values() if target.read is not None], 'read')


def _find(name: str, fitting: list[Target], what: str) -> Target:
    for target in fitting:
        if target.name == name:
            return target
    raise InputError(f"the name of a program whose files can be {what} is required, got '{name}'"
                     f"{did_you_mean(name, (target.name for target in fitting))}; choose from "
                     f"{', '.join(target.name for target in fitting)}")
