"""Mutated inputs for each reader of untrusted input, and the limits of `make fuzz`."""

import pytest
from fuzz import readers, run

from imu_calibration.core.errors import InputError

N_INPUTS = 20
LARGE = (
    'rows that share pages',
    'repeated index entries',
    'overlapping chunks',
    'thousands of Imu topics',
    'own effects',
)
"""Attacks whose inputs take long to draw and to read."""
N_LARGE = 8
"""Their inputs; four of them are the seeds."""


@pytest.mark.parametrize('name', readers.READERS)
def test_mutated_inputs_are_read_or_refused(tmp_path, name):
    reader = readers.READERS[name]
    count = N_LARGE if name in LARGE else N_INPUTS
    record = run.read_inputs(
        reader,
        reader.seeds(tmp_path),
        name,
        tmp_path,
        goes_on=lambda record: record.n_read + record.n_refused < count,
    )
    assert record.n_read > 0 or reader.attack
    assert not record.findings, next(iter(record.findings.values()))[0]


def refuse(data, _folder):
    """A reader that refuses everything."""
    raise InputError('no')


def warn(data, _folder):
    """A reader that warns."""
    import warnings

    warnings.warn('odd', stacklevel=1)


def read_without_end(data, _folder):
    """A reader that never ends."""
    while True:
        pass


def fill_memory(data, _folder):
    """A reader that takes more memory than is allowed."""
    bytearray(2 * run.MEMORY)


def refuse_for_want_of_memory(data, _folder):
    """A reader that refuses what took much memory."""
    bytearray(60_000_000)
    raise InputError('no')


@pytest.mark.live  # each in a process with limits
@pytest.mark.parametrize(
    'read, finding',
    [
        (refuse, None),
        (warn, 'UserWarning'),
        (read_without_end, 'signal 27'),
        (fill_memory, 'MemoryError'),
        (refuse_for_want_of_memory, 'memory'),
    ],
)
def test_faults_of_a_reader_are_findings(monkeypatch, read, finding):
    monkeypatch.setattr(run, 'HANG', 0.2)
    monkeypatch.setattr(run, 'MOST_MEGABYTES', 40.0)
    monkeypatch.setitem(readers.READERS, 'broken', readers.Reader(lambda folder: [], read))
    record = run.fuzz_slice('broken', [b'seed'], 1, 0.2)
    assert (record.n_refused > 0) == (finding in (None, 'memory'))
    assert [finding in place for place in record.findings] == ([True] if finding else [])
