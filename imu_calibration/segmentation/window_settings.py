"""Settings of the segmentation."""

from dataclasses import dataclass

from imu_calibration.settings import setting


@dataclass(frozen=True)
class WindowSettings:
    """Settings for static windows, constant-rate spins and dynamic stretches."""

    static_rate: float = setting(0.002, 'rad/s', 'joints slower than this, and the IMU quiet, count as at rest', (0.0, 1.0),
                                 'too small: no static windows; too large: slow creep enters the means', live=True)
    quiet_ratio: float = setting(3.0, '1', 'at rest the IMU may scatter by this factor more than where it is quietest', (1.2, 100.0),
                                 'too small: no static windows; too large: knocks and vibration enter the means', live=True)
    settling: float = setting(0.5, 's', 'kept out after a joint stops and after a ramp ends', (0.0, 60.0),
                              'too small: ringing of the table shows as between-window variance', live=True)
    turn_on: float = setting(0.0, 's', 'kept out at the start of a recording', (0.0, 3600.0),
                             'too small: the turn-on transient shows as bias drift', fixed='the session has begun')
    static_minimum: float = setting(1.0, 's', 'shortest static window', (0.05, 600.0), 'too large: short poses are lost', live=True)
    window_maximum: float = setting(20.0, 's', 'longer windows are cut, which bounds memory', (1.0, 600.0),
                                    'too large: bias wander inside a window; too small: windows no longer independent', live=True)
    spin_rate_variation: float = setting(0.01, '1', 'largest relative change of each joint rate in a constant-rate spin', (0.0, 0.5),
                                         'too small: spins are treated as dynamic stretches', live=True)
    spin_minimum: float = setting(1.0, 's', 'shortest constant-rate spin', (0.05, 600.0), live=True)
    dynamic_minimum: float = setting(0.3, 's', 'shortest dynamic stretch', (0.05, 600.0), live=True)
    gap: float = setting(0.1, 's', 'a longer hole in either stream ends a window; also never below five IMU periods', (0.001, 60.0),
                         'too small: every lost message cuts a window', live=True)
    chunk: float = setting(20.0, 's', 'the joints are smoothed in pieces of this length', (2.0, 600.0),
                           fixed='the pieces count from the first sample on')
    overlap: float = setting(2.0, 's', 'margin on both sides of a piece, so that its ends do not show', (0.2, 60.0),
                             fixed='the pieces count from the first sample on')
