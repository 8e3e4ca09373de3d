"""Expected errors by class, code and values: sentences may change."""

from contextlib import contextmanager

import pytest


@contextmanager
def refused(kind, code, *values):
    """
    Expect an error.

    Parameters
    ----------
    kind : type
        Class of the error.
    code : str
        See `imu_calibration.core.errors.ImuCalibrationError`.
    values : str or number
        Names and numbers that the text must contain.

    """
    with pytest.raises(kind) as caught:
        yield caught
    assert caught.value.code == code, f'{caught.value.code!r}: {caught.value}'
    assert [value for value in values if str(value) not in str(caught.value)] == [], str(
        caught.value
    )
