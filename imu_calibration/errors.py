"""Errors that a user can act on: one line saying what must hold, what came, and what to do."""


class ImuCalibrationError(Exception):
    """Base of every error that the command line turns into one line and exit code 1."""


class InputError(ImuCalibrationError):
    """A file, topic, option or value does not fit."""


class NotObservableError(ImuCalibrationError):
    """The data do not determine what was asked for."""


class DocumentError(InputError):
    """A calibration document cannot be used."""
