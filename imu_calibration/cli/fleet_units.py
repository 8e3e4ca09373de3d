"""Which recordings in a folder belong to which unit."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from imu_calibration.calibration.fleet import Unit
from imu_calibration.errors import InputError
from imu_calibration.reference.joint import JointNames
from imu_calibration.use_cases.recordings import Topics, provenance_of, source_of
from msg_adapters.storages import suffixes


def find_units(folder: str, output: str) -> list[tuple[str, list[Path]]]:
    """
    Return (name, paths of recordings) for each unit: a bag, or a sub-folder that holds bags, which are joined.

    Parameters
    ----------
    folder : path-like
        Folder of units.
    output : path-like
        Folder of results, left out when it lies in `folder`.

    Raises
    ------
    InputError
        When the folder does not exist or holds no unit.

    """
    folder, output = Path(folder), Path(output).resolve()
    if not folder.is_dir():
        raise InputError(f'the folder of units {folder} must exist, there is none; correct the path')
    members = [path for path in sorted(folder.iterdir()) if not path.name.startswith('.') and path.resolve() != output]
    units = [(path.name if path.is_dir() else path.stem, bags_of(path)) for path in members if path.is_dir() or is_bag(path)]
    units = [(name, bags or [folder / name]) for name, bags in units]
    names = [name for name, _ in units]
    units = [(name if names.count(name) == 1 else bags[0].name, bags) for name, bags in units]
    if not units:
        raise InputError(f'{folder} must hold one bag or one sub-folder with bags per unit, there is none; give the folder above the bags')
    return units


def bags_of(path: Path) -> list[Path]:
    """Return the recordings of a unit in order of name."""
    return [path] if is_bag(path) else [inner for inner in sorted(path.iterdir()) if is_bag(inner)]


def is_bag(path: Path) -> bool:
    """Return whether a path has the form of a recording."""
    if not path.is_dir():
        return path.suffix in (*suffixes(), '.bag')
    return (path / 'metadata.yaml').exists() or any(inner.suffix in suffixes() for inner in path.iterdir())


def unit_of(name: str, paths: Sequence[Path], topics: Topics, *, joint_names: JointNames, options: dict[str, Any]) -> Unit:
    """Return the Unit with sources that read the bags without reporting progress."""
    paths = [path.resolve() for path in paths]
    sources = tuple(source_of(path, topics, joint_names, quiet=True) for path in paths)
    return Unit(name, sources, tuple(path.name for path in paths), partial(provenance_of, paths, options))
