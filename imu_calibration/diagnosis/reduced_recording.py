"""The recording reduced to means and products of columns per window: all that candidates, folds and resamples need."""

from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.columns import INPUT_OF, warped_reference
from imu_calibration.effects.forward_equations import coefficients
from imu_calibration.effects.regressors import GROUPS
from imu_calibration.estimation.window_statistics import batch_statistics, piece_length, slow_part
from imu_calibration.reference.joint_motion import JointMotion
from imu_calibration.reference.reference_motion import lever_matrix

CHUNK = 16384
"""Samples whose columns are held at once."""
MOTION = ('time', 'position', 'rate', 'acceleration', 'jerk')


@dataclass(frozen=True, eq=False)
class Lifted:
    """Rows ``[columns | residual]`` of all windows, reduced."""

    model: object
    """SensorModel with every effect that is asked about, linearised at its point."""
    values: np.ndarray
    """Parameters that the residual belongs to."""
    constants: np.ndarray
    """Time constants of the bank of warm-ups; their columns come last, shape (n_constants,)."""
    kind: np.ndarray
    """Kind of each window, shape (k,)."""
    time: np.ndarray
    """Middle of each window, s, shape (k,)."""
    count: np.ndarray
    """Samples of each window, shape (k,)."""
    duration: np.ndarray
    """Length of each window, s, shape (k,)."""
    session: np.ndarray
    """Recording of each window, shape (k,)."""
    mean: dict
    """Sensor -> mean rows, shape (k, p + 3)."""
    gram: dict
    """Sensor -> products of the centred rows, shape (k, p + 3, p + 3); zero for static windows."""
    slow: dict
    """Sensor -> the part of these products that the means of short pieces make (`bands`), shape (k, p + 3, p + 3)."""
    slow_rows: np.ndarray
    """Short pieces of each window, shape (k,)."""
    noise: dict
    """Sensor -> (variance about the mean, inflation) of static windows, each (k, 3), NaN elsewhere."""
    describe: dict
    """Window means of what a residual may depend on: 'time', 'temperature', joint angles, rates; each (k,)."""


def own_groups(model, sensor):
    """Return the column groups of the diagnosis: a warp's change of the lever-arm terms is folded into its change of the input."""
    return [(name, width) for name, width in model.groups(sensor) if not name.startswith('warp_lever:')]


def own_rows(model, sensor):
    """Return the mask of the model's columns that are columns of the diagnosis."""
    return np.concatenate([np.full(width, not name.startswith('warp_lever:')) for name, width in model.groups(sensor)])


def own_coefficients(model, sensor, values):
    """Return the coefficients of the columns of the diagnosis, shape (n_columns, 3)."""
    return coefficients(model, sensor, values)[own_rows(model, sensor)]


