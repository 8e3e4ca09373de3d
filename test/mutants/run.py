"""
Put each declared fault into a copy of the code, one at a time.

Report the faults that no test noticed.
"""

import argparse
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / 'test'))

from mutants.declared import MUTANTS
from mutants.mutation import NotFound, mutated, path_of_test

LONGEST = 120
"""
s of processor time; a test that a fault keeps from ending has noticed it, one that waits for a busy
machine has not.
"""
PATIENCE = 30
"""Times that by the clock."""
NOTICED, SURVIVED, BROKEN = 'noticed', 'SURVIVED', 'BROKEN'


def copied(folder):
    """Copy what git knows of, so that nothing here is ever broken."""
    names = subprocess.run(
        ['git', 'ls-files', '-z'], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.split('\0')
    for name in filter(None, names):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    return folder


def tested(folder, tests, *options, longest=LONGEST):
    """
    Return pytest's exit code and the last line that it printed.

    `longest` is the processor time of each process.
    """
    env = os.environ | {
        'PYTHONPATH': os.pathsep.join([str(folder), os.environ.get('PYTHONPATH', '')]),
        'PYTHONDONTWRITEBYTECODE': '1',
    }
    command = [
        sys.executable,
        '-m',
        'pytest',
        '-x',
        '-q',
        '-p',
        'no:cacheprovider',
        *options,
        *tests,
    ]
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            env=env,
            capture_output=True,
            text=True,
            timeout=PATIENCE * LONGEST,
            stdin=subprocess.DEVNULL,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (longest, longest + 5)),
        )
    except subprocess.TimeoutExpired:
        return 1, f'did not end within {PATIENCE * LONGEST} s'
    if done.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
        return 1, f'took more than {longest} s of processor time'
    return done.returncode, next(
        (
            line
            for line in reversed(done.stdout.splitlines())
            if line.startswith(('FAILED', 'ERROR'))
        ),
        '',
    )


def tried(folder, mutant):
    """Return (what became of a mutant, the test that noticed)."""
    try:
        place, broken = mutated(ROOT, mutant.place, mutant.pattern, mutant.fault)
    except NotFound as error:
        return BROKEN, str(error)
    path = folder / place.relative_to(ROOT)
    text = path.read_text()
    path.write_text(broken)
    try:
        for test in mutant.tests:
            code, line = tested(folder, [path_of_test(ROOT, test)])
            if code == 1:
                return NOTICED, line
            if code:
                return BROKEN, line or f'pytest ended with {code} on {test}'
        return SURVIVED, ''
    finally:
        path.write_text(text)


def main():
    """
    Try all mutants, or those whose name or place contains a given word.

    Exit code 1 when one survives.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        'words', nargs='*', help='only mutants with one of these in their name or place'
    )
    parser.add_argument('--workers', type=int, default=2)
    asked = parser.parse_args()
    chosen = [
        m
        for m in MUTANTS
        if not asked.words or any(word in m.name or word in m.place for word in asked.words)
    ]
    start, counts = time.monotonic(), dict.fromkeys((NOTICED, SURVIVED, BROKEN), 0)
    with tempfile.TemporaryDirectory() as place:
        folders = Queue()
        for number in range(asked.workers):
            folders.put(copied(Path(place) / str(number)))
        needed = sorted({path_of_test(ROOT, test) for mutant in chosen for test in mutant.tests})
        # All of them in one go.
        code, line = tested(
            folders.queue[0],
            needed,
            '-n',
            str(asked.workers),
            '--dist',
            'loadfile',
            longest=PATIENCE * LONGEST,
        )
        if code:
            sys.exit(f'the tests must pass before anything is broken: {line or code}')

        def one(mutant):
            folder = folders.get()
            try:
                return mutant, *tried(folder, mutant)
            finally:
                folders.put(folder)

        with ThreadPoolExecutor(asked.workers) as pool:
            for mutant, outcome, line in pool.map(one, chosen):
                counts[outcome] += 1
                print(f'{outcome:9}{mutant.name}: {line.partition(" - ")[0]}', flush=True)
    print(
        f'{len(chosen)} faults, {counts[NOTICED]} noticed, {counts[SURVIVED]} survived,'
        f' {counts[BROKEN]} not tried; {time.monotonic() - start:.0f} s'
    )
    sys.exit(bool(counts[SURVIVED] + counts[BROKEN]))


if __name__ == '__main__':
    main()
