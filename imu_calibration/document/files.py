"""Files that the verbs read and write, atomically."""

import hashlib
import io
import os
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from errno import EISDIR
from functools import lru_cache, partial
from itertools import count
from os import PathLike
from pathlib import Path
from secrets import token_hex
from stat import S_ISDIR
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any, NamedTuple

from imu_calibration.core import documents
from imu_calibration.core.documents import open_regular
from imu_calibration.core.errors import InputError, shortened
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.calibration_text import calibration_from_text, checked_tolerances
from imu_calibration.effects.catalogue import CATALOGUE, Catalogue
from imu_calibration.kinematics.table import Table

if TYPE_CHECKING:
    from imu_calibration.allan.figures import NoiseFigures

REPORT = 'report.html'
"""Page next to the document of a result; one name for all verbs."""


def user_path(text: str) -> Path:
    """
    Return the absolute path that a user means, with ``~`` for the home folder.

    Raises
    ------
    InputError
        When there is no such user.

    """
    try:
        return Path(os.path.abspath(Path(text).expanduser()))
    except (RuntimeError, ValueError) as error:
        raise InputError(
            f'{text!r} must be a path: {error}; correct it', code='not_a_path'
        ) from error


def name_of_path(path: str | PathLike[str]) -> str:
    """Return the name of a file or folder, of ``.`` and ``..`` too."""
    return os.path.basename(os.path.abspath(path))


def read_text(path: str | PathLike[str], what: str) -> str:
    """
    Return the text of a file, or refuse in one line.

    It is read up to one character more than a document may have, so that its reader refuses it.
    """
    try:
        with io.TextIOWrapper(open_regular(path), encoding='utf-8') as stream:
            return stream.read(documents.MAX_DOCUMENT_CHARACTERS + 1)
    except (OSError, ValueError) as error:
        raise InputError(
            f'the {what} {path} must be a readable text file: {_why(error)}; correct the path',
            code='file_unreadable',
        ) from error


def read_bytes(path: str | PathLike[str], what: str) -> bytes:
    """Return the bytes of a file, or refuse in one line."""
    try:
        with open_regular(path) as stream:
            return stream.read()
    except (OSError, ValueError) as error:
        raise InputError(
            f'the {what} {path} must be readable: {_why(error)}; correct the path'
        ) from error


def _why(error: Exception) -> str:
    """Return the text of an error, for one of the operating system without number and path."""
    return getattr(error, 'strerror', None) or str(error) or type(error).__name__


def read_mapping(path: str | PathLike[str], what: str, checked: Callable | type = dict) -> Any:
    """
    Return the mapping in a YAML file, as `checked` returns it; an error of either names the file.
    """
    try:
        return checked(documents.from_text(read_text(path, what), what))
    except InputError as error:
        raise error.named(str(path)) from error


def read_table(
    path: str | PathLike[str], *, gravity: float | None = None, gravity_sd: float = 0.0
) -> Table:
    """Return the table that a YAML file describes, with the gravity of `Table.at`."""
    mapping = read_mapping(path, 'table description')
    return Table.from_mapping(mapping, gravity=gravity, gravity_sd=gravity_sd)


def read_tolerances(path: Path, catalogue: Catalogue = CATALOGUE) -> dict[str, dict[str, float]]:
    """Return the tolerances in a YAML file: {section: {effect: tolerance}}."""
    return read_mapping(
        path, 'tolerance file', lambda mapping: checked_tolerances(mapping, catalogue)
    )


def read_effects(path: str | PathLike[str]) -> Catalogue:
    """
    Return the catalogue with the effects that a YAML file defines.

    The file is a file of effects or a calibration.
    """
    return read_mapping(path, 'file of effects', CATALOGUE.with_document)


