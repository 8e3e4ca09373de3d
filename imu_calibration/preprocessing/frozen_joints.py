"""
Joints whose states do not follow the table: they are frozen, or jump.

And gyroscopes that repeat one reading while the joints turn.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np

from imu_calibration.core.samples import runs_of, smallest_step
from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.checks import first_of, span_words
from imu_calibration.preprocessing.joint_geometry import (
    LARGEST_UNEXPLAINED,
    description_error,
    is_unexplained,
    turned_rates,
    unexplained_share,
)
from imu_calibration.preprocessing.on_table import a_period_late
from imu_calibration.preprocessing.recording_evidence import REFUSE, CheckFinding
from imu_calibration.preprocessing.scan import MIN_TURN_RATE
from imu_calibration.preprocessing.window import Window

LASTING = 1.0
"""Least duration of a standstill, s; shorter ones are handled by other checks."""
MAX_REPEATED_RATE = 1e-6
"""Largest rate of a joint with a repeated state after smoothing of the positions, rad/s."""
SAME_STATE = 1e-2
"""
Positions of a joint with a repeated state differ by at most this after smoothing, rad: a jump at
its end affects some seconds.
"""
FROZEN_SHARE = 0.8
"""Share of the unexplained rate that the motion of a frozen joint explains, as a mean square."""
SAME_GAIN = 0.05
"""Joints that explain the same but for this share are not told apart: their axes are parallel."""
LEAST_GAIN_ERROR = 0.3
"""
The unexplained rate along that axis is at least this share of the measured rate along it: a wrong
gain causes less.
"""
BESIDE_JUMP, BESIDE_STANDSTILL = 0.5, 5.0
"""
Seconds beside a jump of a joint's state, and beside a standstill that may end in one, in which the
rates of the joints are wrong.
"""
JUMP_FACTOR = 2.0
"""Rate by the joints over the largest rate of the IMU in the recording from which a state jumps."""
LONGEST_JUMP = 0.5
"""Time over which the smoothing of the positions spreads a jump, s; what lasts longer is none."""
RARE_SHARE = 0.02
"""Share of the samples of moving windows that jumps take at most."""
SATURATED_SAMPLES = 50
"""Equal largest readings of one axis above which they are an end of its range."""
OFTEN = 0.25
"""
Share of repeated readings of one axis from which the steps of a gyroscope are coarser than its
noise.
"""


@dataclass(frozen=True, eq=False)
class JointRest:
    """Mean rate of the IMU while all joints are constant."""

    start: float
    """First sample, s."""
    stop: float
    """Last sample, s."""
    count: int
    """Samples."""
    position: np.ndarray
    """Of the joints, rad or m, shape (j,)."""
    rate_s: np.ndarray
    """Mean rate in the sensor frame, rad/s, shape (3,)."""


def standing_still(
    windows: Sequence[Window], table: Table, *, rests: Sequence[JointRest] = ()
) -> CheckFinding | None:
    """
    Return the finding of a joint or gyroscope that is frozen for a second in motion, or None.

    A joint is frozen when its state is constant while the gyroscope measures a rate about its axis
    that the other joints do not explain. A delay between the clocks that explains more of the rates
    of all windows, or a wrong zero or axis in the table description that explains them, is reported
    instead. A gyroscope with steps coarser than its noise may repeat a reading while the reference
    rate stays within one step.

    Parameters
    ----------
    windows : sequence of Window
        Moving windows with their samples.
    table : Table
    rests : sequence of JointRest
        Windows in which no joint moves.

    """
    windows = _with_motion(windows)
    if not windows:
        return None
    # 1. A frozen gyroscope.
    expected = _expected_rates(windows, table)
    differences = [window.rate_s - rate for window, rate in zip(windows, expected)]
    bias = np.median(np.concatenate(differences), axis=0)
    spans = _repeating_spans(windows, expected, bias)
    if spans:
        return CheckFinding(
            'frozen',
            REFUSE,
            f'the gyroscope must measure all the time, it repeats one reading {span_words(spans)} '
            'while the joints turn; check the sensor and its driver, and exclude that time',
        )
    # 2. A frozen joint.
    unsaturated = _unsaturated(windows)
    windows = list(compress(windows, unsaturated))
    expected = list(compress(expected, unsaturated))
    if not windows:
        return None
    finding = _frozen_joint(windows, table, expected, bias=bias, rests=rests)
    if finding is not None:
        return finding
    # 3. An error of the table description without a frozen joint.
    return description_error(windows, table) if is_unexplained(windows, expected) else None


def _frozen_joint(
    windows: Sequence[Window],
    table: Table,
    expected: Sequence[np.ndarray],
    *,
    bias: np.ndarray,
    rests: Sequence[JointRest],
) -> CheckFinding | None:
    """
    Return the finding of a frozen joint, or of another cause that explains the same better.

    Parameters
    ----------
    windows, table, rests
        As for `standing_still`.
    expected : sequence of arrays, shape (n, 3)
        Rates by the joints in each window, rad/s.
    bias : array, shape (3,)
        Bias of the gyroscope, rad/s.

    """
    suspects = _suspects(windows, table, [rate + bias for rate in expected], rests)
    if not suspects:
        return None
    # An IMU that is turned against its mount measures the rates of other joints about the axis of
    # one at rest too.
    turned = turned_rates(windows, expected)
    if turned is not None:
        suspects = _suspects(windows, table, turned, rests)
    frozen = [joint for joint in suspects if joint.is_explained]

    # A delay or a wrong description explains the whole recording, a frozen joint all but the time
    # in which its state is constant.
    spans = [span for joint in frozen for span in joint.spans]
    outside = outside_of(windows, spans, margin=BESIDE_STANDSTILL)
    unexplained = unexplained_share(outside, table) if outside else 0.0
    least_share = 1.0 - unexplained if frozen and outside else 0.0
    other_cause = a_period_late(windows, table, least_share=least_share)
    other_cause = other_cause or description_error(windows, table)
    if other_cause or not frozen or unexplained > LARGEST_UNEXPLAINED:
        return other_cause

    best = frozen[0]
    names = [joint.name for joint in frozen if joint.gain > (1.0 - SAME_GAIN) * best.gain]
    return CheckFinding(
        'frozen',
        REFUSE,
        f'joint states must follow the table, {" or ".join(names)} is constant'
        f' {span_words(best.spans)} while the IMU turns about its axis; check the driver of the'
        ' table, and exclude that time',
    )


def _with_motion(windows: Sequence[Window]) -> list[Window]:
    """Return the windows with the motion of the joints at each of several samples."""
    return [window for window in windows if len(window) > 2 and len(window.motion) == len(window)]


@dataclass(frozen=True)
class Jump:
    """A jump of a joint's state."""

    name: str
    """The joint."""
    start: float
    """First sample of the fast motion, s."""
    stop: float
    """Last sample, s."""
    rate: float
    """Largest rate of the IMU by the joints in this time, rad/s."""
    fastest: float
    """Largest rate that the IMU measures in the recording, rad/s."""


