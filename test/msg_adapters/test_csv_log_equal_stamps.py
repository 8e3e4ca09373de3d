"""Text logs whose times were written with too few digits."""

import numpy as np
import pytest
from refusal import refused

from imu_calibration.core.errors import InputError
from msg_adapters.csv_log import read_csv

HEAD = 'time,ax,ay,az,gx (rad/s),gy (rad/s),gz (rad/s)'


def write(path, start, seconds, form, head=HEAD):
    """A log at 50 Hz, at rest, with times in a number format."""
    rng = np.random.default_rng(2)
    time = start + np.arange(int(50 * seconds)) / 50.0
    values = rng.normal(0, 1, (len(time), 6)) * ([0.02] * 3 + [1e-3] * 3)
    values[:, 2] += 9.81
    rows = [head]
    for moment, row in zip(time, values):
        cells = [form % moment]
        for value in row:
            cells.append(f'{value:.9f}')
        rows.append(','.join(cells))
    path.write_text('\n'.join(rows))
    return path


@pytest.mark.parametrize(
    ('start', 'form', 'head', 'number'),
    (
        (1_699_999_000.0, '%.6g', HEAD, 2000),
        (1_699_999_000.0, '%.5g', HEAD.replace('time', 'time (s)'), 2000),
        (86_000.0, '%.4g', HEAD, 5),
    ),
)
def test_stamps_of_few_digits_are_named(tmp_path, start, form, head, number):
    path = write(tmp_path / 'log.csv', start, 40.0, form, head)
    with refused(InputError, 'stamps_equal', number):
        read_csv(path)


def test_stamps_of_enough_digits_are_read(tmp_path):
    block = read_csv(write(tmp_path / 'log.csv', 1_699_999_000.0, 4.0, '%.3f'))
    assert len(block.imu) == 200