def read_robot_description(path: str | PathLike[str], allow_xacro: bool = False) -> str:
    """
    Return the text of a robot description.

    Parameters
    ----------
    path : path-like
    allow_xacro : bool
        Expand a .xacro file. Its expressions can execute any Python code, so that expanding it is
        running a program.

    Raises
    ------
    InputError
        When the file cannot be read or expanded, or is a .xacro file without that permission.

    """
    text = read_text(path, 'robot description')
    if Path(path).suffix != '.xacro':
        return text
    if not allow_xacro:
        raise InputError(
            f'a .xacro file is a program and needs explicit permission to run, got {path}; expand'
            ' it to a .urdf, or allow it if you trust its author',
            key='allow_xacro',
        )
    try:
        import xacro
    except ImportError as error:
        raise InputError(
            'a .xacro file needs the package xacro, it is not installed; install'
            " 'imu_calibration[arm]'",
            code='package_missing',
        ) from error
    try:
        return xacro.process_file(str(path)).toxml()
    except Exception as error:  # expressions in macros may raise any exception
        reason = shortened(str(error), 200) or type(error).__name__
        raise InputError(
            f'the robot description {path} must be one that xacro can expand, it says: {reason};'
            ' correct it, or expand it yourself to a .urdf',
            code='xacro_fails',
        ) from error


def calibration_path(path: str | PathLike[str]) -> Path:
    """Return the path of a calibration; that of calibration.yaml in a folder."""
    return Path(path) / 'calibration.yaml' if Path(path).is_dir() else Path(path)


def read_calibration(path: str | PathLike[str]) -> Calibration:
    """Return the calibration in a file, or in calibration.yaml of a folder."""
    return calibration_from_text(read_text(calibration_path(path), 'calibration'))


def given_calibration(calibration: Calibration | str | PathLike[str]) -> Calibration:
    """Return a calibration, which is read if it is the path of a file."""
    if isinstance(calibration, (str, PathLike)):
        return read_calibration(calibration)
    return calibration


def read_noise(path: str | os.PathLike) -> 'NoiseFigures':
    """Return the noise in a file that the verb `noise` wrote; an error names the file."""
    # Here, because its import needs 1 MB of the compensator node.
    from imu_calibration.allan.document import noise_from_text

    try:
        return noise_from_text(read_text(path, 'noise document'))
    except InputError as error:
        raise error.named(str(path)) from error


def make_folder(path: str | PathLike[str]) -> Path:
    """Return the output folder, made and checked for writing before any work is done."""
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):
            pass
    except (OSError, ValueError) as error:
        raise InputError(
            f'the output folder {folder} must be writable: {_why(error)}; choose another one'
        ) from error
    return folder


@contextmanager
def output_folder(path: str) -> Iterator[Path]:
    """Yield the output folder; when the work is refused, folders made for it are removed."""
    missing = [folder for folder in (Path(path), *Path(path).parents) if not folder.exists()]
    try:
        yield make_folder(path)
    except BaseException:
        with suppress(OSError):  # a folder with content is not removed
            for folder in missing:  # the innermost first
                folder.rmdir()
        raise


def require_new(path: str | PathLike[str], *, force: bool) -> None:
    """
    Refuse to replace an existing file without consent.

    Raises
    ------
    InputError
        If the file exists and `force` is false.

    """
    if not force and Path(path).exists():
        raise InputError(
            f'an existing file must not be replaced silently, {path} exists; choose another one, or'
            ' overwrite it',
            key='force',
            code='file_exists',
        )


def write_text(path: str | PathLike[str], text: str) -> None:
    """Write a text file atomically; raises as `write_whole`."""
    write_whole(path, text.encode(), to_disk=False)


def write_texts(folder: str | PathLike[str], texts: Mapping[str, str]) -> None:
    """
    Write {name: text} into a folder, which is made; raises as `make_folder` and `write_whole`.
    """
    place = make_folder(folder)
    for name, text in texts.items():
        write_text(place / name, text)


def hash_of(path: str | PathLike[str]) -> str:
    """
    Return the SHA-256 of a file, or of the data files of a bag in order of name, as hex digits.
    """
    path = Path(path)
    paths = [path]
    if path.is_dir():
        paths = sorted(f for f in path.rglob('*') if f.is_file() and f.name != 'metadata.yaml')
    states = []
    for file in paths:
        state = file.stat()
        states.append(_FileState(file, state.st_size, state.st_mtime_ns, state.st_ino))
    return _hash_of_unchanged(tuple(states))


