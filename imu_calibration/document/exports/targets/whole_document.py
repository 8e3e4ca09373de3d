"""JSON and MATLAB: the complete document for programs that read neither YAML nor this package."""

import io
import json
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from imu_calibration.core.documents import plain
from imu_calibration.core.errors import InputError
from imu_calibration.document.exports.target import Page, Read, Target, read_json
from imu_calibration.effects.base import SENSORS

MAT_HEADER = b'MATLAB 5.0 MAT-file'
"""
Beginning of a .mat file; the rest of its text, which holds the time, is made blank: the same input
gives the same bytes.
"""
MAT_TEXT_BYTES = 116
"""Length of that text."""
DOCUMENT = 'document_json'
"""Variable with the calibration document."""


def write_json(page: Page) -> str:
    """Return calibration.yaml as JSON, with the comments as an entry."""
    return json.dumps({**plain(page.numbers), 'comments': page.comments}, indent=1) + '\n'


def read_json_document(content: bytes, _path: str | Path) -> Read:
    """Read the document in a JSON file."""
    return Read(read_json(content, 'JSON calibration'))


def write_mat(page: Page) -> bytes:
    """
    Return a struct for each sensor, values with names and covariance, and the document as text.
    """
    from scipy.io import savemat

    calibration = page.calibration
    sensors: dict[str, dict[str, Any]] = {sensor: {} for sensor in SENSORS}
    for effect in calibration.model.effects:
        if effect.section in sensors:
            sensors[effect.section][effect.name] = calibration.value(*effect.key)
    stream = io.BytesIO()
    savemat(
        stream,
        {
            **sensors,
            'param_names': np.array(calibration.param_names, dtype=object),
            'values': calibration.values,
            'sd': calibration.sd,
            'covariance': calibration.covariance,
            'status': np.array(calibration.status, dtype=object),
            'comments': '\n'.join(page.comments),
            DOCUMENT: json.dumps(plain(page.numbers)),
        },
        long_field_names=True,
    )
    return MAT_HEADER.ljust(MAT_TEXT_BYTES) + stream.getvalue()[MAT_TEXT_BYTES:]


def read_mat(content: bytes, _path: str | Path) -> Read:
    """Read the document in a .mat file."""
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    what = 'MATLAB calibration'
    try:
        # Only the text is read: damaged structs crash scipy.
        variables = loadmat(io.BytesIO(content), variable_names=[DOCUMENT])
        text = str(variables[DOCUMENT][0])
    except (
        MatReadError,
        ValueError,
        KeyError,
        IndexError,
        TypeError,
        NotImplementedError,
        OSError,
        MemoryError,
        zlib.error,
    ) as error:
        raise InputError(
            f"the {what} must be a .mat file with '{DOCUMENT}', as an export writes it; give"
            ' another file'
        ) from error
    return Read(read_json(text.encode(), what))


def _target(name: str, title: str, writer: Callable, reader: Callable, suffix: str) -> Target:
    """Return a target that has the complete document."""
    return Target(
        name=name,
        title=title,
        formula=(
            'measured = bias + matrix @ (true + lever-arm terms) + further effects; values in SI'
        ),
        source='imu_calibration, calibration.yaml',
        whole=True,
        write=writer,
        read=reader,
        suffix=suffix,
    )


TARGETS = (
    _target('json', 'the whole document as JSON', write_json, read_json_document, '.json'),
    _target('mat', 'the whole document as MATLAB .mat', write_mat, read_mat, '.mat'),
)