def find_jumps(windows: Sequence[Window], table: Table) -> list[Jump]:
    """
    Return the jumps of the joint states in moving windows.

    In a jump the joints turn the IMU, for a short time, several times as fast as it ever turns in
    the recording. Where such rates are not rare, they have another cause.
    """
    windows = _with_motion(windows)
    if not windows:
        return []
    fastest = max(float(np.linalg.norm(window.rate_s, axis=1).max()) for window in windows)
    windows = list(compress(windows, _unsaturated(windows)))
    jumps = []
    n_fast = 0
    for window, expected in zip(windows, _expected_rates(windows, table)):
        rate = np.linalg.norm(expected, axis=1)
        for start, stop in runs_of(rate > JUMP_FACTOR * fastest):
            n_fast += stop - start
            first, last = float(window.time[start]), float(window.time[stop - 1])
            if last - first < LONGEST_JUMP:
                joint = int(np.argmax(np.abs(window.motion.rate[start:stop]).max(axis=0)))
                largest = float(rate[start:stop].max())
                jumps.append(Jump(table.joint_names[joint], first, last, largest, fastest))
    is_rare = n_fast < RARE_SHARE * sum(len(window) for window in windows)
    return jumps if is_rare else []


def jump_finding(jumps: Sequence[Jump]) -> CheckFinding:
    """Return the finding of jumps."""
    words = first_of([f'{jump.name} at {jump.start:.1f} s' for jump in jumps])
    by_joints = max(jump.rate for jump in jumps)
    return CheckFinding(
        'joint_jump',
        REFUSE,
        f'joint states must not jump, they do: {words} ({by_joints:.0f} rad/s by the joints, the'
        f' IMU measures {jumps[0].fastest:.1f} rad/s at most); check the driver of the table, and'
        ' exclude that time; if a zero has changed, use the time before or after it only',
    )


