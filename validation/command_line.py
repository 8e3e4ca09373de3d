"""The command line on a recording, as a user would call it."""

import os
import subprocess
import sys
from pathlib import Path

import yaml

from validation.recordings import BOARD, ROOT, SHAFT, reference

ALL = (
    *((name, '/imu/data_raw') for name in SHAFT),
    *((name, f'/imu_{k}/data_raw') for name in ('array_2', 'array_5') for k in BOARD),
    ('xsens_counts', None),
    ('mpu9150_0', None),
    ('mpu9150_3', None),
    ('ferraris', None),
)
"""Every recording, with the topic where there are several."""
TIMEOUT = 1200


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
    """Return (exit code, lines of standard output, last line of standard error)."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get('PYTHONPATH', '')]))
    environment = {**os.environ, 'PYTHONPATH': path, 'COLUMNS': '240', 'NO_COLOR': '1'}
    command = [sys.executable, '-m', 'imu_calibration', verb, str(bag), *options]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=TIMEOUT)
    errors = [line for line in done.stderr.splitlines() if line.strip()]
    return (
        done.returncode,
        [line.rstrip() for line in done.stdout.splitlines()],
        errors[-1] if errors else '',
    )
