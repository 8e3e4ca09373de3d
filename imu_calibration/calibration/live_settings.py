"""Settings of a live calibration: solving, storage and published data, and the reference without a table."""

from dataclasses import dataclass, replace

from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.reference.earth import local_gravity
from imu_calibration.settings import setting


@dataclass(frozen=True)
class LiveSettings:
    """Solving interval, storage and published data."""

    solve_share: float = setting(0.1, '1', 'largest share of the time for solving after each window', (0.001, 1.0),
                                 'too small: late results; too large: the node uses a whole core', live=True)
    residual_rate: float = setting(20.0, 'Hz', 'residuals published per second of data; 0: none', (0.0, 10000.0),
                                   'too large: publishing needs more time than calibration', live=True)
    store_samples: int = setting(300_000, '1', 'samples in motion kept, '
                                 'so that effects can be added to the model or linearised again (table tilt, delays); '
                                 'about 250 bytes each', (0, 100_000_000),
                                 'too small: effects that the data support cannot be added to the model, '
                                 'and the result on a strongly tilted table is that of the first pass, see diagnostics',
                                 fixed='windows that were not kept are lost')
    diagnosis_period: float = setting(60.0, 's', 'shortest time between diagnoses, in a separate thread with a fifth '
                                      'of the time at most; also when the streams stop and with ~/solve and ~/save; '
                                      'supported effects are added to the model; '
                                      '0: never', (0.0, 86400.0), 'too small: the diagnosis occupies a core', live=True)


@dataclass(frozen=True)
class LiveByHandSettings:
    """Reference and memory of a calibration by hand."""

    gravity: float = setting(0.0, 'm/s^2', 'local gravity, used without a table; 0: the standard gravity, which may be off by 0.02',
                             (0.0, 30.0), 'all three accelerometer scales are wrong together',
                             live=True, session=True)
    latitude: float = setting(100.0, 'deg', 'latitude, used without a table if gravity is 0 (WGS 84 normal gravity); above 90: unknown',
                              (-90.0, 100.0), 'as with a wrong gravity', live=True, session=True)
    height: float = setting(0.0, 'm', 'height above the ellipsoid, used with latitude', (-500.0, 9000.0), '3e-6 m/s^2 of gravity per metre',
                            live=True, session=True)
    hand_samples: int = setting(800_000, '1', 'Imu samples kept without a table, about 60 bytes each (800000: over an hour at 200 Hz); '
                                'beyond them the inside of the longest rest is forgotten, then the oldest', (2000, 100_000_000),
                                'too small: poses are dropped, see diagnostics', live=True)

    def at_place(self, options: CalibrationOptions) -> CalibrationOptions:
        """Return the options with the gravity of these settings and its standard deviation."""
        place = () if self.gravity or self.latitude > 90 else (self.latitude, self.height)
        gravity, spread = local_gravity(self.gravity or None, *place)
        return replace(options, gravity=gravity, gravity_sd=spread)
