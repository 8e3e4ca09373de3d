"""
Documents as YAML text (the same content gives the same bytes), and opening of untrusted files.

Regular ones only, up to a size.
"""

import io
import math
import os
import re
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from errno import EINVAL
from functools import cache
from os import PathLike
from stat import S_ISREG
from typing import Any, BinaryIO, cast

import numpy as np

from imu_calibration.core.errors import DocumentError, shortened
from imu_calibration.core.text_enum import StrEnum

MAX_DOCUMENT_CHARACTERS = 2_000_000
"""
Largest number of characters of a document; the covariance of a hundred parameters has 300 000.
"""
MOST_PARTS = 60_000
"""
Largest number of numbers, texts, lists and mappings in a document: they are read in half a second.
"""
MAX_SCALAR_CHARACTERS = 5000
"""
Largest number of characters of one text or number; the time of a number in base sixty grows with
the square of its length.
"""
NO_SUCH_VALUE = (ValueError, OverflowError, TypeError, AttributeError)
"""Exceptions of the parser for malformed dates and numbers."""
NUMBER_START, MAX_NUMBER_CHARACTERS = re.compile(r'[-+0-9][0-9_:.a-fxA-F+-]*'), 100
"""
Start of a number, and its largest number of characters; larger integers do not fit into a float.
"""
FLOAT = re.compile(r'[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]{1,3}$')
"""
Numbers such as 1e-6 and 1.5e3: the rules of YAML 1.1 require a point and a sign of the exponent;
YAML 1.2, ROS and JSON do not.
"""
MAX_DOCUMENT_DEPTH = 20
"""
Deepest nesting of lists and mappings; the stack of a recursive parser overflows well above it.
"""


def finite(value: float) -> float | None:
    """Return a float, or None for an infinite value or NaN, which documents do not contain."""
    return float(value) if math.isfinite(value) else None


def stated(entry: Any) -> dict[str, Any]:
    """
    Return the fields of a dataclass as the entry of a document, also in its fields and mappings.

    Without fields that are None, False or ''; an unknown number (NaN) becomes null.
    """
    stated_fields = {}
    for field in fields(entry):
        value = getattr(entry, field.name)
        if value is None or value is False or (isinstance(value, str) and not value):
            continue
        stated_fields[field.name] = _entry(value)
    return stated_fields


