"""
The source distribution and the wheel made of it.

Complete, accepted by the package index, and working in an empty environment.
"""

import shutil
import subprocess
import sys
import sysconfig
import tarfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ('imu_calibration', 'msg_adapters', 'config', 'launch', 'resource')
FILES = (
    'README.md',
    'LICENSE',
    'CHANGELOG.rst',
    'CONTRIBUTING.md',
    'SECURITY.md',
    'package.xml',
    'setup.py',
    'setup.cfg',
    'MANIFEST.in',
    'pyproject.toml',
)


def run(*command, **options):
    """Run a command that must succeed; return its output."""
    done = subprocess.run(
        [str(word) for word in command], capture_output=True, text=True, **options
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def sources():
    """Files that a distribution must contain."""
    found = {
        path.relative_to(ROOT).as_posix()
        for folder in FOLDERS
        for path in (ROOT / folder).rglob('*')
        if path.is_file() and path.suffix != '.pyc' and '.egg-info' not in path.as_posix()
    }
    return found | set(FILES)


@pytest.fixture(scope='module')
def archive(tmp_path_factory):
    """The source distribution, built from a copy so that nothing is written into the checkout."""
    copy = tmp_path_factory.mktemp('checkout')
    for name in sources():
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, copy / name)
    run(sys.executable, 'setup.py', '--quiet', 'sdist', cwd=copy)
    return next((copy / 'dist').iterdir())


@pytest.mark.long
@pytest.mark.live
def test_the_source_distribution_is_complete(archive):
    with tarfile.open(archive) as opened:
        names = {name.partition('/')[2] for name in opened.getnames()}
    assert sources() - names == set()


@pytest.mark.long
@pytest.mark.live
def test_it_installs_into_an_empty_environment_and_runs(archive, tmp_path):
    """
    From the archive alone: the wheel, its metadata, the command line and the installed data files.

    Requirements come from this environment.
    """
    pip = (sys.executable, '-m', 'pip', '--disable-pip-version-check', '--quiet')
    run(
        *pip,
        'wheel',
        '--no-deps',
        '--no-build-isolation',
        '--wheel-dir',
        tmp_path / 'dist',
        archive,
        cwd=tmp_path,
    )
    (wheel,) = (tmp_path / 'dist').iterdir()
    twine = pytest.importorskip('twine.commands.check')  # not in Ubuntu 24.04
    assert twine.check([str(archive), str(wheel)], strict=True) is False  # whether it found a fault
    run(sys.executable, '-m', 'venv', '--without-pip', tmp_path / 'empty')
    python = tmp_path / 'empty/bin/python'
    run(*pip, '--python', python, 'install', '--no-deps', wheel, cwd=tmp_path)
    installed = Path(
        run(python, '-c', 'import sysconfig; print(sysconfig.get_path("purelib"))').strip()
    )
    (installed / 'requirements.pth').write_text(sysconfig.get_path('purelib'))
    assert Path(
        run(
            python, '-c', 'import imu_calibration; print(imu_calibration.__file__)', cwd=tmp_path
        ).strip()
    ).is_relative_to(installed)
    tool = tmp_path / 'empty/bin/imu_calibration'
    # By the installed table.
    run(tool, 'simulate', '--profile', 'six_faces', '--output', 'session', cwd=tmp_path)
    assert '/imu/data_raw' in run(tool, 'inspect', 'session', cwd=tmp_path)
