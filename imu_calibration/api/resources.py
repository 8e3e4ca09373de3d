"""
Files that are installed with the package, searched relative to the running code.

The code runs from a checkout, a colcon workspace or an installation by pip.
"""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

from imu_calibration.core.errors import InputError

PACKAGE = 'imu_calibration'


def share_folder() -> Path:
    """
    Return the folder that holds ``config`` and ``launch``.

    The checkout or installation of this module has priority, so that a second
    installation on the machine cannot replace it; then the sourced workspaces; then the
    interpreter's prefix.

    Raises
    ------
    InputError
        When none of them holds the files.

    """
    for folder in _candidates():
        if (folder / 'config').is_dir() and (folder / 'package.xml').is_file():
            return folder
    raise InputError(
        f'the config files of {PACKAGE} must be installed with it, none found near {__file__};'
        ' reinstall the package'
    )


def config_file(name: str) -> Path:
    """
    Return the path of the installed file `name` of the folder config.

    An example of `name` is ``'tolerances.yaml'``.

    Raises
    ------
    InputError
        When there is no such file.

    """
    folder = share_folder() / 'config'
    path = folder / name
    if not path.is_file():
        known = ', '.join(sorted(p.name for p in folder.glob('*.yaml')))
        raise InputError(
            f"config file '{name}' does not exist in {folder}; the files there are {known}",
            code='config_file_unknown',
        )
    return path


def _candidates() -> Iterator[Path]:
    """Yield the folders that may hold the files, in order of priority."""
    module = Path(__file__).resolve()
    yield module.parents[2]
    for prefix in module.parents[3:]:
        yield prefix / 'share' / PACKAGE
    for prefix in filter(None, os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)):
        yield Path(prefix) / 'share' / PACKAGE
    yield Path(sys.prefix) / 'share' / PACKAGE
