"""
What verbs print on a terminal.

No line ends within a word at 80 columns, colour only where wanted, an early interruption in one
line.
"""

import fcntl
import functools
import io
import os
import pty
import re
import shutil
import signal
import struct
import subprocess
import sys
import termios
import threading
import time
from importlib import import_module
from pathlib import Path

import pytest

from imu_calibration.cli import parser, show
from imu_calibration.cli.main import ProgressBars, main
from imu_calibration.cli.terminal import Terminal

from worlds.small_bags import write_small_bag

ROOT = parser.__file__.rsplit('/imu_calibration/', 1)[0]
SESSION, TABLE, TRUTH = (
    f'{ROOT}/bags/sample_session{name}' for name in ('', '/table.yaml', '/truth.yaml')
)
PRINTING = {
    'inspect': [SESSION],
    'compare': [TRUTH, TRUTH],
    'effects': [],
    'export': ['--list'],
    'plan': ['--by-hand', '--no-report', '--output', 'plan'],
    'check': [SESSION, '--table', TABLE, '--calibration', TRUTH],
    'noise': [SESSION, '--no-report', '--output', 'noise'],
}


COMPUTED = (
    'calibrate.check_recording',
    'inspect.inspect_recording',
    'noise.identify_recording',
)
"""Functions of `imu_calibration.api` that take the time of a verb."""


def remember(name, monkeypatch):
    """Let a function be called once, and return what it returned then."""
    module, _, attribute = f'imu_calibration.api.{name}'.rpartition('.')
    function, results = getattr(import_module(module), attribute), []

    @functools.wraps(function)
    def once(*arguments, **options):
        results.extend([] if results else [function(*arguments, **options)])
        return results[0]

    monkeypatch.setattr(f'{module}.{attribute}', once)


def shown(monkeypatch, capsys, width, run):
    """
    Return the words that are printed on a terminal of a width; dotted names may break at a dot.
    """
    monkeypatch.setenv('COLUMNS', str(width))
    out = io.StringIO()
    monkeypatch.setattr(
        Terminal, 'of', classmethod(lambda cls, stream=None: cls(stream or out, width))
    )
    run()
    return (capsys.readouterr().out + out.getvalue()).replace('.', ' ').split()


@pytest.mark.parametrize('verb', parser.VERBS)
def test_no_word_of_a_help_is_broken(verb, monkeypatch, capsys):
    def run():
        with pytest.raises(SystemExit):
            main([verb, '--help'])

    wide, narrow = (shown(monkeypatch, capsys, width, run) for width in (400, 80))
    assert set(narrow) - {'\\'} <= set(wide)  # a continued example ends with it


