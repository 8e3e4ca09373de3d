"""The source distribution is complete; `make readme-check` installs the wheel made of it."""

import shutil
import subprocess
import sys
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


@pytest.mark.live
def test_the_tree_of_a_distribution_is_not_unpacked_in_the_checkout(tmp_path):
    """`make lint` runs beside `make dist` and reads every Python file of the checkout."""
    checkout = tmp_path / 'checkout'
    checkout.mkdir()
    shutil.copy(ROOT / 'Makefile', checkout)
    (checkout / 'setup.py').write_text(
        'import os, pathlib\n'
        'place = pathlib.Path(__file__).resolve().parent / "built_in"\n'
        'place.write_text(os.getcwd())\n'
    )
    installed = ('VENV=installed', 'PINS=none.txt', '--old-file=installed/.installed-none')
    (checkout / 'installed').mkdir()
    (checkout / 'installed/.installed-none').touch()
    # Only the first command runs: the wheel of an archive that is not there ends with an error.
    subprocess.run(['make', 'dist', f'PY={sys.executable}', *installed], cwd=checkout)
    folder = Path((checkout / 'built_in').read_text())
    assert folder != checkout
    assert not folder.exists()
