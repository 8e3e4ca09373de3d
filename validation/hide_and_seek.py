"""
Hide and seek: effects are hidden in sessions made by physics, and `diagnose` has to find them.

Run as ``python validation/hide_and_seek.py`` (or ``make hide-and-seek``): two hours of processor
time. Prints a confusion matrix and the figures, draws them into docs/, and lists the sessions of
which the record in the repository tells another thing. ``--seeds``, ``--minutes 20``, ``--pairs
100`` and ``--parts effects,none`` run less, and draw beside the record; what was run stands beside
every figure. Rows are written as they come, so that ``--from-record`` counts what there is of a run
that was stopped, or of several that ran apart. The exit code is 1 if a session could not be run.
"""

import argparse
import json
import signal
import sys
import time
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, ProcessPoolExecutor, wait
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / 'test')]

from tools.smallest import add_smallest  # noqa: E402
from validation.hide_and_seek_figures import write_figures  # noqa: E402
from validation.hide_and_seek_report import report  # noqa: E402

from worlds import hide_and_seek_record as record_kept  # noqa: E402
from worlds.hide_and_seek_worlds import GRADES, PARTS, failed, run, tasks_of  # noqa: E402

FIRST_SEED = 277000
"""
Seeds from here on were never used while the search was developed; those of earlier runs were 7000
on, 8000 to 8019.
"""


def main(arguments=None):
    """Run the tasks on some processes, keep a record, print and draw."""

    def names(text):
        return tuple(text.split(','))

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        '--seeds',
        type=int,
        default=1,
        help=(
            'times that every effect is hidden at each grade in white and in realistic noise; other'
            ' parts grow alike'
        ),
    )
    parser.add_argument('--first-seed', type=int, default=FIRST_SEED)
    parser.add_argument('--effects', help='names joined by commas; default all')
    parser.add_argument('--parts', default=PARTS, type=names)
    parser.add_argument('--grades', default=GRADES, type=names)
    parser.add_argument(
        '--noise',
        type=names,
        help=(
            'white, realistic and names of worlds.wanders, joined by commas; default white, and'
            ' realistic kinds dealt to the effects'
        ),
    )
    parser.add_argument('--pairs', type=int, help='so many pairs, drawn by chance; default all')
    parser.add_argument('--processes', type=int, default=2)
    parser.add_argument('--minutes', type=float, help='start nothing new after this time')
    parser.add_argument(
        '--record', type=Path, default=Path('out/hide_and_seek.jsonl'), help='one line per session'
    )
    parser.add_argument(
        '--docs',
        type=Path,
        help=(
            'where pictures and figures go; default docs/ for a run in full, else beside the record'
        ),
    )
    parser.add_argument(
        '--from-record', nargs='+', type=Path, help='only print and draw what these records hold'
    )
    parser.add_argument(
        '--keep', action='store_true', help='take the rows into the record of the repository'
    )
    add_smallest(
        parser,
        parts=('effects',),
        effects='gyro_g_sensitivity',
        grades=('tactical',),
        noise=('white',),
        processes=1,
    )
    options = parser.parse_args(arguments)
    is_partial = (
        options.from_record
        or options.effects
        or options.minutes
        or options.noise
        or options.pairs
        or set(options.parts) != set(PARTS)
        or len(options.grades) < len(GRADES)
    )
    docs = options.docs or (options.record.parent if is_partial else ROOT / 'docs')
    rows = []
    for path in options.from_record or ():
        rows += record_kept.read(path)
    if not options.from_record:
        rows = _work(tasks_of(options), options)
    report(rows, docs)
    write_figures(rows, docs)
    kept = record_kept.read()
    changed = record_kept.differences(rows, kept)
    print(
        f'\nbeside the record in the repository ({len(kept)} sessions), of {len(rows)} sessions'
        f' another thing is told of {len(changed)}',
        *changed,
        sep='\n  ',
    )
    if options.keep:
        record_kept.keep(rows)
    return int(any(row['part'] == 'failed' for row in rows))


def _work(tasks, options):
    """Return the rows of all tasks, or of those that were done when the run was stopped."""
    options.record.parent.mkdir(parents=True, exist_ok=True)
    rows = []
    n_done = 0
    waiting = list(tasks)
    running = {}  # future -> its task
    start = time.time()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    pool = ProcessPoolExecutor(options.processes)
    with options.record.open('w') as record_file:
        try:
            while waiting or running:
                # As many tasks as processes at a time, so that none begins after the last minute.
                in_time = options.minutes is None or time.time() - start < 60 * options.minutes
                while waiting and in_time and len(running) < options.processes:
                    task = waiting.pop(0)
                    running[pool.submit(run, task)] = task
                if not running:
                    break
                completed, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in completed:
                    task_rows = _result(future, running.pop(future))
                    n_done += 1
                    rows += task_rows
                    record_file.writelines(json.dumps(row) + '\n' for row in task_rows)
                    # After the death of a process the pool accepts no further task.
                    if isinstance(future.exception(), BrokenExecutor) and not running:
                        pool = ProcessPoolExecutor(options.processes)
                record_file.flush()
                minutes = (time.time() - start) / 60
                print(
                    f'\r{n_done}/{len(tasks)} tasks, {len(rows)} sessions, {minutes:.1f} min',
                    end='',
                    file=sys.stderr,
                    flush=True,
                )
        except KeyboardInterrupt:
            print('\nstopped: what is done is counted', end='', file=sys.stderr)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
    print(file=sys.stderr)
    return rows


def _result(future, task):
    """Return the rows of a task; a process that died with it, for lack of memory, is a row."""
    problem = future.exception()
    if problem is None:
        return future.result()
    return [failed(f'{task[0].__name__}{task[1][:2]}', problem)]


if __name__ == '__main__':
    sys.exit(main())
