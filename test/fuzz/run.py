"""
Read mutated recordings, documents and messages under limits.

Every reader of untrusted input reads them, with limits of memory and processor time.

Run: ``python test/fuzz/run.py --minutes 10`` (or ``make fuzz MINUTES=10``). An input must be read
or refused with an `ImuCalibrationError`. Any other exception, a warning, more than 10 s of
processor time, or more than 400 MB is a finding; its input is kept in `out/fuzz`.
"""

import argparse
import contextlib
import hashlib
import io
import multiprocessing
import random
import resource
import secrets
import signal
import sys
import time
import traceback
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

sys.path[:0] = [str(Path(__file__).resolve().parents[k]) for k in (1, 2)]

MEMORY = 1 << 30
"""Address space beyond that of the imported modules, bytes."""
MOST_MEGABYTES = 400.0
"""Growth of the memory at most, also by inputs that are refused for want of memory."""
HANG = 10.0
"""Seconds of processor time for one input."""
SLICE = 15.0
"""Seconds of one process; the readers take turns."""


@dataclass
class Record:
    """Results of the inputs of one reader."""

    n_read: int = 0
    """Inputs that were read."""
    n_refused: int = 0
    """Inputs that were refused with an `ImuCalibrationError`."""
    findings: dict[str, tuple[str, bytes]] = field(default_factory=dict)
    """Place of the fault -> (traceback, input)."""
    megabytes: float = 0.0
    """Largest memory beyond that of the imported modules."""
    seconds: float = 0.0
    """Longest processor time of one input."""

    def add(self, other):
        """Add the inputs of another process."""
        self.n_read, self.n_refused = self.n_read + other.n_read, self.n_refused + other.n_refused
        self.findings = other.findings | self.findings
        self.megabytes, self.seconds = (
            max(self.megabytes, other.megabytes),
            max(self.seconds, other.seconds),
        )


def read_inputs(reader, seeds, seed, folder, *, goes_on, before=lambda data: None):
    """
    Read mutations of `seeds` while `goes_on(record)` holds; `before` is called with each input.

    Return the Record.
    """
    from imu_calibration.core.errors import ImuCalibrationError

    rng, record = random.Random(seed), Record()
    inputs = list(seeds)
    while inputs or goes_on(record):
        data = (
            inputs.pop()
            if inputs
            else reader.mutate(rng.choice(seeds), seeds, rng, *((True,) if reader.text else ()))
        )
        before(data)
        _one(reader, data, folder, record, ImuCalibrationError)
    return record


def _one(reader, data, folder, record, refusal):
    start = time.process_time()
    try:
        with warnings.catch_warnings(), contextlib.redirect_stderr(io.StringIO()):
            warnings.simplefilter('error')
            reader.read(data, folder)
        record.n_read += 1
    except refusal:
        record.n_refused += 1
    except Exception as error:
        frame = traceback.extract_tb(error.__traceback__)[-1]
        record.findings.setdefault(
            f'{type(error).__name__} in {Path(frame.filename).name}:{frame.lineno}',
            (traceback.format_exc(), data),
        )
    record.seconds = max(record.seconds, time.process_time() - start)


def _megabytes():
    """Return the largest memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def _child(pipe, name, seeds, seed, seconds):
    from fuzz.readers import READERS  # imported by the parent already

    used = _megabytes()
    size = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, size + MEMORY))
    resource.setrlimit(resource.RLIMIT_CPU, (int(seconds + 60), int(seconds + 61)))
    until = time.monotonic() + seconds
    reported = [time.monotonic()]

    def report(record):
        record.megabytes = _megabytes() - used
        if record.megabytes > MOST_MEGABYTES:
            found = f'{record.megabytes:.0f} MB by this input or one before', last.read_bytes()
            record.findings.setdefault('memory', found)
        pipe.send(record)

    def goes_on(record):
        if time.monotonic() - reported[0] > 0.5:
            reported[0] = time.monotonic()
            report(record)
        return time.monotonic() < until

    with TemporaryDirectory() as folder:
        last = Path(folder) / 'last'

        def before(data):
            last.write_bytes(data)
            # Whose signal ends the process, in library code too.
            signal.setitimer(signal.ITIMER_PROF, HANG)

        pipe.send(str(last))
        report(
            read_inputs(READERS[name], seeds, seed, Path(folder), goes_on=goes_on, before=before)
        )
    pipe.send(None)


def fuzz_slice(name, seeds, seed, seconds):
    """Read inputs in a process of its own for some seconds; return the Record."""
    # The parent has one thread and has imported the readers.
    context = multiprocessing.get_context('fork')
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(theirs, name, seeds, seed, seconds))
    process.start()
    theirs.close()
    record, last = Record(), None
    try:
        last = ours.recv()
        while ours.poll(seconds + 120) and (found := ours.recv()) is not None:
            record = found
        if process.is_alive():
            process.join(30)
    except EOFError:
        process.join()
        data = Path(last).read_bytes() if last and Path(last).exists() else b''
        record.findings[f'process ended by signal {-(process.exitcode or 0)}'] = (
            f'exit code {process.exitcode}: hang or too much memory',
            data,
        )
    if process.is_alive():
        data = Path(last).read_bytes() if last and Path(last).exists() else b''
        process.kill()
        record.findings['waits for ever'] = ('no answer', data)
    return record


def main():
    """Run, print a table, return 1 where there is a finding."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--minutes', type=float, default=10.0)
    parser.add_argument(
        '--seed', type=int, default=None, help='default: a new one, which is printed'
    )
    parser.add_argument('--only', default='', help='part of the name of a reader')
    parser.add_argument(
        '--output', type=Path, default=Path('out/fuzz'), help='folder for inputs with a finding'
    )
    options = parser.parse_args()
    from fuzz.readers import READERS

    seed = secrets.randbits(32) if options.seed is None else options.seed
    records = {name: Record() for name in READERS if options.only in name}
    seeds = {}
    for name in records:
        with TemporaryDirectory() as folder:
            seeds[name] = READERS[name].seeds(Path(folder))
    print(f'seed {seed}, {len(records)} readers, {options.minutes:g} minutes', flush=True)
    until, turn = time.monotonic() + 60.0 * options.minutes, 0
    seconds = min(SLICE, 60.0 * options.minutes / len(records))
    while turn == 0 or time.monotonic() < until:
        for name, record in records.items():
            if turn == 0 or time.monotonic() < until:
                record.add(fuzz_slice(name, seeds[name], f'{seed} {name} {turn}', seconds))
        turn += 1
    print(
        f'{"reader":24} {"inputs":>8} {"read":>8} {"refused":>8} {"findings":>8} {"MB":>6}'
        f' {"longest s":>9}'
    )
    for name, record in records.items():
        n_inputs = record.n_read + record.n_refused
        print(
            f'{name:24} {n_inputs:8d} {record.n_read:8d} {record.n_refused:8d}'
            f' {len(record.findings):8d} {record.megabytes:6.0f} {record.seconds:9.2f}'
        )
    print(f'{"all":24} {sum(record.n_read + record.n_refused for record in records.values()):8d}')
    for name, record in records.items():
        for place, (text, data) in record.findings.items():
            options.output.mkdir(parents=True, exist_ok=True)
            path = (
                options.output / f'{name.replace(" ", "_")}-{hashlib.sha256(data).hexdigest()[:12]}'
            )
            path.write_bytes(data)
            print(f'\n{name}: {place}\ninput: {path}\n{text}')
    return 1 if any(record.findings for record in records.values()) else 0


if __name__ == '__main__':
    sys.exit(main())
