"""The last lines of .ci/run name each stage that failed, with its first error."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.live

ROOT = Path(__file__).resolve().parents[2]
MAKE = """#!/bin/bash
for goal in "$@"; do
    if [ -f "$goal.fails" ]; then cat "$goal.fails"; exit 2; fi
    if [ -f "$goal.slow" ]; then sleep 1; fi
done
echo "$*" >>ended
"""
"""
In place of make: a goal with a file GOAL.fails prints it and fails, one with GOAL.slow takes a
second. Calls that ended are appended to the file `ended`.
"""
PROBLEMS = {
    'demo-check': 'NameError: no Terminal.standard',
    'readme-check': 'E   README.md: 1 line is not listed',
    'lint': 'benchmarks/run.py:7: error: no attribute "runs"',
    'test-all': 'E   assert 3 == 4',
    'oracles': 'error: no matching distribution',
}
PLACE = 'test/test_a.py:7: '
"""What pytest prints above an error of a function of the test."""
NOTE = 'note: the latitude must agree with the rates'
STAGES = {
    'demo-check': 'demo',
    'readme-check': 'readme',
    'lint': 'lint',
    'test-all': 'tests',
    'oracles': 'lint',
}


def result_of_run(folder, failing):
    """Run .ci/run in a folder in which the goals `failing` fail."""
    (folder / '.ci').mkdir()
    (folder / 'bin').mkdir()
    shutil.copy(ROOT / '.ci/run', folder / '.ci')
    for name, text in (('make', MAKE), ('chromium', '')):
        (folder / 'bin' / name).write_text(text)
        (folder / 'bin' / name).chmod(0o755)
    for goal in failing:
        place = f'{PLACE}\n' if PROBLEMS[goal].startswith('E ') else ''
        printed = f'{NOTE}\n{place}{PROBLEMS[goal]}\nmake: *** [{goal}]\n'
        (folder / f'{goal}.fails').write_text(printed)
    path = f'{folder / "bin"}{os.pathsep}{os.environ["PATH"]}'
    return subprocess.run(
        ['bash', folder / '.ci/run'],
        env=os.environ | {'PATH': path},
        capture_output=True,
        text=True,
        timeout=60,
    )


@pytest.mark.parametrize(
    'failing',
    (
        ('lint', 'test-all'),
        ('lint', 'readme-check'),
        ('lint',),
        ('test-all',),
        ('demo-check',),
        ('oracles',),
        (),
    ),
)
def test_each_failing_stage_is_named_with_its_first_error(tmp_path, failing):
    done = result_of_run(tmp_path, failing)
    named = re.findall(r'failed in the stage: (\w+)\nfirst error: (.*)\n', done.stderr)
    assert dict(named) == {STAGES[goal]: PROBLEMS[goal] for goal in failing}
    assert done.returncode == int(bool(failing))


def test_the_tests_begin_after_the_last_installation(tmp_path):
    (tmp_path / 'oracles.slow').touch()
    assert result_of_run(tmp_path, ()).returncode == 0
    ended = (tmp_path / 'ended').read_text().splitlines()
    installed, tested = 'oracles lint-tools', 'test-all README_CHECKED=yes'
    assert ended.index(installed) < ended.index(tested)
    assert '--keep-going --output-sync=target lint' in ended


def test_the_stages_follow_the_pages():
    """The demonstration, then the README, then all tests without those of the README."""
    text = (ROOT / '.ci/run').read_text()
    stages = re.findall(r'^stage (\w+)', text, re.MULTILINE)
    assert stages == ['setup', 'demo', 'readme', 'tests'] and 'README_CHECKED=yes' in text


@pytest.mark.parametrize(('options', 'code'), (((), 0), (('--fail-skipped',), 1)))
def test_a_skipped_test_fails_on_request(tmp_path, options, code):
    (tmp_path / 'test_it.py').write_text('import pytest\ndef test_a():\n    pytest.skip("no")\n')
    done = subprocess.run(
        [sys.executable, '-m', 'pytest', '-p', 'lanes', *options, tmp_path],
        cwd=tmp_path,
        env=os.environ | {'PYTHONPATH': str(ROOT / 'test')},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == code, done.stdout
    assert not code or 'test_a was skipped: Skipped: no' in done.stdout
