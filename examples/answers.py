"""
The pages in docs/answers.

Run each of their commands and write its output below it (``make answers``).

A page is its own source. Blocks that begin with ``console`` contain lines ``$ command``; the lines
below a command are replaced by its output. The pages are processed in alphabetical order in one
folder, so that later pages use the files of earlier pages.
"""

import argparse
import contextlib
import io
import os
import re
import shlex
import subprocess
import tempfile
from functools import cache
from pathlib import Path

from imu_calibration.cli.main import main as imu_calibration

ROOT = Path(__file__).resolve().parents[1]
PAGES = ROOT / 'docs/answers'
BLOCK = re.compile(r'^```console\n(.*?)^```$', flags=re.M | re.S)
FILTERS = ('grep', 'head', 'tail', 'cat', 'printf')
"""Permitted programs in addition to `imu_calibration`."""


@cache
def verb_output(_folder: str, arguments: tuple[str, ...]) -> str:
    """
    Return both outputs of a command line of `imu_calibration` in the current folder.

    A page repeats a command to show another part of its output: it is run once.
    """
    stream = io.StringIO()
    with contextlib.redirect_stdout(stream), contextlib.redirect_stderr(stream):
        imu_calibration(list(arguments))
    return stream.getvalue()


def run(command: str) -> str:
    """
    Run a command in the current folder and return both of its outputs.

    ``|`` joins stages, ``>`` writes a file.
    """
    command, _, target = command.partition(' > ')
    output = ''
    for stage in command.split(' | '):
        name, *arguments = shlex.split(stage)
        if name == 'imu_calibration':
            output = verb_output(os.getcwd(), tuple(arguments))
        elif name in FILTERS:
            output = subprocess.run(
                [name, *arguments], input=output, capture_output=True, text=True, check=False
            ).stdout
        else:
            raise ValueError(
                f'a command of a page must be one of {("imu_calibration", *FILTERS)}, got {name}'
            )
    if target:
        Path(target).write_text(output)
    return '' if target else output


def commands(text: str) -> list[str]:
    """Return the commands of a page."""
    return [
        line[2:]
        for block in BLOCK.findall(text)
        for line in block.splitlines()
        if line.startswith('$ ')
    ]


def worked_through(text: str) -> str:
    """Return a page with the output of its commands in the current folder."""

    def block(match):
        parts = []
        for command in (line for line in match.group(1).splitlines() if line.startswith('$ ')):
            printed = '\n'.join(line.rstrip() for line in run(command[2:]).splitlines())
            parts.append(f'{command}\n{printed}\n' if printed else f'{command}\n')
        return '```console\n' + ''.join(parts) + '```'

    return BLOCK.sub(block, text)


def pages() -> list[Path]:
    """Return the pages in the order of processing."""
    return sorted(PAGES.glob('[0-9]*.md'))


@contextlib.contextmanager
def inside(folder: Path):
    """Change to a folder with the sample session as `session`."""
    before = Path.cwd()
    (folder / 'session').symlink_to(ROOT / 'bags/sample_session')
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def main() -> None:
    """Write all pages and their pictures."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    from answer_pictures import PICTURES

    with tempfile.TemporaryDirectory() as folder, inside(Path(folder)):
        for page in pages():
            page.write_text(worked_through(page.read_text()))
            print(page.relative_to(ROOT))
        for name, draw in PICTURES.items():
            draw(PAGES / f'{name}.png')


if __name__ == '__main__':
    main()
