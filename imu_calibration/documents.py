"""Documents as YAML text: the calibration, the table, tolerances. The same content gives the same bytes."""

from imu_calibration.errors import InputError


def to_text(document):
    """
    Return a mapping as YAML: block style for mappings, lists of numbers on one line each.

    Parameters
    ----------
    document : dict
        Plain dicts, lists, strings and numbers.

    """
    import yaml

    class Dumper(yaml.SafeDumper):
        """Writes lists of scalars on one line and floats with all their digits."""

        def ignore_aliases(self, data):
            return True

    def sequence(dumper, items):
        flat = all(not isinstance(item, (dict, list, tuple)) for item in items)
        return dumper.represent_sequence('tag:yaml.org,2002:seq', items, flow_style=flat)

    Dumper.add_representer(list, sequence)
    Dumper.add_representer(tuple, sequence)
    return yaml.dump(document, Dumper=Dumper, sort_keys=False, width=100_000, allow_unicode=True)


def from_text(text, what='document'):
    """
    Return the mapping in a YAML text.

    Raises
    ------
    InputError
        When the text is not YAML or not a mapping.

    """
    import yaml
    loader = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
    try:
        document = yaml.load(text, Loader=loader)
    except yaml.YAMLError as error:
        line = str(error).replace('\n', ' ')
        raise InputError(f'a {what} must be YAML, this is not: {line}; correct the file') from error
    if not isinstance(document, dict):
        raise InputError(f'a {what} must be a mapping, got {type(document).__name__}; correct the file')
    return document


def version_of(text):
    """Return twelve characters that change whenever a document does: the beginning of its SHA-256."""
    from hashlib import sha256
    return sha256(text.encode()).hexdigest()[:12]
