"""What a calibration that goes on solves, keeps and tells, and what it takes where no table is the reference."""

from dataclasses import dataclass

from imu_calibration.settings import setting


@dataclass(frozen=True)
class LiveSettings:
    """How often to solve, and what is kept and told."""

    solve_share: float = setting(0.1, '1', 'largest share of the time that solving after each window may take', (0.001, 1.0),
                                 'too small: results come late; too large: the node takes a whole core', live=True)
    residual_rate: float = setting(20.0, 'Hz', 'residuals published per second of data, the others are left out; 0: none', (0.0, 10000.0),
                                   'too large: more time goes into publishing than into calibrating', live=True)
    store_samples: int = setting(300_000, '1', 'samples in motion kept, '
                                 'so that effects can join the model or be linearised anew (table tilt, delays); '
                                 'about 250 bytes each', (0, 100_000_000),
                                 'too small: what the motion demands cannot join the model, '
                                 'and the answer on a strongly tilted table is that of the first pass; diagnostics say so',
                                 fixed='windows that were not kept are gone')
    diagnosis_period: float = setting(60.0, 's', 'ask at most this often what the model gets wrong, in a thread of its own and a fifth '
                                      'of the time at most; also when the streams stop and with ~/solve and ~/save; '
                                      'what it demands joins the model; '
                                      '0: never', (0.0, 86400.0), 'too small: the diagnosis takes a core from other programs', live=True)


@dataclass(frozen=True)
class LiveByHandSettings:
    """What a calibration by hand keeps, and its reference."""

    gravity: float = setting(0.0, 'm/s^2', 'local gravity, used without a table; 0: the standard gravity, which may be off by 0.02',
                             (0.0, 30.0), 'all three accelerometer scales are wrong together',
                             live=True, session=True)
    hand_samples: int = setting(800_000, '1', 'Imu samples kept without a table, about 60 bytes each (800000: over an hour at 200 Hz); '
                                'beyond them the inside of the longest rest is forgotten, then the oldest', (2000, 100_000_000),
                                'too small: poses are forgotten, diagnostics say so', live=True)
