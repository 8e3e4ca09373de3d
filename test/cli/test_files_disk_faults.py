"""
Places that cannot be written: one line, what was there stays, and nothing half written is left.
"""

import errno
import os
import subprocess
import sys

import pytest
from refusal import refused

from imu_calibration.core.errors import InputError
from imu_calibration.document import files

FULL = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
from imu_calibration.document import files
from imu_calibration.core.errors import InputError
try:
    files.write_whole(sys.argv[1], b'x' * 5000)
except InputError as error:
    print(error)
"""


def place_of(kind, folder):
    """A place of that kind that cannot be written."""
    (folder / 'file').write_text('here already')
    if kind == 'folder without permission':
        if os.geteuid() == 0:
            pytest.skip('root may write everywhere')
        (folder / 'closed').mkdir(mode=0o400)
    return {
        'a file as parent': folder / 'file' / 'calibration.yaml',
        'a name too long': folder / ('x' * 300),
        'a folder': folder,
        'folder without permission': folder / 'closed' / 'calibration.yaml',
        'a path with zero': folder / 'a\0b',
    }[kind]


@pytest.mark.parametrize(
    'write',
    (
        lambda place: files.write_whole(place, b'new'),
        lambda place: files.write_text(place, 'new'),
        files.try_place,
    ),
    ids=('bytes', 'text', 'try'),
)
@pytest.mark.parametrize(
    'kind',
    (
        'a file as parent',
        'a name too long',
        'a folder',
        'folder without permission',
        'a path with zero',
    ),
)
def test_a_place_that_cannot_be_written_is_refused_in_one_line(tmp_path, kind, write):
    place = place_of(kind, tmp_path)
    with refused(InputError, 'not_writable') as refusal:
        write(place)
    assert '\n' not in str(refusal.value)
    assert {path.name for path in tmp_path.iterdir()} <= {'file', 'closed'} and (
        tmp_path / 'file'
    ).read_text() == 'here already'


@pytest.mark.parametrize('step', ('mkdir', 'open', 'fsync', 'replace', 'unlink too'))
@pytest.mark.parametrize(
    'code', (errno.EROFS, errno.EACCES, errno.ENOSPC, errno.EIO), ids=errno.errorcode.get
)
def test_whatever_step_fails_the_old_file_stays_whole(tmp_path, monkeypatch, step, code):
    """
    Also where taking the new file away fails as well.

    That ended the node, with the table's time in it.
    """
    place = tmp_path / 'calibration.yaml'
    place.write_text('old')

    def fail(*arguments, **options):
        raise OSError(code, os.strerror(code))

    where = {
        'mkdir': 'pathlib.Path.mkdir',
        'open': 'builtins.open',
        'fsync': 'os.fsync',
        'replace': 'os.replace',
        'unlink too': 'os.fsync',
    }[step]
    with monkeypatch.context() as patch:
        patch.setattr(where, fail)
        if step == 'unlink too':
            patch.setattr('pathlib.Path.unlink', fail)
        with refused(InputError, 'not_writable', os.strerror(code)):
            files.write_whole(place, b'new')
    assert place.read_text() == 'old'
    assert len(list(tmp_path.iterdir())) == (2 if step == 'unlink too' else 1)


@pytest.mark.live
def test_a_full_disk_leaves_what_was_there(tmp_path):
    place = tmp_path / 'calibration.yaml'
    place.write_text('old')
    done = subprocess.run(
        [sys.executable, '-c', FULL, str(place)], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0 and os.strerror(errno.EFBIG) in done.stdout, done.stderr
    assert place.read_text() == 'old' and list(tmp_path.iterdir()) == [place]


def test_trying_a_place_leaves_nothing_behind_but_its_folder(tmp_path):
    files.try_place(tmp_path / 'new' / 'calibration.yaml')
    assert list(tmp_path.rglob('*')) == [tmp_path / 'new']
    (tmp_path / 'old.yaml').write_text('old')
    files.try_place(tmp_path / 'old.yaml')
    assert (tmp_path / 'old.yaml').read_text() == 'old'


def test_the_longest_name_that_is_allowed_can_be_written(tmp_path):
    place = tmp_path / ('x' * 255)
    files.write_whole(place, b'whole')
    assert place.read_bytes() == b'whole' and list(tmp_path.iterdir()) == [place]


@pytest.mark.parametrize('text', ('~nobody_of_this_name/calibration.yaml',))
def test_a_home_folder_that_does_not_exist_is_refused_in_one_line(text):
    with refused(InputError, 'not_a_path'):
        files.user_path(text)


def test_paths_of_users_become_absolute(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv('HOME', str(tmp_path / 'home'))
    assert files.user_path('a.yaml') == tmp_path / 'a.yaml'
    assert files.user_path('~/b/../a.yaml') == tmp_path / 'home' / 'a.yaml'


@pytest.mark.parametrize('name', ('folder', 'absent', 'latin', 'zero\0'))
def test_a_file_that_cannot_be_read_is_refused_in_one_line(tmp_path, name):
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'latin').write_bytes(b'frame_id: \xff')
    with refused(InputError, 'file_unreadable') as refusal:
        files.read_calibration(tmp_path / name)
    assert '\n' not in str(refusal.value)


def test_no_more_than_a_document_may_hold_is_read_from_a_large_file(tmp_path):
    with refused(InputError, 'file_unreadable'):
        files.read_calibration('/dev/zero')
    with open(tmp_path / 'large.yaml', 'wb') as stream:
        stream.truncate(1 << 40)  # without blocks on the disk
    with refused(InputError, 'document_limit', 2000000):
        files.read_calibration(tmp_path / 'large.yaml')
