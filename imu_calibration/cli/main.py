"""Entry of the command line, with bars of progress."""

import contextlib
import io
import json
import os
import sys
import threading
import time
from argparse import Namespace
from collections.abc import Mapping, Sequence
from typing import Any, TextIO, cast

SHARE_BAR = '{desc} {percentage:3.0f}% |{bar:40}| {elapsed}'
"""Line of progress with a known total."""
RUNNING_BAR = '{desc} |{bar:40}| {elapsed}'
"""Line of progress with an unknown total."""
SWEEP = 10
"""Steps of the bar of an unknown total."""
SWEEP_STEP_SECONDS = 0.2
"""Seconds per step."""


class ProgressBars:
    """
    A listener of `imu_calibration.core.progress` that shows the present phase as a bar.

    The bar is removed before other text; it moves between reports too.
    """

    def __init__(self, *, verbose: bool = False) -> None:
        self._verbose = verbose
        # Ends the thread that moves the bar.
        self._ended = threading.Event()
        # The tqdm bar, made at the first report on a terminal.
        self._bar: Any = None
        # Present phase, and the time of its beginning, s.
        self._phase = ''
        self._since = time.monotonic()
        # Whether the bar is not on the screen at present.
        self._removed = False

    def __enter__(self) -> 'ProgressBars':
        """Replace the standard streams by `BarFreeStream`."""
        self._streams = sys.stdout, sys.stderr
        sys.stdout = cast(TextIO, BarFreeStream(sys.stdout, self))
        sys.stderr = cast(TextIO, BarFreeStream(sys.stderr, self))
        return self

    def __exit__(self, *exception: object) -> None:
        """End the phase, and restore the streams."""
        self._begin_phase('')
        self._ended.set()
        sys.stdout, sys.stderr = self._streams
        if self._bar is not None:
            self._refresher.join()
            self._bar.close()

    def remove(self) -> None:
        """Remove the bar until the next report."""
        if self._bar is not None and not self._removed:
            with self._bar.get_lock():
                self._removed = True
                self._bar.clear(nolock=True)

    def __call__(self, phase: str, done: float, total: float) -> None:
        """Show the amount done of a phase."""
        is_new = phase != self._phase
        if is_new:
            self._begin_phase(phase)
        if not self._streams[1].isatty():
            return
        # One bar for all phases, which a thread draws.
        if self._bar is None:
            from tqdm import tqdm

            self._bar = tqdm(
                total=SWEEP,
                bar_format=RUNNING_BAR,
                leave=False,
                dynamic_ncols=True,
                file=self._streams[1],
            )
            self._refresher = threading.Thread(target=self._refresh, name='progress', daemon=True)
            self._refresher.start()
        self._bar.total = total or SWEEP
        self._bar.bar_format = SHARE_BAR if total else RUNNING_BAR
        self._removed = False
        if is_new:
            self._bar.set_description_str(phase, refresh=False)
            self._bar.reset()
        if total:
            self._bar.n = min(done, total)

    def _refresh(self) -> None:
        """Draw the bar again and again, in a thread; one of unknown total sweeps."""
        while not self._ended.wait(SWEEP_STEP_SECONDS):
            if self._bar.bar_format == RUNNING_BAR:
                self._bar.n = (self._bar.n + 1) % (SWEEP + 1)
            with self._bar.get_lock():
                if not self._removed:
                    self._bar.refresh(nolock=True)

    def _begin_phase(self, phase: str) -> None:
        """Begin a phase, '' for none; with --verbose print the time of the last one."""
        if self._verbose and self._phase:
            print(f'{self._phase}: {time.monotonic() - self._since:.1f} s', file=sys.stderr)
        self._phase = phase
        self._since = time.monotonic()


class BarFreeStream:
    """A stream that removes the bar of progress before each text."""

    def __init__(self, stream: TextIO, bars: ProgressBars) -> None:
        self._stream = stream
        self._bars = bars

    def __getattr__(self, name: str) -> Any:
        """Return any other attribute of the stream."""
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Remove the bar and write."""
        self._bars.remove()
        return self._stream.write(text)


os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
"""
The matrices are narrow: several BLAS threads cost more than they save, above all next to other
programs.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb; return the exit code (see `parser.EXIT_CODES`)."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    try:
        from imu_calibration.cli.parser import make_parser

        options = make_parser(*arguments[:1]).parse_args(arguments)
    except KeyboardInterrupt:
        return _interrupted('imu_calibration')
    return run(options)


def run(options: Namespace) -> int:
    """
    Run the verb that was parsed and print its document if --json is given; return the exit code.
    """
    from imu_calibration.cli.parser import complain
    from imu_calibration.core.errors import ImuCalibrationError, printable
    from imu_calibration.core.progress import listening, reading_remarks

    prog = f'imu_calibration {options.verb}'
    reasons = ()
    try:
        with contextlib.ExitStack() as stack:
            if options.json or options.quiet:  # the lines of the verb are not shown
                stack.enter_context(contextlib.redirect_stdout(io.StringIO()))
            if not options.quiet:
                bars = stack.enter_context(ProgressBars(verbose=options.verbose))
                stack.enter_context(listening(bars))
                stack.enter_context(reading_remarks(complain))
            code, document, reasons = options.run(options)
    except BrokenPipeError:
        sys.stdout = None  # a later flush would fail again
        return 1
    except (ImuCalibrationError, OSError, MemoryError, RecursionError) as error:
        if isinstance(error, ImuCalibrationError):
            text = error.with_hint(options.hints())
            key = error.key
            error_code = error.code
        else:
            text = printable(
                f'{type(error).__name__}: {error}; check disk space, memory, permissions and'
                ' the input'
            )
            key = None
            error_code = ''
        complain(f'{prog}: {text}')
        code = 1
        document = {'error': text, 'key': key, 'code': error_code}
    except KeyboardInterrupt:
        return _interrupted(prog)
    if options.quiet:
        for reason in reasons:
            complain(f'{prog}: exit code {code}: {printable(reason)}')
    if options.json:
        print(json_text(options.verb, code, document, reasons=reasons))
    return code


def _interrupted(prog: str) -> int:
    """Print that the command was interrupted; return its exit code."""
    print(f'{prog}: interrupted; no file was written', file=sys.stderr)
    return 130


CLI_FORMAT = 'imu_calibration/cli/1'


def json_text(
    verb: str, exit_code: int, document: Mapping[str, Any], *, reasons: Sequence[str] = ()
) -> str:
    """
    Return one JSON document: format, verb, exit code, its reasons, and the result or the error.

    Numbers that are not finite become null.
    """
    from imu_calibration.core.documents import json_types

    part = 'error' if 'error' in document else 'result'
    content = {'format': CLI_FORMAT, 'verb': verb, 'exit_code': exit_code}
    if reasons:
        content['reasons'] = list(reasons)
    return json.dumps({**content, part: json_types(document)}, allow_nan=False)
