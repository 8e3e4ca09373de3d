"""Every adjustable number, declared once: YAML files, options and ROS parameters are made from here."""

from dataclasses import dataclass, field, fields, replace

from imu_calibration.errors import InputError


def setting(default, unit, text, bounds=(None, None), symptom=''):
    """Declare one field of a settings dataclass: default, unit, meaning, bounds, and what a wrong value looks like."""
    return field(default=default, metadata={'unit': unit, 'text': text, 'bounds': bounds, 'symptom': symptom})


def describe(group):
    """Return (name, default, unit, text, bounds, symptom) for each field of a settings class or instance."""
    return [(f.name, f.default, *(f.metadata[key] for key in ('unit', 'text', 'bounds', 'symptom'))) for f in fields(group)]


def override(group, values):
    """
    Return a copy of the settings `group` with `values` (name -> value) set.

    Raises
    ------
    InputError
        When a name is unknown, a type does not fit or a value is out of bounds.

    """
    known = {f.name: f for f in fields(group)}
    checked = {}
    for name, value in values.items():
        if name not in known:
            raise InputError(f"setting '{name}' is unknown; the settings here are {', '.join(sorted(known))}")
        checked[name] = _checked(known[name], value)
    return replace(group, **checked)


def _checked(declared, value):
    default, (low, high) = declared.default, declared.metadata['bounds']
    if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if default is not None and not isinstance(value, type(default)):
        raise InputError(f"setting '{declared.name}' must be {type(default).__name__}, got {value!r}; correct it")
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        if (low is not None and value < low) or (high is not None and value > high):
            raise InputError(f"setting '{declared.name}' must lie in [{low}, {high}], got {value!r}; choose a value inside")
    return value


@dataclass(frozen=True)
class WindowSettings:
    """How static windows, constant-rate spins and dynamic stretches are found."""

    static_rate: float = setting(0.002, 'rad/s', 'joints slower than this, and the IMU quiet, count as at rest', (0.0, 1.0),
                                 'too small: no static windows; too large: slow creep enters the means')
    quiet_ratio: float = setting(3.0, '1', 'at rest the IMU may scatter by this factor more than where it is quietest', (1.2, 100.0),
                                 'too small: no static windows; too large: knocks and vibration enter the means')
    settling: float = setting(0.5, 's', 'kept out after a joint stops and after a ramp ends', (0.0, 60.0),
                              'too small: ringing of the table shows as between-window variance')
    turn_on: float = setting(0.0, 's', 'kept out at the start of a recording', (0.0, 3600.0),
                             'too small: the turn-on transient shows as bias drift')
    static_minimum: float = setting(1.0, 's', 'shortest static window', (0.05, 600.0), 'too large: short poses are lost')
    window_maximum: float = setting(20.0, 's', 'longer windows are cut, which bounds memory', (1.0, 600.0),
                                    'too large: bias wander inside a window; too small: windows no longer independent')
    spin_rate_variation: float = setting(0.01, '1', 'largest relative change of each joint rate in a constant-rate spin', (0.0, 0.5),
                                         'too small: spins are treated as dynamic stretches')
    spin_minimum: float = setting(1.0, 's', 'shortest constant-rate spin', (0.05, 600.0), '')
    dynamic_minimum: float = setting(0.3, 's', 'shortest dynamic stretch', (0.05, 600.0), '')
    gap: float = setting(0.1, 's', 'a longer hole in either stream ends a window; also never below five IMU periods', (0.001, 60.0),
                         'too small: every lost message cuts a window')
    chunk: float = setting(20.0, 's', 'the joints are smoothed in pieces of this length', (2.0, 600.0), '')
    overlap: float = setting(2.0, 's', 'margin on both sides of a piece, so that its ends do not show', (0.2, 60.0), '')


@dataclass(frozen=True)
class JointSettings:
    """How the joints' motion is drawn from their readings."""

    robustness: float = setting(0.7, '1', 'guard against rough fits when the smoothing is chosen; 1 is plain cross-validation', (0.05, 1.0),
                                'too large: rough accelerations now and then; too small: sharp ramps are rounded')
    velocity_scale: float = setting(2e-3, '1', 'joint velocities are used when their scale agrees with the positions to this', (0.0, 0.1),
                                    'too large: filtered velocities bend the reference')
    velocity_lag: float = setting(2e-4, 's', 'joint velocities are used when their lag behind the positions stays below this', (0.0, 0.1),
                                  'too large: late velocities look like a time offset of the IMU')
