"""Files that the verbs read and write: whole or not at all."""

import hashlib
import os
from contextlib import contextmanager
from pathlib import Path

from imu_calibration import documents
from imu_calibration.calibration.document import calibration_from_text
from imu_calibration.errors import InputError
from imu_calibration.reference.table import Table


def read_text(path, what):
    """Return the text of a file, or refuse in one line."""
    try:
        return Path(path).read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f'the {what} {path} must be a readable text file: {getattr(error, "strerror", None) or error}; correct the path') from error


def read_mapping(path, what):
    """Return the mapping in a YAML file."""
    try:
        return documents.from_text(read_text(path, what), what)
    except InputError as error:
        raise error.named(path) from error


def read_table(path):
    """Return the table that a YAML file describes."""
    return Table.from_mapping(read_mapping(path, 'table description'))


def read_calibration(path):
    """Return the calibration in a file."""
    return calibration_from_text(read_text(path, 'calibration'))


def make_folder(path):
    """Return the output folder, made and checked for writing before any work is done."""
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f'.write_test_{os.getpid()}'
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f'the output folder {folder} must be writable: {error.strerror}; choose another one') from error
    return folder


@contextmanager
def output_folder(path):
    """Give the output folder; when the work is refused, folders that were made for it are taken away again."""
    missing = [folder for folder in (Path(path), *Path(path).parents) if not folder.exists()]
    folder = make_folder(path)
    try:
        yield folder
    except BaseException:
        for made in missing:
            if not made.is_dir() or any(made.iterdir()):
                break
            made.rmdir()
        raise


def write_text(path, text):
    """Write a file beside and rename it, so that it is never half written."""
    path = Path(path)
    beside = path.with_name(f'.{path.name}.{os.getpid()}')
    try:
        beside.write_text(text, encoding='utf-8')
        os.replace(beside, path)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise InputError(f'{path} must be writable: {error.strerror}; choose another place') from error


def hash_of(path):
    """Return the SHA-256 of a bag: of its data files in order of name, 16 hexadecimal digits."""
    path, digest = Path(path), hashlib.sha256()
    files = sorted(f for f in path.rglob('*') if f.is_file() and f.name != 'metadata.yaml') if path.is_dir() else [path]
    for file in files:
        with open(file, 'rb') as stream:
            while chunk := stream.read(1 << 20):
                digest.update(chunk)
    return digest.hexdigest()[:16]


def write_whole(path, data, to_disk=True):
    """
    Write bytes beside the file and rename.

    Parameters
    ----------
    path : path-like
    data : bytes
    to_disk : bool
        Wait until the disk has them, so that they outlast a power failure; a busy disk takes seconds.

    Raises
    ------
    InputError
        When the place cannot be written; what was there stays.

    """
    path = Path(path)
    beside = path.with_name(f'.{path.name}.{os.getpid()}')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(beside, 'wb') as stream:
            stream.write(data)
            if to_disk:
                stream.flush()
                os.fsync(stream.fileno())
        os.replace(beside, path)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise InputError(f'{path} must be writable: {error.strerror}; choose another place') from error
