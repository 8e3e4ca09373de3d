"""Where a session is kept: each of two files is whole or as it was, and whoever asked knows which."""

import errno
import os
from types import SimpleNamespace

import pytest

from imu_calibration import files
from imu_calibration.nodes.session_files import SessionFiles


def live(n_windows=7, saved=b'motion'):
    """Stands for a session."""
    return SimpleNamespace(n_windows=n_windows, saved=lambda pending: saved)


@pytest.mark.parametrize('full_for', ('calibration.yaml', 'calibration.accumulator.npz'))
def test_on_a_full_disk_the_answer_says_which_file_is_safe(tmp_path, monkeypatch, full_for):
    place = SessionFiles(str(tmp_path / 'calibration.yaml'))
    place.calibration.write_text('old')
    write = files.write_whole

    def fill(path, data, to_disk=True):
        if path.name == full_for:
            monkeypatch.setattr('os.fsync', lambda number: (_ for _ in ()).throw(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))))
        try:
            write(path, data, to_disk)
        finally:
            monkeypatch.undo()
            monkeypatch.setattr(files, 'write_whole', fill)
    monkeypatch.setattr(files, 'write_whole', fill)
    whole, answer = place.save(live(), 'new')
    other = place.accumulator if full_for == 'calibration.yaml' else place.calibration
    state = 'the earlier one there stays whole' if full_for == 'calibration.yaml' else 'there was none before'
    assert not whole and f'written: {other}; not written: {tmp_path / full_for} must be writable: No space left on device' in answer and state in answer
    assert place.calibration.read_text() == ('old' if full_for == 'calibration.yaml' else 'new')
    assert place.accumulator.exists() == (full_for == 'calibration.yaml') and place.unsaved(live()) == 7


def test_what_is_saved_counts_as_safe_and_answers_are_absolute(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    place = SessionFiles('')
    whole, answer = place.save(live(), 'text')
    assert whole and answer == f'written: {tmp_path}/calibration.yaml and {tmp_path}/calibration.accumulator.npz'
    assert place.unsaved(live(9)) == 2 and place.keep(live(), 'windows') == ''
    assert 'are lost: call ~/save' in place.keep(live(9), 'windows')


def test_autosave_is_due_once_a_period_and_not_again_at_once_when_it_fails(tmp_path, monkeypatch):
    place, now = SessionFiles(str(tmp_path / 'calibration.yaml')), [100.0]
    monkeypatch.setattr('time.monotonic', lambda: now[0])
    place.note_saved(0)
    assert not place.autosave(live(), 30.0)
    now[0] += 31.0
    assert place.autosave(live(), 30.0) and place.unsaved(live()) == 0 and not place.autosave(live(), 30.0)
    now[0] += 31.0
    (tmp_path / 'calibration.accumulator.npz').unlink()
    (tmp_path / 'calibration.accumulator.npz').mkdir()
    with pytest.raises(files.InputError):
        place.autosave(live(9), 30.0)
    assert not place.autosave(live(9), 30.0)


def test_what_is_put_aside_is_never_written_over(tmp_path):
    for number in (1, 2):
        (tmp_path / 'a').write_text(str(number))
        assert files.put_aside(tmp_path / 'a') == tmp_path / f'a.{number}'
    assert [(tmp_path / f'a.{number}').read_text() for number in (1, 2)] == ['1', '2']
