"""Folders of runs that were killed while they wrote a bag."""

import os

import pytest
from test_bag import make_session

from imu_calibration.core.errors import InputError
from msg_adapters.bag_writer import make_partial_folder
from msg_adapters.write import write_session


@pytest.fixture
def ended(monkeypatch):
    """Processes that do not run: every other than this one."""
    from msg_adapters import bag_writer

    monkeypatch.setattr(bag_writer, 'is_running', lambda process: process == os.getpid())


def folder(path, *files):
    """Make a folder with files."""
    path.mkdir()
    for name in files:
        (path / name).write_bytes(b'x')
    return path


@pytest.mark.usefixtures('ended')
def test_a_leftover_of_the_same_output_is_removed(tmp_path, capsys):
    own = folder(tmp_path / f'.bag.77.{"0a" * 8}.partial', 'bag_0.db3', 'bag_0.db3-journal')
    kept = [
        folder(tmp_path / f'.bag.{os.getpid()}.{"0a" * 8}.partial', 'bag_0.db3'),
        folder(tmp_path / f'.other.77.{"0a" * 8}.partial', 'other_0.db3'),
        folder(tmp_path / f'.bag.77.{"0b" * 8}.partial', 'bag_0.db3', 'notes.txt'),
        folder(tmp_path / '.bag.77.partial', 'bag_0.db3'),
        folder(tmp_path / 'target', 'bag_0.db3'),
    ]
    link = tmp_path / f'.bag.77.{"0c" * 8}.partial'
    link.symlink_to(kept[-1])
    imu, *_ = make_session(50)
    write_session(tmp_path / 'bag', imu)
    assert not own.exists() and link.is_symlink()
    assert all(path.is_dir() and any(path.iterdir()) for path in kept)
    (line,) = capsys.readouterr().err.splitlines()
    assert own.name in line


@pytest.mark.usefixtures('ended')
def test_nothing_is_removed_where_the_output_exists(tmp_path):
    own = folder(tmp_path / f'.bag.77.{"0a" * 8}.partial', 'bag_0.db3')
    (tmp_path / 'bag').mkdir()
    with pytest.raises(InputError):
        make_partial_folder(tmp_path / 'bag')
    assert own.exists()
