"""
Core tests start no process and use no DDS.

Live tests that fail are repeated once, core tests never.
"""

import multiprocessing
import os
import subprocess
import sys
from pathlib import Path

import pytest

TEST = Path(__file__).resolve().parents[1]
LIVE = 'import pytest\npytestmark = pytest.mark.live\n'
FAILS_ONCE = """from pathlib import Path
def test_once():
    tried, _ = Path('tried').exists(), Path('tried').touch()
    assert tried, 'the first failure'
"""
FAILS = 'def test_always():\n    raise ValueError\n'
PASSES = 'def test_sound():\n    pass\n'


@pytest.mark.parametrize(
    'start',
    (
        lambda: subprocess.run([sys.executable, '-c', ''], check=True),
        lambda: multiprocessing.get_context('spawn').Process(target=print).start(),
        lambda: os.system('true'),
    ),
)
def test_a_core_test_that_starts_a_process_fails(start):
    with pytest.raises(pytest.fail.Exception, match='test_a_core_test_that_starts_a_process_fails'):
        start()


def test_a_core_test_that_uses_dds_fails():
    context = pytest.importorskip('rclpy.context').Context()
    with pytest.raises(pytest.fail.Exception, match='test_a_core_test_that_uses_dds_fails'):
        context.init()
    assert not context.ok()


def test_a_file_of_tests_that_needs_ros_is_skipped_where_there_is_none(
    tmp_path, monkeypatch, request
):
    monkeypatch.setattr(sys, 'path', list(sys.path))
    for package, error in (
        ('rclpy', pytest.skip.Exception),
        ('absent', pytest.Collector.CollectError),
    ):
        monkeypatch.setitem(sys.modules, package, None)
        file = tmp_path / f'test_with_{package}.py'
        file.write_text(f'import {package}\n')
        made = request.config.hook.pytest_pycollect_makemodule(
            module_path=file, parent=request.session
        )
        with pytest.raises(error):
            made.obj


@pytest.mark.live
def test_a_live_test_may_start_a_process():
    assert subprocess.run([sys.executable, '-c', ''], check=True).returncode == 0


@pytest.mark.live
@pytest.mark.parametrize(
    ('text', 'code', 'unstable'),
    (
        (PASSES, 0, False),
        (LIVE + FAILS_ONCE + PASSES, 0, True),
        (LIVE + FAILS, 1, False),
        (FAILS_ONCE, 1, False),
        (FAILS_ONCE.replace('def', LIVE.replace('pytestmark =', '@') + 'def') + FAILS, 1, False),
        ('raise ValueError\n', 1, False),
    ),
    ids=(
        'passes',
        'live test fails once',
        'live test fails twice',
        'core test fails once',
        'core test fails too',
        'file cannot be imported',
    ),
)
def test_only_live_tests_are_repeated(tmp_path, text, code, unstable):
    (tmp_path / 'pytest.ini').write_text('[pytest]\nmarkers =\n    live: x\n    long: x\n')
    (tmp_path / 'test_it.py').write_text(text)
    done = subprocess.run(
        [
            sys.executable,
            TEST / 'run_lanes.py',
            *'core live -- -p xdist -n'.split(),
            str(int(unstable)),
        ],
        cwd=tmp_path,
        env=os.environ | {'PYTEST_DISABLE_PLUGIN_AUTOLOAD': '1'},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert (bool(done.returncode), 'unstable: test_it.py::test_once' in done.stdout) == (
        bool(code),
        unstable,
    ), done.stdout
    assert ('failed: test_it.py::' in done.stdout) == (unstable or 'def' in text and bool(code))
    assert not unstable or 'the first failure' in done.stdout.partition('unstable: ')[2]
    assert 'passed' in done.stdout.splitlines()[-1] or code