def lift(windows, table, model, values, constants, progress=None):
    """
    Reduce windows to `Lifted` for a model and its values.

    Parameters
    ----------
    windows : sequence of Window
        Static, spin and dynamic windows.
    constants : array, shape (n_constants,)
        Time constants of the bank of warm-up columns.
    progress : callable, optional
        Called with the share that is done, in [0, 1].

    """
    means, grams, slows = {s: [] for s in SENSORS}, {s: [] for s in SENSORS}, {s: [] for s in SENSORS}
    noise = {s: [] for s in SENSORS}
    describe = []
    coefficient = {s: own_coefficients(model, s, values) for s in SENSORS}
    done = 0
    for part in _pieces(windows):
        blocks = _columns(part, table, model, constants, mean_arm(model, values))
        edges = np.cumsum([0] + [len(w.motion) for w in part])
        for index, window in enumerate(part):
            rows = slice(edges[index], edges[index + 1])
            for sensor in SENSORS:
                design = blocks[sensor][rows]
                output = window.force_s if sensor == 'accelerometer' else window.rate_s
                p = len(coefficient[sensor])
                residual = output - design[:, :p] @ coefficient[sensor]
                mean, gram, slow, spread = _reduce(piece_length(window), design, residual)
                slows[sensor].append(slow)
                means[sensor].append(mean)
                grams[sensor].append(gram)
                noise[sensor].append(spread)
            describe.append(_describe(window))
        done += len(part)
        if progress:
            progress(done / len(windows))
    fields = {name: np.array([d[name] for d in describe]) for name in describe[0]}
    return Lifted(model, values, np.asarray(constants), np.array([w.kind for w in windows]), fields['time'],
                  np.array([len(w.time) for w in windows], float), np.array([w.time[-1] - w.time[0] for w in windows]),
                  np.zeros(len(windows), int),
                  {s: np.array(means[s]) for s in SENSORS}, {s: np.array(grams[s]) for s in SENSORS}, {s: np.array(slows[s]) for s in SENSORS},
                  np.array([len(w.time) // n if (n := piece_length(w)) > 1 else 0 for w in windows]),
                  {s: (np.array([n[0] for n in noise[s]]), np.array([n[1] for n in noise[s]])) for s in SENSORS}, fields)


def rebased(lifted, values):
    """Return the same recording with the residual of other `values`; the columns stay where they were taken."""
    mean, gram, slow = {}, {}, {}
    for sensor in SENSORS:
        change = own_coefficients(lifted.model, sensor, values) - own_coefficients(lifted.model, sensor, lifted.values)
        join = np.eye(lifted.mean[sensor].shape[1])
        join[:len(change), -3:] -= change
        mean[sensor] = lifted.mean[sensor] @ join
        gram[sensor], slow[sensor] = (join.T @ part[sensor] @ join for part in (lifted.gram, lifted.slow))
    return replace(lifted, values=values, mean=mean, gram=gram, slow=slow)


def _pieces(windows):
    part, size = [], 0
    for window in windows:
        part.append(window)
        size += len(window.motion)
        if size > CHUNK:
            yield part
            part, size = [], 0
    if part:
        yield part


def _reduce(length, design, residual):
    unknown = np.full(3, np.nan)
    if length == 0:
        p = design.shape[1] + 3
        return np.concatenate([design.mean(axis=0), residual.mean(axis=0)]), np.zeros((p, p)), np.zeros((p, p)), batch_statistics(residual)
    rows = np.concatenate([design, residual], axis=1)
    mean = rows.mean(axis=0)
    rows = rows - mean
    pieces = slow_part(rows, length)
    return mean, rows.T @ rows, pieces.T @ pieces, (unknown, unknown)


def _describe(window):
    motion = window.motion
    found = {'time': float(window.time.mean()), 'specific force': float(np.linalg.norm(window.force_s.mean(axis=0))),
             'temperature': np.nan if window.temperature_c is None else float(window.temperature_c.mean()),
             'rate': float(np.sqrt((motion.rate**2).sum(axis=1).mean()))}
    for joint in range(motion.position.shape[1]):
        found[f'angle{joint}'] = float(motion.position[:, joint].mean())
        found[f'span{joint}'] = float(np.ptp(motion.position[:, joint]))
    return found


def joined_motion(windows):
    """Return the motion of all windows in one piece, and the temperatures (window means where static), or None."""
    motion = JointMotion(*(np.concatenate([getattr(w.motion, name) for w in windows]) for name in MOTION))
    if any(w.temperature_c is None for w in windows):
        return motion, None
    return motion, np.concatenate([[w.temperature_c.mean()] if w.kind == 'static' else w.temperature_c for w in windows])


def mean_arm(model, values):
    """Return the mean lever arm of the accelerometers, or None when there are none."""
    arms = np.zeros(3)
    for name in ('lever_arm', 'accel_size_effect'):
        if ('accelerometer', name) in model.slices:
            arms = arms + values[model.slices['accelerometer', name]].reshape(-1, 3).mean(axis=0)
    return arms if np.any(arms) else None


def _columns(windows, table, model, constants, arm):
    """Return sensor -> ``[columns of the model | bank of warm-ups]`` of windows in one piece."""
    motion, temperature = joined_motion(windows)
    bank = -np.expm1(-motion.time[:, None] / np.asarray(constants)[None, :])
    references = _References(model, table, motion, temperature, arm)
    blocks = {}
    for sensor in SENSORS:
        ref, point = references.at(sensor), model.full_point()
        warps = {'warp:' + e.name: e for e in model.concerning(sensor) if e.warp is not None}
        parts = [references.derivative(sensor, warps[name]) if name in warps else GROUPS[name](ref, point)
                 for name, _ in own_groups(model, sensor)]
        blocks[sensor] = np.concatenate(parts + [bank], axis=1)
    return blocks


class _References:
    """Motions with the warps of a model, each computed once for both sensors where both feel the same."""

    def __init__(self, model, table, motion, temperature_c, arm):
        self.arm = arm
        self.model, self.table, self.motion, self.temperature_c = model, table, motion, temperature_c
        self._known = {}

    def at(self, sensor, effect=None, values=None):
        """Return the reference of `sensor`, with other values for one effect."""
        key = (self._branch(sensor), effect, None if values is None else tuple(values))
        if key not in self._known:
            change = None if effect is None else {effect: values}
            self._known[key] = warped_reference(self.model, sensor, self.table, self.motion, self.temperature_c, change)
        return self._known[key]

    def _branch(self, sensor):
        """Return a key that is the same for sensors that feel the same motion (neither has a lag of its own)."""
        own = [e for e in self.model.concerning(sensor) if e.warp is not None and e.sensor == sensor and np.any(self.model.warp_point(e))]
        return tuple(e.name for e in own)

    def _input(self, sensor, ref):
        true = getattr(ref, INPUT_OF[sensor])
        return true if self.arm is None or sensor == 'gyroscope' else true + lever_matrix(ref.rate_s, ref.alpha_s) @ self.arm

    def derivative(self, sensor, effect):
        """Return d(true input)/d(parameter) by forward differences, shape (n, 3 size); a lag of zero is a delay to first order."""
        at = self.model.warp_point(effect)
        if effect.derivative is not None:
            return effect.derivative(self.at(sensor))
        if effect.sensor == sensor and not np.any(at):
            clock = next((e for e in self.model.effects if e.name == 'time_offset'), None)
            if clock is not None:
                return self.derivative(sensor, clock)
        parts, base = [], self._input(sensor, self.at(sensor))
        for index in range(effect.size):
            moved = at.copy()
            moved[index] += effect.step
            parts.append((self._input(sensor, self.at(sensor, effect.name, moved)) - base) / effect.step)
        if effect.sensor in SENSORS:
            self._known = {key: ref for key, ref in self._known.items() if key[1] is None}
        return np.concatenate(parts, axis=1)
