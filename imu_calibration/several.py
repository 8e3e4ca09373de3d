"""Several recordings of one IMU: the map step, which can run anywhere, and the checks before its results are merged."""

from dataclasses import dataclass

from imu_calibration.errors import ImuCalibrationError, InputError
from imu_calibration.gathering import NominalScaling, gather, merge
from imu_calibration.sensor_model import SensorModel
from imu_calibration.settings import WindowSettings
from imu_calibration.turntable import Table


@dataclass(frozen=True)
class GatherStep:
    """The map step with its arguments bound, so that it can be sent to another process or machine."""

    table: Table
    """The reference."""
    model: SensorModel
    """Defines the columns."""
    windows: WindowSettings = WindowSettings()
    """How windows are found."""
    nominal: NominalScaling | None = None
    """For recordings in volts or counts."""
    names: tuple = ()
    """Names of the recordings for messages; with several of them an error names the one at fault."""
    progress: object = None
    """Called with the number of IMU samples read so far."""

    def __call__(self, numbered):
        """Return the Gathered of a recording, given (its number, callable that yields its blocks)."""
        session, source = numbered
        with_name = naming(self.names, session)
        return with_name(gather, source(), self.table, self.model, self.windows, self.nominal, session, progress=self.progress)


def naming(names, session):
    """Return a function that calls another one and, with several recordings, puts the recording's name before its error."""
    def call(function, *arguments, **options):
        try:
            return function(*arguments, **options)
        except ImuCalibrationError as error:
            if len(names) < 2:
                raise
            raise type(error)(f'{names[session]}: {error}') from error
    return call


def join(parts, names, check):
    """
    Return the merged Gathered of several recordings.

    Parameters
    ----------
    parts : list of Gathered
        One per recording, in order.
    names : sequence of str
        Names of the recordings.
    check : callable
        Called with each part; raises when it cannot be used.

    Raises
    ------
    InputError
        When a recording has no window, another frame than the first, or does not pass the check, with its name.

    """
    for session, part in enumerate(parts):
        naming(names, session)(check, part)
        if len(parts) > 1:
            part.findings = tuple(finding.named(names[session]) for finding in part.findings)
            _require_like_the_first(parts[0], part, names[0], names[session])
    return merge(parts)


def _require_like_the_first(first, part, first_name, name):
    if not part.accumulator.rows:
        raise InputError(f'{name}: every recording must hold a static window, spin or dynamic stretch, this one has none; leave it out')
    if part.frame_id != first.frame_id:
        raise InputError(f"{name}: all recordings must come from one IMU, the frame is '{part.frame_id}' here and '{first.frame_id}' in {first_name}; "
                         'calibrate different IMUs one by one')