def outside_of(
    windows: Sequence[Window], spans: Sequence[tuple[float, float]], *, margin: float
) -> list[Window]:
    """Return the parts of moving windows that are more than `margin` away from all spans, s."""
    parts = []
    for window in windows:
        is_outside = np.ones(len(window), bool)
        for start, stop in spans:
            is_outside &= (window.time < start - margin) | (window.time > stop + margin)
        parts += [window.select(slice(start, stop)) for start, stop in runs_of(is_outside)]
    return parts


def _repeating_spans(
    windows: Sequence[Window], expected: Sequence[np.ndarray], bias: np.ndarray
) -> list[tuple[float, float]]:
    """
    Return (start, stop) in which the gyroscope repeats one reading while the joints turn, s.

    Not where the reading is the expected rate of the joints, rad/s, plus the bias, rounded to the
    steps of a coarse gyroscope.
    """
    is_repeated = [np.diff(window.rate_s, axis=0) == 0 for window in windows]
    # A gyroscope that often repeats readings is coarse, and has the smallest step between them.
    step = np.zeros(3)
    if np.concatenate(is_repeated).mean() > OFTEN:
        step = np.min([smallest_step(window.rate_s) for window in windows], axis=0)
        known = np.isfinite(step)  # an axis without motion has the steps of the other axes
        step = np.where(known, step, step[known].max(initial=0.0))
    spans = []
    for window, repeated, rate in zip(windows, is_repeated, expected):
        turns = np.linalg.norm(rate, axis=1) > MIN_TURN_RATE
        # Samples `start` to `stop` - 1 are equal to the sample after them.
        for start, stop in runs_of(np.append(repeated.all(axis=1), False)):
            first = float(window.time[start])
            last = float(window.time[stop - 1])
            if last - first < LASTING or turns[start:stop].mean() <= 0.5:
                continue
            if not _is_rounded(window.rate_s[start], rate[start:stop], bias, step):
                spans.append((first, last))
    return _joined(spans)


def _expected_rates(windows: Sequence[Window], table: Table) -> list[np.ndarray]:
    """Return the rates of the sensor by the joints in each window, rad/s, shape (n, 3)."""
    return [reference_motion(table, window.motion, attitude=False).rate_s for window in windows]


def _unsaturated(windows: Sequence[Window]) -> list[bool]:
    """
    Return for each window whether no rate in it is at an end of its range.

    The missing part of a saturated rate may lie along the axis of a joint that rests.
    """
    rates = np.concatenate([window.rate_s for window in windows])
    # Whether each reading is the smallest, or the largest, of its axis, shape (2, n, 3).
    ends = np.stack([rates.min(axis=0), rates.max(axis=0)])
    at_end = rates == ends[:, None]
    # Of noisy readings one is the largest; an end of the range is reached again and again.
    is_limit = at_end.sum(axis=1) > SATURATED_SAMPLES
    saturated = (at_end & is_limit[:, None]).any(axis=(0, 2))
    parts = np.split(saturated, np.cumsum([len(window) for window in windows])[:-1])
    return [not part.any() for part in parts]


@dataclass(frozen=True)
class _Standstill:
    """A time in which the state of a joint is constant and the IMU turns about its axis."""

    start: float
    """First sample, s."""
    stop: float
    """Last sample, s."""
    gain: float
    """Sum of squares of the rates that a motion of the joint explains, (rad/s)^2."""
    square: float
    """Sum of squares of the rates that its state does not explain, (rad/s)^2."""


@dataclass(frozen=True, eq=False)
class _Suspect:
    """A joint that may be frozen."""

    name: str
    """Its name."""
    spans: list[tuple[float, float]]
    """(start, stop) in which its state is constant, s."""
    standstills: list[_Standstill]
    """Parts of this time in which the IMU turns about its axis."""

    @property
    def gain(self) -> float:
        """`_Standstill.gain` of all."""
        return sum(standstill.gain for standstill in self.standstills)

    @property
    def is_explained(self) -> bool:
        """Whether a motion of the joint explains what its state does not."""
        return self.gain > FROZEN_SHARE * sum(each.square for each in self.standstills)