def _entry(value: Any) -> Any:
    """Return the value of a field as a document has it."""
    if is_dataclass(value):
        return stated(value)
    if isinstance(value, Mapping):
        return {key: _entry(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return list(value)
    return finite(value) if isinstance(value, float) else value


def plain(value: Any) -> Any:
    """Return a value with arrays as lists and numpy's numbers as Python's."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value


def json_types(value: Any) -> Any:
    """Return a value as JSON types: mappings, lists, text, finite numbers, null."""
    if isinstance(value, Mapping):
        return {str(key): json_types(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set)):
        return [json_types(item) for item in value]
    if hasattr(value, 'tolist'):
        return json_types(value.tolist())
    if isinstance(value, float):
        return finite(value)
    return value if value is None or isinstance(value, (str, bool, int)) else str(value)


def to_text(document: dict[str, Any]) -> str:
    """
    Return a mapping as YAML: block style for mappings, lists of numbers on one line each.

    Parameters
    ----------
    document : dict
        Plain dicts, lists, strings and numbers.

    """
    import yaml

    base: Any = _with_floats('SafeDumper')

    class Dumper(base):
        """Writes lists of scalars on one line and floats with all their digits."""

        def ignore_aliases(self, _data):
            return True

    def sequence(dumper, items):
        flat = all(not isinstance(item, (dict, list, tuple)) for item in items)
        return dumper.represent_sequence('tag:yaml.org,2002:seq', items, flow_style=flat)

    Dumper.add_representer(list, sequence)
    Dumper.add_representer(tuple, sequence)
    Dumper.add_multi_representer(StrEnum, lambda dumper, word: dumper.represent_str(word.value))
    return yaml.dump(document, Dumper=Dumper, sort_keys=False, width=100_000, allow_unicode=True)


@cache
def _with_floats(name: str) -> Any:
    """
    Return PyYAML's reader or writer of that name, in C where available, with `FLOAT`.

    A text that resembles a number is then quoted.
    """
    import yaml

    kind: Any = type(name, (getattr(yaml, f'C{name}', getattr(yaml, name)),), {})
    kind.add_implicit_resolver('tag:yaml.org,2002:float', FLOAT, list('-+.0123456789'))
    return kind


def from_text(text: str, name: str = 'document') -> dict[str, Any]:
    """Return the mapping in a YAML text; raises as `parsed`, also when it is not a mapping."""
    document = parsed(text, name)
    if not isinstance(document, dict):
        raise DocumentError(
            f'a {name} must be a mapping, got {type(document).__name__}; correct the file',
            code='not_a_mapping',
        )
    return document


def parsed(text: str, name: str, aliases: bool = False) -> Any:
    """
    Return the content of a YAML text.

    Parameters
    ----------
    text : str
    name : str
        Name of the document in errors.
    aliases : bool
        Whether a part may refer to an earlier one, as recorders write it.

    Raises
    ------
    DocumentError
        When the text is not YAML, is too large or too deep, repeats a key or is built on aliases; a
        text of a few lines could otherwise exhaust the memory.

    """
    import yaml

    loader = _with_floats('SafeLoader')
    _require_at_most(len(text), MAX_DOCUMENT_CHARACTERS, name, 'characters')
    try:
        # The text is parsed twice: the events show its size before any part of it is stored.
        _refuse_large(yaml.parse(text, Loader=loader), name, aliases)
        return yaml.load(text, Loader=loader)
    except (yaml.YAMLError, *NO_SUCH_VALUE) as error:
        raise DocumentError(
            f'a {name} must be YAML, this is not: {shortened(str(error), 500)}; correct the file',
            code='not_yaml',
        ) from error


@dataclass
class _OpenPart:
    """A list or mapping whose end was not parsed yet."""

    anchor: str | None
    """Its name for aliases."""
    count_at_start: int
    """Number of parts of the document up to its start, itself included."""
    keys: set[Any] | None
    """Keys so far of a mapping; None for a list."""
    expects_key: bool = True
    """Whether the next part of a mapping is a key, not a value."""


def _refuse_large(events: Iterable[Any], name: str, aliases: bool) -> None:
    """
    Raise DocumentError for a document that needs much time or memory, or repeats a key.

    `events` of PyYAML's parser are read one by one and need neither. `name` and `aliases` as for
    `parsed`.
    """
    # Number of parts with aliases expanded.
    count = 0
    # Anchor -> number of parts of the part that has it.
    sizes = {}
    # Lists and mappings around the present event, from the outermost to the innermost.
    open_parts: list[_OpenPart] = []
    for event in events:
        kind = type(event).__name__
        if kind.startswith(('Stream', 'Document')):
            continue
        # The end of the innermost list or mapping: its size for later aliases.
        if kind.endswith('EndEvent'):
            part = open_parts.pop()
            sizes[part.anchor] = count - part.count_at_start
            continue
        if kind == 'AliasEvent' and not (aliases and event.anchor in sizes):
            raise DocumentError(
                f'a {name} must not use aliases, this document has YAML aliases (*{event.anchor});'
                ' write it without',
                code='yaml_alias',
            )
        if open_parts and open_parts[-1].keys is not None:
            _check_key(event, open_parts[-1], name)
        # A text or number, an alias of an earlier part, or the start of a list or mapping.
        count += sizes[event.anchor] if kind == 'AliasEvent' else 1
        if kind == 'ScalarEvent':
            sizes[event.anchor] = 1
            _check_scalar(event, name)
        elif kind != 'AliasEvent':
            keys = set() if kind == 'MappingStartEvent' else None
            open_parts.append(_OpenPart(event.anchor, count, keys))
        _require_at_most(len(open_parts), MAX_DOCUMENT_DEPTH, name, 'levels')
        _require_at_most(count, MOST_PARTS, name, 'parts')


def _check_scalar(event: Any, name: str) -> None:
    """Refuse a long text that the parser may convert to a number or date."""
    if not (event.implicit[0] or event.tag):  # a quoted text
        return
    n_characters = len(event.value)
    _require_at_most(n_characters, MAX_SCALAR_CHARACTERS, name, 'characters in a row')
    if NUMBER_START.fullmatch(event.value):
        _require_at_most(n_characters, MAX_NUMBER_CHARACTERS, name, 'characters in a number')


def _check_key(event: Any, mapping: _OpenPart, name: str) -> None:
    """
    Refuse a key that the open mapping has already, and one that merges another mapping into it.

    Called for the event of each key and value of the `_OpenPart`, in turn.
    """
    assert mapping.keys is not None  # it is no list
    is_key = mapping.expects_key
    mapping.expects_key = not is_key
    if not is_key:
        return
    # The value of a scalar key; keys of other kinds have none.
    key: Any = getattr(event, 'value', None)
    if key in mapping.keys or (key == '<<' and event.implicit[0]):
        raise DocumentError(
            f'a {name} must not repeat or merge keys, this one has {shortened(key)!r} again in line'
            f' {event.start_mark.line + 1}; remove it',
            code='key_repeated',
        )
    if key is not None:
        mapping.keys.add(key)


def _require_at_most(number: int, limit: int, name: str, unit: str) -> None:
    """Raise where a document has more than `limit` of a unit, such as characters."""
    if number > limit:
        raise DocumentError(
            f'a {name} must not have more than {limit} {unit}, this one has more; is it the right'
            ' file?',
            code='document_limit',
        )


def version_of(text: str) -> str:
    """
    Return twelve characters that change whenever a document does: the beginning of its SHA-256.
    """
    from hashlib import sha256

    return sha256(text.encode()).hexdigest()[:12]


ARRAYS_BASE, ARRAYS_RATIO = 64 << 20, 20
"""Largest size of arrays: this many bytes, plus this many times their compressed size."""


def open_regular(path: str | PathLike[str]) -> BinaryIO:
    """
    Open a regular file, or a link to one, for reading.

    A FIFO would block, and a device may never end.

    Raises
    ------
    OSError
        When it cannot be opened or is not a regular file.

    """
    # Opening a FIFO would wait for its writer.
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    if not S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(EINVAL, 'it is not a regular file', str(path))
    return cast(BinaryIO, os.fdopen(descriptor, 'rb'))


def load_arrays(data: bytes) -> Any:
    """
    Return the arrays of an .npz archive as a context manager.

    Each is decompressed at its first use.

    Raises
    ------
    ValueError, zipfile.BadZipFile
        If it is no such archive, or its arrays need much more memory than a session.

    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        n_bytes = sum(member.file_size for member in archive.infolist())
        limit = ARRAYS_BASE + ARRAYS_RATIO * len(data)
    if n_bytes > limit:
        raise ValueError(f'its arrays need {n_bytes} bytes, at most {limit} are accepted')
    return np.load(io.BytesIO(data), allow_pickle=False)
