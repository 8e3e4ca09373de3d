"""The provenance of a result: verb, recordings, options and files with their hashes; results of other inputs are not overwritten."""

from collections.abc import Iterable, Mapping
from hashlib import sha256
from os import PathLike
from pathlib import Path
from typing import Any

from imu_calibration.core.documents import to_text
from imu_calibration.core.errors import ImuCalibrationError, InputError
from imu_calibration.core.samples import SampleBlock
from imu_calibration.document import files
from imu_calibration.kinematics.table import Table
from imu_calibration.use_cases.choices import Choices
from imu_calibration.use_cases.recordings import provenance_of
from imu_calibration.use_cases.resources import config_file
from imu_calibration.use_cases.stand import Arm, Stand

LABELS = ('serial', 'operator')
"""Options that name the IMU and the person."""
STANDS = ('table', 'urdf', 'site')
"""Options with the files of the reference."""
SHORT_HASH_DIGITS = 16
"""Hexadecimal digits of the hashes that earlier versions wrote."""


def provenance_with(verb: str, recordings: Iterable[str | PathLike | SampleBlock], choices: Choices | Mapping[str, Any], *,
                    stand: Stand | None = None) -> dict[str, Any]:
    """
    Return the provenance of a result, without anything that changes from run to run.

    Parameters
    ----------
    verb : str
        Verb or node that computes the result.
    recordings : iterable
        Bags, or samples in memory.
    choices : mapping
        Options, see `Choices`; the file of tolerances is named also if it is the default.
    stand : Stand, optional
        Table or arm.

    """
    used = dict(choices) | (vars(stand) if isinstance(stand, Arm) else {'table': stand})
    used['tolerances'] = used.get('tolerances') or config_file('tolerances.yaml')
    if isinstance(setting := used.get('setting'), Mapping):
        used['setting'] = [f'{name}={value}' for name, value in setting.items()]
    options = {name: _named(used[name]) for name in sorted(used) if used[name] and name not in LABELS}
    return {'verb': verb, **provenance_of(recordings, options), **{name: str(used[name]) for name in LABELS if used.get(name)}}


def _named(option):
    """Return name and hash of a file or of data in memory; other options unchanged."""
    if isinstance(option, (str, PathLike)):
        return {'name': Path(option).name, 'sha256': files.hash_of(option)} if Path(option).is_file() else str(option)
    if isinstance(option, (bool, int, float)):
        return option
    if isinstance(option, Iterable) and not isinstance(option, Mapping):
        return list(option)
    mapping = option.to_mapping() if isinstance(option, Table) else option
    known = {'sha256': sha256(to_text(dict(mapping)).encode()).hexdigest()} if isinstance(mapping, Mapping) else {}
    return {'name': 'in memory', **known}


def made_from(found: Mapping[str, Any]) -> set[str]:
    """Return the hashes of the recordings of a provenance, as many digits as all versions write."""
    return {str(bag.get('sha256'))[:SHORT_HASH_DIGITS] for bag in found.get('bags') or () if isinstance(bag, Mapping)}


def require_same_inputs(folder: str | PathLike, found: Mapping[str, Any]) -> None:
    """
    Refuse to overwrite the calibration of another verb or of other inputs.

    Parameters
    ----------
    folder : path-like
        Output folder.
    found : mapping
        Provenance of the new result.

    Raises
    ------
    InputError
        If calibration.yaml in the folder differs in verb, recordings, table or robot description, or is none.

    """
    path = Path(folder) / 'calibration.yaml'
    if not path.exists():
        return
    try:
        before = files.read_mapping(path, 'calibration document').get('provenance')
    except ImuCalibrationError:
        before = None
    before = before if isinstance(before, Mapping) else {}
    parts = {'verb': before.get('verb', found['verb']) == found['verb'], 'recordings': made_from(before) == made_from(found),
             'reference': _stands(before) == _stands(found)}
    if not all(parts.values()):
        raise InputError(f'a result must not replace that of other inputs, {path} differs in '
                         f'{" and ".join(name for name, same in parts.items() if not same)}; choose another folder, or overwrite it',
                         key='force', code='other_result')


def _stands(found):
    options = found.get('options')
    return {name: options[name] for name in STANDS if name in options} if isinstance(options, Mapping) else {}