def _suspects(
    windows: Sequence[Window],
    table: Table,
    expected: Sequence[np.ndarray],
    rests: Sequence[JointRest],
) -> list[_Suspect]:
    """
    Return the joints that may be frozen, the one whose motion explains most of the rates first.

    `expected`: rates in each window, rad/s, shape (n, 3).
    """
    # The bias is the rate of the slowest rest.
    bias = min((rest.rate_s for rest in rests), key=np.linalg.norm, default=np.zeros(3))
    turning = [rest for rest in rests if np.linalg.norm(rest.rate_s - bias) > MIN_TURN_RATE]
    suspects = []
    for k, name in enumerate(table.joint_names):
        standstills: list[_Standstill] = []
        for window, rate in zip(windows, expected):
            standstills += _standstills(window, table, rate, joint=k)
        for rest in turning:
            standstills += _turn_at_rest(rest, table, rest.rate_s - bias, joint=k)
        if standstills:
            course = _JointCourse.of(windows, rests, joint=k)
            spans = _joined([course.while_constant(standstill) for standstill in standstills])
            suspects.append(_Suspect(name, spans, standstills))
    return sorted(suspects, key=lambda suspect: -suspect.gain)


@dataclass(frozen=True, eq=False)
class _JointCourse:
    """The state of a joint in moving windows and at rest, in the order of time."""

    time: np.ndarray
    """s, shape (n,)."""
    position: np.ndarray
    """rad, shape (n,)."""

    @classmethod
    def of(
        cls, windows: Sequence[Window], rests: Sequence[JointRest], *, joint: int
    ) -> '_JointCourse':
        """Return the state of a joint at the samples of windows, and at both ends of rests."""
        times = [window.time for window in windows]
        positions = [window.motion.position[:, joint] for window in windows]
        for rest in rests:
            times.append(np.array([rest.start, rest.stop]))
            positions.append(np.full(2, rest.position[joint]))
        time = np.concatenate(times)
        order = np.argsort(time, kind='stable')
        return cls(time[order], np.concatenate(positions)[order])

    def while_constant(self, standstill: _Standstill) -> tuple[float, float]:
        """
        Return from when to when the state is that in a standstill, s.

        Where a joint with a frozen state rests in another place, the rates of the others are wrong
        too.
        """
        is_within = (self.time >= standstill.start) & (self.time <= standstill.stop)
        is_same = np.abs(self.position - np.median(self.position[is_within])) < SAME_STATE
        for start, stop in runs_of(is_same):
            first, last = float(self.time[start]), float(self.time[stop - 1])
            if first <= standstill.stop and last >= standstill.start:
                return first, last
        return standstill.start, standstill.stop


def _standstills(
    window: Window, table: Table, expected: np.ndarray, *, joint: int
) -> Iterator[_Standstill]:
    """Yield the times in which a joint's state is constant while the IMU turns about its axis."""
    for start, stop in runs_of(np.abs(window.motion.rate[:, joint]) < MAX_REPEATED_RATE):
        if window.time[stop - 1] - window.time[start] < LASTING:
            continue
        # The axis of the joint in the sensor frame: change of the rates for 1 rad/s more.
        motion = window.motion.select(slice(start, stop))
        joint_rates = motion.rate.copy()
        joint_rates[:, joint] += 1.0
        faster = replace(motion, rate=joint_rates)
        axis = (
            reference_motion(table, faster, attitude=False).rate_s
            - reference_motion(table, motion, attitude=False).rate_s
        )
        # A late clock turns the rates of the other joints about this axis too: without the lag.
        residual = (window.rate_s - expected)[start:stop]
        slope = np.gradient(expected[start:stop], window.time[start:stop], axis=0)
        lag = (residual * slope).sum() / max((slope**2).sum(), 1e-300)
        residual = residual - lag * slope

        residual_along = (residual * axis).sum(axis=1)
        measured_along = (window.rate_s[start:stop] * axis).sum(axis=1)
        square_along = float(residual_along @ residual_along)
        square = float((residual**2).sum())
        carried = _carried_rates(table, motion, joint)
        left = _beyond_joint_motion(residual, carried, axis=axis, time=motion.time)
        gain = square - float((left**2).sum())
        if (
            square_along > len(residual_along) * MIN_TURN_RATE**2
            and max(gain, square_along) > FROZEN_SHARE * square
            and square_along > LEAST_GAIN_ERROR**2 * (measured_along @ measured_along)
        ):
            first, last = float(window.time[start]), float(window.time[stop - 1])
            yield _Standstill(first, last, gain, square)


