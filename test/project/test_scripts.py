"""
Each script of the repository runs once at its smallest size.

The scripts run in a copy of the tree, because some of them write pages, and in one process, because
their imports take as long as they do.
"""

import ast
import importlib.util
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import without_search

from benchmarks import run as benchmarks
from validation import run
from validation.recordings import VARIABLE

pytestmark = pytest.mark.live

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ('examples', 'benchmarks', 'tools', 'validation')
RUN = {
    'benchmarks/bench_calibrate.py': ('--smallest',),
    'benchmarks/bench_compensator.py': ('--smallest',),
    'benchmarks/bench_decode.py': ('--smallest',),
    'benchmarks/bench_plan.py': ('--smallest',),
    'benchmarks/bench_verbs.py': ('--smallest',),
    'benchmarks/noise_records.py': ('--smallest',),
    'tools/exports_page.py': (),
    'tools/tolerance_file.py': (),
    'validation/closed_loop.py': ('--smallest',),
    'validation/foreign_physics.py': ('--seed', '1', '--smallest'),
    'validation/frozen_numbers.py': ('write', 'out_frozen', '--smallest'),
    'validation/hide_and_seek.py': ('--smallest',),
    'validation/separating_worlds.py': ('--smallest',),
}
"""Script -> arguments of its smallest size."""
CANDIDATES = {
    'validation/closed_loop.py': 'gyro_g_sensitivity',
    'validation/hide_and_seek.py': 'gyro_g_sensitivity',
    'validation/separating_worlds.py': 'accel_quadratic+accel_scale_asymmetry',
}
"""Script -> candidates of its search for effects; none for the others."""
NEEDS_ROS = ('benchmarks/bench_compensator.py',)
RUN_ELSEWHERE = {
    'benchmarks/relay_ends.py': 'benchmarks/bench_compensator.py starts it',
    'benchmarks/run.py': 'test_the_benchmarks_run_one_after_the_other',
    'examples/answers.py': 'test/cli/test_answers.py runs every command of every page',
    'examples/coverage_picture.py': 'test/calibration/test_coverage.py draws the picture',
    'examples/demo.py': 'make demo-check',
    'examples/downstream_nav.py': 'test/papers/test_reproduce_examples.py',
    'examples/live_demo.py': 'test/nodes/test_live_demo.py',
    'examples/notebook.py': 'test/api/test_notebook.py runs its cells',
    'examples/reproduce_avrutov2017.py': 'test/papers/test_reproduce_examples.py',
    'examples/reproduce_zhang2017.py': 'test/papers/test_reproduce_examples.py',
    'tools/demo_figures.py': 'make demo-check',
    'tools/parameter_files.py': 'test/nodes/test_node_parameters.py runs its main function',
    'tools/plain.py': 'make lint-words',
    'tools/quoted_names.py': 'make lint-words',
    'tools/weigh.py': 'make lint-size',
    'validation/decisions.py': 'a section of validation/run.py',
    'validation/run.py': 'the sections below',
}
"""Script -> command, script or test of `.ci/run` that runs it; not run a second time here."""
SECTION_ELSEWHERE = {
    'arm_live': 'test/api/test_validation.py::test_one_imu_predicts_another_live',
}
"""Section -> test that runs it; not run a second time here."""


def is_script(path):
    """Return whether a file does more than change the path of imports when it is started."""
    text = path.read_text()
    _, guard, body = text.rpartition("\nif __name__ == '__main__':\n")
    starts = bool(guard) and not body.lstrip().startswith('sys.path')
    return starts or text.startswith('# %%')


def test_every_script_is_listed():
    scripts = set()
    for folder in FOLDERS:
        for path in (ROOT / folder).glob('*.py'):
            if is_script(path):
                scripts.add(str(path.relative_to(ROOT)))
    assert scripts == RUN.keys() | RUN_ELSEWHERE.keys()
    assert not RUN.keys() & RUN_ELSEWHERE.keys()


def test_what_is_smaller_is_no_default_of_an_argument():
    """A default keeps the value that the constant had when its function was defined."""
    smaller = {place.split('.')[1] for place in run.SMALLEST}
    bound = set()
    for path in (ROOT / 'validation').glob('*.py'):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.arguments):
                for default in filter(None, node.defaults + node.kw_defaults):
                    names = {part.id for part in ast.walk(default) if isinstance(part, ast.Name)}
                    bound |= {f'{path.stem}.{name}' for name in names & smaller}
    assert not bound


@pytest.mark.parametrize('missed', [(), ('bench_decode', 'bench_plan')])
def test_the_benchmarks_run_one_after_the_other(missed, monkeypatch, capsys):
    started = []

    def started_with(command, **_):
        started.append(command)
        return SimpleNamespace(returncode=int(Path(command[1]).stem in missed))

    monkeypatch.setattr(sys, 'argv', ['run.py', '--smallest'])
    monkeypatch.setattr(benchmarks.subprocess, 'run', started_with)
    assert benchmarks.main() == int(bool(missed))
    expected = []
    for path in sorted((ROOT / 'benchmarks').glob('bench_*.py')):
        expected.append([sys.executable, str(path), '--smallest'])
    assert started == expected
    missed_line = 'targets missed: ' + ', '.join(missed)
    assert (missed_line in capsys.readouterr().out) == bool(missed)


@pytest.mark.long
def test_the_scripts_run(tmp_path):
    # With what was compiled already: it belongs to the times of the files, which are kept.
    ignored = shutil.ignore_patterns('.*', 'out', 'site', 'build', 'demo')
    tree = shutil.copytree(ROOT, tmp_path / 'tree', ignore=ignored)
    environment = os.environ | {'PYTHONPATH': f'{tree}{os.pathsep}{tree / "test"}'}
    environment |= {'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1', 'MPLBACKEND': 'agg'}
    lines = []
    for script, arguments in RUN.items():
        if script not in NEEDS_ROS or importlib.util.find_spec('rclpy'):
            module = script.removesuffix('.py').replace('/', '.')
            lines.append(shlex.join([CANDIDATES.get(script, 'none'), module, *arguments]))
    done = subprocess.run(
        [sys.executable, '-m', 'without_search', *lines],
        cwd=tree,
        env=environment,
        capture_output=True,
        text=True,
        timeout=1800,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert 'Traceback' not in done.stdout + done.stderr, done.stdout + done.stderr


@pytest.mark.long
@pytest.mark.real_data
@pytest.mark.filterwarnings('default')  # figures of one recording have no spread
@pytest.mark.parametrize('section', sorted(set(run.SECTIONS) - set(SECTION_ELSEWHERE)))
def test_a_section_of_the_validation_runs(section, recordings, tmp_path, monkeypatch, capsys):
    """At its smallest size, and without candidates in the search for effects."""
    monkeypatch.setenv(VARIABLE, str(recordings))
    with without_search.candidates_in_scripts('none'):
        code = run.main(['--smallest', '--only', section, '--output', str(tmp_path)])
    shown = capsys.readouterr()
    assert code == 0 and 'Traceback' not in shown.err, shown.out + shown.err
    for line in shown.out.splitlines():
        if line.startswith('Skipped: '):
            pytest.skip(f'{section}: {line}')
