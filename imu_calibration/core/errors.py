"""
Errors that a user can act on: one line with the requirement, the value received and the remedy.

The core states the requirement. If an input is missing, the error has a key of `ERROR_KEYS`, and
the program that prints the error adds its local name: an option of the command line, a parameter or
topic of a node, an argument in a notebook.
"""

from collections.abc import Iterable
from difflib import get_close_matches

ERROR_KEYS = (
    'accelerometer_unit',
    'allow_xacro',
    'anyway',
    'axes',
    'calibration',
    'columns',
    'diagnose',
    'exclude',
    'force',
    'frame_id',
    'gravity',
    'gyroscope_unit',
    'imu_link',
    'imu_topic',
    'increments',
    'inspect',
    'jobs',
    'joint_topic',
    'noise',
    'scheduler',
    'setting',
    'table',
    'target_frame',
    'temperature_topic',
    'up',
    'urdf',
    'where',
)
"""Inputs that an error may request, and programs that a remedy may need."""
OFFERS = {
    'accelerometer_unit': ', or state the unit of the readings',
    'anyway': ', or give your consent',
    'gyroscope_unit': ', or state the unit of the readings',
}
"""Key -> a second remedy, which is offered only where the key has a name."""
REMEDY_VERBS = {
    'diagnose': "run 'imu_calibration diagnose' to {}",
    'inspect': "run 'imu_calibration inspect' to {}",
}
"""Key -> the program for a remedy, unless the hints name another one."""


class ImuCalibrationError(Exception):
    """
    Base of every error that the command line turns into one line and exit code 1.

    Parameters
    ----------
    text : str
        Requirement, value received, remedy.
    key : str, optional
        The missing input, a key of `ERROR_KEYS`.
    code : str
        Stable name of the requirement that is not met, for programs and tests; the text may change.
    value : str
        Proposed value of the missing input, which is printed after its local name.

    """

    def __init__(self, text: str = '', *, key: str | None = None, code: str = '', value: str = ''):
        super().__init__(text)
        self.key = key
        self.code = code
        self.value = value

    def named(self, name: str) -> 'ImuCalibrationError':
        """Return the error with the name of its subject before its text."""
        return type(self)(f'{name}: {self}', key=self.key, code=self.code, value=self.value)

    def with_hint(self, hints: dict[str, str]) -> str:
        """Return the text with the local name of the key; `hints` as for `with_hint`."""
        return with_hint(str(self), self.key, hints, value=self.value)


class InputError(ImuCalibrationError):
    """A file, topic, option or value does not fit."""


class NotObservableError(ImuCalibrationError):
    """The data do not determine the requested parameters."""


class DocumentError(InputError):
    """A document cannot be used."""


def printable(text: str) -> str:
    """
    Return a text with a question mark for each unsafe character.

    These are each line end, control character, change of direction and undecodable byte.
    """
    if text.isprintable() and '\ufffd' not in text:
        return text
    return ''.join(
        character if character.isprintable() and character != '\ufffd' else '?'
        for character in text
    )


def shortened(text: str, length: int = 60) -> str:
    """
    Return a text on one line without control characters, truncated at `length` characters.

    For received text, which may be anything.
    """
    text = printable(' '.join(text[: length * 4].split()))
    return text if len(text) <= length else f'{text[: length - 3]}...'


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return '; did you mean NAME?' with the closest known name, or an empty text."""
    close = get_close_matches(name, list(known), n=1)
    return f'; did you mean {close[0]}?' if close else ''


def with_hint(text: str, key: str | None, hints: dict[str, str], *, value: str = '') -> str:
    """
    Return a text whose remedy is available in the program that prints it.

    Parameters
    ----------
    text : str
    key : str or None
        A key of `ERROR_KEYS`.
    hints : dict
        Key -> its local name, such as ``{'gravity': "parameter 'gravity'"}``, or for a key of
        `REMEDY_VERBS` a phrase with ``{}`` for the text; a key without a local name adds nothing.
    value : str
        Proposed value, printed after the local name.

    """
    if key in REMEDY_VERBS:
        return printable(hints.get(key, REMEDY_VERBS[key]).format(text))
    if key not in hints:
        return printable(text)
    return printable(f'{text}{OFFERS.get(key, "")} ({" ".join([hints[key], value]).strip()})')
