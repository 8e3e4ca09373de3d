"""
Entry of the command line, also as ``python -m imu_calibration VERB``.

An interruption ends it with 130 from here on.
"""

import gc
import signal
import sys
from types import FrameType

NUMERICAL = ('numpy', 'scipy')
RETRY_SECONDS, MOST_RETRIES = 0.02, 100
"""
A postponed interruption is tried again after this time; in numerical packages at most so often.
"""

UNCOLLECTED = 50_000
"""New containers after which unused ones are sought."""


class Interruption:
    """
    Handler of signals: raises KeyboardInterrupt as soon as the running code passes it on.

    It is postponed within an import, where numpy reports a broken installation instead, and, at
    most `MOST_RETRIES` times, within numpy and scipy, where finalizers and compiled functions print
    the exception and continue.
    """

    def __init__(self) -> None:
        self._left = MOST_RETRIES

    def __call__(self, _number: int, frame: FrameType | None) -> None:
        """Raise now or later."""
        is_importing = is_numerical = False  # by the running function and all its callers
        while frame is not None:
            is_importing |= frame.f_code.co_filename.startswith('<frozen importlib')
            is_numerical |= frame.f_globals.get('__name__', '').partition('.')[0] in NUMERICAL
            frame = frame.f_back
        if is_numerical:
            self._left -= 1
        if is_importing or (is_numerical and self._left >= 0):
            signal.setitimer(signal.ITIMER_REAL, RETRY_SECONDS)
        else:
            # A second one ends the process at once, without a traceback.
            signal.signal(signal.SIGINT, signal.SIG_DFL)
            raise KeyboardInterrupt


def main() -> int:
    """
    Run the command line; return its exit code.

    Partial results are removed after SIGTERM as after Ctrl+C.
    """
    handler = Interruption()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM):
        if signal.getsignal(number) != signal.SIG_IGN:  # a background job ignores SIGINT
            signal.signal(number, handler)
    # Modules stay: to look for unused objects while they are imported is 4 % of an inspection.
    gc.set_threshold(UNCOLLECTED)
    try:
        from imu_calibration.cli.main import main as run_verb

        return run_verb()
    except KeyboardInterrupt:
        print('imu_calibration: interrupted; no file was written', file=sys.stderr)
        return 130
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGINT, signal.SIG_DFL)


if __name__ == '__main__':
    raise SystemExit(main())