@pytest.mark.long
@pytest.mark.parametrize('verb', PRINTING)
def test_no_word_of_a_result_is_broken(verb, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    for computed in COMPUTED:
        remember(computed, monkeypatch)
    wide, narrow = (
        shown(
            monkeypatch,
            capsys,
            width,
            lambda folder=folder: main(
                [verb, *(folder if word in ('plan', 'noise') else word for word in PRINTING[verb])]
            ),
        )
        for width, folder in ((400, 'first'), (80, 'other'))
    )
    assert {*narrow} - {'other'} <= set(wide) and len(narrow) > 10


def test_a_table_that_is_too_wide_breaks_between_words():
    """No column is narrower than its longest word."""
    out = io.StringIO()
    rows = [
        ('accelerometer.accel_size_effect.xx', 'angular acceleration', '0.0463', ''),
        ('gyroscope.bias.x', 'turns at 30 to 120 deg/s', '12345.678', 'read'),
    ]
    show.show_table(
        Terminal(out, 48), ('parameter', 'motion', 'value', ''), rows, numbers=('value',)
    )
    lines = out.getvalue().splitlines()
    assert max(map(len, lines)) <= 48
    assert set(out.getvalue().split()) == {
        'parameter',
        'motion',
        'value',
        *' '.join(
            cell.replace('.', ' ') if row.index(cell) == 0 else cell for row in rows for cell in row
        ).split(),
    }


@pytest.mark.parametrize(
    ('width', 'name'), [(120, 'accelerometer.bias.x'), (24, 'accelerometer bias x')]
)
def test_names_keep_their_dots_where_the_table_fits(width, name):
    out = io.StringIO()
    show.show_table(
        Terminal(out, width), ('parameter', 'value', ''), [('accelerometer.bias.x', '1.0', '')]
    )
    assert name.split()[-1] in out.getvalue() and ('accelerometer.bias.x' in out.getvalue()) == (
        width == 120
    )


def test_a_table_without_rows_has_no_lines():
    assert Terminal(io.StringIO(), 80).table([]) == []


class Screen(io.StringIO):
    """Standard error on a terminal."""

    def isatty(self):
        """Say so."""
        return True


def test_a_bar_has_the_name_of_its_phase_moves_between_reports_and_is_removed(monkeypatch):
    screen = Screen()
    monkeypatch.setattr(sys, 'stderr', screen)

    def wait_for(*words):
        end = time.monotonic() + 60.0  # far longer than the period of the bar, for a busy machine
        while not all(word in screen.getvalue() for word in words) and time.monotonic() < end:
            time.sleep(0.02)
        assert all(word in screen.getvalue() for word in words)

    with ProgressBars() as bars:
        bars('solving', 0, 0)
        wait_for('solving |#### ', 'solving |######## ')  # without a further report
        bars('reading', 30, 40)
        wait_for('reading  75% |' + 30 * '#')
    assert screen.getvalue().rpartition('\r')[0].rpartition('\r')[
        2
    ].strip() == '' and 'progress' not in [thread.name for thread in threading.enumerate()]


def test_the_bar_is_removed_before_other_text(monkeypatch):
    """The first line of a result followed the bar on its line."""
    screen = Screen()
    for name in ('stdout', 'stderr'):
        monkeypatch.setattr(sys, name, screen)
    with ProgressBars() as bars:
        bars('solving', 20, 40)
        bars('solving', 30, 40)
        print('result')
        print('warning', file=sys.stderr)
        shown = screen.getvalue()
        bars('drawing', 0, 4)
    assert (
        re.search(r'solving .*\r +\rresult\nwarning\n$', shown)
        and 'drawing' in screen.getvalue()
        and sys.stdout is screen
    )


def on_terminal(arguments, *, errors=False, code=0, **environment):
    """Return what a verb writes on a terminal of 80 columns, with its standard error or without."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack('HHHH', 50, 80, 0, 0))
    kept = {
        name: value
        for name, value in os.environ.items()
        if name not in ('COLUMNS', 'NO_COLOR', 'FORCE_COLOR')
    }
    process = subprocess.Popen(
        [sys.executable, '-m', 'imu_calibration', *arguments],
        cwd=ROOT,
        stdout=theirs,
        stderr=theirs if errors else subprocess.DEVNULL,
        env=kept | {'TERM': 'xterm', **environment},
    )
    os.close(theirs)
    found = b''
    while True:
        try:
            part = os.read(ours, 65536)
        except OSError:  # the other end is closed
            part = b''
        if not part:
            break
        found += part
    os.close(ours)
    assert process.wait() == code
    return found


def width_of(output):
    """Return the length of the longest of more than ten lines, without colours."""
    lines = re.sub(rb'\x1b\[[0-9;?]*[a-zA-Z]', b'', output).decode().splitlines()
    assert len(lines) > 10
    return max(map(len, lines))


@pytest.mark.live
@pytest.mark.parametrize('verb', parser.VERBS)
def test_help_is_shorter_than_60_lines_on_a_terminal(verb):
    """Description and examples are folded there."""
    assert len(on_terminal([verb, '--help']).splitlines()) < 60


@pytest.mark.live
@pytest.mark.parametrize(
    'arguments',
    [
        ['compensate', '--help'],
        ['convert', '--help'],
        ['effects'],
        ['export', '--list'],
    ],
)
def test_no_line_is_wider_than_the_terminal(arguments):
    """
    The terminal itself would break them within a word.

    Help up to 138 columns, equations, names of parameters.
    """
    assert width_of(on_terminal(arguments)) <= 80


@pytest.mark.live
@pytest.mark.parametrize(
    'arguments',
    [
        ['calibrate', SESSION, '--table', 'nowhere.yaml', '--output', 'never'],
        ['calibrate', SESSION, '--gravty', '9'],
        ['calibrat'],
    ],
)
def test_no_line_of_an_error_is_wider_than_the_terminal(arguments):
    lines = on_terminal(arguments, errors=True, code=1).decode().splitlines()
    assert len(lines) > 1 and max(map(len, lines)) <= 80


@pytest.mark.long
@pytest.mark.live
def test_an_inspection_has_colour_on_terminals_and_not_with_no_color(tmp_path, capsys):
    bag = str(write_small_bag(tmp_path / 'bag'))
    shown = on_terminal(['inspect', bag])
    assert b'\x1b[32m' in shown
    assert width_of(shown) <= 80
    assert b'\x1b[3' not in on_terminal(['inspect', bag], NO_COLOR='1')
    assert main(['inspect', bag]) == 0  # no terminal
    printed = capsys.readouterr()
    assert printed.out and '\x1b' not in printed.out + printed.err


def children_of(process):
    """Return the numbers of the processes that the main thread of a process started."""
    return Path(f'/proc/{process.pid}/task/{process.pid}/children').read_text().split()


@pytest.mark.live
def test_an_interruption_ends_worker_processes_without_tracebacks(tmp_path):
    """
    Ctrl+C reaches all processes of a terminal; workers printed theirs, and the verb ended with 1.
    """
    for name in ('first', 'second'):
        shutil.copytree(SESSION, tmp_path / 'units' / name)
    program = (
        # A background job ignores it
        'import signal, sys\nsignal.signal(signal.SIGINT, signal.default_int_handler)\nfrom'
        ' imu_calibration.__main__ import main\nif __name__ == "__main__":\n    sys.exit(main())\n'
    )
    process = subprocess.Popen(
        [
            sys.executable,
            '-c',
            program,
            'fleet',
            str(tmp_path / 'units'),
            '--table',
            TABLE,
            '--jobs',
            '2',
            '--output',
            str(tmp_path / 'never'),
        ],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    end = time.monotonic() + 60.0
    # Two workers and the tracker of resources.
    while len(children_of(process)) < 3 and time.monotonic() < end:
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)
    error = process.communicate(timeout=60)[1]
    assert (
        process.returncode == 130 and error.count('\n') == 1 and not (tmp_path / 'never').exists()
    ), error


def interrupted_at(module, *arguments):
    """Run a verb that gets SIGINT while it imports a module."""
    program = (
        # A background job ignores it
        'import os, signal, sys\nsignal.signal(signal.SIGINT, signal.default_int_handler)\nclass'
        ' Watch:\n    def find_spec(self, name, path=None, target=None):\n        if name =='
        f' {module!r}:\n            sys.meta_path.remove(self)\n            os.kill(os.getpid(),'
        ' signal.SIGINT)\nsys.meta_path.insert(0, Watch())\nfrom imu_calibration.__main__ import'
        ' main\nsys.exit(main())\n'
    )
    return subprocess.run(
        [sys.executable, '-c', program, *arguments], cwd=ROOT, capture_output=True, text=True
    )


@pytest.mark.live
@pytest.mark.parametrize(
    'module',
    ['imu_calibration.cli.main', 'numpy', 'datetime', 'scipy'],
)
def test_an_early_interruption_ends_with_130_in_one_line(module, tmp_path):
    """
    The signal arrives while a module is imported.

    Numpy turned it into a broken installation where it imports `datetime`.

    It is tried again every 20 ms until no numerical package runs: `inspect` may end before, a
    calibration has hundreds of such moments.
    """
    done = interrupted_at(
        module, 'calibrate', SESSION, '--table', TABLE, '--output', str(tmp_path / 'never')
    )
    assert (
        done.returncode == 130 and done.stderr.count('\n') == 1 and 'Traceback' not in done.stderr
    ), done.stderr
    assert not (tmp_path / 'never').exists()


@pytest.mark.live
def test_a_postponed_interruption_does_not_kill_a_command_that_has_ended():
    assert interrupted_at('imu_calibration.cli.parser', '--version').returncode in (0, 130)
