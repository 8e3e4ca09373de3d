"""
Every plain command of the README and of the pages for beginners runs as printed.

It runs in a folder with recordings of the names that the commands use.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from blank_canvas import BlankCanvas
from test_main_json_schema import document_of

import imu_calibration
from imu_calibration.cli.main import main
from imu_calibration.core.samples import ImuSamples
from imu_calibration.report import figures
from msg_adapters.write import write_session

from worlds.candidates import searching_few
from worlds.hand_sessions import simulate

LAID_OUT = True  # the commands of the README draw what users see

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = ROOT / 'bags' / 'sample_session'


def commands(page):
    """Commands in the fenced blocks of a page that call the offline tool."""
    parts = re.split(r'^ *```\w*\n?', (ROOT / page).read_text(), flags=re.MULTILINE)
    lines = [line.strip() for block in parts[1::2] for line in block.splitlines()]
    return [line for line in lines if line.startswith('imu_calibration ')]


WITH_ROS = 'test/nodes/test_readme_commands.py runs it where the ros2 command is available'
NOT_RUN = {
    'python3 -m venv venv && . venv/bin/activate': 'the set-up of the tests makes an environment',
    'pip install .': 'make readme-check installs the wheel into an empty environment',
    "pip install '.[arm]'": 'the set-up of the tests installs the extra with its pins',
    'make demo': 'a stage of .ci/run, before the tests',
    'make test': 'this test is a part of it',
    'rosdep install --from-paths src --ignore-src': 'its index is not available without ROS',
    'colcon build': 'test/ros/workspace.py builds the package for the ros2 commands',
    'ros2 launch imu_calibration compensate.launch.py calibration:=calibration.yaml'
    ' imu:=/my_imu/data corrected:=imu/data': WITH_ROS,
    'ros2 launch imu_calibration calibrate.launch.py table:=none imu:=/my_imu/data': WITH_ROS,
}
"""Commands of the README that this file does not run -> reason."""
NO_ROS = 'needs a system with ROS, see Systems in docs/evidence.md'
NO_IMAGE = 'needs docker; the steps of the image ran in a root file system, see Systems'
NOT_RUN_OF_PAGES = {
    'README.md': ('python', NOT_RUN),
    'docs/first-calibration.md': (None, {}),
    'docs/install.md': (
        None,
        {
            'python3 -m venv venv && . venv/bin/activate': 'as in the README',
            'pip install .': 'as in the README',
            "pip install '.[arm]'": 'as in the README',
            'make dist': 'the first step of `make readme-check`, which runs this file',
            'make rosdebian': 'a job of the workflow; its tools take a minute to install',
            'cd ~/ws && rosdep install --from-paths src --ignore-src'
            ' && colcon build --packages-select imu_calibration': 'as in the README',
            'pip install rosbags': 'a requirement of the package',
            'python3 -m venv --system-site-packages venv && . venv/bin/activate': NO_ROS,
            '. /opt/ros/humble/setup.bash': NO_ROS,
            'python -m imu_calibration.nodes.compensator_node --ros-args'
            ' -p calibration_file:=calibration.yaml': NO_ROS,
            'docker build -f docker/Dockerfile -t imu_calibration .': NO_IMAGE,
            'docker run --rm --network host --ipc host imu_calibration'
            ' ros2 run imu_calibration compensator_node': NO_IMAGE,
            'docker compose up': NO_IMAGE,
        },
    ),
}
"""Page -> language of its other blocks, and its commands that this file does not run -> reason."""


@pytest.mark.parametrize('page', NOT_RUN_OF_PAGES)
def test_each_command_of_a_page_runs_or_has_a_reason(page):
    """Each line of a block runs in one of the tests below, or is listed."""
    language, not_run = NOT_RUN_OF_PAGES[page]
    text = (ROOT / page).read_text()
    blocks = re.findall(r'^ *```(\w*)\n(.*?)^ *```$', text, re.DOTALL | re.MULTILINE)
    shell = [block for kind, block in blocks if not kind]
    assert [kind for kind, _ in blocks if kind] == [language] * (language is not None)
    lines = [line.strip() for block in shell for line in block.splitlines()]
    lines += re.findall(r'`((?:make|pip|rosdep|colcon) [^`]+)`', text)
    assert set(lines) - set(commands(page)) == set(not_run)


def test_the_package_is_the_one_to_be_checked():
    """`make readme-check` checks an installed wheel, other targets the checkout."""
    place = Path(os.environ.get('IMPORTED_FROM', ROOT))
    assert Path(imu_calibration.__file__).is_relative_to(place)


@pytest.mark.live
def test_the_installed_command_finds_the_installed_data(tmp_path):
    """The command beside the interpreter simulates by the installed table."""
    tool = Path(sys.executable).with_name('imu_calibration')
    arguments = ['simulate', '--profile', 'six_faces', '--imu-rate', '50', '--output', 'session']
    done = subprocess.run([tool, *arguments], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert 'outer' in (tmp_path / 'session' / 'table.yaml').read_text()


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """
    Recordings under the names of the pages: by hand, at rest, on the table of the sample session.
    """
    place = tmp_path_factory.mktemp('user')
    by_hand = simulate(7, n_poses=14)[0]
    rng = np.random.default_rng(1)
    still = ImuSamples(
        10**18 + 5_000_000 * np.arange(60_000),
        rng.normal([0, 0, 9.81], 0.01, (60_000, 3)),
        rng.normal(0, 1e-3, (60_000, 3)),
        'imu_link',
    )
    for name, imu in (('my_bag', by_hand), ('my_drive', by_hand), ('still_bag', still)):
        write_session(place / name, imu)
    for name in ('session', 'later_session'):
        shutil.copytree(SAMPLE, place / name)
    shutil.copytree(SAMPLE, place / 'bags' / 'sample_session')
    shutil.copy(SAMPLE / 'table.yaml', place / 'table.yaml')
    return place


@pytest.mark.long
@pytest.mark.parametrize(
    'page, least',
    [
        ('README.md', 6),
        ('docs/turntable.md', 6),
        ('docs/install.md', 1),
        ('docs/first-calibration.md', 3),
    ],
)
def test_commands_run_as_printed(page, least, folder, monkeypatch, tmp_path, capsys):
    """Those of other pages that the README has not, and their documents follow the schema."""
    shutil.copytree(folder, tmp_path / 'user')
    monkeypatch.chdir(tmp_path / 'user')
    found = commands(page)
    assert len(found) >= least
    if page == 'README.md':
        for command in found:
            code = main(searching_few(shlex.split(command)[1:]))
            assert code in (0, 3), f'{command}\n{capsys.readouterr().err}'
        return
    # The same verbs draw the same figures.
    monkeypatch.setattr(figures, '_laid_out', lambda figure: BlankCanvas())
    of_readme = commands('README.md')
    for command in found:
        if command not in of_readme:
            document_of(shlex.split(command)[1:], capsys)


def test_arrays_calibrate_as_the_readme_shows(tmp_path):
    code = re.search(r'```python\n(.*?)```', (ROOT / 'README.md').read_text(), re.DOTALL).group(1)
    imu = simulate(7, n_poses=14)[0]
    names = {'time': imu.stamp_ns * 1e-9, 'force': imu.force_s, 'rate': imu.rate_s}
    exec(code.replace("'result'", repr(str(tmp_path / 'result'))), names)
    assert (tmp_path / 'result' / 'calibration.yaml').is_file() and imu_calibration.load(
        tmp_path / 'result' / 'calibration.yaml'
    )


def test_the_messages_of_typical_mistakes_are_those_of_the_product():
    code = '\n'.join(
        path.read_text()
        for folder in ('imu_calibration', 'msg_adapters')
        for path in (ROOT / folder).rglob('*.py')
    )
    rows = re.findall(
        r'^\| `(.*?)` \|',
        (ROOT / 'docs/turntable.md').read_text().partition('## Typical mistakes')[2],
        re.MULTILINE,
    )
    sentences = [row.partition(' ... ')[0] for row in rows if '.' not in row.split()[0]]
    assert len(sentences) >= 6 and [text for text in sentences if text not in code] == []
