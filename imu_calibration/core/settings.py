"""
Every adjustable number, declared once: YAML files, options and ROS parameters are made from here.
"""

import math
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field, fields, replace
from typing import Any

from imu_calibration.core.errors import InputError
from imu_calibration.core.schema import (
    Document,
    Requirement,
    anything,
    flag,
    mapping,
    number,
    require,
    text,
    whole,
)

SETTINGS = Document('setting', anything, 'correct or omit it', error=InputError)
"""Values of settings by name; the requirement of each follows from its declaration."""
CHANGE = 1.5
"""
Factor of the error from which a significant change counts, a convention: with it the error of a
calibration that halved an error still has three quarters of the error before.
"""


@dataclass(frozen=True)
class Setting:
    """One field of a settings dataclass, as it is declared."""

    default: Any
    """Its type is the setting's."""
    unit: str
    """'' or '1' without one."""
    text: str
    """Meaning."""
    bounds: tuple = (None, None)
    """(smallest, largest) value; None: no end."""
    symptom: str = ''
    """Symptoms of a wrong value."""
    _: KW_ONLY
    live: bool = False
    """Whether a change applies to a running session."""
    fixed: str = 'it is read at the start'
    """Why not, when it does not."""
    session: bool = False
    """
    Whether it names an input of a session: settings files omit it, because they would override
    earlier options.
    """
    path: bool = False
    """
    Whether it is the path of a file; such a ROS parameter is read-only, because any participant can
    set writable ones.
    """
    choices: tuple = ()
    """Permitted values; (): any."""
    name: str = ''
    """Name of the field, the option and the parameter."""


def setting(default: Any, *declared: Any, **options: Any) -> Any:
    """Declare one field of a settings dataclass; arguments as in `Setting`."""
    return field(default=default, metadata={'setting': Setting(default, *declared, **options)})


def text_setting(text: str, symptom: str, *, default: str = '', **options: Any) -> Any:
    """Declare a text, which has no unit; arguments as in `Setting`."""
    return setting(default, '', text, symptom=symptom, **options)


def flag_setting(text: str, symptom: str, *, default: bool = False, **options: Any) -> Any:
    """Declare a choice between true and false; arguments as in `Setting`."""
    return setting(default, '', text, symptom=symptom, **options)


def path_setting(text: str, symptom: str, **options: Any) -> Any:
    """Declare the path of a file that is an input of a session; as `text_setting`."""
    return text_setting(text, symptom, session=True, path=True, **options)


def height_setting(**options: Any) -> Any:
    """Declare the height of the place whose latitude is another field; as `setting`."""
    return setting(
        0.0,
        'm',
        'height above the ellipsoid, used with latitude',
        (-500.0, 9000.0),
        '3e-6 m/s^2 of gravity per metre',
        live=True,
        **options,
    )


def describe(group: Any) -> list[Setting]:
    """Return the Setting of each field of a settings class or instance."""
    return [replace(f.metadata['setting'], name=f.name) for f in fields(group)]


def override(group: Any, values: Mapping[str, Any]) -> Any:
    """
    Return a copy of the settings `group` with `values` (name -> value) set.

    Raises
    ------
    InputError
        When a name is unknown, a type does not fit or a value is out of bounds.

    """
    known = {item.name: item for item in describe(group)}
    parts = {name: _requirement(item) for name, item in known.items()}
    require(values, SETTINGS, mapping(optional=parts, closed=True))
    checked = {}
    for name, value in values.items():
        checked[name] = float(value) if isinstance(known[name].default, float) else value
    return replace(group, **checked)


def _requirement(declared: Setting) -> Requirement:
    """Return the requirement of a value: its type is that of the default."""
    low, high = declared.bounds
    low = -math.inf if low is None else low
    high = math.inf if high is None else high
    match declared.default:
        case bool():
            return flag()
        case int():
            return whole(low, high)
        case float():
            return number(low, high)
        case str():
            return text(*declared.choices, code='choice_unknown' if declared.choices else '')
    return anything
