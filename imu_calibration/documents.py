"""Documents as YAML text: the calibration, the table, tolerances. The same content gives the same bytes."""

from enum import StrEnum
from typing import Any

from imu_calibration.errors import InputError

LARGEST = 2_000_000
"""Characters of a document at most; the covariance of a hundred parameters takes 300 000."""
MOST_PARTS = 60_000
"""Numbers, texts, lists and mappings in a document at most: reading so many takes half a second."""
LONGEST = 5000
"""Characters of one text or number at most; a number in base sixty takes time with the square of its length."""
NO_SUCH_VALUE = (ValueError, OverflowError, TypeError, AttributeError)
"""What the parser raises for dates and numbers that are none."""
DEEPEST = 20
"""Levels of lists and mappings inside each other at most; a parser that calls itself for each runs out of stack far beyond."""


def to_text(document: dict[str, Any]) -> str:
    """
    Return a mapping as YAML: block style for mappings, lists of numbers on one line each.

    Parameters
    ----------
    document : dict
        Plain dicts, lists, strings and numbers.

    """
    import yaml

    base: Any = getattr(yaml, 'CSafeDumper', yaml.SafeDumper)

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


def from_text(text: str, what: str = 'document') -> dict[str, Any]:
    """
    Return the mapping in a YAML text.

    Raises
    ------
    InputError
        When the text is not YAML or not a mapping, or too large, too deep or built on aliases; a text of a few lines could otherwise
        take all memory.

    """
    import yaml
    loader = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
    _within_limits(len(text), LARGEST, what, 'characters')
    try:
        _look_through(yaml.parse(text, Loader=loader), what)
        document = yaml.load(text, Loader=loader)
    except (yaml.YAMLError, *NO_SUCH_VALUE) as error:
        line = ' '.join(str(error).split())
        raise InputError(f'a {what} must be YAML, this is not: {line}; correct the file') from error
    if not isinstance(document, dict):
        raise InputError(f'a {what} must be a mapping, got {type(document).__name__}; correct the file')
    return document


def _look_through(events, what):
    """Refuse what would take long or much memory to build, from the parser's events, which take neither."""
    depth = 0
    for count, event in enumerate(events):
        kind = type(event).__name__
        depth += kind.endswith('StartEvent') - kind.endswith('EndEvent')
        if kind == 'AliasEvent':
            raise InputError(f'a {what} must say everything where it stands, this one has YAML aliases (*{event.anchor}); write it without',
                             code='yaml_alias')
        _within_limits(depth - 2, DEEPEST, what, 'levels')   # the stream and the document are levels too
        _within_limits(count, MOST_PARTS, what, 'parts')
        _within_limits(len(getattr(event, 'value', '')), LONGEST, what, 'characters in a row')


def _within_limits(number, limit, what, unit):
    if number > limit:
        raise InputError(f'a {what} must not have more than {limit} {unit}, this one has more; is it the right file?',
                         code='document_limit')


def version_of(text: str) -> str:
    """Return twelve characters that change whenever a document does: the beginning of its SHA-256."""
    from hashlib import sha256
    return sha256(text.encode()).hexdigest()[:12]
