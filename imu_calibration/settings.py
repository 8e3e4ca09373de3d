"""Every adjustable number, declared once: YAML files, options and ROS parameters are made from here."""

from dataclasses import field, fields, replace

from imu_calibration.errors import InputError


def setting(default, unit, text, bounds=(None, None), symptom=''):
    """Declare one field of a settings dataclass: default, unit, meaning, bounds, and what a wrong value looks like."""
    return field(default=default, metadata={'unit': unit, 'text': text, 'bounds': bounds, 'symptom': symptom})


def describe(group):
    """Return (name, default, unit, text, bounds, symptom) for each field of a settings class or instance."""
    return [(f.name, f.default, *(f.metadata[key] for key in ('unit', 'text', 'bounds', 'symptom'))) for f in fields(group)]


def override(group, values):
    """
    Return a copy of the settings `group` with `values` (name -> value) set.

    Raises
    ------
    InputError
        When a name is unknown, a type does not fit or a value is out of bounds.

    """
    known = {f.name: f for f in fields(group)}
    checked = {}
    for name, value in values.items():
        if name not in known:
            raise InputError(f"setting '{name}' is unknown; the settings here are {', '.join(sorted(known))}")
        checked[name] = _checked(known[name], value)
    return replace(group, **checked)


def _checked(declared, value):
    default, (low, high) = declared.default, declared.metadata['bounds']
    if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if default is not None and not isinstance(value, type(default)):
        raise InputError(f"setting '{declared.name}' must be {type(default).__name__}, got {value!r}; correct it")
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        if (low is not None and value < low) or (high is not None and value > high):
            raise InputError(f"setting '{declared.name}' must lie in [{low}, {high}], got {value!r}; choose a value inside")
    return value
