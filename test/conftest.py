"""Shared fixtures of the test suite."""

import os
import re
from collections import Counter
from importlib.util import find_spec
from pathlib import Path

# Before numpy comes: threads that wait for each other take minutes on a busy machine.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import pytest
import yaml
from blank_canvas import BlankCanvas
from hypothesis import HealthCheck, settings

# The same examples every time, and no failure because the machine is busy.
settings.register_profile(
    'suite',
    max_examples=30,
    derandomize=True,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile('suite')

# Tests read whole documents by `yaml.safe_load`: libyaml gives the same, ten times as fast.
yaml.SafeLoader = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)

pytest_plugins = ['lanes']
MANIFEST = (Path(__file__).parents[1] / 'package.xml').read_text()


class FileOfTests(pytest.Module):
    """A file of tests, skipped if it imports packages of ROS where there is no ROS."""

    def _getobj(self):
        try:
            return super()._getobj()
        except self.CollectError as error:
            package = (getattr(error.__cause__, 'name', None) or '').partition('.')[0]
            if not re.search(f'<exec_depend>{package}<', MANIFEST) or find_spec('rclpy'):
                raise
            pytest.skip(f'{package} is missing: there is no ROS here', allow_module_level=True)


def pytest_pycollect_makemodule(module_path, parent):
    """Return a file of tests."""
    return FileOfTests.from_parent(parent, path=module_path)


@pytest.fixture(scope='session')
def recordings():
    """Folder of the real recordings; tests that need it are skipped when it is absent."""
    folder = Path(
        os.environ.get('IMU_CALIBRATION_DATA', Path(__file__).parents[2] / 'shared' / 'data')
    )
    if not folder.is_dir():
        pytest.skip(f'real recordings not found at {folder}; set IMU_CALIBRATION_DATA')
    return folder


@pytest.fixture(scope='module', autouse=True)
def no_layout(request):
    """
    Paint the figures of reports, but do not lay them out, which is a quarter of a calibration.

    Files below test/report and those with `LAID_OUT` set have complete figures.
    """
    from imu_calibration.report import figures

    with pytest.MonkeyPatch.context() as patch:
        if request.path.parent.name != 'report' and not hasattr(request.module, 'LAID_OUT'):
            patch.setattr(figures, '_laid_out', lambda figure: BlankCanvas())
        yield


def pytest_configure(config):
    """
    Keep the order of the files that `pytest_collection_modifyitems` gives.

    Earlier versions of xdist, as in Ubuntu 24.04, know no other.
    """
    if hasattr(config.option, 'loadscopereorder'):
        config.option.loadscopereorder = False


def pytest_collection_modifyitems(items):
    """
    Let the files with the most long tests begin first, live ones and others in turn.

    One that begins last keeps the other processes waiting for it. Live tests mostly wait: where
    all processes have some, the processors are idle.
    """
    long, live = Counter(), Counter()
    for item in items:
        long[item.path] += any(map(item.get_closest_marker, ('slow', 'long', 'live')))
        live[item.path] += item.get_closest_marker('live') is not None

    # Place of each file among those of its kind; of two equal places the live one is first.
    place = {}
    for is_live in (True, False):
        files = [file for file in long if (live[file] > 0) == is_live]
        files.sort(key=lambda file: -long[file])
        place |= {file: (number, not is_live) for number, file in enumerate(files)}
    items.sort(key=lambda item: place[item.path])


def pytest_terminal_summary(terminalreporter):
    """List the figures that passing tests printed beside what was wanted or known."""
    lines = [
        line
        for report in terminalreporter.stats.get('passed', ())
        if report.when == 'call'
        for line in report.capstdout.splitlines()
        if ' wanted ' in line or '(known ' in line
    ]
    if lines:
        terminalreporter.section('measured figures')
        for line in lines:
            terminalreporter.write_line(line)