def _turn_at_rest(
    rest: JointRest, table: Table, rate: np.ndarray, *, joint: int
) -> Iterator[_Standstill]:
    """Yield a rest in which the IMU turns about the axis of a joint at `rate`, rad/s, (3,)."""
    unit = np.zeros((1, len(rest.position)))
    unit[0, joint] = 1.0
    zero = np.zeros_like(unit)
    motion = JointMotion(np.zeros(1), rest.position[None], unit, zero, zero)
    axis = reference_motion(table, motion, attitude=False).rate_s[0]
    square_along = float(rate @ axis) ** 2
    square = float(rate @ rate)
    if square_along > FROZEN_SHARE * square:
        yield _Standstill(rest.start, rest.stop, rest.count * square_along, rest.count * square)


def _carried_rates(table: Table, motion: JointMotion, joint: int) -> np.ndarray:
    """Return the rates by the joints before a joint, which turn it too, rad/s, shape (n, 3)."""
    rates = motion.rate.copy()
    rates[:, joint:] = 0.0
    return reference_motion(table, replace(motion, rate=rates), attitude=False).rate_s


def _beyond_joint_motion(
    residual: np.ndarray, carried: np.ndarray, *, axis: np.ndarray, time: np.ndarray
) -> np.ndarray:
    """
    Return what no motion of a frozen joint explains of a residual, rad/s, shape (n, 3).

    The rate of the joint is that along its axis a. Since its state is constant it has turned by t,
    and with it the rates c of the joints before it, of which the state has the direction of t = 0::

        residual = (a . residual) a + exp(-[a x] t) c - c,    t = t_0 + integral (a . residual)

    The angle t_0 at the first sample is that of least squares.

    Parameters
    ----------
    residual : array, shape (n, 3)
        Measured less expected rates, rad/s.
    carried : array, shape (n, 3)
        Expected rates of the joints before this one, rad/s.
    axis : array, shape (n, 3)
        Its axis in the sensor frame, unit vectors.
    time : array, shape (n,)
        Seconds.

    """
    along = (residual * axis).sum(axis=1)
    turned = np.zeros(len(time))
    turned[1:] = np.cumsum(0.5 * (along[1:] + along[:-1]) * np.diff(time))
    cosine, sine = np.cos(turned)[:, None], np.sin(turned)[:, None]

    # The part of c across the axis, turned by the integral, and by a quarter of a turn more.
    across = carried - (carried * axis).sum(axis=1)[:, None] * axis
    normal = np.cross(axis, across)
    at_zero = cosine * across - sine * normal
    at_quarter = -sine * across - cosine * normal
    measured = residual - along[:, None] * axis + across
    t_0 = np.arctan2((measured * at_quarter).sum(), (measured * at_zero).sum())
    return measured - np.cos(t_0) * at_zero - np.sin(t_0) * at_quarter


def _is_rounded(
    reading: np.ndarray, expected: np.ndarray, bias: np.ndarray, step: np.ndarray
) -> bool:
    """
    Return whether one reading, (3,), is that of all expected rates, (n, 3), with a coarse step.

    The rates vary by at most one step per axis, (3,). The reading differs from rate plus bias by at
    most one step, and by the share of the rates that wrong gains and axes cause.
    """
    error = np.linalg.norm(reading - expected - bias, axis=1)
    allowed = np.linalg.norm(step) + LEAST_GAIN_ERROR * np.linalg.norm(expected, axis=1)
    return bool((np.ptp(expected, axis=0) <= step).all() and (error <= allowed).all())


def _joined(spans: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return spans in order, merged where the gap is below a second."""
    joined: list[tuple[float, float]] = []
    for start, stop in sorted(spans):
        if joined and start - joined[-1][1] < LASTING:
            joined[-1] = (joined[-1][0], max(stop, joined[-1][1]))
        else:
            joined.append((start, stop))
    return joined
