"""
Where a session is kept: each of two files is whole or as it was, and whoever asked knows which.
"""

import errno
import os
import signal
import subprocess
import sys
from types import SimpleNamespace

import pytest

from imu_calibration.document import files
from imu_calibration.nodes.calibration_worker import SessionFiles


def live(n_windows=7, saved=b'motion'):
    """Stands for a session."""
    return SimpleNamespace(n_windows=n_windows, saved=lambda pending: saved)


FULL_DISK = """
import sys
from types import SimpleNamespace
from imu_calibration.nodes.calibration_worker import SessionFiles

def live(n_windows, size):
    return SimpleNamespace(n_windows=n_windows, saved=lambda pending: b'%d' % n_windows * size)

place = SessionFiles(sys.argv[1] + '/calibration.yaml')
print(*place.save(live(3, 40_000), 'the first'), sep='; ')
print(*place.save(live(4, 120_000), 'the second'), sep='; ')
saved = set(place.accumulator.read_text())
n_files = len(list(place.accumulator.parent.iterdir()))
print(place.unsaved(live(5, 0)), place.calibration.read_text(), saved, n_files)
"""
ON_A_SMALL_DISK = [
    'unshare',
    '--user',
    '--map-root-user',
    '--mount',
    'sh',
    '-c',
    'mount -t tmpfs -o size=128k tmpfs "$1" || exit 77; exec "$2" -c "$3" "$1"',
    'sh',
]
"""Mounts a disk of 128 kB that nobody else sees and that ends with the process."""


@pytest.mark.live
def test_on_a_disk_that_is_really_full_what_was_there_stays_whole(tmp_path):
    try:
        done = subprocess.run(
            [*ON_A_SMALL_DISK, str(tmp_path), sys.executable, FULL_DISK],
            capture_output=True,
            text=True,
            timeout=60,
        )
    except FileNotFoundError:
        pytest.skip('no unshare here, with which a small disk could be mounted')
    if done.returncode in (1, 77) and 'Traceback' not in done.stderr:
        pytest.skip(f'no small disk may be mounted here: {done.stderr.strip()}')
    assert done.returncode == 0, done.stderr
    first, second, left = done.stdout.splitlines()
    calibration, accumulator = (
        tmp_path / 'calibration.yaml',
        tmp_path / 'calibration.accumulator.npz',
    )
    assert first.startswith('True; ') and str(calibration) in first and str(accumulator) in first
    whole, written, lost, *_ = second.split('; ')
    assert (
        whole == 'False'
        and str(calibration) in written
        and str(accumulator) in lost
        and os.strerror(errno.ENOSPC) in lost
    )
    assert left == "2 the second {'3'} 2"


@pytest.mark.parametrize('full_for', ('calibration.yaml', 'calibration.accumulator.npz'))
def test_on_a_full_disk_the_answer_says_which_file_is_safe(tmp_path, monkeypatch, full_for):
    place = SessionFiles(str(tmp_path / 'calibration.yaml'))
    place.calibration.write_text('old')
    write = files.write_whole

    def fill(path, data, to_disk=True):
        if path.name == full_for:
            monkeypatch.setattr(
                'os.fsync',
                lambda number: (_ for _ in ()).throw(
                    OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                ),
            )
        try:
            write(path, data, to_disk)
        finally:
            monkeypatch.undo()
            monkeypatch.setattr(files, 'write_whole', fill)

    monkeypatch.setattr(files, 'write_whole', fill)
    whole, answer = place.save(live(), 'new')
    other = place.accumulator if full_for == 'calibration.yaml' else place.calibration
    first, second = answer.split('; ')[:2]
    assert (
        not whole
        and str(other) in first
        and str(tmp_path / full_for) in second
        and os.strerror(errno.ENOSPC) in second
    )
    assert place.calibration.read_text() == ('old' if full_for == 'calibration.yaml' else 'new')
    assert (
        place.accumulator.exists() == (full_for == 'calibration.yaml')
        and place.unsaved(live()) == 7
    )


def test_what_is_saved_counts_as_safe_and_answers_are_absolute(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    place = SessionFiles('')
    whole, answer = place.save(live(), 'text')
    assert (
        whole
        and f'{tmp_path}/calibration.yaml' in answer
        and f'{tmp_path}/calibration.accumulator.npz' in answer
    )
    assert place.unsaved(live(9)) == 2 and place.keep(live(), 'windows') == ''
    assert '2 windows' in place.keep(live(9), 'windows')


def test_autosave_is_due_once_a_period_and_not_again_at_once_when_it_fails(tmp_path, monkeypatch):
    place, now = SessionFiles(str(tmp_path / 'calibration.yaml')), [100.0]
    monkeypatch.setattr('time.monotonic', lambda: now[0])
    place.note_saved(0)
    assert not place.autosave(live(), 30.0)
    now[0] += 31.0
    assert (
        place.autosave(live(), 30.0)
        and place.unsaved(live()) == 0
        and not place.autosave(live(), 30.0)
    )
    now[0] += 31.0
    (tmp_path / 'calibration.accumulator.npz').unlink()
    (tmp_path / 'calibration.accumulator.npz').mkdir()
    with pytest.raises(files.InputError):
        place.autosave(live(9), 30.0)
    assert not place.autosave(live(9), 30.0)


def test_files_of_an_earlier_session_are_kept_unless_it_is_continued(tmp_path):
    path = tmp_path / 'calibration.yaml'
    for number, text in enumerate(('first', 'second', 'third')):
        place = SessionFiles(str(path))
        if text == 'third':
            place.continue_earlier()
        for again in (text, f'{text} again'):
            whole, answer = place.save(live(saved=again.encode()), again)
            assert whole
        assert f'{path.name}.{number}' not in answer  # a second save replaces the first one
    assert path.read_text() == 'third again' and place.accumulator.read_text() == 'third again'
    names = [path, place.accumulator]
    assert [each.with_name(f'{each.name}.1').read_text() for each in names] == ['first again'] * 2
    assert len(list(tmp_path.iterdir())) == 4


def test_what_is_put_aside_is_never_written_over(tmp_path):
    for number in (1, 2):
        (tmp_path / 'a').write_text(str(number))
        assert files.put_aside(tmp_path / 'a') == tmp_path / f'a.{number}'
    assert [(tmp_path / f'a.{number}').read_text() for number in (1, 2)] == ['1', '2']


KILLED = """
import os, signal, sys
from imu_calibration.document import files
files.os.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
files.write_whole(sys.argv[1], b'half')
"""


@pytest.mark.live
def test_what_a_killed_save_left_is_removed_at_the_next_start(tmp_path):
    target = tmp_path / 'calibration.yaml'
    done = subprocess.run([sys.executable, '-c', KILLED, str(target)], timeout=60)
    assert done.returncode == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    # Of a process that is writing now.
    running = tmp_path / f'.{os.getpid()}.{left.name.split(".")[2]}'
    others = [tmp_path / name for name in ('.12.note', '.hidden', '.99999999.00000000')]
    for path in (running, *others):
        path.write_text('kept')
    SessionFiles(str(target))
    assert set(tmp_path.iterdir()) == {running, *others}