HASHED_PIECE_BYTES = 1 << 20


class _FileState(NamedTuple):
    """A file and the signs of a change of it."""

    path: Path
    """Path."""
    size: int
    """Bytes."""
    changed_ns: int
    """Time of the last change, ns."""
    inode: int
    """Number in the file system."""


@lru_cache
def _hash_of_unchanged(files: tuple[_FileState, ...]) -> str:
    """Return the hash of the content of files; unchanged ones are read once in a process."""
    digest = hashlib.sha256()
    for file in files:
        with open(file.path, 'rb') as stream:
            for piece in iter(partial(stream.read, HASHED_PIECE_BYTES), b''):
                digest.update(piece)
    return digest.hexdigest()


def write_whole(path: str | PathLike[str], data: bytes, to_disk: bool = True) -> None:
    """
    Write bytes to a temporary file in the same folder and rename it.

    Parameters
    ----------
    path : path-like
    data : bytes
    to_disk : bool
        Wait until the data are on the disk, so that they survive a power failure; seconds on a busy
        disk.

    Raises
    ------
    InputError
        When the path cannot be written; an existing file is unchanged.

    """
    path = Path(path)
    with _temporary_name(path) as temporary:
        with open(temporary, 'xb') as stream:
            stream.write(data)
            if to_disk:
                stream.flush()
                os.fsync(stream.fileno())
        os.replace(temporary, path)


def try_place(path: Path) -> None:
    """
    Check that `write_whole` could write a file now; only its folder remains.

    Raises
    ------
    InputError
        When it could not.

    """
    path = Path(path)
    with _temporary_name(path) as temporary:
        with open(temporary, 'xb') as stream:
            stream.write(b'.')
        with suppress(FileNotFoundError):
            if S_ISDIR(os.stat(path).st_mode):
                raise IsADirectoryError(EISDIR, os.strerror(EISDIR))


def put_aside(path: str | PathLike[str]) -> Path:
    """
    Rename a file to the first of NAME.1, NAME.2, ... that is free, and return that.

    Raises
    ------
    InputError
        When it cannot be renamed.

    """
    path = Path(path)
    for number in count(1):
        free = path.with_name(f'{path.name}.{number}')
        if not free.exists():
            break
    try:
        os.rename(path, free)
    except OSError as error:
        raise InputError(
            f'{path} must be movable to {free.name}: {_why(error)}; move it away'
        ) from error
    return free


def remove_leftovers(path: Path) -> None:
    """
    Remove the temporary files of processes that were killed while they wrote a file.

    Errors are ignored.
    """
    with suppress(OSError, ValueError):
        # As `_temporary_name` names them: .PROCESS.RANDOM.ENDING
        for file in path.parent.glob(f'.[0-9]*.{_ending(path)}'):
            process = file.name.split('.')[1]
            if process.isdigit() and not is_running(int(process)):
                file.unlink(missing_ok=True)


def is_running(process: int) -> bool:
    """Return whether a process of this host has this number."""
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # of another user
        pass
    return True


def _ending(path: Path) -> str:
    """Return the ending of the names of temporary files of a path: the checksum of its name."""
    return f'{zlib.crc32(path.name.encode(errors="replace")):08x}'


@contextmanager
def _temporary_name(path: Path) -> Iterator[Path]:
    """
    Yield an unpredictable name in the same folder for a temporary file, removed at the end.

    An error of the operating system becomes an InputError.
    """
    # A link placed under a predictable name would be followed; a suffix to a name of the longest
    # length would exceed the limit.
    temporary = path.parent / f'.{os.getpid()}.{token_hex(8)}.{_ending(path)}'
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
    except (OSError, ValueError) as error:
        raise InputError(
            f'{path} must be writable: {_why(error)}; choose another place', code='not_writable'
        ) from error
    finally:
        with suppress(OSError, ValueError):  # in a read-only folder removal fails too
            temporary.unlink(missing_ok=True)
