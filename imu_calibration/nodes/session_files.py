"""Files of a live session: the calibration, and the accumulator from which the session can be resumed."""

import os
import time
from collections.abc import Callable
from pathlib import Path

from imu_calibration.calibration.live import LiveCalibration
from imu_calibration.calibration.live_poses import LiveByHand
from imu_calibration.core.errors import ImuCalibrationError, shortened
from imu_calibration.document import files

DEFAULT_FILE = 'calibration.yaml'
LiveSession = LiveCalibration | LiveByHand
"""A calibration during the motion, on a table or by hand."""


class SessionFiles:
    """
    The two files of a session; each is written atomically, independently of the other.

    Parameters
    ----------
    save_file : str
        Path of the calibration; '': `DEFAULT_FILE` in the working directory, and files are saved on request only.

    """

    def __init__(self, save_file: str):
        self.given = bool(save_file)
        self.calibration = files.user_path(save_file or DEFAULT_FILE)
        self.saved_at, self.n_saved = time.monotonic(), 0
        for path in (self.calibration, self.accumulator):
            files.remove_leftovers(path)

    @property
    def accumulator(self) -> Path:
        """Path of the accumulator."""
        return self.calibration.with_name(self.calibration.stem + '.accumulator.npz')

    def try_place(self) -> str:
        """Return the reason why saving is impossible here, '' when it is possible."""
        try:
            for path in (self.calibration, self.accumulator):
                files.try_place(path)
        except ImuCalibrationError as error:
            return f'saving failed: {error}'
        return ''

    def earlier(self) -> bytes | None:
        """
        Return the accumulator that an earlier session left, or None.

        Raises
        ------
        InputError
            When there is one that cannot be read.

        """
        return files.read_bytes(self.accumulator, 'accumulator') if os.path.isfile(self.accumulator) else None

    def put_aside(self) -> Path:
        """
        Rename the accumulator of an earlier session, so that it is not overwritten; return the new name.

        Raises
        ------
        InputError
            When that cannot be done.

        """
        return files.put_aside(self.accumulator)

    def unsaved(self, live: LiveSession) -> int:
        """Return how many windows or poses of a session are in no file yet."""
        return max(live.n_windows - self.n_saved, 0)

    def note_saved(self, n_windows: int) -> None:
        """Record the number of saved windows or poses."""
        self.saved_at, self.n_saved = time.monotonic(), n_windows

    def save(self, live: LiveSession, text: str | None) -> tuple[bool, str]:
        """
        Save both files; return whether both are saved, and the outcome for each.

        Parameters
        ----------
        live : LiveSession
        text : str or None
            The calibration; None: only the accumulator is saved.

        """
        wanted: list[tuple[Path, Callable[[], bytes]]] = [] if text is None else [(self.calibration, text.encode)]
        done, failed = [], []
        for path, make in [*wanted, (self.accumulator, lambda: live.saved(pending=True))]:
            existed = os.path.exists(path)   # False where the path cannot even be
            try:
                files.write_whole(path, make())
                done.append(str(path))
            except ImuCalibrationError as error:
                failed.append(f'{error}; {"the earlier file is unchanged" if existed else "no earlier file existed"}')
        if not failed:
            self.note_saved(live.n_windows)
        lines = [f'written: {" and ".join(done)}'] * bool(done) + [f'not written: {line}' for line in failed]
        return not failed, '; '.join(lines)

    def autosave(self, live: LiveSession, period: float) -> bool:
        """Save the accumulator when that is due; return whether it was. Raises an InputError when it cannot be written."""
        if not period or time.monotonic() - self.saved_at < period or not self.unsaved(live):
            return False
        self.saved_at, n_windows = time.monotonic(), live.n_windows   # not again at once when it fails
        files.write_whole(self.accumulator, live.saved(pending=False), to_disk=False)
        self.note_saved(n_windows)
        return True

    def keep(self, live: LiveSession, noun: str) -> str:
        """Save unsaved data at the end of a session where a path was given; return the outcome, '' when all was saved."""
        unsaved = self.unsaved(live)
        if not unsaved:
            return ''
        ends = f'{unsaved} {noun} were in no file'
        if not self.given:
            return f"{ends} and are lost: call ~/save, or give parameter 'save_file' and they are kept"
        try:
            files.write_whole(self.accumulator, live.saved(pending=True))
        except Exception as error:   # the process ends in any case
            return f'{ends} and are lost: {shortened(str(error), 300)}'
        return f'{ends}: they are kept in {self.accumulator}; resume:=true continues with them'
