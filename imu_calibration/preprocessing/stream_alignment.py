"""
Alignment of streams, chunk by chunk of a fixed grid in time.

Position and phase of the joints at the IMU's stamps.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from imu_calibration.core.samples import (
    AlignedArrays,
    ImuSamples,
    JointSamples,
    TemperatureSamples,
    runs_of,
)
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.signal_history import (
    BandVariance,
    TemperatureSlope,
    ThermalBranch,
)
from imu_calibration.preprocessing import window_cutter
from imu_calibration.preprocessing.rest_detection import (
    QUIETNESS_REACH,
    QuietFloor,
    quiet_beside_joints,
)
from imu_calibration.preprocessing.stream_cleaning import NEVER_NS, DropCounts
from imu_calibration.preprocessing.window import PhasedSamples, WindowSettings
from imu_calibration.preprocessing.window_cutter import LEAST_READINGS, LOST, STILL, JointRun


class SampleBuffer:
    """Samples of one stream in the order of their stamps; joins its blocks only when read."""

    def __init__(self) -> None:
        self.newest_ns: int | None = None
        """Largest stamp of all samples that were added; None before the first."""
        # Not empty, in order; joined to one when they are read.
        self._blocks: list[Any] = []

    def __len__(self) -> int:
        return sum(len(block) for block in self._blocks)

    def add(self, samples: ImuSamples | JointSamples | TemperatureSamples) -> None:
        """Append samples; all stamps must exceed the buffered ones."""
        if len(samples):
            self.newest_ns = int(samples.stamp_ns[-1])
            self._blocks.append(samples)

    def between(self, first_ns: int, stop_ns: int) -> Any:
        """Return the samples with stamps in [first, stop), or None when the buffer is empty."""
        samples = self._joined()
        if samples is None:
            return None
        return samples.select(slice(*np.searchsorted(samples.stamp_ns, [first_ns, stop_ns])))

    def first_from(self, stamp_ns: int) -> int | None:
        """Return the first stamp that is not before `stamp_ns`, or None."""
        samples = self._joined()
        if samples is None:
            return None
        place = np.searchsorted(samples.stamp_ns, stamp_ns)
        return int(samples.stamp_ns[place]) if place < len(samples) else None

    def forget_before(self, stamp_ns: int, keep_one: bool = False) -> None:
        """Drop samples before `stamp_ns`; with `keep_one` not the last one of them."""
        while len(self._blocks) > 1 and self._blocks[1].stamp_ns[0] < stamp_ns:
            del self._blocks[0]
        if self._blocks and self._blocks[0].stamp_ns[0] < stamp_ns:
            block = self._blocks[0]
            n_dropped = int(np.searchsorted(block.stamp_ns, stamp_ns))
            if keep_one:
                n_dropped -= 1
            if n_dropped > 0:
                kept = block.select(slice(n_dropped, None))
                # A slice would keep the complete block in memory.
                self._blocks[:1] = [type(kept).concatenate([kept])] if len(kept) else []

    def _joined(self) -> Any:
        """Return all buffered samples; None when there are none."""
        if len(self._blocks) > 1:
            self._blocks = [type(self._blocks[0]).concatenate(self._blocks)]
        return self._blocks[0] if self._blocks else None


JOINT_WAIT = 60.0
"""
The IMU or the joints may be ahead of each other by this much before missing samples are skipped, s.
"""
TEMPERATURE_WAIT = 5.0
"""Largest delay of the temperature relative to the IMU, s."""
_LEAST_MARGIN = max(window_cutter.PHASE_REACH, QUIETNESS_REACH) + 0.4


@dataclass(frozen=True, eq=False)
class _JointsAtImu(AlignedArrays):
    """The joints at the stamps of the IMU."""

    phase: np.ndarray
    """STILL, STEADY, MOVING, or LOST where there are no readings of the joints, shape (n,)."""
    level: np.ndarray
    """Positions averaged over 0.2 s, rad, shape (n, n_joints)."""
    step: np.ndarray
    """Steps of the encoders, rad, zero where none are visible, shape (n, n_joints)."""


class MotionChunks:
    """
    One epoch of the clock: converts samples to `PhasedSamples`, in order.

    Chunk k holds the IMU samples of `chunk` seconds from ``start + k * chunk`` on; `start` is the
    first IMU sample. The result depends on samples within the chunk and a margin only, and a chunk
    is processed when all streams have passed its margin (or are given up), so the division of the
    streams into blocks has no effect. The waiting times bound the memory.

    Parameters
    ----------
    settings : WindowSettings
    noise_rad : float or None
        Known noise of the encoders, rad.
    floors : tuple of QuietFloor
        Noise of the accelerometer and the gyroscope at rest, of all epochs.

    """

    def __init__(
        self,
        settings: WindowSettings,
        noise_rad: float | None,
        floors: tuple[QuietFloor, QuietFloor],
    ):
        self.counts = DropCounts()
        """Reason -> number of IMU samples dropped here."""
        self.time_origin = 0.0
        """Session time at the first IMU sample of this epoch, s."""
        self.margin = max(settings.overlap, _LEAST_MARGIN)
        """Samples up to this distance from a chunk have an influence on it, s."""
        self._settings = settings
        self._noise_rad = noise_rad
        self._floors = floors
        self._chunk_ns = _ns(settings.chunk)
        self._margin_ns = _ns(self.margin)

        # Streams, and quantities that are computed from all their samples in order.
        self._imu = SampleBuffer()
        self._joints = SampleBuffer()
        self._temperature = SampleBuffer()
        self._branch = ThermalBranch()
        self._slope = TemperatureSlope()
        self._vibration = BandVariance()

        # Stamps of the first samples, None before they are added. Chunks exist after the first IMU
        # sample only.
        self._start_ns: int | None = None
        self._first_joint_ns: int | None = None
        # Number of the next chunk.
        self._chunk = 0
        # Of the last IMU sample of the chunk before: its stamp, and whether its joints are unknown.
        self._previous_ns: int | None = None
        self._previous_is_lost = False

    @property
    def short_rest(self) -> float:
        """Rests up to this length have a curve of the joints at all their samples, s."""
        return min(self._settings.settling + self._settings.static_minimum, self.margin)

    def change(self, settings: WindowSettings) -> None:
        """
        Use other settings from the next chunk on.

        The length of the chunks and their margin are unchanged.
        """
        self._settings = settings

    @property
    def n_buffered(self) -> int:
        """Number of buffered samples of all streams."""
        return sum(len(buffer) for buffer in (self._imu, self._joints, self._temperature))

    @property
    def end_time(self) -> float:
        """Session time at the newest IMU sample, s."""
        if self._imu.newest_ns is None or self._start_ns is None:
            return self.time_origin
        return self.time_origin + (self._imu.newest_ns - self._start_ns) / 1e9

    def add(
        self,
        imu: ImuSamples | None = None,
        joints: JointSamples | None = None,
        temperature: TemperatureSamples | None = None,
    ) -> None:
        """Add cleaned samples, each stream in the order of its stamps."""
        if imu is not None and len(imu):
            if self._start_ns is None:
                self._start_ns = int(imu.stamp_ns[0])
            n_late = self._n_late(imu, 0)
            self.counts.add('late IMU sample', n_late)
            self._imu.add(imu.select(slice(n_late, None)))
        if joints is not None and len(joints):
            if self._first_joint_ns is None:
                self._first_joint_ns = int(joints.stamp_ns[0])
            n_late = self._n_late(joints, self._margin_ns)
            self._joints.add(joints.select(slice(n_late, None)))
        if temperature is not None and len(temperature):
            self._temperature.add(
                replace(
                    temperature,
                    branch=self._branch.of(temperature.temperature_c),
                    rate=self._slope.of(temperature.stamp_ns, temperature.temperature_c),
                )
            )

    def take(self, final: bool = False) -> Iterator[PhasedSamples]:
        """
        Yield the chunks that can be processed (all with `final`) as `PhasedSamples`.

        Without samples that have no joints.
        """
        if self._start_ns is not None:
            passed_ns = np.inf if final else self._passed_ns()
            while self._chunk_is_complete(passed_ns) and self._advance(passed_ns, final):
                chunk = self._process_chunk(self._next_start_ns(), final)
                self._chunk += 1
                if chunk is not None:
                    yield chunk
        self._drop_old_samples()

    def remaining_joints(self) -> JointSamples | None:
        """Return the buffered joint samples, or None."""
        return self._joints.between(-NEVER_NS, NEVER_NS)

    def _next_start_ns(self) -> int:
        """Return the stamp at which the next chunk starts, once an IMU sample has been added."""
        assert self._start_ns is not None
        return self._start_ns + self._chunk * self._chunk_ns

    def _passed_ns(self) -> int:
        """Return the stamp that all streams have passed or will never pass."""
        imu_ns, joints_ns, temperature_ns = (
            -NEVER_NS if buffer.newest_ns is None else buffer.newest_ns
            for buffer in (self._imu, self._joints, self._temperature)
        )
        # A stream that is behind another one by more than its waiting time is not waited for.
        joint_wait_ns = _ns(JOINT_WAIT)
        imu_passed_ns = max(imu_ns, joints_ns - joint_wait_ns)
        joints_passed_ns = max(joints_ns, imu_ns - joint_wait_ns)
        temperature_passed_ns = max(temperature_ns, imu_passed_ns - _ns(TEMPERATURE_WAIT))
        return min(imu_passed_ns, joints_passed_ns, temperature_passed_ns)

    def _chunk_is_complete(self, passed_ns: float) -> bool:
        """Return whether the streams have passed the next chunk and its margin."""
        return self._next_start_ns() + self._chunk_ns + self._margin_ns <= passed_ns

    def _advance(self, passed_ns: float, final: bool) -> bool:
        """
        Advance to the next chunk with IMU samples, and return whether it is complete.

        False as well if there is no such chunk yet.
        """
        assert self._start_ns is not None
        oldest_ns = self._imu.first_from(self._next_start_ns())
        if oldest_ns is None:
            if not final:
                # IMU samples of these chunks would be late.
                n_passed = int((passed_ns - self._margin_ns - self._start_ns) // self._chunk_ns)
                self._chunk = max(self._chunk, n_passed)
            return False
        self._chunk = (oldest_ns - self._start_ns) // self._chunk_ns
        return self._chunk_is_complete(passed_ns)

    def _n_late(self, samples: ImuSamples | JointSamples, margin_ns: int) -> int:
        """Return the number of samples before the next chunk and its margin: their chunks exist."""
        if self._start_ns is None or self._chunk == 0:
            return 0
        return int(np.searchsorted(samples.stamp_ns, self._next_start_ns() - margin_ns))

    def _drop_old_samples(self) -> None:
        """
        Drop the samples that no later chunk needs.

        Before the first IMU sample, those before the newest joints by more than the waiting time,
        or without joints before the newest temperature. One older temperature is kept, because
        temperatures are interpolated.
        """
        if self._start_ns is not None:
            oldest_ns = self._next_start_ns() - self._margin_ns
        elif self._joints.newest_ns is not None:
            oldest_ns = self._joints.newest_ns - _ns(JOINT_WAIT)
        else:
            oldest_ns = (self._temperature.newest_ns or 0) - _ns(JOINT_WAIT)
        self._imu.forget_before(oldest_ns)
        self._joints.forget_before(oldest_ns)
        self._temperature.forget_before(oldest_ns, keep_one=True)

    def _process_chunk(self, start_ns: int, final: bool) -> PhasedSamples | None:
        """Return the chunk from `start_ns` on, or None when no sample in it can be used."""
        first_ns = start_ns - self._margin_ns
        stop_ns = start_ns + self._chunk_ns
        last_ns = stop_ns + self._margin_ns

        # 1. Phases and quietness of the samples of the chunk and its margins.
        imu = self._imu.between(first_ns, last_ns)
        time = self._seconds(imu.stamp_ns)
        period = float(np.median(np.diff(time))) if len(time) > 1 else self._settings.gap / 5
        longest_step = max(self._settings.gap, 5 * period)
        runs = self._joint_runs(first_ns, last_ns, longest_step)
        joints = self._joints_at(time, runs, final)
        quiet = quiet_beside_joints(
            imu.force_s,
            imu.rate_s,
            period,
            ratio=self._settings.quiet_ratio,
            longest=self._settings.static_minimum,
            floors=self._floors,
            resting=joints.phase == STILL,
        )

        # 2. From here on samples of the chunk only.
        core = slice(*np.searchsorted(imu.stamp_ns, [start_ns, stop_ns]))
        imu = imu.select(core)
        joints = joints.select(core)
        time = time[core]
        is_lost = joints.phase == LOST
        # The sample before the first one is the last of the chunk before.
        after_loss = np.append(self._previous_is_lost, is_lost[:-1])
        after_gap = self._after_gaps(imu.stamp_ns, longest_step) | after_loss
        self._previous_ns = int(imu.stamp_ns[-1])
        self._previous_is_lost = bool(is_lost[-1])

        # 3. Motion of the joints, and what effects need of the temperature and the vibration.
        temperature = self._temperature_at(imu.stamp_ns, last_ns)
        position, joint_rate, acceleration, jerk = self._joint_derivatives(
            joints.level, time, joints.phase, runs
        )
        motion = JointMotion(
            time + self.time_origin,
            position,
            joint_rate,
            acceleration,
            jerk,
            thermal_branch=temperature.branch,
            vibration=self._vibration.of(period, imu.force_s),
            temperature_rate=temperature.rate,
        )
        samples = PhasedSamples(
            stamp_ns=imu.stamp_ns,
            force_s=imu.force_s,
            rate_s=imu.rate_s,
            motion=motion,
            temperature_c=temperature.temperature_c,
            phase=joints.phase,
            quiet=quiet[core],
            after_gap=after_gap,
            after_loss=after_loss,
            joint_step=joints.step,
            corrected=imu.corrected,
            absent=imu.absent,
        )

        # 4. Samples without joints are dropped and counted.
        if not is_lost.any():
            return samples
        is_edge = self._at_edge(imu.stamp_ns, longest_step, final)
        self.counts.add('no joint state', np.count_nonzero(is_lost & ~is_edge))
        self.counts.add('edge of joints', np.count_nonzero(is_lost & is_edge))
        return None if is_lost.all() else samples.select(~is_lost)

    def _seconds(self, stamp_ns: np.ndarray) -> np.ndarray:
        """Return times since the first IMU sample of this epoch, s."""
        assert self._start_ns is not None
        return (stamp_ns - self._start_ns) / 1e9

    def _joint_runs(self, first_ns: int, last_ns: int, longest_step: float) -> list[JointRun]:
        """
        Return joint readings between two stamps as stretches without gaps.

        A gap is longer than `longest_step`, s, and than three periods of the joints.
        """
        joints = self._joints.between(first_ns, last_ns)
        if joints is None or not len(joints):
            return []
        time = self._seconds(joints.stamp_ns)
        step = np.diff(time)
        if len(step):
            longest_step = max(longest_step, 3 * float(np.median(step)))
        runs = []
        for start, stop in runs_of(np.ones(len(time)), step > longest_step):
            if stop - start >= LEAST_READINGS:
                runs.append(
                    JointRun(
                        time[start:stop],
                        joints.position[start:stop],
                        joints.velocity[start:stop],
                        settings=self._settings,
                        noise_rad=self._noise_rad,
                    )
                )
        return runs

    def _joints_at(self, time: np.ndarray, runs: list[JointRun], final: bool) -> _JointsAtImu:
        """Return the joints at the times of IMU samples, s, from readings without gaps."""
        phase = np.full(len(time), LOST, np.int8)
        level = np.zeros((len(time), runs[0].position.shape[1] if runs else 1))
        step = np.zeros(level.shape)
        assert self._start_ns is not None
        # Joints at rest are known for a while before their first reading and after the last one.
        for k, run in enumerate(runs):
            is_first = (
                self._first_joint_ns is not None
                and run.time[0] <= (self._first_joint_ns - self._start_ns) / 1e9
            )
            is_last = final and k == len(runs) - 1
            inside = run.covered(time, before=is_first, after=is_last)
            phase[inside], level[inside] = run.at(time[inside])
            step[inside] = run.step
        return _JointsAtImu(phase, level, step)

    def _joint_derivatives(
        self, level: np.ndarray, time: np.ndarray, phase: np.ndarray, runs: list[JointRun]
    ) -> np.ndarray:
        """
        Return position, rate, acceleration and jerk of the joints, shape (4, n, n_joints).

        Those of a smooth curve near moving joints, elsewhere `level` and zeros.
        """
        derivatives = np.zeros((4,) + level.shape)
        derivatives[0] = level
        for run in runs:
            near = np.flatnonzero((phase != LOST) & run.near_motion(time, self.short_rest))
            if not len(near):
                continue
            # One curve for each motion; motions at a distance above two overlaps are independent.
            is_apart = np.diff(time[near]) > 2 * self._settings.overlap
            for part in np.split(near, np.flatnonzero(is_apart) + 1):
                stretch = slice(part[0], part[-1] + 1)
                curve = run.curve(time[stretch], self._settings.overlap, self._noise_rad)
                derivatives[0, stretch] = curve.position
                derivatives[1, stretch] = curve.rate
                derivatives[2, stretch] = curve.acceleration
                derivatives[3, stretch] = curve.jerk
        return derivatives

    def _after_gaps(self, stamp_ns: np.ndarray, longest_step: float) -> np.ndarray:
        """Return where the step before a sample is longer than `longest_step` s, shape (n,)."""
        # A gap precedes the first sample of the epoch.
        before_ns = stamp_ns[0] - (1 << 40) if self._previous_ns is None else self._previous_ns
        return np.diff(stamp_ns, prepend=before_ns) > _ns(longest_step)

    def _temperature_at(self, stamp_ns: np.ndarray, last_ns: int) -> TemperatureSamples:
        """
        Return temperature, thermal branch and slope at the stamps, NaN where there are none.

        They are interpolated between the readings up to `last_ns`.
        """
        readings = self._temperature.between(-NEVER_NS, last_ns)
        if readings is None or not len(readings):
            unknown = np.full((3, len(stamp_ns)), np.nan)
            return TemperatureSamples(stamp_ns, *unknown)
        time = self._seconds(stamp_ns)
        reading_time = self._seconds(readings.stamp_ns)
        return TemperatureSamples(
            stamp_ns,
            np.interp(time, reading_time, readings.temperature_c),
            np.interp(time, reading_time, readings.branch),
            np.interp(time, reading_time, readings.rate),
        )

    def _at_edge(self, stamp_ns: np.ndarray, longest_step: float, final: bool) -> np.ndarray:
        """
        Return a mask of the samples close before the first joint state or after the last one.

        At most `longest_step` s from it: there no joint state is missing.
        """
        if self._first_joint_ns is None:
            return np.zeros(len(stamp_ns), bool)
        reach_ns = _ns(longest_step)
        edge = (stamp_ns < self._first_joint_ns) & (stamp_ns >= self._first_joint_ns - reach_ns)
        last_joint_ns = self._joints.newest_ns
        if final and last_joint_ns is not None:
            edge |= (stamp_ns > last_joint_ns) & (stamp_ns <= last_joint_ns + reach_ns)
        return edge


def _ns(seconds: float) -> int:
    """Return a time in whole ns."""
    return int(round(seconds * 1e9))
