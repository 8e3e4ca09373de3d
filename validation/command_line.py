"""The command line on a recording, as a user would call it."""

import contextlib
import io
import os
from pathlib import Path
from unittest.mock import patch

import yaml

from imu_calibration.cli.main import main
from validation.recordings import BOARD, SHAFT, reference

ALL = (
    *((name, '/imu/data_raw') for name in SHAFT),
    *((name, f'/imu_{k}/data_raw') for name in ('array_2', 'array_5') for k in BOARD),
    ('xsens_counts', None),
    ('mpu9150_0', None),
    ('mpu9150_3', None),
    ('ferraris', None),
)
"""Every recording, with the topic where there are several."""
WIDE = {'COLUMNS': '240', 'NO_COLOR': '1'}
"""Environment in which no line is broken."""


def options_of(folder, name, topic, work):
    """Return the options that a recording needs: topic, table, nominal scaling."""
    options, known = [], reference(folder, name)
    if topic:
        options += ['--imu-topic', topic]
    if (folder / name / 'table.yaml').is_file():
        options += ['--table', str(folder / name / 'table.yaml')]
    if 'nominal' in known:
        path = Path(work, f'{name}_nominal.yaml')
        path.write_text(yaml.safe_dump(known['nominal']))
        options += ['--nominal', str(path)]
    return options


def run_verb(verb, bag, options):
    """
    Return (exit code, lines of standard output, last line of standard error).

    The verb runs in this process, which has imported the package once.
    """
    printed, complained = io.StringIO(), io.StringIO()
    with (
        patch.dict(os.environ, WIDE),
        contextlib.redirect_stdout(printed),
        contextlib.redirect_stderr(complained),
    ):
        code = main([verb, str(bag), *options])
    errors = [line for line in complained.getvalue().splitlines() if line.strip()]
    return (
        code,
        [line.rstrip() for line in printed.getvalue().splitlines()],
        errors[-1] if errors else '',
    )
