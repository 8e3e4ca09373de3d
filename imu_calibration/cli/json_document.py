"""The JSON document that --json prints"""

import json
import math
from collections.abc import Mapping
from typing import Any

FORMAT = 'imu_calibration/cli/1'


def json_text(verb: str, exit_code: int, document: Mapping[str, Any]) -> str:
    """Return one JSON document: format, verb, exit code, and the result or the error; numbers that are not finite become null."""
    part = 'error' if 'error' in document else 'result'
    return json.dumps({'format': FORMAT, 'verb': verb, 'exit_code': exit_code, part: _plain(document)}, allow_nan=False)


def _plain(value):
    """Return a value as JSON types: mappings, lists, text, numbers, null."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set)):
        return [_plain(item) for item in value]
    if hasattr(value, 'tolist'):
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, (str, bool, int)) else str(value)
